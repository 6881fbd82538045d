"""Whitened linear rows on keys, the odometry's among them, and the GTSAM factors that are made of them.

The residual functions give whitened rows of a whole window at once. The binding's constructors take at most
three keys and one factor at a time. So the rows of all factors are written into one buffer, and each factor
is made of a view of it by way of a Gaussian conditional, which is a Jacobian factor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import accumulate

import gtsam
import numpy as np

from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.gtsam_factors import calibrated_odometry_factor
from pathspace_graph.factors.odometry import CALIBRATION_SIZE, IntegratedOdometry, odometry_residuals
from pathspace_graph.factors.se2 import compose, rotation

from .gaussian import FactoredSystem, half_solve
from .variables import (
    CALIBRATION_KEY,
    CALIBRATION_LETTER,
    POSE,
    UNKNOWN,
    Layout,
    Variables,
    names,
    pose_key,
    pose_keys,
    sizes,
)


@dataclass(frozen=True, eq=False)
class Rows:
    """Whitened linear rows `J_i . dx + r_i`, with dx the change from the linearization point.

    All rows of a group have the same number of keys, with the same letters in the same order. No row has a
    key twice.
    """

    keys: IntArray
    """Keys (m, k) of each row's variables."""
    jacobian: Array
    """Whitened derivatives (m, n) by the entries of the variables, one key after the other."""
    residual: Array
    """Whitened residuals (m,) at the linearization point."""
    owner: IntArray
    """Each row (m,) belongs to the factor with this number; numbers are close together, as cycles are."""

    def __len__(self) -> int:
        return len(self.residual)

    def where(self, chosen: BoolArray | IntArray) -> Rows:
        return Rows(self.keys[chosen], self.jacobian[chosen], self.residual[chosen], self.owner[chosen])

    @property
    def pattern(self) -> tuple[IntArray, IntArray]:
        """Return which of a row's keys each derivative (n,) is by, and which entry of its variable."""
        return _pattern(tuple(sizes(self.keys[0]).tolist()))

    def columns(self, layout: Layout) -> IntArray:
        """Return the column (m, n) of each derivative, which is UNKNOWN where a key is not in the layout."""
        key, entry = self.pattern
        starts = layout.columns(self.keys)[:, key]
        return np.where(starts == UNKNOWN, UNKNOWN, starts + entry)


@cache
def _pattern(widths: tuple[int, ...]) -> tuple[IntArray, IntArray]:
    return np.repeat(np.arange(len(widths)), widths), np.concatenate([np.arange(width) for width in widths])


@dataclass(frozen=True, eq=False)
class LinearFactor:
    keys: frozenset[int]
    linear: gtsam.GaussianConditional


def jacobian_factors(groups: Sequence[Rows], variables: Variables) -> dict[int, LinearFactor]:
    """Return a factor `1/2 |A d - b|^2` by owner, with d = value - reference, `A = J` and `b = J d_now - r`.

    The rows must have been linearized at the variables' values, d_now from the reference.
    """
    groups = [rows for rows in groups if len(rows)]
    if not groups:
        return {}
    blocks = _FactorBlocks(groups, variables.layout)
    buffer = blocks.write(groups, variables)
    return {owner: blocks.factor(f, buffer) for f, owner in enumerate(blocks.owners)}


class _FactorBlocks:
    """Where each derivative goes in the buffer of all factors, each of which is stored by columns."""

    def __init__(self, groups: Sequence[Rows], layout: Layout) -> None:
        owner = np.concatenate([rows.owner for rows in groups])
        lowest = int(owner.min())
        present = np.bincount(owner - lowest) > 0
        owners = present.nonzero()[0]
        self.owners: list[int] = (lowest + owners).tolist()
        member = (present.cumsum() - 1)[owner - lowest]
        ends = [*accumulate(len(rows) for rows in groups)]
        self.slices = [slice(end - len(rows), end) for end, rows in zip(ends, groups, strict=True)]
        places = [_places(rows.keys, layout) for rows in groups]
        held = np.zeros(len(layout.keys), bool)
        for place in places:
            held[place] = True
        number, self.held = held.cumsum() - 1, held.nonzero()[0]  # factors hold few keys of a large map
        self.member, self.places = member, [number[place] for place in places]
        touched = np.zeros((len(owners), len(self.held)), bool)
        for place, own in zip(self.places, self.slices, strict=True):
            touched[member[own, None], place] = True
        widths = layout.widths[self.held]
        ending = (touched * widths).cumsum(axis=1)
        self.begin = ending - widths  # the column of each key in the factors that hold it
        self.width, self.height = ending[:, -1] + 1, np.bincount(member)
        self.size = self.height * self.width
        self.offset = self.size.cumsum() - self.size
        order = member.argsort(kind="stable")
        first = self.height.cumsum() - self.height
        self.row = np.empty(len(member), np.intp)
        self.row[order] = np.arange(len(member)) - first[member[order]]
        factor, key = touched.nonzero()
        self._bounds = factor.searchsorted(np.arange(len(owners) + 1)).tolist()
        self._keys, self._widths = layout.keys[self.held[key]].tolist(), widths[key].tolist()
        ends = [*accumulate(self.size.tolist(), initial=0)]
        self._blocks = list(zip(ends[:-1], ends[1:], self.height.tolist(), strict=True))

    def write(self, groups: Sequence[Rows], variables: Variables) -> Array:
        buffer = np.zeros(int(self.size.sum()))
        change, starts = variables.values - variables.reference, variables.layout.starts[self.held]
        for rows, place, own in zip(groups, self.places, self.slices, strict=True):
            (key, entry), member = rows.pattern, self.member[own]
            height, first = self.height[member], self.offset[member] + self.row[own]
            columns = self.begin[member[:, None], place][:, key] + entry
            columns *= height[:, None]
            columns += first[:, None]
            buffer[columns] = rows.jacobian
            moved = change.take(starts.take(place)[:, key] + entry)
            moved *= rows.jacobian
            buffer[first + (self.width[member] - 1) * height] = moved.sum(axis=1) - rows.residual
        return buffer

    def factor(self, f: int, buffer: Array) -> LinearFactor:
        own, (begin, end, height) = slice(self._bounds[f], self._bounds[f + 1]), self._blocks[f]
        keys, block = self._keys[own], buffer[begin:end].reshape((height, -1), order="F")
        matrix = gtsam.VerticalBlockMatrix([*self._widths[own], 1], block, False)
        return LinearFactor(frozenset(keys), gtsam.GaussianConditional(keys, 1, matrix))


