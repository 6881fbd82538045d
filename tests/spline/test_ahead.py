"""What is ahead of a vehicle, against straights and circles and against the whole centre line."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import KDTree

from pathspace_graph.errors import SettingsError
from pathspace_graph.factors.se2 import to_map
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.run import split_odometry
from pathspace_graph.spline.bspline import BSpline
from pathspace_graph.spline.planning import CurveAhead, check_line, track_ahead

from ..scenes.drives import noisy_lap

Array = NDArray[np.float64]


def straights(length: float = 30.0, until: float = np.inf, beside: float = 0.0) -> dict[int, CurveAhead]:
    """Two straights along x, 4 m apart, which end at a parameter; from there cones lead on. It is x."""
    size = 12
    x = np.linspace(-length / (size - 3), length + length / (size - 3), size)
    sides = {}
    for label, y in ((LEFT, 2.0), (RIGHT, -2.0)):
        points = np.column_stack([x, np.full(size, y)])
        spline = BSpline.open_uniform(points, interval=length / (size - 3))
        cones = np.arange(until + 3.0, length, 4.0) if np.isfinite(until) else np.zeros(0)
        tentative = np.column_stack([cones, np.full(len(cones), y)])
        sides[label] = CurveAhead(spline.tables, spline.control_points, beside, until, tentative)
    return sides


def ring(radius: float, turn: float = 1.0) -> BSpline:
    """A circle about the origin whose parameter is a length."""
    size = 60
    breaks = np.linspace(0.0, 2 * np.pi * radius, size + 1)
    angle = breaks[:-1] / radius
    points = radius * np.column_stack([np.cos(angle), turn * np.sin(angle)])
    blank = BSpline.periodic_from(breaks, np.arange(2.0 * size).reshape(-1, 2))
    return BSpline.periodic_from(breaks, np.linalg.solve(blank.basis_matrix(breaks[:-1]), points))


def test_a_straight_is_seen_from_where_the_vehicle_stands() -> None:
    pose = np.array([5.0, 0.5, 0.1])
    ahead = track_ahead(straights(until=12.0, beside=5.0), pose, 10.0, 1.0)
    assert len(ahead.points) == 11
    np.testing.assert_allclose(ahead.arc_length, np.arange(11.0), atol=1e-9)
    points = to_map(ahead.points, np.tile(pose, (11, 1)))
    np.testing.assert_allclose(points, np.column_stack([5.0 + np.arange(11.0), np.zeros(11)]), atol=1e-9)
    np.testing.assert_allclose(ahead.heading, -0.1)
    np.testing.assert_allclose(ahead.curvature, 0.0, atol=1e-9)
    np.testing.assert_allclose(ahead.width_left, 2.0)
    np.testing.assert_allclose(ahead.width_right, 2.0)
    assert ahead.confirmed.tolist() == [True] * 8 + [False] * 3
    left = to_map(ahead.left, np.tile(pose, (len(ahead.left), 1)))
    np.testing.assert_allclose(left[:, 1], 2.0)
    assert 5.0 <= left[:, 0].min() < 6.0
    assert left[:, 0].max() == pytest.approx(15.0)


def test_it_ends_where_the_map_ends() -> None:
    ahead = track_ahead(straights(beside=22.0), np.array([22.0, 0.0, 0.0]), 50.0, 0.5)
    assert ahead.length == pytest.approx(8.0)
    assert ahead.arc_length == pytest.approx(0.5 * np.arange(17))


def test_beyond_the_end_of_the_map_there_is_nothing() -> None:
    for x in (31.0, 40.0):
        ahead = track_ahead(straights(beside=x), np.array([40.0, 0.0, 0.0]), 10.0, 1.0)
        assert ahead.length == 0.0
        assert len(ahead.left) == 0


def test_the_widths_are_along_the_normal_where_the_boundaries_diverge() -> None:
    """At x they are 2 m + 0.1 x along the normal of the centre line, and less far from its point."""
    curves = straights(until=30.0)
    for label, side in ((LEFT, 1.0), (RIGHT, -1.0)):
        points = curves[label].control_points
        points[:, 1] += 0.1 * side * points[:, 0]
    ahead = track_ahead(curves, np.zeros(3), 20.0, 1.0)
    x = ahead.points[:, 0]
    np.testing.assert_allclose(x, np.arange(21.0), atol=0.01)
    np.testing.assert_allclose(ahead.points[:, 1], 0.0, atol=1e-9)
    np.testing.assert_allclose(ahead.width_left, 2.0 + 0.1 * x, rtol=1e-9)
    np.testing.assert_allclose(ahead.width_right, 2.0 + 0.1 * x, rtol=1e-9)


@pytest.mark.parametrize("turn", [1.0, -1.0])
def test_a_turn_across_the_seam(turn: float) -> None:
    """The vehicle is 3 m before the seam of a ring of 10 m, in its second lap."""
    radii = {LEFT: 10.0 - 2.0 * turn, RIGHT: 10.0 + 2.0 * turn}
    angle = 2 * np.pi - 0.3
    curves = {
        label: CurveAhead(ring(r, turn).tables, ring(r, turn).control_points, (angle + 2 * np.pi) * r)
        for label, r in radii.items()
    }
    pose = np.array([10 * np.cos(angle), 10 * turn * np.sin(angle), turn * (angle + np.pi / 2)])
    ahead = track_ahead(curves, pose, 20.0, 1.0)
    assert len(ahead.points) == 21
    expected = 10.0 * np.column_stack(
        [np.sin(ahead.arc_length / 10), turn * (1 - np.cos(ahead.arc_length / 10))]
    )
    np.testing.assert_allclose(ahead.points, expected, atol=2e-4)
    np.testing.assert_allclose(ahead.curvature, 0.1 * turn, atol=1e-4)
    np.testing.assert_allclose(ahead.heading, turn * ahead.arc_length / 10, atol=1e-4)
    np.testing.assert_allclose(ahead.width_left, 2.0, atol=2e-4)
    np.testing.assert_allclose(ahead.width_right, 2.0, atol=2e-4)
    np.testing.assert_allclose(np.diff(ahead.arc_length), 1.0, atol=2e-2)
    assert ahead.confirmed.all()


def test_a_hairpin_is_followed_to_the_way_back() -> None:
    """The road turns at a radius of 4 m, and comes back 8 m beside itself: 3 m from edge to edge."""
    curves = {}
    for label, radius in ((LEFT, 1.5), (RIGHT, 6.5)):
        x = np.linspace(-30.0, 0.0, 61)[:-1]
        angle = np.linspace(-np.pi / 2, np.pi / 2, 41)
        there = np.column_stack([x, np.full(60, -radius)])
        turn = radius * np.column_stack([np.cos(angle), np.sin(angle)])
        points = np.concatenate([there, turn, there[::-1] * [1.0, -1.0]])
        u = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
        slopes = np.gradient(points, u, axis=0)
        spline = BSpline.hermite(u, points, slopes / np.linalg.norm(slopes, axis=1)[:, None])
        curves[label] = CurveAhead(spline.tables, spline.control_points, 20.0)
    ahead = track_ahead(curves, np.array([-10.0, -4.0, 0.0]), 40.0, 1.0)
    assert len(ahead.points) == 41
    away = np.hypot(*(ahead.points - [10.0, 4.0]).T)
    back = ahead.points[:, 0] < 10.0
    np.testing.assert_allclose(away[~back], 4.0, atol=0.02)
    np.testing.assert_allclose(np.abs(ahead.points[back, 1] - 4.0), 4.0, atol=0.02)
    np.testing.assert_allclose(ahead.width_left, 2.5, atol=0.02)
    np.testing.assert_allclose(ahead.width_right, 2.5, atol=0.02)


def test_a_loop_is_given_at_most_once() -> None:
    curves = {
        label: CurveAhead(ring(r).tables, ring(r).control_points, 0.0)
        for label, r in ((LEFT, 8.0), (RIGHT, 12.0))
    }
    ahead = track_ahead(curves, np.array([10.0, 0.0, np.pi / 2]), 1000.0, 1.0)
    assert 50.0 < ahead.length < 2 * np.pi * 10.0


def test_one_boundary_alone_is_given_without_a_centre_line() -> None:
    only = {LEFT: straights()[LEFT]}
    ahead = track_ahead(only, np.zeros(3), 10.0, 1.0)
    assert ahead.length == 0.0
    assert ahead.points.shape == (0, 2)
    assert len(ahead.right) == 0
    np.testing.assert_allclose(ahead.left, np.column_stack([np.arange(11.0), np.full(11, 2.0)]), atol=1e-9)


@pytest.mark.parametrize(
    ("distance", "step", "message"),
    [
        (0.0, 1.0, "distance: expected a positive"),
        (np.nan, 1.0, "distance: expected a positive"),
        (10.0, 0.0, "step: expected a number"),
        (1e9, 1.0, "at least 5000 m"),
    ],
)
def test_lengths_out_of_range_are_refused(distance: float, step: float, message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        check_line(distance, step)


def test_a_drive_sees_its_centre_line_and_is_not_changed_by_looking() -> None:
    """In each fifth cycle the line is that of the whole outline, on the open map and on the closed one."""
    log = noisy_lap()
    looked = FixedLagMapper(odometry_sigma=log.odometry_sigma)
    compared = {False: 0, True: 0}
    for cycle, (odometry, detections) in enumerate(split_odometry(log)):
        looked.wait()
        looked.update(odometry, detections)
        before = looked.road.smoother.variables.values.copy()
        ahead = looked.ahead(15.0)
        assert np.array_equal(looked.road.smoother.variables.values, before)
        if cycle % 5 or len(ahead.points) < 2:
            continue
        pose = np.tile(looked.poses[-1], (len(ahead.points), 1))
        line = looked.outline().centre_line(0.1)
        distance, nearest = KDTree(line.points).query(to_map(ahead.points, pose))
        sure = ahead.confirmed
        assert distance[sure].max(initial=0.0) < 0.1  # the whole line is smoothed over a few metres
        assert distance.max() < 0.3  # another curve leads through the same cones that are not confirmed
        for own, other in ((ahead.width_left, line.width_left), (ahead.width_right, line.width_right)):
            off = np.abs(own - other[nearest])[sure].max(initial=0.0)
            assert off < 0.06
        bends = np.abs(ahead.curvature - line.curvature[nearest])[sure]
        assert len(bends) == 0 or np.median(bends) < 0.01
        compared[looked.closed] += 1
    assert min(compared.values()) >= 3
