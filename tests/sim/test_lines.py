"""A sensor of lines sees points of the true boundaries, across by its noise, and none of them twice."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from pathspace_graph.errors import SettingsError
from pathspace_graph.io.log import Log
from pathspace_graph.io.log_files import read_log, write_log
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.sim.sensor import LineSensor, LineSettings, as_lines, curve_through
from pathspace_graph.sim.simulate import SimulationSettings, preset, simulate
from pathspace_graph.sim.track import Track, skidpad

from ..scenes.drives import bean_track

INNER, OUTER = 20.0, 23.0  # radii of the boundaries of a ring of a road, driven to the left (m)
AROUND = 2 * np.pi
LINE = preset({"sensor": "line"}).sensor
EXACT = replace(LINE, range_sigma=1e-9, range_sigma_growth=0.0, bearing_sigma=1e-9, false_positives=0.0)
EVERYWHERE = {"range_max": 100.0, "range_min": 0.0, "fov": AROUND}


def ring_track() -> Track:
    """A road between two circles about (0, 21.5), with cones 4 and 4.6 m apart, from the origin along x."""
    angles = np.linspace(0.0, AROUND, 32)[:-1] - np.pi / 2
    around = np.column_stack([np.cos(angles), np.sin(angles)])
    middle = np.array([0.0, 21.5])
    left, right = middle + INNER * around, middle + OUTER * around
    return Track(left, right, np.zeros((0, 2)), True, np.zeros(3), "ring")


def sensor_of(track: Track, settings: LineSettings, seed: int = 0, **changes: float) -> LineSensor:
    lines = as_lines(track)
    return LineSensor(
        lines, lines.cone_labels, replace(EXACT, **changes), settings, np.random.default_rng(seed)
    )


def radii(points: np.ndarray) -> np.ndarray:
    return np.hypot(points[:, 0], points[:, 1] - 21.5)


def test_the_true_boundary_is_the_smooth_curve_through_the_cones() -> None:
    lines = as_lines(ring_track())
    for row, radius in ((lines.left, INNER), (lines.right, OUTER)):
        np.testing.assert_allclose(radii(row), radius, atol=2e-4)
        gaps = np.linalg.norm(np.diff(np.vstack([row, row[:1]]), axis=0), axis=1)
        assert gaps.max() < 1.0
        np.testing.assert_allclose(gaps, AROUND * radius / len(row), atol=1e-3)
        assert curve_through(row, True).length == pytest.approx(AROUND * radius, rel=1e-5)
    assert set(lines.cone_labels[: len(lines.left)]) == {LEFT}
    assert set(lines.cone_labels[len(lines.left) :]) == {RIGHT}


def test_an_open_boundary_ends_at_its_last_cones() -> None:
    x = np.arange(0.0, 30.0, 5.0)
    rows = (np.column_stack([x, np.full(6, y)]) for y in (1.5, -1.5))
    lines = as_lines(Track(*rows, np.zeros((0, 2)), False, np.zeros(3), "straight"))
    np.testing.assert_allclose(lines.left, np.column_stack([np.arange(26.0), np.full(26, 1.5)]), atol=1e-9)


def test_points_lie_on_the_boundary_of_their_label_and_none_is_met_twice() -> None:
    sensor = sensor_of(ring_track(), LineSettings(spacing=1.0), **EVERYWHERE)
    pose = np.array([0.0, 0.0, 0.0])
    cycles = [sensor.detect(0.0, pose)[0] for _ in range(50)]
    for cycle in cycles:
        expected = np.where(cycle.labels == LEFT, INNER, OUTER)
        np.testing.assert_allclose(radii(cycle.points_vehicle), expected, atol=1e-3)
    every = np.concatenate([cycle.points_vehicle for cycle in cycles])
    assert len(np.unique(every.round(9), axis=0)) == len(every)
    # anywhere along the row: the angles about the middle are uniform
    angles = np.arctan2(every[:, 1] - 21.5, every[:, 0]) % AROUND
    assert stats.kstest(angles / AROUND, "uniform").pvalue > 0.01


@pytest.mark.parametrize("spacing", [0.25, 1.0, 4.0])
def test_the_spacing_is_the_mean_distance_along_each_boundary(spacing: float) -> None:
    sensor = sensor_of(ring_track(), LineSettings(spacing=spacing), **EVERYWHERE)
    labels = np.concatenate([sensor.detect(0.0, np.zeros(3))[0].labels for _ in range(400)])
    for label, radius in ((LEFT, INNER), (RIGHT, OUTER)):
        expected = 400 * AROUND * radius / spacing
        assert np.sum(labels == label) == pytest.approx(expected, abs=4 * np.sqrt(expected))


def test_the_variance_across_is_that_of_the_covariance() -> None:
    """Radii of a ring seen from its middle are distances across: range noise and the line's own scatter."""
    noise = {"range_sigma": 0.03, "range_sigma_growth": 0.002, "bearing_sigma": 0.01}
    line = LineSettings(spacing=1.0, sigma_across=0.05)
    sensor = sensor_of(ring_track(), line, **noise, **EVERYWHERE)
    cycles = [sensor.detect(0.0, np.array([0.0, 21.5, 0.7]))[0] for _ in range(60)]
    points = np.concatenate([cycle.points_vehicle for cycle in cycles])
    labels = np.concatenate([cycle.labels for cycle in cycles])
    covariances = np.concatenate([cycle.covariances for cycle in cycles])
    ranges = np.hypot(points[:, 0], points[:, 1])
    rays = points / ranges[:, None]
    along = np.einsum("ni,nij,nj->n", rays, covariances, rays)
    for label, radius in ((LEFT, INNER), (RIGHT, OUTER)):
        sigma = np.hypot(0.03 + 0.002 * radius, 0.05)
        assert (ranges[labels == label] - radius).std() == pytest.approx(sigma, rel=0.04)
        np.testing.assert_allclose(np.sqrt(along[labels == label]), sigma, rtol=0.02)
    # across the ray, along the boundary, only the bearing's own noise is stated
    sideways = np.column_stack([-rays[:, 1], rays[:, 0]])
    stated = np.einsum("ni,nij,nj->n", sideways, covariances, sideways)
    np.testing.assert_allclose(np.sqrt(stated), 0.01 * ranges, rtol=0.02)


