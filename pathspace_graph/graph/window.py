"""The factors of the window: the map's and the odometry's, relinearized where they are stale, and the user's.

This is the fluid relinearization of iSAM2 (Kaess et al. 2012). No linearization point in the window is ever
frozen.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, Generic, Protocol, Self, TypeVar

import gtsam
import numpy as np

from pathspace_graph.copies import shallow
from pathspace_graph.errors import SettingsError
from pathspace_graph.factors._kernels import RowStore
from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.linear import keys_of_factor
from pathspace_graph.factors.odometry import IntegratedOdometry

from .elimination import owners
from .gaussian import graph_of, jacobian_factor, normal_equations, square_root_form
from .rows import OdometryChain, Rows, among, at_reference, factor_of_block, jacobian_factors
from .variables import (
    CALIBRATION_LETTER,
    NO_KEYS,
    POSE,
    POSE_LETTER,
    SENSOR_LETTER,
    Layout,
    Variables,
    are_poses,
    indices,
    name,
    pose_key,
    rotation_blocks,
    sizes,
)

SENSOR_LEVER: Final = 10.0  # m by unit of the sensor's calibration, of detections 10 m away at 10 m/s


@dataclass(frozen=True)
class SmootherSettings:
    """Settings of the fixed-lag smoother."""

    lag: float  # time (s) for which poses stay in the window
    tolerances: tuple[float, float]
    """Motion of a point or position (m), and of a heading (rad), beyond which rows are linearized again."""
    sigmas_calibrations: tuple[float, ...]
    """Prior standard deviations of the calibrations: scale error (-) and yaw-rate bias (rad/s) of the
    odometry, and five of the sensor where they are estimated."""
    calibrations: tuple[float, ...] = ()  # prior means of the same; zero by default
    max_poses: int = 400  # most poses in the window


class MapRows(Protocol):
    """What the engine must know about a map: its rows, and the variables that they depend on.

    While the loop is open, a rigid motion of all variables must not change the rows.
    """

    variables: Variables
    reached_inactive: bool
    """Whether a row of the last call of `rows` should be on an inactive map point, but is not."""

    def changed(self) -> IntArray:
        """Return the cycles (k,) whose detections in use have changed since the last linearization."""

    def rows(self, cycles: IntArray) -> list[Rows]:
        """Return rows of the detections of some cycles, the pose as first key and the cycle as owner."""

    def correct(self) -> None:
        """Correct the detections by the present calibration of the sensor."""

    def linearized(self, cycles: IntArray) -> None:
        """Note that the graph now holds the rows that were returned last, which are of these cycles."""

    def activate(self, keys: IntArray) -> None:
        """Make some map points active, which lie next to the active ones."""

    def activate_all(self) -> None:
        """Make every map point active."""

    def copy(self) -> Self:
        """Return a map that can change independently."""

    def drop_cycle(self, cycle: int) -> None:
        """Note that the pose of a cycle, the window's oldest, has been marginalized."""


M_co = TypeVar("M_co", bound=MapRows, covariant=True)


