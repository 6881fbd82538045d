"""The prediction of the newest pose by odometry (paper: Predict)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.odometry import IntegratedOdometry, integrate_twists
from pathspace_graph.graph.keys import CALIBRATION_KEY, SENSOR_KEY, pose_key
from pathspace_graph.graph.smoother import FixedLagSmoother, SmootherSettings
from pathspace_graph.graph.window import MapRows
from pathspace_graph.io.log import Odometry
from pathspace_graph.io.results import VehicleState
from pathspace_graph.settings.mapper import ODOMETRY_SIGMA, MapperSettings, OdometrySettings

from .path import DrivenPath

Array = NDArray[np.float64]


def odometry_noise(sigma: Array | None) -> Array:
    """Returns the standard deviations (3,) of a twist as a copy; without any, those of the simulator.

    They are in m/s, m/s and rad/s.
    """
    return np.array(ODOMETRY_SIGMA if sigma is None else sigma, float)


def integrate_odometry(odometry: Odometry, until: float, sigma: Array) -> IntegratedOdometry:
    """Integrates twists, each held until the next and the last one until a stamp (s).

    sigma (3,) is the standard deviation of one measured twist (m/s, m/s, rad/s).
    """
    return integrate_twists(np.diff(np.append(odometry.t, until)), odometry.twist, sigma)


def predict(
    smoother: FixedLagSmoother[MapRows],
    path: DrivenPath,
    odometry: Odometry,
    t: float,
    sigma: Array,
    settings: MapperSettings,
) -> IntegratedOdometry:
    """Adds the pose at t (s) by the calibrated odometry since the newest one, and extends the driven path.

    sigma (3,) is the standard deviation of one measured twist (m/s, m/s, rad/s). The integrated odometry is
    returned.
    """
    integrated = integrate_odometry(odometry, t, sigma)
    path.update(smoother.predict(t, integrated, settings.odometry.sigmas_start))
    path.steer(odometry.twist)
    return integrated


def doubted_prior(mean: Array, variance: Array, sigma: Array, settings: OdometrySettings) -> Array:
    """Returns the standard deviations (2,) of the calibration's prior, wider where the drive contradicts it.

    mean m and variance v (2,) are those of the calibration, sigma (2,) is its prior's. If the prior is right,
    then m has the variance `sigma^2 - v` before the drive. So the prior has a heavy tail, as that of a
    mixture of two Gaussians.
    """
    first, spread = np.array(settings.sigmas_calibration), sigma**2 - variance
    shown = spread > np.finfo(np.float32).eps * sigma**2  # the drive says something at all
    doubted = shown & (mean**2 > settings.doubt**2 * spread) & (sigma == first)
    return np.where(doubted, settings.wide * first, sigma)


def doubt_calibration(smoother: FixedLagSmoother[MapRows], settings: OdometrySettings) -> None:
    """Widens the prior of the odometry's calibration where the drive so far contradicts it."""
    if smoother.last_step is None or smoother.next_cycle % settings.doubt_cycles:
        return
    variance = np.diag(smoother.last_covariance(np.array([CALIBRATION_KEY])))
    sigma = doubted_prior(smoother.variables.calibration, variance, smoother.calibration_sigma, settings)
    smoother.widen_calibration(sigma)


def vehicle_state(smoother: FixedLagSmoother[MapRows]) -> VehicleState:
    """Returns the newest pose and the calibration of a smoother, with their joint covariance."""
    variables, keys = smoother.variables, [pose_key(smoother.next_cycle - 1), CALIBRATION_KEY]
    if len(variables.sensor):
        keys.append(SENSOR_KEY)
    covariance = smoother.covariance(np.array(keys, np.intp))
    return VehicleState.split(variables.poses[-1], variables.calibrations, covariance)


def smoother_settings(settings: MapperSettings) -> SmootherSettings:
    """Returns the engine's part of an estimator's settings."""
    return SmootherSettings(
        lag=settings.lag,
        tolerances=(settings.relinearize.point, settings.relinearize.heading),
        keyframe_interval=settings.closing.keyframe_interval,
        sigma_calibration=settings.odometry.sigmas_calibration,
        sigma_sensor=settings.calibration.sigmas,
        relative=True,
    )
