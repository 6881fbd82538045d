"""The belief of the paper's filters: the vehicle's pose and the map's points, with one joint covariance."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, lapack

from pathspace_graph.factors.odometry import CALIBRATION_SIZE, IntegratedOdometry
from pathspace_graph.graph.keys import POSE
from pathspace_graph.settings.mapper import OdometrySettings

from .cubature import Transformed, square_root, transform

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]

PLANE: Final = 2
"""A point has this number of entries."""
HEAD: Final = POSE + CALIBRATION_SIZE
"""The state has this number of entries before the points."""


class Belief:
    """A belief is the Gaussian of `x = [pose | calibration | points]`.

    The pose (x, y, theta) and the points (x, y) are in the map frame, in m and rad. The calibration is the
    scale error of the speeds and the bias of the yaw rate (rad/s). The function of a step depends on few
    entries, so cubature points are drawn for these only; all other entries follow by the joint covariance.
    The full cubature rule gives the same for them at a cubic cost.
    """

    def __init__(self, pose: Array, covariance: Array, calibration_sigma: Array | None = None) -> None:
        sigma = np.zeros(CALIBRATION_SIZE) if calibration_sigma is None else calibration_sigma
        self.mean: Array = np.concatenate([pose, np.zeros(CALIBRATION_SIZE)])
        """(n,) This is the mean of x."""
        self.covariance: Array = block_diag(covariance, np.diag(sigma**2))
        """(n, n) This is the joint covariance of x."""

    @classmethod
    def at_start(cls, settings: OdometrySettings) -> Belief:
        """Returns the belief at the first odometry stamp, without a map."""
        sigmas = np.array([settings.sigma_start, settings.sigma_start, settings.sigma_start_heading])
        calibration = np.array([settings.sigma_scale, settings.sigma_bias])
        return cls(np.zeros(POSE), np.diag(sigmas**2), calibration)

    @property
    def pose(self) -> Array:
        """Returns a view of the mean pose (3,)."""
        return self.mean[:POSE]

    @property
    def points(self) -> Array:
        """Returns a view of the mean points (m, 2)."""
        return self.mean[HEAD:].reshape(-1, PLANE)

    def predict(self, odometry: IntegratedOdometry) -> None:
        """Predicts `pose <- pose * delta * (error - J calibration)`, with the covariance of the error."""
        drift, size = odometry.calibration_jacobian, HEAD + POSE
        augmented = np.zeros((size, size))
        augmented[:HEAD, :HEAD] = self.covariance[:HEAD, :HEAD]
        augmented[HEAD:, HEAD:] = odometry.covariance

        def drive(x: Array) -> Array:
            error = x[:, HEAD:] - x[:, POSE:HEAD] @ drift.T
            return compose_rows(compose_rows(x[:, :POSE], odometry.delta), error)

        moved = transform(drive, np.append(self.mean[:HEAD], np.zeros(POSE)), augmented)
        cross = moved.slope[:, :HEAD] @ self.covariance[:HEAD, POSE:]
        self.mean[:POSE] = moved.mean
        self.covariance[:POSE, :POSE] = moved.covariance
        self.covariance[:POSE, POSE:] = cross
        self.covariance[POSE:, :POSE] = cross.T

    def update(
        self, columns: IntArray, function: Callable[[Array], Array], measured: Array, noise: Array
    ) -> None:
        """Applies one Kalman update: `measured` (q,) is a function of the entries `columns` (d,) plus noise.

        The function maps points (k, d) to (k, q); the noise has the covariance (q, q).
        """
        seen = transform(function, self.mean[columns], self.covariance[np.ix_(columns, columns)])
        root = square_root(seen.covariance + noise)
        cross = seen.slope @ self.covariance[columns]
        half, _ = lapack.dtrtrs(root, np.column_stack([cross, measured - seen.mean]), lower=1)
        self.mean += half[:, :-1].T @ half[:, -1]
        self.covariance -= half[:, :-1].T @ half[:, :-1]
        self._symmetrize()

    def seen(self, points: IntArray) -> Transformed:
        """Returns the predicted detections of points (k,): mean (2 k,) and covariance, vehicle frame."""
        columns = np.concatenate([np.arange(POSE), point_columns(points)])
        covariance = self.covariance[np.ix_(columns, columns)]
        return transform(lambda x: to_vehicle_rows(x[:, :POSE], x[:, POSE:]), self.mean[columns], covariance)

    def observe(self, detections: Array, covariances: Array) -> None:
        """Appends points at detections (k, 2) with covariances (k, 2, 2), both in the vehicle frame."""
        k = len(detections)
        columns = np.arange(POSE)
        own = np.zeros((POSE + PLANE * k, POSE + PLANE * k))
        own[:POSE, :POSE] = self.covariance[:POSE, :POSE]
        for i, covariance in enumerate(covariances):
            block = slice(POSE + PLANE * i, POSE + PLANE * (i + 1))
            own[block, block] = covariance
        mean = np.concatenate([self.pose, detections.ravel()])
        placed = transform(lambda x: to_map_rows(x[:, :POSE], x[:, POSE:]), mean, own)
        cross = placed.slope[:, :POSE] @ self.covariance[columns]
        self.mean = np.concatenate([self.mean, placed.mean])
        self.covariance = np.block([[self.covariance, cross.T], [cross, placed.covariance]])

    def change(self, start: int, stop: int, matrix: Array, sigma: Array) -> None:
        """Replaces the points [start, stop) by `matrix` (k, stop - start) times them, on both coordinates.

        Noise of standard deviation sigma (k,) in m is added to the new points. The change is linear, so the
        result is exact.
        """
        low, high = HEAD + PLANE * start, HEAD + PLANE * stop
        full = np.kron(matrix, np.eye(PLANE))
        mean, covariance = self.mean, self.covariance
        cross = full @ covariance[low:high]
        block = cross[:, low:high] @ full.T + np.diag(np.repeat(sigma, PLANE) ** 2)
        left, right = slice(0, low), slice(high, len(mean))
        self.mean = np.concatenate([mean[left], full @ mean[low:high], mean[right]])
        self.covariance = np.block(
            [
                [covariance[left, left], cross[:, left].T, covariance[left, right]],
                [cross[:, left], block, cross[:, right]],
                [covariance[right, left], cross[:, right].T, covariance[right, right]],
            ]
        )

    def reorder(self, points: IntArray) -> None:
        """Reorders the points, or keeps only some of them, by index (k,)."""
        columns = np.concatenate([np.arange(HEAD), point_columns(points)])
        self.mean = self.mean[columns]
        self.covariance = self.covariance[np.ix_(columns, columns)]

    def _symmetrize(self) -> None:
        """Removes the asymmetry of rounding errors."""
        self.covariance = 0.5 * (self.covariance + self.covariance.T)


def point_columns(points: IntArray) -> IntArray:
    """Returns the entries (2 k,) of x that hold points (k,)."""
    return (HEAD + PLANE * points[:, None] + np.arange(PLANE)).ravel()


def compose_rows(poses: Array, deltas: Array) -> Array:
    """Composes poses (k, 3) with deltas (k, 3) or (3,) on SE(2), row by row; theta is not wrapped."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    dx, dy = deltas[..., 0], deltas[..., 1]
    return np.column_stack(
        [poses[:, 0] + c * dx - s * dy, poses[:, 1] + s * dx + c * dy, poses[:, 2] + deltas[..., 2]]
    )


def to_map_rows(poses: Array, detections: Array) -> Array:
    """Maps r detections (k, 2 r) of each pose (k, 3) from the vehicle frame to the map frame: `R z + t`."""
    c, s = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
    x, y = detections[:, 0::2], detections[:, 1::2]
    placed = np.stack([c * x - s * y + poses[:, :1], s * x + c * y + poses[:, 1:2]], axis=2)
    return placed.reshape(len(poses), -1)


def to_vehicle_rows(poses: Array, points: Array) -> Array:
    """Maps r points (k, 2 r) of each pose (k, 3) from the map frame to the vehicle frame: `R' (p - t)`."""
    c, s = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
    x, y = points[:, 0::2] - poses[:, :1], points[:, 1::2] - poses[:, 1:2]
    return np.stack([c * x + s * y, c * y - s * x], axis=2).reshape(len(poses), -1)
