"""Whitened linear rows on keys, the odometry's among them, and the GTSAM factors that are made of them.

The residual functions give rows of a whole window at once, which are kept and summed into the Hessian of a
step. A GTSAM factor is made of them where they are marginalized or a user asks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Final

import gtsam
import numpy as np

from pathspace_graph.errors import SingularSystemError
from pathspace_graph.factors import _kernels as kernels
from pathspace_graph.factors import se2
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.gtsam_factors import calibrated_odometry_factor
from pathspace_graph.factors.linear import keys_of_factor
from pathspace_graph.factors.odometry import CALIBRATION_SIZE, IntegratedOdometry, accumulated
from pathspace_graph.factors.se2 import compose, left_of, relative, rotation, to_vehicle, wrap_angle

from .gaussian import FactoredSystem, factors_of, half_solve
from .variables import (
    CALIBRATION_KEY,
    CALIBRATION_LETTER,
    INDEX_BITS,
    POSE,
    Layout,
    Variables,
    names,
    pose_key,
    pose_keys,
    sizes,
)

Parts = tuple[IntArray, Array, Array, IntArray]  # the fields of `Rows`


@dataclass(frozen=True, eq=False)
class Rows:
    """Whitened linear rows `J_i . dx + r_i`, with dx the change from the linearization point.

    All rows of a group have keys with the same letters in the same order. No row has a key twice.
    """

    keys: IntArray  # (m, k) of each row's variables
    jacobian: Array  # (m, n) whitened derivatives by the entries of the variables, key after key
    residual: Array  # (m,) whitened residuals at the linearization point
    owner: IntArray  # (m,) number of the factor that a row belongs to, such as a cycle

    def __len__(self) -> int:
        return len(self.residual)

    @property
    def parts(self) -> Parts:
        return self.keys, self.jacobian, self.residual, self.owner

    def where(self, chosen: BoolArray | IntArray | slice) -> Rows:
        return Rows(self.keys[chosen], self.jacobian[chosen], self.residual[chosen], self.owner[chosen])

    @cached_property
    def widths(self) -> tuple[int, ...]:
        """Return the widths (k,) of each row's variables."""
        return _widths(tuple((self.keys[0] >> INDEX_BITS).tolist()))

    def columns(self, layout: Layout) -> IntArray:
        """Return the column (m, n) of each derivative, which is UNKNOWN where a key is not in the layout."""
        return kernels.columns_of(layout, self)


@cache
def _widths(letters: tuple[int, ...]) -> tuple[int, ...]:
    """Return the widths (k,) of variables whose keys begin with these letters (k,)."""
    return tuple(sizes(np.array(letters) << INDEX_BITS).tolist())


def at_values(rows: Rows, variables: Variables) -> Rows:
    """Return rows that were linearized at values of zero, such as `A x - c`, at the variables' values."""
    return replace(rows, residual=kernels.moved_residual(variables.layout, rows, -variables.values))


def at_reference(groups: Sequence[Rows], variables: Variables) -> list[Rows]:
    """Return rows linearized at the variables' values as `J d + r` with d = value - reference."""
    change, layout = variables.values - variables.reference, variables.layout
    moved = []
    for rows in groups:
        if len(rows):
            residual = kernels.moved_residual(layout, rows, change)
            moved.append(Rows(rows.keys, rows.jacobian, residual, rows.owner))
    return moved


def jacobian_factors(groups: Sequence[Rows], layout: Layout) -> dict[int, gtsam.GaussianConditional]:
    """Return a factor `1/2 |J d + r|^2` by owner, from rows whose unknowns are d, on the keys of its rows."""
    try:
        blocks = kernels.blocks_of(layout, groups)
    except ValueError:
        for rows in groups:
            layout.places(rows.keys)  # it says which variable is not known
        raise
    return {owner: factor_of_block(layout, held, block) for owner, held, block in blocks}


