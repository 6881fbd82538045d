"""Simulated sensors have the noise they say they have, and a seed gives the same log to the byte."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from pathspace_graph.cli import main
from pathspace_graph.errors import SettingsError
from pathspace_graph.io.log import Log, Truth
from pathspace_graph.io.log_files import read_log
from pathspace_graph.labels import LEFT, RIGHT, UNKNOWN
from pathspace_graph.sim.sensor import ConeSensor, OdometryNoise, SensorSettings, measure_twists
from pathspace_graph.sim.simulate import SimulationSettings, preset, simulate
from pathspace_graph.sim.track import Track, to_map_frame
from pathspace_graph.sim.track_generator import generate_track

from ..scenes.drives import bean_track
from ..scenes.paths import ROOT

CLEAN = SensorSettings(blind_fraction=0.0, wrong_colour=0.0, false_positives=0.0)


@pytest.fixture(scope="module")
def track() -> Track:
    """A generated track with four gate cones of no boundary."""
    track = to_map_frame(generate_track(np.random.default_rng(1)))
    return replace(track, other=np.array([[3.0, 2.5], [3.0, -2.5], [3.5, 2.5], [3.5, -2.5]]))


@pytest.fixture(scope="module")
def log(track: Track) -> Log:
    return simulate(track, SimulationSettings(laps=3), seed=5)


def truth_of(log: Log) -> tuple[Truth, np.ndarray]:
    assert log.truth is not None
    assert log.truth.associations is not None
    return log.truth, log.truth.associations


def rows(log: Log) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Points, covariances, labels and true poses of every detection."""
    truth, _ = truth_of(log)
    poses = truth.poses[np.searchsorted(truth.pose_t, [cycle.t for cycle in log.cycles])]
    counts = [len(cycle.labels) for cycle in log.cycles]
    return (
        np.concatenate([cycle.points_vehicle for cycle in log.cycles]),
        np.concatenate([cycle.covariances for cycle in log.cycles]),
        np.concatenate([cycle.labels for cycle in log.cycles]),
        np.repeat(poses, counts, axis=0),
    )


def in_vehicle(points: np.ndarray, poses: np.ndarray) -> np.ndarray:
    step = points - poses[:, :2]
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    return np.column_stack([cos * step[:, 0] + sin * step[:, 1], -sin * step[:, 0] + cos * step[:, 1]])


def true_points(log: Log) -> tuple[np.ndarray, np.ndarray]:
    """Which detections are of cones, and the cones' true places in the vehicle's frame."""
    truth, cones = truth_of(log)
    real = cones >= 0
    return real, in_vehicle(truth.cones[cones[real]], rows(log)[3][real])


def test_rates_frames_and_first_pose(log: Log, track: Track) -> None:
    truth, cones = truth_of(log)
    np.testing.assert_array_equal(truth.poses[0], np.zeros(3))
    assert log.odometry.t[0] == log.cycles[0].t == truth.pose_t[0] == 0.0
    np.testing.assert_allclose(np.diff(log.odometry.t), 0.02)
    np.testing.assert_allclose(np.diff([cycle.t for cycle in log.cycles]), 0.1)
    assert np.isin([cycle.t for cycle in log.cycles], truth.pose_t).all()
    assert np.abs(truth.poses[:, 2]).max() <= np.pi
    np.testing.assert_array_equal(truth.cones, np.vstack([track.left, track.right, track.other]))
    assert len(cones) == sum(len(cycle.labels) for cycle in log.cycles)
    assert (log.sensor.range_max, log.sensor.rate) == (15.0, 10.0)


def test_a_switch_of_one_stream_does_not_shift_the_others(track: Track) -> None:
    base = SimulationSettings(laps=1)
    a = simulate(track, base, 0)
    b = simulate(track, replace(base, odometry=OdometryNoise(white=(1.0, 1.0, 1.0))), 0)
    np.testing.assert_array_equal(rows(a)[0], rows(b)[0])
    c = simulate(track, replace(base, sensor=SensorSettings(range_bend=0.01)), 0)
    np.testing.assert_array_equal(a.odometry.twist, c.odometry.twist)
    np.testing.assert_array_equal(truth_of(a)[1], truth_of(c)[1])
    d = simulate(track, replace(base, sensor=SensorSettings(false_positives=0.0)), 0)
    np.testing.assert_array_equal(rows(a)[0][truth_of(a)[1] >= 0], rows(d)[0])


def test_odometry_errors() -> None:
    twists = np.tile([10.0, 0.0, 0.5], (5000, 1))
    scales, biases = [], []
    for seed in range(60):
        measured, calibration = measure_twists(twists, 0.02, OdometryNoise(), np.random.default_rng(seed))
        error = measured - twists
        np.testing.assert_allclose(error[:, 0].mean() / 10.0, calibration[0], atol=5 * 0.025 / np.sqrt(5000))
        np.testing.assert_allclose(error[:, 2].mean(), calibration[1], atol=5 * 0.035 / np.sqrt(5000))
        np.testing.assert_allclose(error.std(axis=0), [0.25, 0.12, 0.035], rtol=0.06)
        assert abs(np.corrcoef(error[1:, 0], error[:-1, 0])[0, 1]) < 0.06
        scales.append(error[:, 0].mean() / 10.0)
        biases.append(error[:, 2].mean())
    # the mean of 5000 readings adds little to what is drawn once for a log
    assert np.std(scales) == pytest.approx(0.004, rel=0.3)
    assert np.std(biases) == pytest.approx(0.0015, rel=0.35)


