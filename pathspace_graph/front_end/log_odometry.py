"""Odometry of a whole log, and the priors of first pose and calibrations: factors of a batch."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.odometry import IntegratedOdometry, accumulated
from pathspace_graph.factors.se2 import compose
from pathspace_graph.graph.elimination import owners
from pathspace_graph.graph.rows import OdometryChain, Rows, odometry_rows
from pathspace_graph.graph.variables import CALIBRATION_KEY, SENSOR_KEY, Variables, pose_key
from pathspace_graph.mapping.motion import BiasMeasurement
from pathspace_graph.settings.mapper import CalibrationSettings, OdometrySettings


@dataclass(frozen=True, eq=False)
class LogOdometry:
    """The prior of the first pose, and the motion from each cycle's pose to the next."""

    stamps: Array  # (P,) stamps of the perception cycles (s)
    first: Array  # (3,) prior mean of the first pose, map frame: odometry since the first odometry stamp
    first_information: Array  # (3, 3) inverse of its covariance, map frame
    odometry: OdometryChain  # P - 1 intervals, one from each cycle's pose to the next
    twists: Array  # (P, 3) twists in force at the cycles (m/s, m/s, rad/s)
    calibration_mean: Array  # (2,) prior mean of the calibration: scale error (-), yaw-rate bias (rad/s)
    calibration_sigma: Array  # (2,) its prior standard deviation
    bias: BiasMeasurement | None = None  # bias of the yaw rate, measured at rest

    def __len__(self) -> int:
        return len(self.stamps)

    def dead_reckoned(self, calibration: Array) -> Array:
        """Integrate the odometry, corrected by a calibration (2,), to poses (P, 3); theta is not wrapped."""
        deltas = compose(self.odometry.deltas, -self.odometry.by_calibration @ calibration)
        return accumulated(np.concatenate([self.first[None], deltas]))

    def rows(self, poses: Array, calibration: Array) -> list[Rows]:
        """Return the rows of `odometry` and `priors` at poses (P, 3) and a calibration (2,)."""
        return [self.odometry_rows(poses, calibration), *self.priors(poses[0], calibration)]

    def odometry_rows(self, poses: Array, calibration: Array) -> Rows:
        """Return the rows of the motion from each of the poses (P, 3) to the next."""
        start, terms = np.arange(len(self.odometry)), self.odometry.terms(slice(None), poses, calibration)
        return odometry_rows(start, terms, owners(start))

    def rows_at(self, variables: Variables, settings: CalibrationSettings) -> list[Rows]:
        """Return all rows at the values of variables, with the prior of the sensor's calibration."""
        rows = self.rows(variables.poses, variables.calibration)
        return [*rows, sensor_prior(variables.sensor, settings)] if len(variables.sensor) else rows

    def priors(self, first: Array, calibration: Array) -> list[Rows]:
        """Return the rows of the priors at a first pose (3,) and a calibration (2,)."""
        root = np.asarray(np.linalg.cholesky(self.first_information).T, np.float64)
        return [_prior(pose_key(0), root, first - self.first), *self.calibration_priors(calibration)]

    def calibration_priors(self, calibration: Array) -> list[Rows]:
        """Return the rows of the priors at a calibration (2,)."""
        weights = np.diag(1.0 / self.calibration_sigma)
        priors = [_prior(CALIBRATION_KEY, weights, calibration - self.calibration_mean)]
        if self.bias is not None:
            root = np.array([[0.0, 1.0 / self.bias.sigma]])
            priors.append(_prior(CALIBRATION_KEY, root, calibration - [0.0, self.bias.value]))
        return priors


def _prior(key: int, root: Array, off: Array) -> Rows:
    """Return the rows `root off` on one variable, owned by the first factor."""
    return Rows(np.full((len(root), 1), key), root, root @ off, np.zeros(len(root), np.intp))


def chained(
    stamps: Sequence[float],
    steps: Sequence[IntegratedOdometry],
    settings: OdometrySettings,
    biases: Iterable[BiasMeasurement | None] = (),
) -> LogOdometry:
    """Chain the odometry of cycles with these stamps (s): each step ends at the pose of its cycle."""
    return LogOdometry(
        stamps=np.array(stamps),
        first=compose(np.zeros(3), steps[0].delta),
        first_information=np.linalg.inv(steps[0].covariance + np.diag(settings.sigmas_start) ** 2),
        odometry=OdometryChain(steps[1:]),
        twists=np.array([step.twist for step in steps]),
        calibration_mean=np.array(settings.means),
        calibration_sigma=np.array(settings.sigmas),
        bias=mean_bias([bias for bias in biases if bias is not None]),
    )


def mean_bias(measured: Sequence[BiasMeasurement]) -> BiasMeasurement | None:
    """Return the information-weighted mean of independent measurements of the bias; None without any."""
    if not measured:
        return None
    information = np.array([one.sigma**-2 for one in measured])
    values = np.array([one.value for one in measured])
    return BiasMeasurement(float(information @ values / information.sum()), float(information.sum() ** -0.5))


def sensor_prior(calibration: Array, settings: CalibrationSettings, number: int = 0) -> Rows:
    """Return the rows `(c - mean) / sigma` of the calibration c (5,) of a sensor."""
    root = np.diag(1.0 / np.array(settings.sigmas))
    return _prior(SENSOR_KEY + number, root, calibration - settings.means)


def half_square(groups: Sequence[Rows]) -> float:
    """Return half the sum of the squared residuals."""
    return sum(0.5 * float((rows.residual**2).sum()) for rows in groups)
