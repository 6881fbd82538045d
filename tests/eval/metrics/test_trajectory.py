"""Errors of a trajectory, and the reach."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.eval.metrics.trajectory import (
    MOST,
    ReachObserver,
    end_of_trajectory,
    interpolate_poses,
    longest_divergence,
    position_rms,
    reach_values,
    trajectory_errors,
    vehicle_errors,
)
from pathspace_graph.factors.se2 import compose
from pathspace_graph.io.log import Truth
from pathspace_graph.io.map import Map, SplineBoundary
from pathspace_graph.io.results import VehicleState
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.spline.bspline import BSpline

from .straight_maps import landmarks, line


def test_trajectory_errors_are_along_and_across_the_true_heading() -> None:
    """Due north at 1 m/s: 0.3 m too far north is along, 0.4 m too far west is across (left positive)."""
    t = np.array([0.0, 10.0])
    true = Truth(
        t, np.array([[0.0, 0.0, np.pi / 2], [0.0, 10.0, np.pi / 2]]), np.zeros((0, 2)), np.zeros(0, dtype=int)
    )
    stamps = np.array([-1.0, 2.0, 5.0, 10.0, 11.0])
    poses = np.array(
        [[9, 9, 0], [0, 2.3, 1.6], [-0.4, 5, np.pi / 2], [0, 10, np.pi / 2], [9, 9, 0]], dtype=float
    )
    errors = trajectory_errors(stamps, poses, true)
    expected = [[0.3, 0, 1.6 - np.pi / 2], [0, 0.4, 0], [0, 0, 0]]
    np.testing.assert_allclose(errors, expected, atol=1e-12)
    assert position_rms(errors) == pytest.approx(np.sqrt((0.3**2 + 0.4**2) / 3))


def test_a_vehicle_is_lost_that_is_5_m_off_in_the_last_second() -> None:
    t = np.linspace(0.0, 10.0, 101)
    path = np.column_stack([t, np.zeros((101, 2))])
    true = Truth(t, path, np.zeros((0, 2)), np.zeros(0, dtype=int))
    for at_end, lost in ((5.1, True), (4.9, False)):
        poses = path.copy()
        poses[50, 1] = 20.0
        poses[t > 8.9, 1] = at_end
        found = end_of_trajectory(t, poses, true)
        assert found == {"error_max": pytest.approx(20.0), "lost_at_end": lost}
    assert end_of_trajectory(t + 100.0, path, true) == {}


def test_a_vehicle_is_astray_until_it_is_within_a_metre_again() -> None:
    """At 2 m/s: 1 s off before it counts, then 0.5 s, then 2 s, and 0.3 s at the end."""
    t = np.linspace(0.0, 20.0, 201)
    path = np.column_stack([2.0 * t, np.zeros((201, 2))])
    true = Truth(t, path, np.zeros((0, 2)), np.zeros(0, dtype=int))
    poses = path.copy()
    for begin, end in ((10, 20), (50, 55), (100, 120), (198, 201)):
        poses[begin:end, 1] = 1.1
    poses[70:90, 1] = 0.9
    assert longest_divergence(t, poses, true, 3.0) == pytest.approx(
        {"divergence_time": 2.0, "divergence_distance": 4.0}
    )
    assert longest_divergence(t, poses, true, 12.0) == pytest.approx(
        {"divergence_time": 0.2, "divergence_distance": 0.4}
    )
    assert longest_divergence(t, path, true, 0.0) == {"divergence_time": 0.0, "divergence_distance": 0.0}
    assert longest_divergence(t, poses, true, np.inf) == {}


def test_the_vehicle_at_the_end_is_compared_with_the_truth() -> None:
    t, nothing = np.array([0.0, 10.0]), (np.zeros((0, 2)), np.zeros(0, dtype=int))
    true = Truth(t, np.array([[0, 0, 3.1], [0, 0, 3.1]]), *nothing, calibration=np.array([0.01, -0.002]))
    covariance = np.diag(np.array([9.0, 9.0, 0.1, 0.004, 0.001]) ** 2)
    state = VehicleState(np.array([1.0, 1.0, -3.1]), np.array([0.012, -0.001]), covariance)
    values = vehicle_errors(state, 5.0, true)
    assert values == pytest.approx(
        {
            "scale": 0.012,
            "scale_true": 0.01,
            "scale_by_sigma": 0.5,
            "bias": -0.001,
            "bias_true": -0.002,
            "bias_by_sigma": 1.0,
            "heading_by_sigma": (2 * np.pi - 6.2) / 0.1,
        }
    )
    unknown = vehicle_errors(state, 11.0, Truth(t, true.poses, *nothing))
    assert set(unknown) == {"scale", "bias"}


def test_headings_are_interpolated_the_short_way_and_wrap() -> None:
    poses = np.array([[0.0, 0.0, np.pi - 0.1], [2.0, 0.0, -np.pi + 0.1]])
    between = interpolate_poses(np.array([0.0, 2.0]), poses, np.array([0.5, 1.0, 1.5]))
    np.testing.assert_allclose(between[:, 0], [0.5, 1.0, 1.5])
    np.testing.assert_allclose(np.abs(between[:, 2]), [np.pi - 0.05, np.pi, np.pi - 0.05])
    assert between[2, 2] < 0.0 < between[0, 2]


Array = NDArray[np.float64]

LENGTH = 100.0
STEP = 5.0


def straight_truth() -> Truth:
    """A straight drive of 100 m along x at 10 m/s, between cones every 5 m at y = 2 and y = -2."""
    t = np.arange(0.0, 10.0 + 1e-9, 0.01)
    x = np.arange(0.0, LENGTH + STEP, STEP)
    cones = np.concatenate([np.column_stack([x, np.full(len(x), y)]) for y in (2.0, -2.0)])
    poses = np.column_stack([10.0 * t, np.zeros((len(t), 2))])
    return Truth(t, poses, cones, np.repeat([LEFT, RIGHT], len(x)))


def straight_map(left: float, right: float, by: float = 0.0) -> Map:
    """Both boundaries from 0 to their own ends, moved to the left by a distance."""
    return Map(False, {LEFT: line(2.0 + by, 0.0, left), RIGHT: line(-2.0 + by, 0.0, right)})


def observed(track: Map, pose: Array, t: float = 2.0) -> list[float]:
    observer, cycle = ReachObserver(straight_truth()), SimpleNamespace(result=SimpleNamespace(t=t, pose=pose))
    cycle.outline = track
    observer(cycle)  # type: ignore[arg-type]
    return list(observer.rows[0])


def test_the_reach_ends_at_the_first_true_cone_that_is_off_the_shorter_side() -> None:
    reach, squares, cones = observed(straight_map(50.0, 41.0), np.array([20.0, 0.0, 0.0]))
    assert reach == pytest.approx(25.0)  # the cone at 45 m is 4 m from the end of the right curve
    assert cones == 10  # 20, 25, ..., 40 on both sides
    assert squares == pytest.approx(0.0, abs=1e-12)


def test_the_map_is_seen_from_the_estimated_pose() -> None:
    true, drift = np.array([20.0, 0.0, 0.0]), np.array([3.0, -1.0, 0.4])
    swung = straight_map(50.0, 41.0).moved(drift)
    assert observed(swung, compose(drift, true)) == pytest.approx(
        observed(straight_map(50.0, 41.0), true), abs=1e-9
    )
    assert observed(swung, true)[0] < 1.0


def test_the_error_is_of_the_cones_in_reach_only() -> None:
    reach, squares, cones = observed(straight_map(40.0, 40.0, by=0.3), np.array([20.0, 0.0, 0.0]))
    assert (reach, cones) == (pytest.approx(25.0), 10)
    assert squares == pytest.approx(10 * 0.3**2)
    assert observed(straight_map(40.0, 40.0, by=0.51), np.array([20.0, 0.0, 0.0]))[::2] == [0.0, 0]


def test_a_reach_has_an_upper_limit_and_a_missing_side_has_none() -> None:
    assert observed(straight_map(100.0, 100.0), np.array([20.0, 0.0, 0.0]))[0] == MOST
    assert observed(Map(False, {LEFT: line(2.0, 0.0, 100.0)}), np.array([20.0, 0.0, 0.0]))[0] == 0.0
    half = Map(False, {LEFT: line(2.0, 0.0, 100.0), RIGHT: landmarks((20, -2), (25, -2.4), (30, -3))})
    reach, squares, _ = observed(half, np.array([20.0, 0.0, 0.0]))
    assert (reach, squares) == (pytest.approx(10.0), pytest.approx(0.4**2))


def test_the_start_and_the_end_of_an_open_road_do_not_count() -> None:
    track = straight_map(100.0, 100.0)
    reach = {t: observed(track, np.array([10.0 * t, 0.0, 0.0]), t)[0] for t in (0.2, 6.4, 6.6)}
    assert [t for t in reach if not np.isnan(reach[t])] == [6.4]


def ring(radius: float) -> SplineBoundary:
    breaks = np.linspace(0.0, 2 * np.pi * radius, 41)
    angles = (np.arange(40) + 0.5) * 2 * np.pi / 40
    return SplineBoundary(
        BSpline.periodic_from(
            breaks, radius * np.column_stack([np.sin(angles), -np.cos(angles)]) + np.array([0.0, 20.0])
        ),
        np.eye(80),
    )


def ring_truth(laps: float) -> Truth:
    """Laps of radius 20 m at 10 m/s, between 36 cones at radius 18 m and 36 at 22 m."""
    t = np.arange(0.0, laps * 4 * np.pi, 0.01)
    angle, cone = t / 2.0, 2 * np.pi * (np.arange(36) + 0.5) / 36

    def on_ring(radius: float, at: Array) -> Array:
        return np.column_stack([radius * np.sin(at), 20.0 - radius * np.cos(at)])

    poses = np.column_stack([on_ring(20.0, angle), (angle + np.pi) % (2 * np.pi) - np.pi])
    return Truth(
        t,
        poses,
        np.concatenate([on_ring(18.0, cone), on_ring(22.0, cone)]),
        np.repeat([LEFT, RIGHT], 36),
    )


@pytest.mark.parametrize("laps", [1.0, 1.2, 2.0])
def test_a_closed_road_goes_on_behind_the_line(laps: float) -> None:
    road, closed = ReachObserver(ring_truth(laps)), Map(True, {LEFT: ring(18.0), RIGHT: ring(22.0)})
    lap = 2 * np.pi * 20.0
    for station in (10.0, lap - 10.0, laps * lap - 5.0):
        _, pose = road.at(station / 10.0)
        reach, squares, cones = road.reach(station, pose, pose, closed)
        assert reach == MOST
        assert cones == pytest.approx(2 * 36 * MOST / lap, abs=2)
        assert np.sqrt(squares / cones) < 0.1


def test_the_values_of_cycles() -> None:
    rows = np.array([[np.nan, 0.0, 0.0], [2.0, 0.0, 0.0], [10.0, 0.04, 4.0], [12.0, 0.12, 6.0]])
    values = reach_values(rows)
    assert values["reach_median"] == 10.0
    assert values["reach_p10"] == pytest.approx(2.0 + 0.2 * 8.0)
    assert values["reach_short"] == pytest.approx(1 / 3)
    assert values["reach_error"] == pytest.approx(np.sqrt(0.16 / 10))
    assert reach_values(rows[:1]) == {}
