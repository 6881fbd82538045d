"""What the check of the odometry learns of the sensor's yaw and latency."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.factors.noise import TwistNoise
from pathspace_graph.factors.se2 import relative, to_vehicle
from pathspace_graph.factors.sensor import by_sensor
from pathspace_graph.front_end import scan_matching
from pathspace_graph.front_end.front_end import FrontEnd, judge_log
from pathspace_graph.front_end.motion import MotionCheck
from pathspace_graph.front_end.scan_matching import (
    LEARNED_ERRORS,
    SIGMAS_ERRORS,
    ScanMatcher,
    Seen,
    SensorErrors,
)
from pathspace_graph.io.log import Log
from pathspace_graph.run import split_odometry
from pathspace_graph.settings.mapper import CalibrationSettings, MapperSettings, MotionSettings
from pathspace_graph.sim.faults import Faults, SensorFaults
from pathspace_graph.sim.sensor import OdometryNoise
from pathspace_graph.sim.simulate import SimulationSettings, simulate

from ..scenes.drives import bean_track, detections

Array = NDArray[np.float64]
SETTINGS = MotionSettings()
CONES = np.array([[4.0, 2.0], [8.0, 2.2], [12.0, 2.0], [4.5, -1.9], [9.0, -2.0], [13.0, -2.1]])


def by_errors(points: Array, twist: Array) -> Array:
    """Derivatives (m, 2, 2) of detections by yaw and latency."""
    return by_sensor(points, twist[None])[:, :, LEARNED_ERRORS]


def test_the_shifts_are_those_of_a_match_of_late_detections_of_a_turned_sensor() -> None:
    """The vehicle goes 2 m ahead while it brakes from 10 to 8 m/s; the sensor has small errors."""
    errors = np.array([0.004, 0.003])
    begin, end = np.zeros(3), np.array([2.0, 0.0, 0.1])
    before, now = np.array([10.0, 0.0, 0.2]), np.array([8.0, 0.0, 0.6])
    seen = []
    for pose, twist in ((begin, before), (end, now)):
        exact = to_vehicle(CONES, np.tile(pose, (len(CONES), 1)))
        seen.append(exact - by_errors(exact, twist) @ errors)
    matcher, labels = ScanMatcher(SETTINGS), np.zeros(6, np.intp)
    matcher.remember(detections(0.0, seen[0], labels), before, begin)
    found = matcher.match(Seen(seen[1], np.full(6, 0.01)), end, [0.4] * 6)
    assert found is not None
    known = SensorErrors(SETTINGS)
    known.follow(before, 10.0)
    off = relative(end, found.pose)
    way = to_vehicle(end[:2][None], np.array([[0.0, 0.0, end[2]]]))[0]
    np.testing.assert_allclose(known.shifts(way, now) @ errors, off, atol=2e-3)
    assert abs(off[0]) > 5e-3  # there is something to be seen
    assert abs(off[1]) > 5e-3
    matcher.errors.mean = errors
    found = matcher.match(matcher.corrected(detections(0.1, seen[1], labels), now), end, [0.4] * 6)
    assert found is not None
    np.testing.assert_allclose(found.pose, end, atol=5e-4)


def test_a_drive_at_one_speed_straight_ahead_says_nothing_of_the_latency() -> None:
    known, velocity = SensorErrors(SETTINGS), np.array([10.0, 0.0, 0.0])
    known.follow(velocity, 10.0)
    before = known.covariance[1, 1]
    shifts = known.shifts(np.array([3.0, 0.0]), velocity)
    known.update(np.array([0.1, -0.2, 0.0]), 0.01 * np.eye(3), shifts, 0.1)
    assert known.covariance[1, 1] == pytest.approx(before, rel=1e-3)
    assert known.mean[1] == pytest.approx(0.0)
    assert known.mean[0] > 0.0  # but a sensor that is turned to the left draws to the right


@pytest.mark.parametrize("shared", [1, 4])
def test_matches_give_the_errors_with_the_claimed_covariance(
    shared: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All matches of a memory have the same noise, since they share what is remembered."""
    rng, spread, off = np.random.default_rng(0), np.diag([0.05, 0.05, 0.005]) ** 2, []
    monkeypatch.setattr(scan_matching, "SIGMAS_CHANGES", (1e-9, 1e-9))
    for _ in range(200):
        truth = rng.normal(scale=SIGMAS_ERRORS)
        known = SensorErrors(SETTINGS)
        for _ in range(12):
            shifts = known.shifts(np.array([3.0, 0.1]), np.array([*rng.normal(scale=1.0, size=2), 0.1]))
            noise = np.sqrt(np.diag(spread)) * rng.standard_normal(3)
            for _ in range(shared):
                seen = shifts @ (truth - known.mean) + noise
                known.update(seen, spread, shifts, scan_matching.SCAN_MEMORY / shared)
        off.append(np.linalg.solve(np.linalg.cholesky(known.covariance), truth - known.mean))
    np.testing.assert_allclose(np.cov(np.array(off).T), np.eye(2), atol=0.25)