class WindowFactors(Generic[M_co]):
    """Factors of the poses in the window and of the map, linearized again beyond tolerances (m, rad)."""

    def __init__(self, map_rows: M_co, tolerances: tuple[float, float]) -> None:
        self.map, self.variables = map_rows, map_rows.variables
        self.odometry = OdometryChain()  # between each pose of the window and the next
        self.exact = False  # whether the tolerances are zero
        self._lengthened = -1  # the rows of this cycle lack the odometry that leads on from it
        self.measured = RowStore()
        """Rows `J d + r` of map and odometry by cycle, with d = value - reference."""
        self._tolerances = tolerances

    def copy(self) -> Self:
        """Return factors that can be linearized independently; the map is left to the owner of both."""
        other = shallow(self)
        other.odometry, other.measured = shallow(self.odometry), self.measured.copy()
        return other

    def fresh_rows(self, cycles: IntArray) -> RowStore:
        """Return the rows of some cycles, linearized now."""
        fresh = RowStore()
        self._put(fresh, NO_KEYS, self._rows(cycles))
        return fresh

    def fresh(self, cycles: IntArray) -> list[gtsam.GaussianFactor]:
        """Return factors of some cycles, linearized now."""
        measured = at_reference(self._rows(cycles), self.variables)
        return [*jacobian_factors(measured, self.variables.layout).values()]

    def relinearize(self, cycles: IntArray, inactive: IntArray) -> bool:
        """Linearize stale rows again; false, and nothing changes, if one would hold an inactive key (k,)."""
        moved = self._moved()
        stale = self._stale(cycles, moved)
        groups = self._rows(stale)
        if self.map.reached_inactive or any(among(rows.keys, inactive).any() for rows in groups):
            return False
        self._put(self.measured, stale, groups)
        self._lengthened = -1
        self.map.linearized(stale)
        entries = self.variables.layout.entries(moved)
        self.variables.linearized[entries] = self.variables.values[entries]
        return True

    def extend(self, cycle: int, odometry: IntegratedOdometry) -> None:
        """Add the odometry that leads from the newest pose, that of a cycle, to the next one."""
        self.odometry.append(odometry)
        self._lengthened = cycle

    def pop(self, cycle: int) -> gtsam.GaussianConditional:
        """Remove the rows of a cycle, and return them as a factor."""
        layout = self.variables.layout
        return factor_of_block(layout, *self.measured.pop(cycle, layout))

    def drop(self, keys: IntArray) -> None:
        """Drop the rows of cycles that hold any of some ascending keys, so that they are linearized again."""
        self.measured.drop(np.sort(self.measured.holding(keys)))

    def clear(self) -> None:
        """Drop every row, since the map has other variables."""
        self.measured = RowStore()

    def _put(self, store: RowStore, owners: IntArray, groups: Sequence[Rows]) -> None:
        """Replace all rows of some ascending owners by rows that are linearized at the values."""
        change = self.variables.values - self.variables.reference
        store.replace(owners, groups, self.variables.layout, change)

    def _rows(self, cycles: IntArray) -> list[Rows]:
        return [*self.map.rows(cycles), *self.odometry.rows(self.variables, cycles)]

    def _moved(self) -> IntArray:
        """Return the keys of variables that moved by more than the tolerance since their linearization.

        Every row is linear in the odometry's calibration, but that of the sensor moves foot points.
        """
        layout = self.variables.layout
        tolerance, poses = np.zeros(layout.size), layout.block(POSE_LETTER)
        if not self.exact:
            tolerance += self._tolerances[0]
            tolerance[poses.start + POSE - 1 : poses.stop : POSE] = self._tolerances[1]
            tolerance[layout.block(SENSOR_LETTER)] = self._tolerances[0] / SENSOR_LEVER
        tolerance[layout.block(CALIBRATION_LETTER)] = np.inf
        moved = np.abs(self.variables.values - self.variables.linearized) > tolerance
        return layout.keys[np.logical_or.reduceat(moved, layout.starts)]

    def _stale(self, cycles: IntArray, moved: IntArray) -> IntArray:
        if np.array_equal(moved[-len(cycles) :], self.variables.keys[-len(cycles) :]):
            return cycles  # every pose has moved
        stale = self.measured.stale(cycles, moved) | (cycles == self._lengthened)
        stale |= among(cycles, np.sort(self.map.changed()))
        return np.asarray(cycles[stale])


class UserFactors:
    """User's factors, which stay nonlinear until one of their variables is eliminated or becomes inactive."""

    def __init__(self) -> None:
        self.factors: list[gtsam.NonlinearFactor] = []
        self.given = False  # whether the user has ever given a factor, which may be absolute

    def add(self, factors: Sequence[gtsam.NonlinearFactor]) -> None:
        """Add factors that `check_factors` lets pass."""
        self.factors = [*self.factors, *factors]
        self.given |= len(factors) > 0

    @property
    def keys(self) -> IntArray:
        """Return the keys (k,) of all factors; a key may occur several times."""
        return np.concatenate([NO_KEYS, *map(keys_of_factor, self.factors)])

    def linearized(self, variables: Variables) -> list[gtsam.GaussianFactor]:
        """Return the factors, linearized at the values."""
        return _linear(self.factors, variables)

    def remove(self, keys: IntArray, variables: Variables) -> list[gtsam.GaussianFactor]:
        """Remove every factor that holds one of these variables (k,), and return them linearized."""
        taken = [one for one in self.factors if np.isin(keys_of_factor(one), keys).any()]
        self.factors = [one for one in self.factors if one not in taken]
        return _linear(taken, variables)

    def drop(self, factors: Sequence[gtsam.NonlinearFactor | None]) -> None:
        """Drop some of the factors, which another prior includes."""
        self.factors = [one for one in self.factors if one not in factors]


def user_rows(factors: Sequence[gtsam.NonlinearFactor], variables: Variables) -> list[Rows]:
    """Return user's factors as rows at values of zero, linearized now; the first pose owns the rows."""
    found = []
    for linear in _linear(factors, variables):
        keys, (A, b) = keys_of_factor(linear), linear.jacobian()
        residual = -np.ravel(b) - A @ variables.reference[variables.layout.entries(keys)]
        cycles = np.append(indices(keys[are_poses(keys)]), 0)  # of its poses; none of the calibration alone
        owner = np.repeat(owners(cycles[:1]), len(A))
        found.append(Rows(np.tile(keys, (len(A), 1)), np.array(A), residual, owner))
    return found


