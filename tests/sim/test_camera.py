"""A camera's errors have the size and correlation of its settings, and presets can be overridden."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pathspace_graph.cli import main
from pathspace_graph.errors import SettingsError
from pathspace_graph.io.log import Log
from pathspace_graph.io.log_files import read_log
from pathspace_graph.sim.sensor import ConeSensor, OdometryNoise, SensorSettings, measure_twists
from pathspace_graph.sim.simulate import CAMERA, CAMERA_FAULTS, INS, SimulationSettings, preset, simulate

from ..scenes.drives import bean_track
from ..scenes.paths import ROOT

EVERY = replace(
    CAMERA, detection_falloff=0.0, false_positives=0.0, dropped_cycles=0.0, duplicates=0.0, wrong_colour=0.0
)
"""This camera sees every cone in its field once."""


def errors(settings: SensorSettings, ranges: np.ndarray, cycles: int, cones: int = 400) -> np.ndarray:
    """Errors (cycles, 2, ranges, cones) along the ray (m) and of the bearing (rad), seen at a standstill."""
    places = np.repeat(np.column_stack([ranges, np.zeros(len(ranges))]), cones, axis=0)
    rng = np.random.default_rng(3)
    sensor = ConeSensor(places, np.zeros(len(places), dtype=int), settings, rng)
    found = []
    for k in range(cycles):
        detections, seen = sensor.detect(k / settings.rate, np.zeros(3))
        np.testing.assert_array_equal(seen, np.arange(len(places)))
        x, y = detections.points_vehicle.T
        found.append([np.hypot(x, y) - places[:, 0], np.arctan2(y, x)])
    return np.array(found).reshape(cycles, 2, len(ranges), cones)


@pytest.mark.parametrize("shares", [(0.0, 0.0), (0.08, 0.8), (1.0, 1.0)])
def test_the_sigma_of_one_detection_by_range_does_not_depend_on_what_stays(
    shares: tuple[float, float],
) -> None:
    ranges = np.array([5.0, 15.0, 35.0])
    settings = replace(EVERY, slow_range=shares[0], slow_bearing=shares[1], slow_time=0.5)
    found = errors(settings, ranges, cycles=60)
    np.testing.assert_allclose(found[:, 0].std(axis=(0, 2)), 0.03 + 0.05 * ranges, rtol=0.04)
    np.testing.assert_allclose(found[:, 1].std(axis=(0, 2)), 0.0125, rtol=0.04)


def test_the_errors_of_a_cone_correlate_by_their_share_and_time() -> None:
    settings = replace(EVERY, slow_range=0.3, slow_bearing=0.8, slow_time=2.0)
    found = errors(settings, np.array([20.0]), cycles=200, cones=2000)[:, :, 0]
    for lag in (1, 5, 10):
        for kind, share in ((0, 0.3), (1, 0.8)):
            pairs = found[lag:, kind] * found[:-lag, kind]
            expected = share * np.exp(-lag / (5.0 * 2.0))
            assert pairs.mean() / found[:, kind].var() == pytest.approx(expected, abs=0.015)
    # cones have errors of their own
    assert abs(np.corrcoef(found[:, 1, 0], found[:, 1, 1])[0, 1]) < 0.5
    assert abs(np.mean(found[0, 1, ::2] * found[0, 1, 1::2]) / found[0, 1].var()) < 0.1


def test_cones_in_the_overlap_are_seen_twice_with_other_errors() -> None:
    bearings = np.deg2rad([0.0, 8.0, -12.0, 25.0])
    places = 10.0 * np.column_stack([np.cos(bearings), np.sin(bearings)])
    settings = replace(EVERY, duplicates=0.7, overlap=(np.deg2rad(5.0), np.deg2rad(17.0)))
    once = ConeSensor(
        places, np.zeros(4, dtype=int), replace(settings, duplicates=0.0), np.random.default_rng(0)
    )
    sensor = ConeSensor(places, np.zeros(4, dtype=int), settings, np.random.default_rng(0))
    twice, first, second = np.zeros(4), [], []
    for _ in range(4000):
        detections, cones = sensor.detect(0.0, np.zeros(3))
        single, _ = once.detect(0.0, np.zeros(3))
        # what the first camera sees comes first, and is what it sees alone
        np.testing.assert_array_equal(detections.points_vehicle[:4], single.points_vehicle)
        np.add.at(twice, cones[4:], 1)
        for cone, point in zip(cones[4:], detections.points_vehicle[4:], strict=True):
            first.append(single.points_vehicle[cone] - places[cone])
            second.append(point - places[cone])
    np.testing.assert_allclose(twice / 4000, [0.0, 0.7, 0.7, 0.0], atol=0.03)
    along = np.column_stack([np.array(first)[:, 0], np.array(second)[:, 0]])
    assert abs(np.corrcoef(along.T)[0, 1]) < 0.1
    np.testing.assert_allclose(along.std(axis=0), 0.53, rtol=0.05)


def test_dropped_cycles_are_left_out_and_change_no_other() -> None:
    whole = simulate(bean_track(), SimulationSettings(laps=2), 0)
    base = SimulationSettings(laps=2, sensor=SensorSettings(dropped_cycles=0.3))
    some = simulate(bean_track(), base, 0)
    assert len(some.cycles) / len(whole.cycles) == pytest.approx(0.7, abs=0.08)
    known = {cycle.t: cycle for cycle in whole.cycles}
    for cycle in some.cycles:
        np.testing.assert_array_equal(cycle.points_vehicle, known[cycle.t].points_vehicle)


def test_a_range_that_is_wrong_has_noise_of_the_sigma_that_is_written() -> None:
    """A range of 20 m reads 21.41 m; the noise beside it is that of a detection there, and is written so."""
    sensor = ConeSensor(
        np.tile([[20.0, 0.0]], (4000, 1)), np.zeros(4000, dtype=int), EVERY, np.random.default_rng(0)
    )
    detections, _ = sensor.detect(0.0, np.zeros(3), scale=0.08, bias=-0.19)
    ranges = np.linalg.norm(detections.points_vehicle, axis=1)
    assert ranges.mean() == pytest.approx(21.41, abs=0.06)
    assert ranges.std() == pytest.approx(0.03 + 0.05 * 21.41, rel=0.04)
    x, y = (detections.points_vehicle - [21.41, 0.0]).T
    assert np.mean(x**2) / detections.covariances[:, 0, 0].mean() == pytest.approx(1.0, abs=0.08)
    assert np.mean(y**2) / detections.covariances[:, 1, 1].mean() == pytest.approx(1.0, abs=0.08)


def test_the_slow_errors_of_the_odometry_have_their_size_and_time_and_shift_no_draw() -> None:
    twists, dt = np.zeros((400_000, 3)), 0.025
    noise = OdometryNoise(white=(0.01, 0.01, 0.003), scale=0.0, gyro_bias=0.0)
    slow = replace(noise, slow=(0.03, 0.02, 0.001), slow_time=2.0)
    plain, _ = measure_twists(twists, dt, noise, np.random.default_rng(0))
    measured, _ = measure_twists(twists, dt, slow, np.random.default_rng(0))
    errors = (measured - plain) / slow.slow
    np.testing.assert_allclose(errors.std(axis=0), 1.0, rtol=0.06)
    for lag in (1, 40, 80):
        expected = np.exp(-lag * dt / 2.0)
        np.testing.assert_allclose((errors[lag:] * errors[:-lag]).mean(axis=0), expected, atol=0.08)
    # over 100 s it drifts as the white noise does that the truth of a log names
    sums = measured.reshape(-1, 4000, 3).sum(axis=1) / np.sqrt(4000)
    np.testing.assert_allclose(sums.std(axis=0), slow.drift_sigmas(dt), rtol=0.3)


# --- presets ---------------------------------------------------------------------------------------------


def command(out: Path, *options: str) -> Log:
    track = ROOT / "eval" / "studies" / "tracks" / "double_loop.csv"
    fixed = ["simulate", "--track", str(track), "--laps", "1", "--seed", "0", "--out", str(out)]
    assert main([*fixed, *options]) == 0
    return read_log(out)


def test_the_command_takes_presets_and_single_options_beside_them(tmp_path: Path) -> None:
    log = command(tmp_path / "log", "--sensor", "camera", "--odometry", "ins", "--sensor.range-max", "30")
    assert (log.sensor.rate, log.sensor.range_max) == (CAMERA.rate, 30.0)
    assert np.median(np.diff(log.odometry.t)) == pytest.approx(0.025)
    assert log.truth is not None and log.truth.sensor is not None and log.truth.noise is not None
    np.testing.assert_array_equal(log.truth.sensor, [-0.0175, 0.0, -0.12, 0.08, -0.19])
    np.testing.assert_array_equal(log.truth.noise[3:], [0.08, 0.8, 8.0])
    np.testing.assert_array_equal(log.odometry_sigma, INS.white)
    assert log.odometry_drift is not None  # of errors that last 5 s: a random walk of sigma sqrt(2 * 5 s)
    np.testing.assert_allclose(log.odometry_drift, np.sqrt(10.0) * np.array(INS.slow), rtol=1e-5)
    assert log.sensor.sigma_range_scale is None, "nobody knows the scale of a camera"
    other = command(tmp_path / "other", "--faults.sensor.yaw", "0.1", "--odometry=plain", "--sensor=camera")
    assert other.truth is not None and other.truth.sensor is not None
    np.testing.assert_array_equal(other.truth.sensor, [0.1, 0.0, -0.12, 0.08, -0.19])
    assert np.median(np.diff(other.odometry.t)) == pytest.approx(0.02)


def test_without_presets_a_log_says_nothing_of_them(tmp_path: Path) -> None:
    log = command(tmp_path / "log", "--sensor", "plain")
    assert log.truth is not None and log.truth.sensor is None and log.truth.noise is None
    assert set(log.source) == {"track", "seed", "laps"}


def test_presets_are_of_their_groups_only() -> None:
    assert preset({}) == SimulationSettings()
    both = preset({"sensor": "camera", "odometry": "ins"})
    assert (both.sensor, both.odometry, both.faults.sensor) == (CAMERA, INS, CAMERA_FAULTS)
    assert preset({"sensor": "camera"}).odometry == OdometryNoise()
    assert preset({"odometry": "ins"}).sensor == SensorSettings()
    with pytest.raises(SettingsError, match=r"odometry: expected a known preset.*'ins'"):
        preset({"odometry": "inns"})