def test_detections_are_consistent_with_their_covariance(log: Log) -> None:
    points, covariances, _, _ = rows(log)
    real, true = true_points(log)
    error = points[real] - true
    chi2 = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariances[real]), error)
    assert chi2.mean() == pytest.approx(2.0, abs=0.12)
    assert stats.kstest(chi2, stats.chi2(2).cdf).statistic < 0.03


def test_field_of_view(log: Log) -> None:
    _, true = true_points(log)
    assert np.linalg.norm(true, axis=1).max() <= 15.0
    assert np.abs(np.arctan2(true[:, 1], true[:, 0])).max() <= np.deg2rad(55.0)


def test_blind_cones_are_never_seen_and_the_rest_is(log: Log) -> None:
    truth, cones = truth_of(log)
    seen = np.unique(cones[cones >= 0])
    assert len(seen) == len(truth.cones) - round(0.05 * len(truth.cones))


def test_labels(log: Log) -> None:
    truth, cones = truth_of(log)
    labels = rows(log)[2]
    real = cones >= 0
    true = truth.cone_labels[cones[real]]
    assert (labels[real][true == UNKNOWN] == UNKNOWN).all()
    assert (true == UNKNOWN).any()
    boundary = true != UNKNOWN
    wrong = labels[real][boundary] != true[boundary]
    assert np.isin(labels[real][boundary], (LEFT, RIGHT)).all()
    assert wrong.mean() == pytest.approx(0.01, abs=0.004)


def test_probability_of_detection_falls_with_range() -> None:
    rng = np.random.default_rng(0)
    ranges = np.repeat([2.0, 8.0, 14.0], 3)
    cones = np.column_stack([ranges, np.zeros(9)])
    sensor = ConeSensor(cones, np.zeros(9, dtype=int), CLEAN, rng)
    hits = np.zeros(9)
    for _ in range(3000):
        hits[sensor.detect(0.0, np.zeros(3))[1]] += 1
    share = hits.reshape(3, 3).sum(axis=1) / 9000
    np.testing.assert_allclose(share, [0.96, 0.90, 0.84], atol=0.012)


def test_false_positives_are_in_the_field_at_their_rate() -> None:
    settings = replace(CLEAN, false_positives=0.5)
    sensor = ConeSensor(np.zeros((0, 2)), np.zeros(0, dtype=int), settings, np.random.default_rng(0))
    cycles = [sensor.detect(0.0, np.zeros(3)) for _ in range(4000)]
    assert all((cones == -1).all() for _, cones in cycles)
    points = np.concatenate([detections.points_vehicle for detections, _ in cycles])
    labels = np.concatenate([detections.labels for detections, _ in cycles])
    assert len(points) / 4000 == pytest.approx(0.5, abs=0.04)
    ranges = np.linalg.norm(points, axis=1)
    assert ranges.max() <= 15.0
    assert np.abs(np.arctan2(points[:, 1], points[:, 0])).max() <= np.deg2rad(55.0)
    # uniform over the area: half of them beyond the range that halves it
    assert (ranges > 15.0 / np.sqrt(2)).mean() == pytest.approx(0.5, abs=0.04)
    assert set(labels.tolist()) == {LEFT, RIGHT}


def test_range_bias_can_be_switched_on() -> None:
    settings = replace(SensorSettings(range_bias=True), range_bend=0.0)
    ranges = np.array([3.0, 6.5, 12.0])
    np.testing.assert_allclose(settings.systematic_errors(ranges), [0.02, 0.18, 0.34])
    assert not SensorSettings().systematic_errors(ranges).any()


def test_detections_at_odd_rates_are_posed_between_odometry_stamps(track: Track) -> None:
    sensor = replace(CLEAN, rate=13.0, range_sigma=1e-6, range_sigma_growth=0.0, bearing_sigma=1e-7)
    log = simulate(track, SimulationSettings(laps=1, sensor=sensor), 0)
    _, true = true_points(log)
    np.testing.assert_allclose(rows(log)[0], true, atol=1e-4)


def test_bad_settings(track: Track) -> None:
    for bad in ({"range_bias_at": (1.0,)}, {"fov": 7.0}, {"overlap": (2.0, 1.0)}):
        with pytest.raises(SettingsError, match="sensor"):
            SensorSettings(**bad)  # type: ignore[arg-type]
    with pytest.raises(SettingsError, match="seed"):
        simulate(track, SimulationSettings(), -1)


# --- a camera's errors, and presets ----------------------------------------------------------------------


CAMERA, INS = preset({"sensor": "camera"}).sensor, preset({"odometry": "ins"}).odometry
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
    starts = np.random.default_rng(1)
    begins = [measure_twists(twists[:1], dt, slow, starts)[0] / slow.slow for _ in range(2000)]
    np.testing.assert_allclose(
        np.std(begins, axis=0)[0], np.hypot(1.0, np.divide(noise.white, slow.slow)), rtol=0.06
    )
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