def factor_of_block(layout: Layout, held: IntArray, block: Array) -> gtsam.GaussianConditional:
    """Return the factor of rows `[J -r]` (m, n + 1), by columns, on a layout's variables at places (h,)."""
    matrix = gtsam.VerticalBlockMatrix([*layout.widths[held].tolist(), 1], block, False)
    return gtsam.GaussianConditional(layout.keys[held].tolist(), 1, matrix)


def stacked_factor(groups: Sequence[Rows], variables: Variables) -> list[gtsam.GaussianConditional]:
    """Return a list of one factor that holds all rows, or an empty list where there are no rows."""
    stacked = [replace(rows, owner=np.zeros(len(rows), np.intp)) for rows in groups]
    return [*jacobian_factors(at_reference(stacked, variables), variables.layout).values()]


def among(keys: IntArray, ascending: IntArray) -> BoolArray:
    """Return which keys, in any shape, are among some ascending ones (k,)."""
    if len(ascending) == 0:
        return np.zeros(keys.shape, bool)
    return np.asarray(ascending.take(ascending.searchsorted(keys), mode="clip") == keys)


def by_widths(groups: Sequence[Rows]) -> list[Rows]:
    """Return few groups: one for all rows on variables of the same widths."""
    alike: dict[tuple[int, ...], list[Rows]] = {}
    for rows in groups:
        alike.setdefault(rows.widths, []).append(rows)
    parts = (zip(*(rows.parts for rows in same), strict=True) for same in alike.values())
    return [Rows(*map(np.concatenate, columns)) for columns in parts]


def newton_system(
    graph: gtsam.GaussianFactorGraph, rows: kernels.RowStore, layout: Layout, change: Array
) -> tuple[Array, Array]:
    """Return the lower triangle of H (n, n), stored by columns, and the negative gradient (n,) at `change`.

    They are sums over the graph and the rows of a window, on the variables of a layout. SingularSystemError
    where nothing holds one of them, and ValueError where something holds another one.
    """
    factors = [(keys_of_factor(factor), factor.augmentedInformation()) for factor in factors_of(graph)]
    hessian, gradient = kernels.summed(layout, factors, rows, change)
    missing = layout.keys[hessian.diagonal()[layout.starts] == 0.0]
    if len(missing):
        raise SingularSystemError(f"expected a factor on every variable, found none on {names(missing)}")
    return hessian, gradient


_FIRST_KEYS: Final = np.array([CALIBRATION_KEY, pose_key(0), pose_key(1)])  # of a row of odometry at cycle 0
_ON_POSE: Final = np.array([0, 1, 1])  # which of them count the cycles


