"""Simulated sensors have the noise they say they have, and a seed gives the same log to the byte."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from pathspace_graph.errors import SettingsError
from pathspace_graph.io.log import Log, Truth
from pathspace_graph.labels import LEFT, RIGHT, UNKNOWN
from pathspace_graph.sim.sensor import (
    ConeSensor,
    OdometryNoise,
    SensorSettings,
    gauss_markov,
    measure_twists,
)
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track import Track, to_map_frame
from pathspace_graph.sim.track_generator import generate_track

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
    c = simulate(track, replace(base, sensor=SensorSettings(range_bias=True)), 0)
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


def test_logged_sigma_is_that_of_the_readings(track: Track) -> None:
    noise = OdometryNoise(white=(0.3, 0.2, 0.1), scale=0.0, gyro_bias=0.0)
    log = simulate(track, SimulationSettings(laps=1, odometry=noise), 0)
    truth, _ = truth_of(log)
    np.testing.assert_array_equal(log.odometry_sigma, [0.3, 0.2, 0.1])
    turn = np.diff(np.unwrap(truth.poses[:, 2])) / 0.02
    assert (log.odometry.twist[:-1, 2] - turn).std() == pytest.approx(0.1, rel=0.05)


def test_detections_are_consistent_with_their_covariance(log: Log) -> None:
    points, covariances, _, _ = rows(log)
    real, true = true_points(log)
    error = points[real] - true
    chi2 = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariances[real]), error)
    assert chi2.mean() == pytest.approx(2.0, abs=0.12)
    assert stats.kstest(chi2, stats.chi2(2).cdf).statistic < 0.03


def test_noise_is_polar(log: Log) -> None:
    points, covariances, _, _ = rows(log)
    real, true = true_points(log)
    ranges, measured = np.linalg.norm(true, axis=1), np.linalg.norm(points[real], axis=1)
    turn = np.arctan2(points[real][:, 1], points[real][:, 0]) - np.arctan2(true[:, 1], true[:, 0])
    assert turn.std() == pytest.approx(np.deg2rad(0.9), rel=0.05)
    for low, high in ((2.0, 6.0), (6.0, 10.0), (10.0, 15.0)):
        inside = (ranges > low) & (ranges < high)
        expected = 0.05 + 0.012 * ranges[inside].mean()
        assert (measured - ranges)[inside].std() == pytest.approx(expected, rel=0.08)
        assert abs((measured - ranges)[inside].mean()) < 0.02
    # along the ray the covariance is the range's own
    ray = points / np.linalg.norm(points, axis=1, keepdims=True)
    along = np.einsum("ni,nij,nj->n", ray, covariances, ray)
    np.testing.assert_allclose(along, (0.05 + 0.012 * np.linalg.norm(points, axis=1)) ** 2)


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
    cones = np.array([[3.0, 0.0], [12.0, 0.0]])
    for bias, expected in ((False, [0.0, 0.0]), (True, [0.02, 0.34])):
        settings = replace(CLEAN, range_bias=bias, detection_falloff=0.0, detection_probability=1.0)
        sensor = ConeSensor(cones, np.zeros(2, dtype=int), settings, np.random.default_rng(0))
        measured = [
            np.linalg.norm(sensor.detect(0.0, np.zeros(3))[0].points_vehicle, axis=1) for _ in range(2000)
        ]
        np.testing.assert_allclose(np.mean(measured, axis=0) - [3.0, 12.0], expected, atol=0.015)


def test_detections_at_odd_rates_are_posed_between_odometry_stamps(track: Track) -> None:
    sensor = replace(CLEAN, rate=13.0, range_sigma=1e-6, range_sigma_growth=0.0, bearing_sigma=1e-7)
    log = simulate(track, SimulationSettings(laps=1, sensor=sensor), 0)
    _, true = true_points(log)
    np.testing.assert_allclose(rows(log)[0], true, atol=1e-4)


def test_open_track_gives_a_log() -> None:
    x = np.arange(-3.0, 61.0, 3.0)
    rows_ = (np.column_stack([x, x * 0 + side]) for side in (2.0, -2.0))
    track = Track(*rows_, np.zeros((0, 2)), False, np.zeros(3), "straight")
    log = simulate(track, SimulationSettings(), 0)
    assert 4.0 < log.odometry.t[-1] < 15.0
    assert len(log.cycles) > 30


def test_bad_settings(track: Track) -> None:
    for bad in (
        {"rate": 0.0},
        {"wrong_colour": 1.5},
        {"bearing_sigma": 0.0},
        {"range_bias_at": (1.0,)},
        {"fov": 7.0},
    ):
        with pytest.raises(SettingsError, match="sensor"):
            SensorSettings(**bad)  # type: ignore[arg-type]
    with pytest.raises(SettingsError, match="white"):
        OdometryNoise(white=(0.0, 1.0, 1.0))
    with pytest.raises(SettingsError, match="laps"):
        SimulationSettings(laps=0)
    with pytest.raises(SettingsError, match="seed"):
        simulate(track, SimulationSettings(), -1)


def test_a_slow_error_has_its_size_from_the_first_reading_on() -> None:
    drawn = gauss_markov((50, 20_000), 0.02, np.random.default_rng(0))
    np.testing.assert_allclose(drawn[[0, 1, 10, 49]].std(axis=1), 1.0, rtol=0.03)
