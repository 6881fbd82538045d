"""The state of the spline estimators: the curves, and the variables of their control points and poses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.graph.keys import CONTROL_LETTERS, control_keys
from pathspace_graph.graph.variables import Variables
from pathspace_graph.spline.boundary import Boundary
from pathspace_graph.spline.bspline import BSpline

from .curves import Curves, lay_out_curves

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


class State:
    """Holds the boundaries and the variables: control points (m) and poses (m, m, rad), map frame."""

    def __init__(self, variables: Variables | None = None) -> None:
        self.variables = variables or Variables()
        """The control points, the calibration and the poses are stored here by key."""
        self.boundaries: dict[int, Boundary] = {}
        """The curves are sorted by label, as their control points are."""
        self.active_stretch: dict[int, IntArray] = {}
        """A boundary that is partly inactive has its active control points (k,) here: one stretch in driving
        order, by index from the boundary's first control point."""
        self.pose_u: dict[int, Array] = {}
        """(P,) Each pose has its foot point at this parameter of each boundary; the parameter increases from
        lap to lap."""
        self._curves: Curves | None = None

    def copy(self) -> State:
        """Returns a state whose boundaries, values and pose parameters can change independently."""
        other = State(self.variables.copy())
        other.boundaries, other.pose_u = dict(self.boundaries), dict(self.pose_u)
        return other

    # --- by key ------------------------------------------------------------------------------------------

    def keys(self, label: int) -> IntArray:
        """Returns the keys (m,) of a boundary's control points."""
        return control_keys(label, self.boundaries[label].numbers)

    @property
    def map_keys(self) -> IntArray:
        """Returns the keys (m,) of all boundaries' control points, in the order of `map_points`."""
        return np.concatenate([np.zeros(0, np.intp), *(self.keys(label) for label in self.boundaries)])

    @property
    def map_points(self) -> Array:
        """Returns a view of all boundaries' control points (m, 2) in m, map frame."""
        layout, (left, right) = self.variables.layout, CONTROL_LETTERS
        both = slice(layout.block(left).start, layout.block(right).stop)
        return self.variables.values[both].reshape(-1, 2)

    def control_points(self, label: int) -> Array:
        """Returns a view of a boundary's control points (m, 2) in m, map frame."""
        return self.variables.block(CONTROL_LETTERS[label]).reshape(-1, 2)

    @property
    def poses(self) -> Array:
        """Returns a view of the poses (P, 3), the oldest first."""
        return self.variables.poses

    @property
    def calibration(self) -> Array:
        """Returns a view of the calibration: (scale error [-], yaw-rate bias [rad/s])."""
        return self.variables.calibration

    # --- the curves --------------------------------------------------------------------------------------

    def active(self, label: int) -> IntArray:
        """Returns the indices (k,) of a boundary's active control points, in driving order."""
        return self.active_stretch.get(label, self.boundaries[label].everything)

    @property
    def whole(self) -> bool:
        """Returns whether every control point is active."""
        return not self.active_stretch

    @property
    def closed(self) -> bool:
        """Returns whether a curve is closed; both are closed together."""
        return any(boundary.periodic for boundary in self.boundaries.values())

    def spline(self, label: int) -> BSpline:
        """Returns a boundary as a spline of its own, which later changes of the state leave alone."""
        return self.boundaries[label].spline(self.control_points(label).copy())

    @property
    def splines(self) -> dict[int, BSpline]:
        """Returns all boundaries as splines of their own, by label."""
        return {label: self.spline(label) for label in self.boundaries}

    @property
    def curves(self) -> Curves:
        """Returns the boundaries, at least one, side by side; the result is cached."""
        known = self._curves
        if known is None or not known.is_current(self.boundaries, self.active):
            active = {label: self.active(label) for label in self.boundaries}
            known = self._curves = lay_out_curves(self.boundaries, active)
        return known

    def add_boundary(self, label: int, boundary: Boundary, control_points: Array) -> None:
        """Adds a boundary with control points (m, 2)."""
        self.boundaries = dict(sorted({**self.boundaries, label: boundary}.items()))
        self.variables.insert(self.keys(label), control_points.ravel())

    def extend(self, label: int, points: Array) -> None:
        """Adds the variables of control points (k, 2) by which a boundary has grown; they are active."""
        size, count = self.boundaries[label].size, len(points)
        self.variables.insert(self.keys(label)[size - count :], points.ravel())
        if label in self.active_stretch:
            self.active_stretch[label] = np.append(self.active_stretch[label], np.arange(size - count, size))

    def replace_boundary(self, label: int, boundary: Boundary, control_points: Array) -> None:
        """Replaces a boundary by another one with control points (m, 2)."""
        self.variables.remove(self.keys(label))
        self.add_boundary(label, boundary, control_points)

    def drop_oldest_pose_u(self) -> None:
        """Removes the parameters of the oldest pose, which has left the window."""
        self.pose_u = {label: u[1:] for label, u in self.pose_u.items()}
