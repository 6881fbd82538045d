"""What is estimated of a track: the curves, and the variables that are their control points and the poses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.graph.keys import CONTROL_LETTERS, control_keys
from pathspace_graph.graph.variables import Variables
from pathspace_graph.spline.boundary import Boundary

from .curves import Curves, side_by_side

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


class State:
    """The boundaries beside their variables: control points (m) and poses (m, m, rad) in the map frame."""

    def __init__(self, variables: Variables | None = None) -> None:
        self.variables = variables or Variables()
        """Control points, calibration and poses by key."""
        self.boundaries: dict[int, Boundary] = {}
        """The curves by label, in the order of their control points."""
        self.narrowed: dict[int, IntArray] = {}
        """Where not all of a boundary's control points are active, those (k,) that are: one stretch, in
        driving order, counted from the boundary's first."""
        self.pose_u: dict[int, Array] = {}
        """For each boundary the parameter (P,) of each pose's foot point on it; not wrapped."""
        self._curves: Curves | None = None

    def copy(self) -> State:
        """The same curves, which may be replaced, with values and stations of their own."""
        other = State(self.variables.copy())
        other.boundaries, other.pose_u = dict(self.boundaries), dict(self.pose_u)
        return other

    # --- by key ------------------------------------------------------------------------------------------

    def keys(self, label: int) -> IntArray:
        """(m,) keys of a boundary's control points."""
        return control_keys(label, self.boundaries[label].numbers)

    @property
    def map_keys(self) -> IntArray:
        """(m,) keys of the control points of all boundaries, as `map_points` has them."""
        return np.concatenate([np.zeros(0, np.intp), *(self.keys(label) for label in self.boundaries)])

    @property
    def map_points(self) -> Array:
        """Control points (m, 2) of all boundaries, m, map frame: a view."""
        layout, (left, right) = self.variables.layout, CONTROL_LETTERS
        both = slice(layout.block(left).start, layout.block(right).stop)
        return self.variables.values[both].reshape(-1, 2)

    def control_points(self, label: int) -> Array:
        """Control points (m, 2) of a boundary, m, map frame: a view."""
        return self.variables.block(CONTROL_LETTERS[label]).reshape(-1, 2)

    @property
    def poses(self) -> Array:
        """Poses (P, 3) of the window, oldest first: a view."""
        return self.variables.poses

    @property
    def calibration(self) -> Array:
        """(scale error [-], yaw-rate bias [rad/s]): a view."""
        return self.variables.calibration

    # --- the curves --------------------------------------------------------------------------------------

    def active(self, label: int) -> IntArray:
        """(k,) a boundary's control points that are solved for, in driving order."""
        return self.narrowed.get(label, self.boundaries[label].everything)

    @property
    def whole(self) -> bool:
        """Whether every control point is active."""
        return not self.narrowed

    @property
    def curves(self) -> Curves:
        """The boundaries, at least one, side by side; kept for next time."""
        known = self._curves
        if known is None or not known.are(self.boundaries, self.active):
            active = {label: self.active(label) for label in self.boundaries}
            known = self._curves = side_by_side(self.boundaries, active)
        return known

    def add_boundary(self, label: int, boundary: Boundary, control_points: Array) -> None:
        """Take up a boundary with control points (m, 2)."""
        self.boundaries = dict(sorted({**self.boundaries, label: boundary}.items()))
        self.variables.insert(self.keys(label), control_points.ravel())

    def extend(self, label: int, points: Array) -> None:
        """New control points (k, 2) at a boundary's end, which has grown by as many; they are active."""
        size, count = self.boundaries[label].size, len(points)
        self.variables.insert(self.keys(label)[size - count :], points.ravel())
        if label in self.narrowed:
            self.narrowed[label] = np.append(self.narrowed[label], np.arange(size - count, size))

    def replace_boundary(self, label: int, boundary: Boundary, control_points: Array) -> None:
        """Another curve takes a boundary's place, with control points (m, 2)."""
        self.variables.remove(self.keys(label))
        self.add_boundary(label, boundary, control_points)

    def drop_oldest_pose_u(self) -> None:
        """The oldest pose has left the window."""
        self.pose_u = {label: u[1:] for label, u in self.pose_u.items()}
