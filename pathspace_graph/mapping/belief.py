"""The state of the paper's filters: the vehicle's pose and points of the map, with one covariance."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, lapack

from pathspace_graph.factors.odometry import CALIBRATION_SIZE, IntegratedOdometry
from pathspace_graph.factors.se2 import compose
from pathspace_graph.graph.keys import POSE
from pathspace_graph.settings.mapper import OdometrySettings

from .cubature import Transformed, square_root, transform

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]

PLANE: Final = 2
"""Entries of a point."""
HEAD: Final = POSE + CALIBRATION_SIZE
"""Entries before the points."""


class Belief:
    """`x = [pose | calibration | points]`, Gaussian: pose (x, y, theta) and points (x, y) in the map frame, m
    and rad; the odometry's calibration (scale error of the speeds, bias of the yaw rate, rad/s).

    A step's function depends on few entries. Cubature points are laid through those only; all others follow
    by the joint covariance, which is what the full rule would give for them, without its cubic cost.
    """

    def __init__(self, pose: Array, covariance: Array, calibration_sigma: Array | None = None) -> None:
        sigma = np.zeros(CALIBRATION_SIZE) if calibration_sigma is None else calibration_sigma
        self.mean: Array = np.concatenate([pose, np.zeros(CALIBRATION_SIZE)])
        """(n,) x."""
        self.covariance: Array = block_diag(covariance, np.diag(sigma**2))
        """(n, n)."""

    @classmethod
    def at_start(cls, settings: OdometrySettings) -> Belief:
        """The vehicle at the first odometry stamp, no map."""
        sigmas = np.array([settings.sigma_start, settings.sigma_start, settings.sigma_start_heading])
        calibration = np.array([settings.sigma_scale, settings.sigma_bias])
        return cls(np.zeros(POSE), np.diag(sigmas**2), calibration)

    @property
    def pose(self) -> Array:
        """(3,) a view of x."""
        return self.mean[:POSE]

    @property
    def points(self) -> Array:
        """(m, 2) a view of x."""
        return self.mean[HEAD:].reshape(-1, PLANE)

    def predict(self, odometry: IntegratedOdometry) -> None:
        """`pose <- pose * delta * (error - J calibration)`, with the covariance of the odometry's error."""
        drift, size = odometry.calibration_jacobian, HEAD + POSE
        augmented = np.zeros((size, size))
        augmented[:HEAD, :HEAD] = self.covariance[:HEAD, :HEAD]
        augmented[HEAD:, HEAD:] = odometry.covariance

        def drive(x: Array) -> Array:
            error = x[:, HEAD:] - x[:, POSE:HEAD] @ drift.T
            return compose(compose(x[:, :POSE], odometry.delta), error)

        moved = transform(drive, np.append(self.mean[:HEAD], np.zeros(POSE)), augmented)
        cross = moved.slope[:, :HEAD] @ self.covariance[:HEAD, POSE:]
        self.mean[:POSE] = moved.mean
        self.covariance[:POSE, :POSE] = moved.covariance
        self.covariance[:POSE, POSE:] = cross
        self.covariance[POSE:, :POSE] = cross.T

    def update(
        self, columns: IntArray, function: Callable[[Array], Array], measured: Array, noise: Array
    ) -> None:
        """One Kalman update: `measured` (q,) is a function of the entries `columns` (d,), plus noise (q, q).

        The function takes points (k, d) to (k, q).
        """
        seen = transform(function, self.mean[columns], self.covariance[np.ix_(columns, columns)])
        root = square_root(seen.covariance + noise)
        cross = seen.slope @ self.covariance[columns]
        half, _ = lapack.dtrtrs(root, np.column_stack([cross, measured - seen.mean]), lower=1)
        self.mean += half[:, :-1].T @ half[:, -1]
        self.covariance -= half[:, :-1].T @ half[:, :-1]
        self._symmetrize()

    def seen(self, points: IntArray) -> Transformed:
        """Where the vehicle should see points (k,): mean (2 k,) and covariance (2 k, 2 k), vehicle frame."""
        columns = np.concatenate([np.arange(POSE), point_columns(points)])
        covariance = self.covariance[np.ix_(columns, columns)]
        return transform(lambda x: to_vehicle_rows(x[:, :POSE], x[:, POSE:]), self.mean[columns], covariance)

    def observe(self, detections: Array, covariances: Array) -> None:
        """New points, the last of x from now on: readings (k, 2) of the vehicle frame with (k, 2, 2)."""
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
        """The points [start, stop) become `matrix` (k, stop - start) times them, each coordinate alike.

        sigma (k,): what is added to each of them, m. The rule's own result, since the change is linear.
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
        """The points in another order, or some of them."""
        columns = np.concatenate([np.arange(HEAD), point_columns(points)])
        self.mean = self.mean[columns]
        self.covariance = self.covariance[np.ix_(columns, columns)]

    def _symmetrize(self) -> None:
        self.covariance = 0.5 * (self.covariance + self.covariance.T)


def point_columns(points: IntArray) -> IntArray:
    """(2 k,) entries of x of points (k,)."""
    return (HEAD + PLANE * points[:, None] + np.arange(PLANE)).ravel()


def to_map_rows(poses: Array, detections: Array) -> Array:
    """`R z + t`: for each of k poses (k, 3) its r readings (k, 2 r) of the vehicle frame -> map (k, 2 r)."""
    c, s = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
    x, y = detections[:, 0::2], detections[:, 1::2]
    placed = np.stack([c * x - s * y + poses[:, :1], s * x + c * y + poses[:, 1:2]], axis=2)
    return placed.reshape(len(poses), -1)


def to_vehicle_rows(poses: Array, points: Array) -> Array:
    """`R' (p - t)`: for each of k poses (k, 3) its r points (k, 2 r) of the map -> vehicle frame (k, 2 r)."""
    c, s = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
    x, y = points[:, 0::2] - poses[:, :1], points[:, 1::2] - poses[:, 1:2]
    return np.stack([c * x + s * y, c * y - s * x], axis=2).reshape(len(poses), -1)