class OdometryChain:
    """Odometry from each pose to the next: m stacked intervals, in the order of the drive."""

    def __init__(self, intervals: Sequence[IntegratedOdometry] = ()) -> None:
        self.deltas: Array = np.array([one.delta for one in intervals]).reshape(-1, POSE)
        """(m, 3) Relative poses, in m, m and rad."""
        self.whiteners: Array = np.array([one.whitener for one in intervals]).reshape(-1, POSE, POSE)
        """(m, 3, 3) W with `W' W` the inverse covariance, in the frame of the end pose."""
        by_calibration = np.array([one.calibration_jacobian for one in intervals])
        self.by_calibration: Array = by_calibration.reshape(-1, POSE, CALIBRATION_SIZE)
        """(m, 3, 2) Derivatives G of the end pose, in its own frame, by the calibration."""

    def __len__(self) -> int:
        return len(self.deltas)

    @property
    def intervals(self) -> list[IntegratedOdometry]:
        covariances = np.linalg.inv(self.whiteners.transpose(0, 2, 1) @ self.whiteners)
        stacked = zip(self.deltas, covariances, self.by_calibration, self.whiteners, strict=True)
        return [IntegratedOdometry(*interval) for interval in stacked]

    def append(self, interval: IntegratedOdometry) -> None:
        self.deltas = np.concatenate([self.deltas, interval.delta[None]])
        self.whiteners = np.concatenate([self.whiteners, interval.whitener[None]])
        self.by_calibration = np.concatenate([self.by_calibration, interval.calibration_jacobian[None]])

    def drop_first(self) -> None:
        self.deltas, self.whiteners = self.deltas[1:], self.whiteners[1:]
        self.by_calibration = self.by_calibration[1:]

    def compose_between(self, cycles: IntArray) -> None:
        """Compose the intervals between some cycles (k,), the first and the last one among them, to one each.

        An error e_i at the end of interval i moves the end of the composition by `Ad(T_end^-1 T_i) e_i`.
        """
        poses = accumulated(np.concatenate([np.zeros((1, POSE)), self.deltas]))
        x, y, theta = relative(poses[np.repeat(cycles[1:], np.diff(cycles))], poses[1:]).T
        adjoint = np.zeros((len(theta), POSE, POSE))
        adjoint[:, :2, :2] = se2.rotations(theta)
        adjoint[:, :, 2] = np.column_stack([y, -x, np.ones(len(theta))])
        root = adjoint @ np.linalg.inv(self.whiteners)
        covariances = np.add.reduceat(root @ root.transpose(0, 2, 1), cycles[:-1])
        self.deltas = relative(poses[cycles[:-1]], poses[cycles[1:]])
        self.whiteners = np.asarray(np.linalg.inv(np.linalg.cholesky(covariances)), np.float64)
        self.by_calibration = np.add.reduceat(adjoint @ self.by_calibration, cycles[:-1])

    def terms(self, slots: IntArray | slice, poses: Array, calibration: Array) -> tuple[Array, Array]:
        """Return `W_k (Log(delta_k^-1 x_k^-1 x_{k+1}) + G_k b)` (m, 3) of some intervals k, and derivatives.

        The poses x (P, 3) are in the map frame, and b (2,) is the calibration. The derivatives (m, 3, 8) are
        by [calibration | pose | next pose].
        """
        measured = self.deltas[slots], self.whiteners[slots], self.by_calibration[slots]
        return kernels.whitened_odometry(poses[:-1][slots], poses[1:][slots], *measured, calibration)

    def rows(self, variables: Variables, cycles: IntArray) -> list[Rows]:
        """Return the rows from the poses of some cycles (m,) to the next poses; each cycle owns its rows.

        The first interval begins at the window's oldest pose, and none begins at the newest one.
        """
        slots = cycles - variables.first_cycle
        slots = slots[slots < len(self)]
        if len(slots) == 0:
            return []
        cycles = variables.first_cycle + slots
        return [odometry_rows(cycles, self.terms(slots, variables.poses, variables.calibration), cycles)]


def odometry_rows(cycles: IntArray, terms: tuple[Array, Array], owner: IntArray) -> Rows:
    """Return the result of `OdometryChain.terms` for cycles (m,) as rows with these owners (m,)."""
    residual, jacobian = terms
    keys = _FIRST_KEYS + np.repeat(cycles, POSE)[:, None] * _ON_POSE
    flat = jacobian.reshape(residual.size, CALIBRATION_SIZE + 2 * POSE)
    return Rows(keys, flat, residual.ravel(), np.repeat(owner, POSE))


def odometry_factor(cycle: int, interval: IntegratedOdometry) -> gtsam.CustomFactor:
    """Return the factor of the odometry, with its calibration, from the pose of a cycle to the next pose."""
    return calibrated_odometry_factor(pose_key(cycle), pose_key(cycle + 1), CALIBRATION_KEY, interval)


def calibrated_delta(odometry: IntegratedOdometry, calibration: Array) -> Array:
    """Return `delta * (-G b)` (3,), the relative pose of an interval corrected by the calibration b (2,)."""
    return compose(odometry.delta, -odometry.calibration_jacobian @ calibration)


