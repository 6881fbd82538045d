"""The prediction of poses by odometry, cycle by cycle and over a whole log."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.factors.noise import KnownNoise
from pathspace_graph.factors.sensor import SENSOR
from pathspace_graph.front_end.front_end import judge_log
from pathspace_graph.front_end.log_odometry import half_square
from pathspace_graph.graph.smoother import FixedLagSmoother
from pathspace_graph.io.log import Log, Odometry
from pathspace_graph.mapping.curve_map import CurveMap
from pathspace_graph.mapping.motion import (
    MeasuredMotion,
    integrate_odometry,
    predict,
    smoother_settings,
    with_inflated_priors,
)
from pathspace_graph.mapping.path import DrivenPath
from pathspace_graph.run import split_odometry
from pathspace_graph.settings.mapper import MapperSettings, OdometrySettings

from ..scenes.drives import DT, ODOMETRY_SIGMA, ahead, exact_log, true_poses

Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def log() -> Log:
    """A drive of 2 s around a bend, which sees nothing."""
    twists = ahead(5.0, 2.0) + np.array([0.0, 0.1, 0.5])
    return exact_log(twists, np.zeros((0, 2)), np.zeros(0, np.intp))


def test_the_last_twist_is_held_until_the_stamp() -> None:
    """4 m/s for 0.1 s, then 2 m/s for 0.3 s."""
    odometry = Odometry(np.array([0.0, 0.1]), np.array([[4.0, 0.0, 0.0], [2.0, 0.0, 0.0]]))
    motion = integrate_odometry(odometry, 0.4, np.array([0.5, 0.0, 0.0]))
    np.testing.assert_allclose(motion.delta, [1.0, 0.0, 0.0], atol=1e-12)
    assert motion.covariance[0, 0] == pytest.approx(0.25 * (0.1**2 + 0.3**2), rel=1e-6)


def test_every_cycle_adds_its_pose_and_extends_the_path(log: Log) -> None:
    settings = MapperSettings()
    smoother, path = FixedLagSmoother(smoother_settings(settings), CurveMap(settings)), DrivenPath()
    for odometry, cycle in split_odometry(log):
        motion = MeasuredMotion(integrate_odometry(odometry, cycle.t, ODOMETRY_SIGMA), odometry.twist)
        predict(smoother, path, motion, cycle.t)
    np.testing.assert_allclose(smoother.variables.poses, true_poses(log), atol=1e-9)
    assert smoother.times == [cycle.t for cycle in log.cycles]
    driven = np.hypot(*np.diff(true_poses(log)[:, :2], axis=0).T).sum()
    assert path.length == pytest.approx(driven, rel=1e-3)
    assert path.curvature == pytest.approx(0.1, abs=0.01)


def test_a_log_is_dead_reckoned_along_its_true_poses(log: Log) -> None:
    odometry = judge_log(log, KnownNoise(ODOMETRY_SIGMA), MapperSettings()).chain
    np.testing.assert_allclose(odometry.dead_reckoned(np.zeros(2)), true_poses(log), atol=1e-9)
    assert len(odometry) == len(log.cycles) == len(odometry.stamps)
    residual, _ = odometry.odometry.terms(slice(None), true_poses(log), np.zeros(2))
    np.testing.assert_allclose(residual, 0.0, atol=1e-6)


def test_a_calibration_frees_the_odometry_of_a_bias(log: Log) -> None:
    """Odometry that turns by 0.02 rad/s too fast is corrected by that bias."""
    biased = exact_log(
        log.odometry.twist + np.array([0.0, 0.0, 0.02]), np.zeros((0, 2)), np.zeros(0, np.intp)
    )
    odometry = judge_log(biased, KnownNoise(ODOMETRY_SIGMA), MapperSettings()).chain
    poses = odometry.dead_reckoned(np.array([0.0, 0.02]))
    np.testing.assert_allclose(poses[:, 2], true_poses(log)[:, 2], atol=1e-9)
    np.testing.assert_allclose(poses, true_poses(log), atol=2 * DT**2)


@pytest.mark.parametrize("mean", [(0.0, 0.0), (-0.04, 0.01)])
def test_the_rows_of_the_priors_have_their_cost(log: Log, mean: tuple[float, float]) -> None:
    settings = MapperSettings(odometry=OdometrySettings(scale=mean[0], bias=mean[1]))
    odometry = judge_log(log, KnownNoise(ODOMETRY_SIGMA), settings).chain
    rng = np.random.default_rng(0)
    first = odometry.first + np.array([1e-4, -2e-4, 1e-5])
    off = rng.normal(size=2)
    calibration = mean + odometry.calibration_sigma * off
    moved = first - odometry.first
    cost = 0.5 * (moved @ odometry.first_information @ moved + off @ off)
    assert half_square(odometry.priors(first, calibration)) == pytest.approx(cost, rel=1e-9)
    assert half_square(odometry.priors(odometry.first, calibration)) == pytest.approx(
        0.5 * off @ off, rel=1e-9
    )
    assert half_square(odometry.priors(odometry.first, np.array(mean))) == 0.0


# --- a prior that the drive contradicts ------------------------------------------------------------------


def posterior(shown: Array, known: Array, prior: Array) -> tuple[Array, Array]:
    """Returns mean and variance of what a drive shows with sigmas `known`, given a prior about zero."""
    variance = 1.0 / (known**-2.0 + prior**-2.0)
    return variance * shown / known**2, variance


SETTINGS = MapperSettings()


def shown(entry: int, value: float, sigma: float, settings: MapperSettings = SETTINGS) -> MapperSettings:
    """Returns what is left of the priors after a drive that shows one calibration with a sigma."""
    prior = np.array(settings.sigmas_calibrations)
    values, sigmas = np.zeros(7), 1e3 * prior
    values[entry], sigmas[entry] = value, sigma
    return with_inflated_priors(*posterior(values, sigmas, prior), settings)


@pytest.mark.parametrize(
    ("entry", "held", "sigmas", "doubt"),
    [
        (0, False, (0.05, 0.02), np.inf),
        (0, True, (0.0001, 0.002), 4.0),
        (1, False, (0.05, 0.02), np.inf),
        (1, True, (0.0001, 0.02), np.inf),
    ],
)
def test_a_scale_that_is_held_is_neither_widened_nor_doubted(
    entry: int, held: bool, sigmas: tuple[float, float], doubt: float
) -> None:
    """The drive shows the scale or the bias ten sigmas off."""
    prior = SETTINGS.sigmas_calibrations[entry]
    settings = replace(SETTINGS, odometry=OdometrySettings(hold_scale=held))
    found = shown(entry, 10.0 * prior, 0.1 * prior, settings).odometry
    assert (found.sigmas, found.doubt) == (pytest.approx(sigmas), doubt)


@pytest.mark.parametrize(("value", "wide"), [(0.0189, False), (0.0191, True), (-0.0191, True), (0.0, False)])
def test_a_prior_is_widened_where_the_drive_is_four_sigmas_off(value: float, wide: bool) -> None:
    """The bias is shown to 0.0043 rad/s, its prior has 0.002: both together are 0.00474, four times 0.019."""
    found = shown(1, value, 0.0043)
    assert found.odometry == (SETTINGS.odometry.widened() if wide else SETTINGS.odometry)
    assert found.calibration == SETTINGS.calibration


@pytest.mark.parametrize("name", SENSOR)
def test_an_error_of_the_sensor_widens_its_priors_but_keeps_the_scale_of_the_world(name: str) -> None:
    """The range scale never becomes wide."""
    entry = 2 + SENSOR.index(name)
    prior = SETTINGS.sigmas_calibrations[entry]
    found = shown(entry, 10.0 * prior, prior)
    assert found.odometry == SETTINGS.odometry
    is_wide = [other != "range_scale" for other in SENSOR]
    expected = np.where(is_wide, 20.0, 1.0) * np.array(SETTINGS.calibration.sigmas)
    np.testing.assert_allclose(found.calibration.sigmas, expected)


def test_a_prior_is_widened_once() -> None:
    wide = shown(1, 1.0, 1e-4)
    mean, variance = posterior(np.ones(7), np.full(7, 1e-6), np.array(wide.sigmas_calibrations))
    again = with_inflated_priors(mean, variance, wide)
    assert again.odometry == wide.odometry
    assert again.calibration == wide.calibration.widened()
    assert with_inflated_priors(mean, variance, again) == again


def test_what_a_drive_does_not_show_is_not_doubted() -> None:
    sigma = np.array(SETTINGS.sigmas_calibrations)
    assert with_inflated_priors(np.zeros(7), sigma**2, SETTINGS) == SETTINGS
