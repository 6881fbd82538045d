"""The vehicle keeps its limits and its lane, and its true twist is the one of its true poses."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.linalg import expm
from scipy.spatial import cKDTree

from pathspace_graph.errors import SettingsError
from pathspace_graph.factors.se2 import left_of
from pathspace_graph.laps import lap_end_indices
from pathspace_graph.sim.track import SmoothCurve, Track, to_map_frame
from pathspace_graph.sim.track_generator import generate_track
from pathspace_graph.sim.vehicle import Trajectory, VehicleSettings, _settling, _wander, drive, integrate


def generated(seed: int) -> Track:
    return to_map_frame(generate_track(np.random.default_rng(seed)))


def straight_track() -> Track:
    x = np.arange(-3.0, 61.0, 3.0)
    left, right = np.column_stack([x, x * 0 + 2.0]), np.column_stack([x, x * 0 - 2.0])
    return Track(left, right, np.zeros((0, 2)), False, np.array([0.0, 0.3, 0.1]), "straight")


@pytest.fixture(scope="module")
def driven() -> tuple[Track, Trajectory]:
    track = generated(1)
    return track, drive(track, 2, VehicleSettings(), np.random.default_rng(0))


def matrix_exponential(twist: np.ndarray, dt: float) -> np.ndarray:
    vx, vy, wz = twist * dt
    return np.asarray(expm(np.array([[0.0, -wz, vx], [wz, 0.0, vy], [0.0, 0.0, 0.0]])))


def test_integration_is_the_exponential_map() -> None:
    rng = np.random.default_rng(0)
    twists = rng.normal(size=(20, 3)) * [5.0, 1.0, 2.0]
    twists[3, 2] = 0.0
    twists[4, 2] = 1e-12
    pose = np.eye(3)
    for found, twist in zip(integrate(twists, 0.3)[1:], twists, strict=True):
        pose = pose @ matrix_exponential(twist, 0.3)
        np.testing.assert_allclose(found[:2], pose[:2, 2], atol=1e-9)
        np.testing.assert_allclose([np.cos(found[2]), np.sin(found[2])], pose[:2, 0], atol=1e-12)


def test_starts_at_the_origin_at_a_standstill(driven: tuple[Track, Trajectory]) -> None:
    _, d = driven
    np.testing.assert_array_equal(d.poses[0], np.zeros(3))
    assert np.hypot(*d.twists[0, :2]) < 0.2
    np.testing.assert_allclose(np.diff(d.t), 0.02)


def test_speed_and_acceleration_limits(driven: tuple[Track, Trajectory]) -> None:
    _, d = driven
    speed = np.hypot(d.twists[:, 0], d.twists[:, 1])
    assert 8.0 < speed.max() <= 12.0 * 1.01
    assert np.abs(speed * d.twists[:, 2]).max() <= 5.0 * 1.15
    along = np.diff(speed) / 0.02
    assert -4.0 * 1.1 <= along.min() < -3.3  # it brakes harder than it speeds up
    assert along.max() <= 3.0 * 1.1
    # the heading is that of the path: no side-slip beyond what a step of the odometry turns
    assert np.abs(d.twists[:, 1]).max() < 0.1


@pytest.mark.parametrize("seed", range(5))
def test_stays_between_the_cones_and_wanders(seed: int) -> None:
    track = generated(seed)
    d = drive(track, 3, VehicleSettings(), np.random.default_rng(seed))
    cones = np.vstack([track.left, track.right])
    assert cKDTree(cones).query(d.poses[:, :2])[0].min() > 0.75 + 0.25
    line = track.centre_line
    offset = cKDTree(line.points(np.arange(0.0, line.length, 0.05))).query(d.poses[:, :2])[0]
    assert 0.05 < offset.std() + offset.mean() < 0.5
    assert offset.max() < 0.5


def test_drives_its_laps_and_a_little_more(driven: tuple[Track, Trajectory]) -> None:
    track, d = driven
    path_ahead = np.linalg.norm(np.diff(d.poses[:, :2], axis=0), axis=1).sum()
    assert path_ahead == pytest.approx(2 * track.centre_line.length + 10.0, rel=0.01)
    # after two laps it is beyond the start again, where it began
    assert np.linalg.norm(d.poses[-1, :2]) == pytest.approx(10.0, abs=1.5)
    assert d.poses[-1, 0] > 0


def test_a_drive_may_end_before_the_line() -> None:
    track = generated(0)
    whole, open_drive = (
        drive(track, 1, VehicleSettings(overrun=overrun), np.random.default_rng(0))
        for overrun in (0.0, -50.0)
    )
    gap = np.hypot(*(open_drive.poses[-1, :2] - whole.poses[-1, :2]))
    assert 20.0 < gap < 55.0
    assert len(lap_end_indices(whole.poses)) == 1 and len(lap_end_indices(open_drive.poses)) == 0
    with pytest.raises(SettingsError, match="overrun: expected a drive"):
        drive(track, 1, VehicleSettings(overrun=-1e4), np.random.default_rng(0))


def test_wander_depends_on_the_seed_and_can_be_none() -> None:
    track = generated(2)
    a, b = (drive(track, 1, VehicleSettings(), np.random.default_rng(seed)).poses for seed in (0, 1))
    assert a.shape != b.shape or not np.allclose(a, b)
    still = VehicleSettings(wander=0.0)
    a, b = (drive(track, 1, still, np.random.default_rng(seed)).poses for seed in (0, 1))
    np.testing.assert_array_equal(a, b)


def test_open_track_is_driven_once_from_an_odd_start_pose() -> None:
    track = to_map_frame(straight_track())
    d = drive(track, 5, VehicleSettings(wander=0.0), np.random.default_rng(0))
    np.testing.assert_array_equal(d.poses[0], np.zeros(3))
    first = np.diff(d.poses[:20, :2], axis=0)
    np.testing.assert_allclose(np.arctan2(first[:, 1], first[:, 0])[:5], 0.0, atol=0.02)
    # back in the track's own frame it ends on the middle line
    cos, sin = np.cos(0.1), np.sin(0.1)
    end = np.array([[cos, -sin], [sin, cos]]) @ d.poses[-1, :2] + [0.0, 0.3]
    assert end[0] == pytest.approx(60.0, abs=1.0)
    assert abs(end[1]) < 0.05


def test_a_start_beside_a_bend_begins_in_its_own_direction() -> None:
    """2 m inside a circle of 10 m, a metre of the middle line is 0.8 m of the path beside it."""
    at = np.linspace(0.0, 20.0 * np.pi, 401)
    circle = 10.0 * np.column_stack([np.cos(at / 10.0), np.sin(at / 10.0)])
    circle[-1] = circle[0]
    line = SmoothCurve(CubicSpline(at, circle, bc_type="periodic"), at[-1], True, np.full(401, 2.0))
    pose = line.points(np.array([0.0]))[0] + 2.0 * left_of(line.tangents(np.array([0.0])))[0]
    heading = np.arctan2(*line.tangents(np.array([0.0]))[0][::-1]) + 0.3
    s = np.array([0.0, 1e-4])
    offset = _settling(line, 0.0, np.append(pose, heading), s)
    path = line.points(s) + left_of(line.tangents(s)) * offset[:, None]
    assert np.arctan2(*np.diff(path, axis=0)[0][::-1]) == pytest.approx(heading, abs=1e-3)


def test_a_vehicle_brakes_before_it_stands() -> None:
    d = drive(generated(0), 1, VehicleSettings(stand=2.0), np.random.default_rng(0))
    standing = np.flatnonzero(d.twists.any(axis=1))[-1] + 1
    assert len(d.t) - standing == pytest.approx(100, abs=2)
    assert 0.0 <= d.twists[standing - 1, 0] < 4.0 * 0.02 * 2.0
    assert d.twists[standing - 25, 0] < 2.5


def test_the_wander_begins_in_the_middle() -> None:
    """It grows like the square of the distance, by `1 - exp(-(s / 5 m)^2)`."""
    s = np.array([0.0, 0.5, 20.0])
    offsets = [_wander(s, np.full(3, 5.0), 0.3, np.random.default_rng(k)) for k in range(20)]
    least, near, far = np.abs(offsets).max(axis=0)
    assert least == 0.0 and near < 0.003
    assert 0.2 < far < 0.3