def through_odometry(by_pose: Array, poses: Array, odometry: OdometryChain) -> tuple[Array, Array, Array]:
    """Return the derivatives of rows on a predicted pose by the variables that the prediction depends on.

    by_pose g (m, 3) are the derivatives by the newer of two poses (2, 3) in the map frame, which the last
    interval predicts. The result is the derivatives by the older pose (m, 3) and by the calibration (m, 2),
    `-g R G`, and N (m, 3), with `N N'` the covariance of the rows from the odometry's own noise.
    """
    dx, dy = poses[1, :2] - poses[0, :2]
    by_older = by_pose.copy()
    by_older[:, 2] += by_pose[:, 1] * dx - by_pose[:, 0] * dy
    local = by_pose.copy()
    local[:, :2] = by_pose[:, :2] @ rotation(poses[1, 2])
    return by_older, -local @ odometry.by_calibration[-1], local @ np.linalg.inv(odometry.whiteners[-1])


def predicted_covariance(
    step: FactoredSystem, rows: Rows, poses: Array, odometry: OdometryChain, newest: int, together: int
) -> Array:
    """Return the predicted covariances `J Sigma J'` (m / k, k, k) of every k = `together` rows.

    The pose is the first key of a row, and Sigma is the covariance of the last step. The pose of the cycle
    `newest` was not in that step, so it is replaced by its prediction from the pose before, from the first to
    the second of `poses` (2, 3). A map point that was not in the step contributes nothing.
    """
    gradient, row = np.zeros((step.layout.size, len(rows)), order="F"), np.arange(len(rows))
    columns = rows.columns(step.layout)
    known = columns >= 0
    gradient[columns[known], np.broadcast_to(row[:, None], columns.shape)[known]] = rows.jacobian[known]
    noise, on_newest = np.zeros((len(rows), POSE)), columns[:, 0] < 0
    if on_newest.any():
        by_previous, by_calibration, noise[on_newest] = through_odometry(
            rows.jacobian[on_newest, :POSE], poses, odometry
        )
        previous = pose_keys(np.array([newest - 1]))
        gradient[step.layout.entries(previous)[:, None], row[on_newest]] += by_previous.T
        gradient[step.layout.block(CALIBRATION_LETTER), row[on_newest]] += by_calibration.T
    half = half_solve(step.factor, gradient).T.reshape(-1, together, step.layout.size)
    own = noise.reshape(-1, together, POSE)
    return np.asarray(half @ half.transpose(0, 2, 1) + own @ own.transpose(0, 2, 1))


# --- a place that was met again --------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Revisit:
    """The pose of one cycle in the frame of an earlier one's, by cones seen from both: `A (y(x) - y0)`.

    Where a drive meets its road again without a lap, as on a skidpad, a pose may slide along both boundaries,
    but the cones themselves hold it in every direction.
    """

    earlier: int  # cycle in whose frame the pose is
    later: int
    local: Array  # (3,) the measured pose y0 (m, m, rad)
    root: Array  # (3, 3) A, a square root of its information


def revisit_rows(revisits: Sequence[Revisit], poses: Array) -> list[Rows]:
    """Return the rows on [earlier pose | later pose], linearized at the poses (P, 3) of all cycles.

    They are one group, or none without revisits. Those of one later pose are a factor of their own, since the
    earlier one is far away.
    """
    if not revisits:
        return []
    ends = np.array([(one.earlier, one.later) for one in revisits])
    frame, other = poses[ends.T]
    turn, moved = se2.rotations(frame[:, 2]), other - frame
    off = np.column_stack([(moved[:, None, :2] @ turn)[:, 0], moved[:, 2]])
    off -= [one.local for one in revisits]
    off[:, 2] = wrap_angle(off[:, 2])
    by_other = np.tile(np.eye(POSE), (len(ends), 1, 1))
    by_other[:, :2, :2] = turn.transpose(0, 2, 1)
    by_frame = -by_other
    by_frame[:, :2, 2] = -left_of(to_vehicle(other[:, :2], frame))
    by_ends = np.concatenate([by_frame, by_other], axis=2)
    jacobian = np.concatenate([one.root @ by for one, by in zip(revisits, by_ends, strict=True)])
    residual = np.concatenate([one.root @ own for one, own in zip(revisits, off, strict=True)])
    keys, owner = np.repeat(pose_keys(ends), POSE, axis=0), np.repeat(-1 - ends[:, 1], POSE)
    return [Rows(keys, jacobian, residual, owner)]
