"""Odometry between poses by key: rows of the graph, and the uncertainty of the predicted pose."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.gtsam_factors import calibrated_odometry_factor
from pathspace_graph.factors.odometry import CALIBRATION_SIZE, IntegratedOdometry, odometry_residuals
from pathspace_graph.factors.se2 import compose, rotation

from .gaussian import FactoredSystem, half_solve
from .keys import CALIBRATION_KEY, CALIBRATION_LETTER, POSE, pose_key, pose_keys
from .rows import Rows
from .variables import Variables

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


class OdometryChain:
    """Holds the odometry from each pose to the next: m stacked intervals, in the order of the drive."""

    def __init__(self, intervals: Sequence[IntegratedOdometry] = ()) -> None:
        self.deltas: Array = np.array([one.delta for one in intervals]).reshape(-1, POSE)
        """These are the relative poses (m, 3), in m, m and rad."""
        self.whiteners: Array = np.array([one.whitener for one in intervals]).reshape(-1, POSE, POSE)
        """Each W (m, 3, 3) has `W' W` equal to the inverse covariance, in the frame of the end pose."""
        by_calibration = np.array([one.calibration_jacobian for one in intervals])
        self.by_calibration: Array = by_calibration.reshape(-1, POSE, CALIBRATION_SIZE)
        """These are the derivatives G (m, 3, 2) of the end pose, in its own frame, by the calibration."""

    def __len__(self) -> int:
        return len(self.deltas)

    @property
    def intervals(self) -> list[IntegratedOdometry]:
        """Returns the intervals one by one."""
        covariances = np.linalg.inv(self.whiteners.transpose(0, 2, 1) @ self.whiteners)
        stacked = zip(self.deltas, covariances, self.by_calibration, self.whiteners, strict=True)
        return [IntegratedOdometry(*interval) for interval in stacked]

    def append(self, interval: IntegratedOdometry) -> None:
        """Appends the next interval."""
        self.deltas = np.concatenate([self.deltas, interval.delta[None]])
        self.whiteners = np.concatenate([self.whiteners, interval.whitener[None]])
        self.by_calibration = np.concatenate([self.by_calibration, interval.calibration_jacobian[None]])

    def drop_first(self) -> None:
        """Removes the oldest interval."""
        self.deltas, self.whiteners = self.deltas[1:], self.whiteners[1:]
        self.by_calibration = self.by_calibration[1:]

    def terms(self, slots: IntArray | slice, poses: Array, calibration: Array) -> tuple[Array, Array]:
        """Returns `W_k (Log(delta_k^-1 x_k^-1 x_{k+1}) + G_k b)` (m, 3) of some intervals k, and derivatives.

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
        """Returns the rows from the poses of some cycles (m,) to the next poses; each cycle owns its rows.

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
    """Returns the result of `OdometryChain.terms` for cycles (m,) as rows with these owners (m,)."""
    residual, jacobian = terms
    keys = np.stack([np.full(len(cycles), CALIBRATION_KEY), pose_keys(cycles), pose_keys(cycles + 1)], axis=1)
    flat = jacobian.reshape(residual.size, CALIBRATION_SIZE + 2 * POSE)
    return Rows(np.repeat(keys, POSE, axis=0), flat, residual.ravel(), np.repeat(owner, POSE))


def odometry_factor(cycle: int, interval: IntegratedOdometry) -> gtsam.CustomFactor:
    """Returns the factor of the odometry, with its calibration, from the pose of a cycle to the next pose."""
    return calibrated_odometry_factor(pose_key(cycle), pose_key(cycle + 1), CALIBRATION_KEY, interval)


def calibrated_delta(odometry: IntegratedOdometry, calibration: Array) -> Array:
    """Returns `delta * (-G b)` (3,), the relative pose of an interval corrected by the calibration b (2,)."""
    return compose(odometry.delta, -odometry.calibration_jacobian @ calibration)


def through_odometry(by_pose: Array, poses: Array, odometry: OdometryChain) -> tuple[Array, Array, Array]:
    """Returns the derivatives of rows on a predicted pose by the variables that the prediction depends on.

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
    """Returns the predicted covariances `J Sigma J'` (m / k, k, k) of every k = `together` rows.

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