def check_keys(factors: Sequence[gtsam.NonlinearFactor], known: IntArray, expected: str) -> None:
    """Raise a SettingsError for the first factor that is not one, or without keys or with an unknown key."""
    for row, factor in enumerate(factors):
        if not isinstance(factor, gtsam.NonlinearFactor):
            raise _unusable(row, "a gtsam.NonlinearFactor", type(factor).__name__)
        keys = keys_of_factor(factor)
        unknown = np.setdiff1d(keys, known)
        if len(unknown) or len(keys) == 0:
            raise _unusable(row, f"keys of {expected}", name(int(unknown[0])) if len(unknown) else "no key")


def check_linear(
    factors: Sequence[gtsam.NonlinearFactor], values: Callable[..., gtsam.Values], constant: bool = True
) -> None:
    """Raise a SettingsError for the first factor that cannot be linearized at its values.

    `constant` allows residuals that depend on nothing; those of zero always may, as of a limit that is kept.
    """
    for row, factor in enumerate(factors):
        try:
            linear = factor.linearize(values(factor))
        except Exception as error:  # whatever a user's own function raises, or GTSAM where types differ
            raise _unusable(row, "a factor that can be linearized", error) from error
        A, b = linear.jacobian() if linear is not None else (np.zeros(0), np.zeros(0))
        if not (np.isfinite(A).all() and np.isfinite(b).all()):
            raise _unusable(row, "finite numbers", "others where it is linearized")
        if not constant and np.any(b) and not np.any(A):
            raise _unusable(row, "a residual that depends on its variables", "Jacobians of zero")


def check_factors(factors: Sequence[gtsam.NonlinearFactor], variables: Variables, next_cycle: int) -> None:
    """Raise a SettingsError for the first factor that is not one, or whose keys or numbers cannot be used.

    It may hold any variable, poses of the window, and that of the next cycle, linearized at the newest one.
    """
    if not factors:
        return
    first, following = pose_key(variables.first_cycle), pose_key(next_cycle)
    keys_known = np.append(variables.keys[~are_poses(variables.keys)], np.arange(first, following + 1))
    expected = (
        f"poses in the window, {name(first)} to {name(following)}, of control points and of the calibration"
    )
    check_keys(factors, keys_known, expected)
    check_linear(factors, lambda factor: values_of(factor, next_cycle, variables))


def values_of(factor: gtsam.NonlinearFactor, next_cycle: int, variables: Variables) -> gtsam.Values:
    """Return the values of a factor's variables; the pose of the next cycle is at the newest one."""
    keys, following = keys_of_factor(factor), pose_key(next_cycle)
    values = variables.gtsam_values(keys[keys != following])
    if following in keys:
        newest = variables.poses[-1] if len(variables.poses) else np.zeros(POSE)
        values.insert(following, gtsam.Pose2(*newest))
    return values


def _unusable(row: int, expected: str, found: object) -> SettingsError:
    return SettingsError(f"factors, row {row}: expected {expected}, found {found}")


def _linear(factors: Sequence[gtsam.NonlinearFactor], variables: Variables) -> list[gtsam.GaussianFactor]:
    """Return `1/2 |A d - b|^2` with d = value - reference of each factor that is linearized to anything.

    The tangent of `gtsam.Pose2` is in the frame of the pose, so `A_xy` becomes `A_xy R'` in the map frame.
    """
    found: list[gtsam.GaussianFactor] = []
    for factor in factors:
        linear = factor.linearize(variables.gtsam_values(keys_of_factor(factor)))
        if linear is not None:
            keys, (matrix, right) = keys_of_factor(linear), linear.jacobian()
            A = np.array(matrix, float) @ _rotations(keys, variables).T
            b = np.array(right, float).ravel()
            found.append(jacobian_factor(keys, A, b + A @ variables.change(variables.layout.entries(keys))))
    return found


def as_nonlinear(factor: gtsam.GaussianFactor, variables: Variables) -> gtsam.LinearContainerFactor:
    """Return a linear factor on our unknowns as a factor of a nonlinear graph, about the variables' values.

    The inverse of `_linear`: `A_xy R` on each pose, and `b - A d_now`.
    """
    layout = Layout(np.sort(keys_of_factor(factor)))
    information, vector = normal_equations(graph_of(factor), layout)
    turn = _rotations(layout.keys, variables)
    negative_gradient = vector - information @ variables.change(variables.layout.entries(layout.keys))
    root, right = square_root_form(turn.T @ information @ turn, turn.T @ negative_gradient)
    linear = jacobian_factor(layout.keys, root, right)
    return gtsam.LinearContainerFactor(gtsam.JacobianFactor(linear), variables.gtsam_values(layout.keys))


def _rotations(keys: IntArray, variables: Variables) -> Array:
    """Return the rotation (n, n), on keys (k,), of poses' x and y from their own frames to the map frame."""
    widths, poses = sizes(keys), are_poses(keys)
    starts = np.cumsum(widths) - widths
    headings = variables.of(keys[poses])[POSE - 1 :: POSE]
    return rotation_blocks(int(widths.sum()), starts[poses], headings)