def _places(keys: IntArray, layout: Layout) -> IntArray:
    """Return the index of each key in a layout; ValueError where the layout does not hold it."""
    places = layout.keys.searchsorted(keys)
    known = layout.keys.take(places, mode="clip") == keys
    if not known.all():
        raise ValueError(f"expected rows on known variables, found {names(keys[~known])}")
    return places


def stacked_factor(groups: Sequence[Rows], variables: Variables) -> list[gtsam.GaussianConditional]:
    """Return a list of one factor that holds all rows, or an empty list where there are no rows."""
    stacked = [Rows(r.keys, r.jacobian, r.residual, np.zeros(len(r), np.intp)) for r in groups]
    return [factor.linear for factor in jacobian_factors(stacked, variables).values()]


class OdometryChain:
    """Odometry from each pose to the next: m stacked intervals, in the order of the drive."""

    def __init__(self, intervals: Sequence[IntegratedOdometry] = ()) -> None:
        self.deltas: Array = np.array([one.delta for one in intervals]).reshape(-1, POSE)
        """Relative poses (m, 3), in m, m and rad."""
        self.whiteners: Array = np.array([one.whitener for one in intervals]).reshape(-1, POSE, POSE)
        """Each W (m, 3, 3) has `W' W` equal to the inverse covariance, in the frame of the end pose."""
        by_calibration = np.array([one.calibration_jacobian for one in intervals])
        self.by_calibration: Array = by_calibration.reshape(-1, POSE, CALIBRATION_SIZE)
        """Derivatives G (m, 3, 2) of the end pose, in its own frame, by the calibration."""

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

    def terms(self, slots: IntArray | slice, poses: Array, calibration: Array) -> tuple[Array, Array]:
        """Return `W_k (Log(delta_k^-1 x_k^-1 x_{k+1}) + G_k b)` (m, 3) of some intervals k, and derivatives.

        The poses x (P, 3) are in the map frame, and b (2,) is the calibration. The derivatives (m, 3, 8) are
        by [calibration | pose | next pose].
        """
        whiteners, by_calibration = self.whiteners[slots], self.by_calibration[slots]
        start, end = poses[:-1][slots], poses[1:][slots]
        residual, by_start, by_end = odometry_residuals(start, end, self.deltas[slots])
        residual = residual + by_calibration @ calibration
        jacobian = whiteners @ np.concatenate([by_calibration, by_start, by_end], axis=2)
        return (whiteners @ residual[:, :, None])[:, :, 0], jacobian

    def rows(self, variables: Variables, cycles: IntArray) -> list[Rows]:
        """Return the rows from the poses of some cycles (m,) to the next poses; each cycle owns its rows.

        The first interval begins at the window's oldest pose. The newest pose has no rows, since no interval
        begins there.
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
    keys = np.stack([np.full(len(cycles), CALIBRATION_KEY), pose_keys(cycles), pose_keys(cycles + 1)], axis=1)
    flat = jacobian.reshape(residual.size, CALIBRATION_SIZE + 2 * POSE)
    return Rows(np.repeat(keys, POSE, axis=0), flat, residual.ravel(), np.repeat(owner, POSE))


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
    `newest` was not in that step, so it is replaced by its prediction from the pose before: the odometry's
    last interval leads from the first of `poses` (2, 3) to it. A map point that was not in the step
    contributes nothing.
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