def test_nothing_is_detected_in_a_gap_and_elsewhere_all_is() -> None:
    for seed in range(5):
        sensor = sensor_of(ring_track(), LineSettings(spacing=0.5, gaps=1), seed, **EVERYWHERE)
        ((side, begin),) = sensor.gaps
        radius = (INNER, OUTER)[side]
        cycles = [sensor.detect(0.0, np.zeros(3))[0] for _ in range(200)]
        points = np.concatenate([cycle.points_vehicle[cycle.labels == side] for cycle in cycles])
        # the first cone of both boundaries is at the angle -pi / 2
        angles = np.arctan2(points[:, 1] - 21.5, points[:, 0]) + np.pi / 2
        beyond = np.sort((angles * radius - begin - 5.0) % (AROUND * radius)) - AROUND * radius / 2
        # from the gap's middle it is empty by 5 m to both sides, and no other stretch is
        near = np.abs(np.abs(beyond) - AROUND * radius / 2)
        assert near.min() == pytest.approx(5.0, abs=0.1)
        assert np.diff(beyond).max() < 0.2


def test_the_index_is_that_of_the_nearest_true_point() -> None:
    lines = as_lines(ring_track())
    sensor = sensor_of(ring_track(), LineSettings(spacing=1.0))
    detections, index = sensor.detect(0.0, np.zeros(3))
    assert len(index) > 10
    assert np.linalg.norm(detections.points_vehicle - lines.cones[index], axis=1).max() < 0.51


@pytest.fixture(scope="module")
def log() -> Log:
    return simulate(bean_track(), replace(preset({"sensor": "line"}), laps=1), 3)


def test_a_log_says_its_kind_and_has_the_true_boundary(log: Log, tmp_path: Path) -> None:
    write_log(log, tmp_path / "log")
    assert 'kind = "line"' in (tmp_path / "log" / "log.toml").read_text()
    read = read_log(tmp_path / "log")
    assert read.sensor == log.sensor
    assert read.sensor.kind == "line"
    assert read.truth is not None and log.truth is not None
    assert read.truth.associations is None
    np.testing.assert_array_equal(read.truth.cones, log.truth.cones)
    for label in (LEFT, RIGHT):
        row = log.truth.cones[log.truth.cone_labels == label]
        assert np.linalg.norm(np.diff(row, axis=0), axis=1).max() < 1.001


def test_the_drive_is_that_of_the_plain_sensor(log: Log) -> None:
    plain = simulate(bean_track(), SimulationSettings(laps=1), 3)
    assert plain.sensor.kind is None
    np.testing.assert_array_equal(plain.odometry.twist, log.odometry.twist)
    assert plain.truth is not None and log.truth is not None
    np.testing.assert_array_equal(plain.truth.poses, log.truth.poses)


def test_an_event_has_no_lines() -> None:
    with pytest.raises(SettingsError, match=r"line\.spacing: expected a track between two boundaries"):
        as_lines(skidpad())
