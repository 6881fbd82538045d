"""Boundaries across the way driven: found wherever they are, and true maps are not accused."""

from __future__ import annotations

import numpy as np
import pytest

from pathspace_graph.factors.arrays import Array
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.lengths import times
from pathspace_graph.spline.boundary import Crossing, crossed_boundaries, crossings_told
from pathspace_graph.spline.bspline import BSpline

X = np.arange(0.0, 61.0, 2.0)
STRAIGHT = np.column_stack([np.arange(0.0, 60.0), np.zeros(60)])
ANGLES = np.linspace(0.0, 2.0 * np.pi, 40, endpoint=False)


def row(y: Array | float) -> BSpline:
    """A boundary from x = 0 to 60 m at y, by its control points 2 m apart."""
    points = np.column_stack([X, np.broadcast_to(y, X.shape)])
    return BSpline.clamped_from(np.linspace(0.0, 60.0, len(X) - 2), points)


def road(left: Array | float = 2.0, right: Array | float = -2.0) -> dict[int, BSpline]:
    """A straight road, by default 4 m wide."""
    return {LEFT: row(left), RIGHT: row(right)}


def arc(angles: Array, radius: Array | float = 1.0) -> Array:
    return np.asarray(radius)[..., None] * np.column_stack([np.cos(angles), np.sin(angles)])


def ring(radius: Array | float) -> BSpline:
    points = arc(ANGLES, radius)
    return BSpline.periodic_from(np.linspace(0.0, 120.0, len(points) + 1), points)


def beside(middle: Array, ahead: Array, closed: bool) -> dict[int, BSpline]:
    """Boundaries 2 m to the left and to the right of points (n, 2) with directions (n, 2)."""
    left = np.column_stack([-ahead[:, 1], ahead[:, 0]]) / np.hypot(*ahead.T)[:, None]
    make = BSpline.periodic_from if closed else BSpline.clamped_from
    breaks = np.linspace(0.0, 240.0, len(middle) + (1 if closed else -2))
    return {label: make(breaks, middle + off * left) for label, off in ((LEFT, 2.0), (RIGHT, -2.0))}


def test_a_true_road_is_not_crossed() -> None:
    assert crossed_boundaries(road(), STRAIGHT) == []
    laps = arc(np.linspace(0.0, 6.0 * np.pi, 500), 20.0)
    assert crossed_boundaries({LEFT: ring(18.0), RIGHT: ring(22.0)}, laps) == []


@pytest.mark.parametrize("scale", [0.1, 1.0, 10.0])
def test_a_boundary_that_sweeps_across_the_road_is_found_with_its_place(scale: float) -> None:
    """The left boundary goes from y = 2 m at x = 28 m to y = -3 m at x = 30 m."""
    curves = times(road(left=np.where(X < 30.0, 2.0, -3.0)), 0, scale)
    (one,) = crossed_boundaries(curves, scale * STRAIGHT)
    assert one.label == LEFT
    np.testing.assert_allclose(one.place, [28.8 * scale, 0.0], atol=0.5 * scale)
    assert one.driven == pytest.approx(28.8 * scale, abs=0.7 * scale)
    said = f"the left boundary lies across the driven path at x = {one.place[0]:.3g} m"
    assert crossings_told([one]).startswith(said)


def test_a_boundary_that_comes_back_is_crossed_twice() -> None:
    found = crossed_boundaries(road(right=np.where((X > 20.0) & (X < 36.0), 2.0, -2.0)), STRAIGHT)
    assert [one.label for one in found] == [RIGHT, RIGHT]
    np.testing.assert_allclose([one.place[0] for one in found], [21.0, 35.0], atol=0.5)
    assert crossings_told(found).endswith("and at 1 more")


def test_a_closed_boundary_across_the_way_is_found() -> None:
    laps = arc(np.linspace(0.0, 4.0 * np.pi, 400), 20.0)
    bent = ring(np.where((ANGLES > 1.0) & (ANGLES < 1.4), 23.0, 18.0))
    found = crossed_boundaries({LEFT: bent, RIGHT: ring(25.0)}, laps)
    assert [one.label for one in found] == 4 * [LEFT]  # there and back, in both laps
    np.testing.assert_allclose([np.hypot(*one.place) for one in found], 20.0, atol=0.1)
    np.testing.assert_allclose([np.arctan2(*one.place[::-1]) for one in found], [1.0, 1.4] * 2, atol=0.1)


def test_cut_corners_are_no_crossings() -> None:
    bump = np.exp(-0.5 * ((STRAIGHT[:, 0] - 30.0) / 4.0) ** 2)
    for height, count in ((2.4, 0), (3.6, 2)):  # 0.4 and 1.6 m beyond the cones
        assert len(crossed_boundaries(road(), STRAIGHT + np.outer(height * bump, [0.0, 1.0]))) == count


def test_a_vehicle_may_come_to_the_road_and_leave_it() -> None:
    way = np.linspace(0.0, 1.0, 40)[:, None]
    comes = [-20.0, 25.0] + way * (STRAIGHT[8] - [-20.0, 25.0])
    leaves = STRAIGHT[50] + way * ([75.0, -25.0] - STRAIGHT[50])
    assert crossed_boundaries(road(), np.concatenate([comes, STRAIGHT[9:50], leaves])) == []


def test_a_figure_of_eight_crosses_the_boundaries_of_its_other_half() -> None:
    s = np.linspace(0.0, 2.0 * np.pi, 120, endpoint=False)
    middle = 40.0 * np.column_stack([np.sin(s), np.sin(s) * np.cos(s)])
    curves = beside(middle, np.column_stack([np.cos(s), np.cos(2.0 * s)]), closed=True)
    assert crossed_boundaries(curves, np.tile(middle, (2, 1))) == []


def test_laps_of_an_open_map_may_lie_beside_each_other() -> None:
    """The way drifts by 2.5 m in a lap, and crosses boundaries of its own beginning."""
    angles = np.linspace(0.0, 2.6 * np.pi, 120)
    middle = arc(angles, 30.0 + 2.5 * angles / (2.0 * np.pi) + 0.8 * np.sin(3.3 * angles))
    curves = beside(arc(angles, 30.0 + 2.5 * angles / (2.0 * np.pi)), arc(angles + 0.5 * np.pi), closed=False)
    assert crossed_boundaries(curves, middle) == []


def test_a_drive_with_a_hole_is_not_judged_in_it() -> None:
    swept = road(left=np.where(X < 30.0, 2.0, -3.0))
    assert crossed_boundaries(swept, np.concatenate([STRAIGHT[:20], STRAIGHT[38:]])) == []


def test_nothing_crosses_nothing() -> None:
    assert crossed_boundaries({}, STRAIGHT) == []
    assert crossed_boundaries(road(), np.zeros((0, 2))) == []
    assert crossed_boundaries(road(), np.zeros((5, 2))) == []
    assert crossings_told([]) == ""
    assert crossings_told([Crossing(RIGHT, np.array([1.0, 2.0]), 3.0)]).endswith(
        "x = 1 m, y = 2 m, after 3 m"
    )


def test_where_the_vehicle_was_lost_its_path_crosses_nothing() -> None:
    """Between x = 20 and 40 m the path leads through the left boundary and back."""
    path = STRAIGHT.copy()
    path[20:40, 1] = 6.0 * np.sin(np.pi * np.arange(20) / 19.0)
    assert len(crossed_boundaries(road(), path)) == 2
    known = np.ones(len(path), bool)
    known[19:41] = False
    assert crossed_boundaries(road(), path, known) == []
