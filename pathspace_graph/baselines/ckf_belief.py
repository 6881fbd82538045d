"""State of the paper's filters: a joint Gaussian over pose and map, propagated by the cubature rule.

The paper's transform is the third-degree spherical-radial rule (Arasaratnam and Haykin 2009).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final, Self

import numpy as np
from scipy.linalg import block_diag, lapack

from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.odometry import CALIBRATION_SIZE, IntegratedOdometry
from pathspace_graph.factors.se2 import compose, to_map, to_vehicle
from pathspace_graph.factors.sensor import SENSOR_SIZE, by_sensor, corrected
from pathspace_graph.graph.variables import POINT, POSE
from pathspace_graph.io.log import Detections
from pathspace_graph.io.results import VehicleState
from pathspace_graph.mapping.motion import MeasuredMotion
from pathspace_graph.settings.online import CalibrationSettings, OdometrySettings

_LEAST_VARIANCE: Final = 1e-12
"""Least eigenvalue of a covariance without a Cholesky factor, relative to the largest one."""


@dataclass(frozen=True, eq=False)
class Transformed:
    """Moments of a function of a Gaussian, by the cubature rule."""

    mean: Array  # (q,) mean of the function
    covariance: Array  # (q, q) covariance of the function
    slope: Array
    """(q, d) Statistical linearization `C_yx C_xx^-1`. The covariance of the function with a variable z that
    it does not depend on is `slope @ C_xz`, exactly for Gaussians."""


def square_root(covariance: Array) -> Array:
    """Lower L with `L L' = covariance` (d, d); small eigenvalues of a singular covariance are raised."""
    factor, info = lapack.dpotrf(covariance, lower=1, clean=1)
    if info == 0:
        return np.asarray(factor)
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    lifted = np.maximum(values, _LEAST_VARIANCE * max(float(values[-1]), _LEAST_VARIANCE))
    return np.asarray(np.linalg.qr((vectors * np.sqrt(lifted)).T)[1].T)


def transform(function: Callable[[Array], Array], mean: Array, covariance: Array) -> Transformed:
    """Compute mean, covariance and slope of `function`, which maps points (k, d) row by row to (k, q).

    Its 2 d points are `mean +- sqrt(d) L e_i`, of equal weight, where L is the root of the covariance. All
    are exact for a linear function; the mean is exact for a polynomial of the third degree.
    """
    root = square_root(covariance)
    d = len(mean)
    offsets = np.sqrt(d) * root.T
    values = function(np.concatenate([mean + offsets, mean - offsets]))
    centre = values.mean(axis=0)
    spread = (values - centre) / np.sqrt(2.0 * d)
    half = (values[:d] - values[d:]) / (2.0 * np.sqrt(d))
    slope, _ = lapack.dtrtrs(root, half, lower=1, trans=1)
    return Transformed(centre, spread.T @ spread, np.asarray(slope).T)


_ODOMETRY: Final = slice(POSE, POSE + CALIBRATION_SIZE)
HEAD: Final = POSE + CALIBRATION_SIZE + SENSOR_SIZE  # number of entries of the state before its points
SENSOR_COLUMNS: Final = np.arange(POSE + CALIBRATION_SIZE, HEAD)  # entries of the sensor's calibration


class Belief:
    """Gaussian over `x = [pose | calibration of odometry and sensor | points]`.

    Pose (x, y, theta) and points (x, y) are in the map frame, in m and rad. The calibration is the scale
    error of the speeds, the bias of the yaw rate (rad/s), and `factors.sensor:SENSOR`. Only the entries of x
    that a model depends on get cubature points. The others follow by the joint covariance. The result is that
    of the full rule, without its cubic cost.
    """

    def __init__(self, pose: Array, covariance: Array, calibration_sigma: Array | None = None) -> None:
        sigma, known = np.zeros(HEAD - POSE), () if calibration_sigma is None else calibration_sigma
        sigma[: len(known)] = known
        self.mean: Array = np.concatenate([pose, np.zeros(HEAD - POSE)])  # (n,) mean of x
        self.covariance: Array = block_diag(covariance, np.diag(sigma**2))  # (n, n) covariance of x
        self.twist: Array = np.zeros(POSE)  # (3,) twist of the vehicle, in m/s, m/s and rad/s

    @classmethod
    def at_start(cls, settings: OdometrySettings, sensor: CalibrationSettings) -> Self:
        """Make the belief at the first odometry stamp, with an empty map.

        The priors of the sensor are wide: unlike a window, a filter cannot relinearize past errors.
        """
        calibration = np.array([*settings.sigmas, *sensor.widened().sigmas])
        belief = cls(np.zeros(POSE), np.diag(np.square(settings.sigmas_start)), calibration)
        known = np.array([*settings.means, *sensor.means])
        belief.mean[POSE : POSE + len(known)] = known
        return belief

    @property
    def pose(self) -> Array:
        """View of the mean pose (3,); theta is not wrapped."""
        return self.mean[:POSE]

    @property
    def points(self) -> Array:
        """View of the mean points (m, 2)."""
        return self.mean[HEAD:].reshape(-1, POINT)

    @property
    def sensor(self) -> Array:
        """View of the mean calibration of the sensor (5,)."""
        return self.mean[POSE + CALIBRATION_SIZE : HEAD]

    def corrected(self, detections: Detections) -> Detections:
        """Correct the newest detections by the mean calibration of the sensor."""
        points = detections.points_vehicle
        twists = np.tile(self.twist, (len(points), 1))
        return replace(detections, points_vehicle=corrected(points, twists, self.sensor))

    def by_sensor(self, points_vehicle: Array) -> Array:
        """Derivatives (m, 2, 5) of the newest detections (m, 2) by the sensor's calibration."""
        return by_sensor(points_vehicle, np.tile(self.twist, (len(points_vehicle), 1)))

    def vehicle_state(self) -> VehicleState:
        """Return a copy of the pose and the calibration, with their joint covariance."""
        covariance = self.covariance[:HEAD, :HEAD].copy()
        return VehicleState.split(self.pose, self.mean[POSE:HEAD], covariance)

    def follow(self, motion: MeasuredMotion) -> None:
        """Predict the pose by a motion, and update by a bias that was measured at rest."""
        self.predict(motion.odometry)
        if motion.bias is not None:
            measured, noise = np.array([motion.bias.value]), np.array([[motion.bias.sigma**2]])
            self.update(np.array([POSE + 1]), lambda x: x, measured, noise)

    def predict(self, odometry: IntegratedOdometry) -> None:
        """Predict `pose <- pose * delta * (error - J calibration)`; the error is that of the odometry."""
        drift, size, self.twist = odometry.calibration_jacobian, HEAD + POSE, odometry.twist
        augmented = np.zeros((size, size))
        augmented[:HEAD, :HEAD] = self.covariance[:HEAD, :HEAD]
        augmented[HEAD:, HEAD:] = odometry.covariance

        def drive(x: Array) -> Array:
            error = x[:, HEAD:] - x[:, _ODOMETRY] @ drift.T
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
        """Update by `measured` (q,): `function(x[columns])`, row by row, plus noise of covariance (q, q)."""
        predicted = transform(function, self.mean[columns], self.covariance[np.ix_(columns, columns)])
        root = square_root(predicted.covariance + noise)
        cross = predicted.slope @ self.covariance[columns]
        half, _ = lapack.dtrtrs(root, np.column_stack([cross, measured - predicted.mean]), lower=1)
        self.mean += half[:, :-1].T @ half[:, -1]
        self.covariance -= half[:, :-1].T @ half[:, :-1]
        self.covariance = 0.5 * (self.covariance + self.covariance.T)

    def measuring_columns(self, others: IntArray) -> IntArray:
        """Entries of x that detections depend on: pose, sensor, and others (k,)."""
        return np.concatenate([np.arange(POSE), SENSOR_COLUMNS, others])

    def measuring(self, points: IntArray) -> Callable[[Array], Array]:
        """Return the function from [pose | sensor | points] (k, d) to corrected detections of points (k,).

        It is `R' (p - t) - C (b - b0)`, where b0 is the mean calibration of the correction.
        """
        expected = to_vehicle_rows(self.pose[None], self.points[points].reshape(1, -1)).reshape(-1, POINT)
        shift, now = self.by_sensor(expected).reshape(-1, SENSOR_SIZE), self.sensor.copy()

        def detect(x: Array) -> Array:
            seen = to_vehicle_rows(x[:, :POSE], x[:, POSE + SENSOR_SIZE :])
            return seen - (x[:, POSE : POSE + SENSOR_SIZE] - now) @ shift.T

        return detect

    def add_points(self, detections: Array, covariances: Array) -> None:
        """Add points at the end of x, at detections (k, 2) with covariances (k, 2, 2), vehicle frame."""
        joint = block_diag(self.covariance[:POSE, :POSE], *covariances)
        mean = np.concatenate([self.pose, detections.ravel()])
        placed = transform(lambda x: to_map_rows(x[:, :POSE], x[:, POSE:]), mean, joint)
        cross = placed.slope[:, :POSE] @ self.covariance[:POSE]
        self.mean = np.concatenate([self.mean, placed.mean])
        self.covariance = np.block([[self.covariance, cross.T], [cross, placed.covariance]])

    def transform_points(self, start: int, stop: int, matrix: Array, sigma: Array) -> None:
        """Multiply points [start, stop) by `matrix` (k, stop - start), and add noise of sigma (k,) in m."""
        low, high = HEAD + POINT * start, HEAD + POINT * stop
        full = np.kron(matrix, np.eye(POINT))
        mean, covariance = self.mean, self.covariance
        cross = full @ covariance[low:high]
        block = cross[:, low:high] @ full.T + np.diag(np.repeat(sigma, POINT) ** 2)
        before, after = slice(0, low), slice(high, len(mean))
        self.mean = np.concatenate([mean[before], full @ mean[low:high], mean[after]])
        self.covariance = np.block(
            [
                [covariance[before, before], cross[:, before].T, covariance[before, after]],
                [cross[:, before], block, cross[:, after]],
                [covariance[after, before], cross[:, after].T, covariance[after, after]],
            ]
        )

    def reorder(self, points: IntArray) -> None:
        """Reorder or select points by their indices (k,)."""
        columns = np.concatenate([np.arange(HEAD), point_columns(points)])
        self.mean = self.mean[columns]
        self.covariance = self.covariance[np.ix_(columns, columns)]


def point_columns(points: IntArray) -> IntArray:
    """Entries (2 k,) of points (k,) in x."""
    return (HEAD + POINT * points[:, None] + np.arange(POINT)).ravel()


def to_map_rows(poses: Array, detections: Array) -> Array:
    """Transform r detections (k, 2 r) from each of k poses (k, 3) to the map frame: `R z + t`."""
    repeated = np.repeat(poses, detections.shape[1] // POINT, axis=0)
    return to_map(detections.reshape(-1, POINT), repeated).reshape(len(poses), -1)


def to_vehicle_rows(poses: Array, points: Array) -> Array:
    """Transform r map points (k, 2 r) to the vehicle frame of each of k poses (k, 3): `R' (p - t)`."""
    repeated = np.repeat(poses, points.shape[1] // POINT, axis=0)
    return to_vehicle(points.reshape(-1, POINT), repeated).reshape(len(poses), -1)
