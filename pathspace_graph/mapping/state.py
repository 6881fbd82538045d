"""State of the spline estimators: curves, and the variables of control points and poses."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from operator import is_
from typing import Any, Final, Self

import gtsam
import numpy as np

from pathspace_graph.copies import shallow
from pathspace_graph.factors import _kernels as kernels
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.bspline import SpanPolynomials
from pathspace_graph.factors.footpoint import FootPoints
from pathspace_graph.factors.linear import keys_of_factor
from pathspace_graph.graph.rows import Rows
from pathspace_graph.graph.variables import (
    CALIBRATION_KEY,
    CONTROL_LETTERS,
    FIRST_POINT,
    ONE_DRIVE,
    POINT,
    SENSOR_KEY,
    Drives,
    Layout,
    Variables,
    are_poses,
    control_keys,
    indices,
    sizes,
)
from pathspace_graph.graph.window import user_rows
from pathspace_graph.spline.boundary import Boundary
from pathspace_graph.spline.bspline import BSpline

SAMPLE: Final = 0.25  # step of the samples of curves that are compared with curves and cones (m)
SAMPLES_PER_POINT: Final = 3  # points of a curve for each control point that is expressed by them
NEGLIGIBLE: Final = 1e-6  # share of the largest derivative below which one is left out


@dataclass(frozen=True, eq=False)
class Curves:
    """The active parts of all curves; their control points are the rows of `State.map_points`."""

    labels: IntArray  # (k,) labels of the curves, ascending
    active: tuple[IntArray, ...]  # active control points of each curve, by index
    tables: tuple[SpanPolynomials, ...]  # bases of the whole curves
    searched: kernels.Curves  # all of closed curves, and open ones from their first active control point on
    active_from: Array  # (k,) parameter before which an open curve is inactive; -inf if all is active
    keys: IntArray  # (m,) keys of all control points

    @classmethod
    def of(cls, boundaries: Mapping[int, Boundary], active: Mapping[int, IntArray]) -> Self:
        """Lay out at least one boundary, with the active control points (k,) of each."""
        curves, active_of = tuple(boundaries.values()), tuple(active[label] for label in boundaries)
        counts = [boundary.size for boundary in curves]
        first = [0 if b.periodic else int(own[0]) for b, own in zip(curves, active_of, strict=True)]
        bases = [b.tables.tail(start) if start else b.tables for b, start in zip(curves, first, strict=True)]
        begins = [base.low if start else -np.inf for base, start in zip(bases, first, strict=True)]
        return cls(
            labels=np.array(list(boundaries), np.intp),
            active=active_of,
            tables=tuple(boundary.tables for boundary in curves),
            searched=kernels.Curves(bases, (np.cumsum([0, *counts[:-1]]) + first).tolist(), counts),
            active_from=np.array(begins),
            keys=np.concatenate([control_keys(label, b.numbers) for label, b in boundaries.items()]),
        )

    def is_of(self, boundaries: Mapping[int, Boundary], active: Mapping[int, IntArray]) -> bool:
        """Whether these are the curves of the boundaries with these active control points, by default all."""
        tables = [boundary.tables for boundary in boundaries.values()]
        stretches = [active.get(label, boundary.everything) for label, boundary in boundaries.items()]
        known = *self.tables, *self.active
        return len(tables) == len(self.tables) and all(map(is_, (*tables, *stretches), known))


class State:
    """Boundaries, and the variables: control points (m) and poses (m, m, rad), map frame."""

    def __init__(self, variables: Variables | None = None, drives: Drives = ONE_DRIVE) -> None:
        self.variables = variables or Variables()  # control points, calibration and poses by key
        self.boundaries: dict[int, Boundary] = {}  # curves, sorted by label as their control points are
        self.active_stretch: dict[int, IntArray] = {}
        """Active control points (k,) of a partly inactive boundary: one stretch in driving order, by index
        from the boundary's first control point."""
        self.drives = drives  # drives of the poses
        self.pose_u: dict[int, Array] = {}  # (P,) parameters of the poses, increasing from lap to lap
        self._curves: Curves | None = None

    def copy(self) -> Self:
        """Return an independent copy."""
        other = shallow(self)
        other.variables = self.variables.copy()
        other.boundaries = {label: shallow(boundary) for label, boundary in self.boundaries.items()}
        other.pose_u = self.pose_u.copy()
        other.active_stretch = self.active_stretch.copy()
        return other

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the compiled curves, which are laid out again."""
        return vars(self) | {"_curves": None}

    def control_keys(self, label: int) -> IntArray:
        """Keys (m,) of a boundary's control points."""
        return control_keys(label, self.boundaries[label].numbers)

    @property
    def map_keys(self) -> IntArray:
        """Keys (m,) of all boundaries' control points, in the order of `map_points`."""
        return np.concatenate([np.zeros(0, np.intp), *map(self.control_keys, self.boundaries)])

    @property
    def map_points(self) -> Array:
        """View of all boundaries' control points (m, 2) in m, map frame."""
        layout, (left, right) = self.variables.layout, CONTROL_LETTERS
        both = slice(layout.block(left).start, layout.block(right).stop)
        return self.variables.values[both].reshape(-1, 2)

    def control_points(self, label: int) -> Array:
        """View of a boundary's control points (m, 2) in m, map frame."""
        return self.variables.block(CONTROL_LETTERS[label]).reshape(-1, 2)

    @property
    def poses(self) -> Array:
        """View of the poses (P, 3), the oldest first."""
        return self.variables.poses

    def calibration_keys(self, drive: int) -> IntArray:
        """Keys of a drive's calibrations: of the odometry, and of the sensor if estimated."""
        keys = [CALIBRATION_KEY + drive, SENSOR_KEY + self.drives.sensors[drive]]
        return np.array(keys[: 2 if len(self.variables.sensor) else 1])

    # --- the curves --------------------------------------------------------------------------------------

    @property
    def closed(self) -> bool:
        """Whether a curve is closed; both are closed together."""
        return any(boundary.periodic for boundary in self.boundaries.values())

    def spline(self, label: int) -> BSpline:
        """Copy a boundary to a spline that is independent of the state."""
        return self.boundaries[label].spline(self.control_points(label).copy())

    @property
    def splines(self) -> dict[int, BSpline]:
        """All boundaries as independent splines, by label."""
        return {label: self.spline(label) for label in self.boundaries}

    @property
    def curves(self) -> Curves:
        """Layout of the boundaries, at least one, with their active control points; cached."""
        known = self._curves
        if known is None or not known.is_of(self.boundaries, self.active_stretch):
            active = {label: self.active(label) for label in self.boundaries}
            known = self._curves = Curves.of(self.boundaries, active)
        return known

    @property
    def trusted(self) -> Array:
        """Parameter (k,) of each curve up to which foot points are allowed."""
        return np.array([boundary.trusted for boundary in self.boundaries.values()])

    def find(self, points: Array, curve: IntArray, low: Array, high: Array) -> FootPoints:
        """Find the foot points of points (m, 2), each on its own curve (m,) and stretch [low, high]."""
        s, high = next(iter(self.boundaries.values())).settings, np.minimum(high, self.trusted[curve])
        search = (s.search_step, s.search_iterations)
        return FootPoints(*self.curves.searched.search(self.map_points, points, curve, low, high, *search))

    def add_boundary(self, label: int, boundary: Boundary, control_points: Array) -> None:
        """Add a boundary with control points (m, 2)."""
        self.boundaries = dict(sorted({**self.boundaries, label: boundary}.items()))
        self.variables.insert(self.control_keys(label), control_points.ravel())

    def extend(self, label: int, points: Array) -> None:
        """Add the variables of control points (k, 2) by which a boundary has grown, as active ones."""
        size, count = self.boundaries[label].size, len(points)
        self.variables.insert(self.control_keys(label)[size - count :], points.ravel())
        if label in self.active_stretch:
            self.active_stretch[label] = np.append(self.active_stretch[label], np.arange(size - count, size))

    def replace_boundary(self, label: int, boundary: Boundary, control_points: Array) -> None:
        """Replace a boundary by another one with control points (m, 2)."""
        self.variables.remove(self.control_keys(label))
        self.add_boundary(label, boundary, control_points)

    def replace_curves(self, boundaries: Mapping[int, Boundary]) -> None:
        """Replace all boundaries; the smoother inserts their control points."""
        self.boundaries = dict(sorted(boundaries.items()))

    # --- active control points ---------------------------------------------------------------------------

    def active(self, label: int) -> IntArray:
        """Indices (k,) of a boundary's active control points, in driving order."""
        return self.active_stretch.get(label, self.boundaries[label].everything)

    @property
    def whole(self) -> bool:
        """Whether every control point is active."""
        return not self.active_stretch

    def activate(self, keys: IntArray) -> None:
        """Activate control points that are next to the active ones."""
        for label, active in self.active_stretch.items():
            numbers = self.control_keys(label)[:1] + np.arange(active[0])
            back = np.flatnonzero(np.isin(numbers, keys))
            self.active_stretch[label] = np.append(back, active)

    def activate_only(self, active: dict[int, IntArray]) -> None:
        """Activate exactly these control points, by label; all of a missing label."""
        self.active_stretch = active

    def locate(self, label: int, pose_u: Array) -> None:
        """Set the parameters (P,) of all poses on a boundary."""
        self.pose_u[label] = pose_u

    def locate_newest(self, label: int, u: float) -> None:
        """Add the newest pose's parameter; on a closed curve it increases from lap to lap."""
        boundary, known = self.boundaries[label], self.pose_u[label]
        if boundary.periodic:
            u += boundary.length * round((float(known[-1]) - u) / boundary.length)
        self.pose_u[label] = np.concatenate([known, [u]])

    def drop_oldest_pose_u(self) -> None:
        """Remove the parameters of the oldest pose, which has left the window."""
        self.pose_u = {label: u[1:] for label, u in self.pose_u.items()}