def test_errors_may_change_as_much_in_a_minute_as_the_settings_say() -> None:
    """Matches that say nothing leave the covariance to grow."""
    known = SensorErrors(SETTINGS)
    for _ in range(600):
        known.update(np.zeros(3), np.eye(3), np.zeros((3, 2)), 0.1)
    expected = np.square(SIGMAS_ERRORS) + np.square(scan_matching.SIGMAS_CHANGES)
    np.testing.assert_allclose(known.covariance, np.diag(expected))


# --- whole drives ----------------------------------------------------------------------------------------


def drive(**faults: float) -> Log:
    odometry = OdometryNoise(scale=0.0, gyro_bias=0.0)
    settings = SimulationSettings(laps=2, odometry=odometry, faults=Faults(sensor=SensorFaults(**faults)))
    return simulate(bean_track(), settings, seed=1)


@pytest.mark.parametrize(
    ("faults", "expected"),
    [({}, (0.0, 0.0)), ({"yaw": -0.03}, (-0.03, 0.0)), ({"latency": 0.06}, (0.0, 0.06))],
    ids=["none", "yaw", "latency"],
)
def test_a_drive_shows_the_errors_of_its_sensor(
    faults: dict[str, float], expected: tuple[float, float]
) -> None:
    log = drive(**faults)
    check = MotionCheck(TwistNoise(log.odometry_sigma), SETTINGS)
    for odometry, cycle in split_odometry(log):
        check.update(odometry, cycle)
    assert (np.sqrt(np.diag(check.errors.covariance)) < 0.2 * np.array(SIGMAS_ERRORS)).all()
    assert (np.abs(check.errors.mean - expected) < (0.003, 0.006)).all()
    assert check.errors.contradict(CalibrationSettings()) == bool(faults)


def test_priors_of_a_turned_sensor_lie_about_its_yaw_from_the_cycle_on_that_shows_it() -> None:
    """A recorded car's sensor is turned by 6.5 degrees, of which a prior about zero would hide the most."""
    log, settings = drive(yaw=0.1134), MapperSettings()
    front_end = FrontEnd(settings, log.noise)
    readings = (front_end.update(*cycle) for cycle in split_odometry(log))
    first = next(reading for reading in readings if reading.sensor_doubted)
    assert first.measured is not None
    found = first.measured.calibration
    assert found.sigma_yaw == found.yaw > settings.calibration.widened().sigma_yaw
    assert found.yaw == pytest.approx(0.1134, abs=1.5 * found.sigma_yaw)
    assert first.measured.odometry == settings.odometry


def test_the_prior_of_a_sensor_becomes_wide_for_a_batch_where_the_drive_contradicts_it() -> None:
    turned, settings = drive(yaw=-0.03), MapperSettings(noise="stated")
    judged = judge_log(turned, turned.noise, settings)
    assert judged.settings.calibration == settings.calibration.widened()
    sure = replace(settings, calibration=CalibrationSettings(doubt=np.inf))
    assert judge_log(turned, turned.noise, sure).settings == sure
    none = replace(settings, calibration=CalibrationSettings(sensor=False))
    assert judge_log(turned, turned.noise, none).settings == none
    measured = judge_log(turned, turned.noise, MapperSettings()).settings.calibration
    assert measured.yaw == pytest.approx(-0.03, abs=4.0 * measured.sigma_yaw)
    assert measured.sigma_yaw < settings.calibration.widened().sigma_yaw
