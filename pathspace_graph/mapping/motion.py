"""The motion between two perception cycles, prediction (paper: Predict), and calibration."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from math import inf
from typing import Final, Self

import numpy as np

from pathspace_graph.errors import SettingsError
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.noise import KnownNoise, TwistNoise
from pathspace_graph.factors.odometry import (
    CALIBRATION_SIZE,
    IntegratedOdometry,
    integrate_each,
    integrate_twists,
)
from pathspace_graph.graph.smoother import FixedLagSmoother
from pathspace_graph.graph.variables import CALIBRATION_KEY, POSE, SENSOR_KEY, pose_key
from pathspace_graph.graph.window import MapRows, SmootherSettings
from pathspace_graph.io.log import SIGMA_ODOMETRY, Odometry
from pathspace_graph.io.results import VehicleState
from pathspace_graph.settings.mapper import MapperSettings, OdometrySettings

from .path import DrivenPath

DOUBT_CYCLES: Final = 10  # cycles between two checks of the calibrations


@dataclass(frozen=True)
class BiasMeasurement:
    """Bias of the yaw rate, measured by a vehicle at rest."""

    value: float  # mean yaw rate (rad/s)
    sigma: float  # its standard deviation (rad/s)


@dataclass(frozen=True, eq=False)
class MeasuredMotion:
    """The motion since the last cycle, and the findings of the check of odometry."""

    odometry: IntegratedOdometry  # relative pose, with its covariance
    twists: Array  # (k, 3) twists since the last cycle, in m/s, m/s and rad/s
    doubted: bool = False  # whether the detections contradict the odometry; their own motion replaces it
    missing: bool = False  # whether twists were missing for too long
    stuck: bool = False  # whether the twist repeats to the last digit
    bias: BiasMeasurement | None = None  # bias, if just measured at rest
    durations: Array | None = None  # (k,) durations of the twists (s); None if they are not the odometry's
    excess: Array = field(default_factory=lambda: np.zeros((0, POSE)))
    """(k, 3) Additional standard deviation of a twist that is extrapolated for long, with `durations`."""

    def with_missed(self, sigmas: Array, noise: TwistNoise) -> Self:
        """Add the standard deviations (3,) of a motion that the twists have missed (m, m, rad)."""
        if self.durations is None or not self.durations.any():
            return self
        excess = np.hypot(self.excess, sigmas / float(np.linalg.norm(self.durations)))
        motion = replace(self, excess=excess)
        return replace(motion, odometry=integrated_again([motion], noise)[0])

    @property
    def rests(self) -> bool:
        return not self.twists.any()

    @property
    def fault(self) -> str:
        """Fault of the odometry in words; empty if there is none."""
        if self.missing:
            return "there is no odometry"
        return "the detections contradict the odometry" if self.doubted else ""


def integrated_again(motions: Sequence[MeasuredMotion], noise: TwistNoise) -> list[IntegratedOdometry]:
    """Return the odometry of motions, integrated with other noise of a twist where it is of twists."""
    durations = [motion.durations for motion in motions if motion.durations is not None]
    of_twists = [motion for motion in motions if motion.durations is not None]
    if not of_twists:
        return [motion.odometry for motion in motions]
    held, twists = np.concatenate(durations), np.concatenate([motion.twists for motion in of_twists])
    sigmas = np.hypot(noise.sigmas(held), np.concatenate([motion.excess for motion in of_twists]))
    again = iter(integrate_each(held, twists, sigmas, [len(one) for one in durations]))
    return [motion.odometry if motion.durations is None else next(again) for motion in motions]


def known_noise(sigma: Array | KnownNoise | None) -> KnownNoise:
    """Noise as known before a drive; by default the simulator's, not stated.

    An array (3,) states the standard deviations of a twist (m/s, m/s, rad/s). SettingsError for anything but
    three positive numbers.
    """
    if sigma is None:
        return KnownNoise(np.array(SIGMA_ODOMETRY), odometry_stated=False)
    if not isinstance(sigma, KnownNoise):
        sigma = KnownNoise(sigma)
    try:
        sigmas = np.array(sigma.odometry, float)
    except (TypeError, ValueError):
        sigmas = np.zeros(0)
    if sigmas.shape != (3,) or not ((sigmas > 0.0) & (sigmas < np.inf)).all():
        found = sigma.odometry.tolist() if isinstance(sigma.odometry, np.ndarray) else sigma.odometry
        raise SettingsError(f"odometry_sigma: expected 3 positive numbers, found {found!r:.80}")
    return replace(sigma, odometry=sigmas)


def integrate_odometry(odometry: Odometry, until: float, sigma: Array) -> IntegratedOdometry:
    """Integrate twists, each constant until the next one, and the last one until a stamp (s).

    sigma, (3,) or (k, 3), is the standard deviation of one measured twist (m/s, m/s, rad/s).
    """
    return integrate_twists(np.diff(np.append(odometry.t, until)), odometry.twist, sigma)


def predict(smoother: FixedLagSmoother[MapRows], path: DrivenPath, motion: MeasuredMotion, t: float) -> None:
    """Add the pose at t (s) by the calibrated motion since the newest one, and extend the driven path."""
    path.update(smoother.predict(t, motion.odometry, OdometrySettings.sigmas_start))
    path.steer(motion.twists)
    if motion.bias is not None:
        smoother.measure_bias(motion.bias.value, motion.bias.sigma)


def with_inflated_priors(mean: Array, variance: Array, settings: MapperSettings) -> MapperSettings:
    """Widen the priors of the calibrations if the drive contradicts one of them; return the settings.

    mean m and variance v, (2,) or (7,), are the estimates of the calibrations. If a prior with mean p and
    standard deviation sigma is right, m - p has the variance `sigma^2 - v`. The group with the most
    contradicted entry becomes wide, odometry or sensor. This acts like a heavy-tailed prior.
    """
    sigma = np.array(settings.sigmas_calibrations)
    limits = np.full(len(sigma), settings.calibration.doubt)
    limits[:CALIBRATION_SIZE] = settings.odometry.doubt
    if settings.odometry.hold_scale:
        limits[0] = np.inf
    spread = sigma**2 - variance
    shown = spread > np.finfo(np.float32).eps * sigma**2  # whether the drive is informative
    off = mean - settings.calibrations
    square = np.where(shown, off**2 / np.where(shown, spread, 1.0), 0.0) / limits**2
    most = int(np.argmax(square))
    if square[most] <= 1.0:
        return settings
    if most < CALIBRATION_SIZE:
        return replace(settings, odometry=settings.odometry.widened())
    return replace(settings, calibration=settings.calibration.widened())


def inflate_priors(
    smoother: FixedLagSmoother[MapRows],
    settings: MapperSettings,
    sensor_doubted: bool,
    measured: MapperSettings | None = None,
) -> MapperSettings:
    """Widen the priors of calibrations that the drive contradicts; return the settings with the new priors.

    If the front end doubts the prior of the sensor, it becomes wide at once, before other variables absorb
    the sensor's errors. If it has measured these errors, the priors come from the settings `measured`. Call
    it on an open loop only: the prior of a closed map is linearized at the calibration of its closure, and is
    overconfident.
    """
    if measured is not None:
        settings = replace(settings, odometry=measured.odometry, calibration=measured.calibration)
    if sensor_doubted and settings.calibration.doubt < inf:
        settings = replace(settings, calibration=settings.calibration.widened())
    is_due = (
        measured is None and smoother.next_cycle % DOUBT_CYCLES == 0
    )  # else the estimate lacks the new priors
    if smoother.last_step is not None and is_due:
        variables = smoother.variables
        variance = np.diag(smoother.last_covariance(variables.calibration_keys))
        settings = with_inflated_priors(variables.calibrations, variance, settings)
    smoother.set_calibration_priors(np.array(settings.calibrations), np.array(settings.sigmas_calibrations))
    return settings


def with_size(covariance: Array, values: Array, sigma: float) -> Array:
    """Add the uncertainty of the scale of the world to a covariance (n, n): `sigma^2 v v'`.

    The values v (n,) are lengths from the start (m), and zero for headings. A fixed scale error of the
    odometry is not measured, and changes all lengths alike.
    """
    return covariance + sigma**2 * np.outer(values, values)


def vehicle_of(pose: Array, calibrations: Array, covariance: Array, sigma_size: float) -> VehicleState:
    """Return the vehicle's state, given the covariance of [pose | calibrations] without that of the scale."""
    values = np.concatenate([pose[:2], [0.0, -1.0], np.zeros(len(calibrations) - 1)])  # -1 by the scale error
    return VehicleState.split(pose, calibrations, with_size(covariance, values, sigma_size))


def vehicle_state(smoother: FixedLagSmoother[MapRows], sigma_size: float = 0.0) -> VehicleState:
    """Return the newest pose and the calibration of a smoother, with their joint covariance."""
    variables, keys = smoother.variables, [pose_key(smoother.next_cycle - 1), CALIBRATION_KEY]
    if len(variables.sensor):
        keys.append(SENSOR_KEY)
    covariance = smoother.covariance(np.array(keys, np.intp))
    return vehicle_of(variables.poses[-1], variables.calibrations, covariance, sigma_size)


def smoother_settings(settings: MapperSettings) -> SmootherSettings:
    """Select the engine's part of an estimator's settings."""
    return SmootherSettings(
        lag=settings.lag,
        max_poses=settings.max_poses,
        tolerances=(settings.relinearize.point, settings.relinearize.heading),
        sigmas_calibrations=settings.sigmas_calibrations,
        calibrations=settings.calibrations,
    )