# --- the user's factors on other curves ------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class GivenFactor:
    """A user's factor as rows that curves on other knots can have, linearized while its variables last.

    The control points of a curve S with the basis B at parameters u are `c = (B' B)^-1 B' S(u)`. So a row on
    control points is one on points of the curve, and another curve has those at their feet.
    """

    factor: gtsam.NonlinearFactor  # left out in another process, as one in Python cannot be pickled
    cycle: int  # first cycle of its poses; without poses the one in which it was given
    rows: Rows | None = None  # m rows on its poses and calibrations, at values of zero; None if not active
    points: Mapping[int, Array] = field(default_factory=dict)  # (k, 2) points of each boundary, map frame
    by_points: Mapping[int, Array] = field(default_factory=dict)  # (m, k, 2) derivatives by them

    @classmethod
    def of(cls, factor: gtsam.NonlinearFactor, state: State, cycle: int) -> Self:
        """Linearize a factor that was given in a cycle."""
        keys = keys_of_factor(factor)
        cycle = int(indices(keys[are_poses(keys)]).min(initial=cycle))
        linear = user_rows([factor], state.variables)
        if not linear:
            return cls(factor, cycle)
        rows, keys, points, by_points = linear[0], linear[0].keys[0], dict[int, Array](), dict[int, Array]()
        others, column_keys = are_poses(keys) | (keys < FIRST_POINT), np.repeat(keys, sizes(keys))
        for label, boundary in () if others.all() else state.boundaries.items():
            own = state.control_keys(label)
            held = keys[np.isin(keys, own)]
            if len(held) == 0:
                continue
            by_control = np.zeros((len(rows), POINT * len(own)))
            by_control[:, Layout(own).entries(held)] = rows.jacobian[:, np.isin(column_keys, own)]
            u = np.linspace(boundary.tables.low, boundary.tables.high, SAMPLES_PER_POINT * len(own))
            basis = boundary.basis(u)
            weights = np.linalg.solve(basis.T @ basis, basis.T)
            by_curve = np.einsum("mjd,jk->mkd", by_control.reshape(len(rows), -1, POINT), weights)
            near = _counts(by_curve)
            points[label] = boundary.evaluate(state.control_points(label), u[near])
            by_points[label] = by_curve[:, near]
        by_others = rows.jacobian[:, np.repeat(others, sizes(keys))]
        rest = replace(rows, keys=rows.keys[:, others], jacobian=by_others)
        return cls(factor, cycle, rest, points, by_points)

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"factor": None}

    def on(self, state: State) -> list[Rows]:
        """Return the rows on the variables of a state, or none where it lacks one of their boundaries."""
        if self.rows is None or not set(self.points) <= set(state.boundaries):
            return []
        keys, columns = [self.rows.keys], [self.rows.jacobian]
        for label, points in self.points.items():
            boundary = state.boundaries[label]
            u = boundary.find_anywhere(state.control_points(label), points).u
            by_control = np.einsum("mkd,kj->mjd", self.by_points[label], boundary.basis(u))
            near = _counts(by_control)
            keys.append(np.tile(state.control_keys(label)[near], (len(by_control), 1)))
            columns.append(by_control[:, near].reshape(len(by_control), -1))
        rows = replace(self.rows, keys=np.hstack(keys), jacobian=np.hstack(columns))
        return [rows] if rows.keys.size else []


def _counts(derivatives: Array) -> BoolArray:
    """Whether derivatives (m, k, 2) by each of k points are more than round-off."""
    largest = np.abs(derivatives).max(axis=(0, 2))
    return np.asarray(largest > NEGLIGIBLE * largest.max())
