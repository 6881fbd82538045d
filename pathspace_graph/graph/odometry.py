"""Odometry between poses by key: rows of the graph, and uncertainty carried to the pose that comes next."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.gtsam_factors import calibrated_odometry_factor
from pathspace_graph.factors.odometry import CALIBRATION_SIZE, IntegratedOdometry, odometry_residuals
from pathspace_graph.factors.se2 import compose

from .keys import CALIBRATION_KEY, POSE, pose_key, pose_keys
from .rows import Rows
from .variables import Variables

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


class OdometryChain:
    """What leads from each pose to the next, stacked: m intervals in the order of the drive."""

    def __init__(self, intervals: Sequence[IntegratedOdometry] = ()) -> None:
        self.deltas: Array = np.array([one.delta for one in intervals]).reshape(-1, POSE)
        """(m, 3) relative poses."""
        self.whiteners: Array = np.array([one.whitener for one in intervals]).reshape(-1, POSE, POSE)
        """(m, 3, 3) W with `W' W` the inverse of their covariance, in the frame of the end."""
        by_calibration = np.array([one.calibration_jacobian for one in intervals])
        self.by_calibration: Array = by_calibration.reshape(-1, POSE, CALIBRATION_SIZE)
        """(m, 3, 2) derivative of the end by the calibration, in the frame of the end."""

    def __len__(self) -> int:
        return len(self.deltas)

    @property
    def intervals(self) -> list[IntegratedOdometry]:
        """Each interval by itself."""
        covariances = np.linalg.inv(self.whiteners.transpose(0, 2, 1) @ self.whiteners)
        stacked = zip(self.deltas, covariances, self.by_calibration, self.whiteners, strict=True)
        return [IntegratedOdometry(*interval) for interval in stacked]

    def append(self, interval: IntegratedOdometry) -> None:
        """The next interval."""
        self.deltas = np.concatenate([self.deltas, interval.delta[None]])
        self.whiteners = np.concatenate([self.whiteners, interval.whitener[None]])
        self.by_calibration = np.concatenate([self.by_calibration, interval.calibration_jacobian[None]])

    def drop_first(self) -> None:
        """The oldest interval is known no more."""
        self.deltas, self.whiteners = self.deltas[1:], self.whiteners[1:]
        self.by_calibration = self.by_calibration[1:]

    def terms(self, slots: IntArray | slice, poses: Array, calibration: Array) -> tuple[Array, Array]:
        """`W_k (Log(delta_k^-1 x_k^-1 x_{k+1}) + G_k b)` of some intervals k (m,) between poses (P, 3).

        G is `by_calibration`. Gives residuals (m, 3) and derivatives (m, 3, 8) by [calibration | pose |
        next].
        """
        whiteners, by_calibration = self.whiteners[slots], self.by_calibration[slots]
        start, end = poses[:-1][slots], poses[1:][slots]
        residual, by_start, by_end = odometry_residuals(start, end, self.deltas[slots])
        residual = residual + by_calibration @ calibration
        jacobian = whiteners @ np.concatenate([by_calibration, by_start, by_end], axis=2)
        return (whiteners @ residual[:, :, None])[:, :, 0], jacobian

    def rows(self, variables: Variables, cycles: IntArray) -> list[Rows]:
        """The terms from the poses of some cycles (m,) to the next as rows; each cycle owns its own.

        The chain leads from each pose of the window to the next; the newest pose, from which it does not lead
        on, has no rows.
        """
        slots = cycles - variables.first_cycle
        slots = slots[slots < len(self)]
        if len(slots) == 0:
            return []
        cycles = variables.first_cycle + slots
        return [odometry_rows(cycles, self.terms(slots, variables.poses, variables.calibration), cycles)]


def odometry_rows(cycles: IntArray, terms: tuple[Array, Array], owner: IntArray) -> Rows:
    """What `OdometryChain.terms` gives, as rows of the cycles (m,) it is of, with owners (m,)."""
    residual, jacobian = terms
    keys = np.stack([np.full(len(cycles), CALIBRATION_KEY), pose_keys(cycles), pose_keys(cycles + 1)], axis=1)
    flat = jacobian.reshape(residual.size, CALIBRATION_SIZE + 2 * POSE)
    return Rows(np.repeat(keys, POSE, axis=0), flat, residual.ravel(), np.repeat(owner, POSE))


def odometry_factor(cycle: int, interval: IntegratedOdometry) -> gtsam.CustomFactor:
    """The odometry from the pose of a cycle to the next one, with its calibration."""
    return calibrated_odometry_factor(pose_key(cycle), pose_key(cycle + 1), CALIBRATION_KEY, interval)


def calibrated_delta(odometry: IntegratedOdometry, calibration: Array) -> Array:
    """Returns `delta * (-G b)` (3,), the relative pose of an interval corrected by the calibration b (2,)."""
    return compose(odometry.delta, -odometry.calibration_jacobian @ calibration)


def through_odometry(by_pose: Array, poses: Array, odometry: OdometryChain) -> tuple[Array, Array, Array]:
    """Rows on a pose that is reached by the last odometry only, on what it is reached from.

    by_pose (m, 3) derivatives by the newer of two poses (2, 3), map frame. Gives the derivatives by the older
    pose (m, 3) and by the calibration (m, 2), `-g R G`, and whitened rows (m, 3) of the odometry's own noise.
    """
    dx, dy = poses[1, :2] - poses[0, :2]
    by_last = by_pose.copy()
    by_last[:, 2] += by_pose[:, 1] * dx - by_pose[:, 0] * dy
    c, s = np.cos(poses[1, 2]), np.sin(poses[1, 2])
    local = by_pose @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return by_last, -local @ odometry.by_calibration[-1], local @ np.linalg.inv(odometry.whiteners[-1])
