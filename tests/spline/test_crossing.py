"""Whether boundaries cross."""

from __future__ import annotations

import numpy as np
import pytest

from pathspace_graph.factors.arrays import Array
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.spline.boundary import boundaries_cross, polyline_crossings, sampled
from pathspace_graph.spline.bspline import BSpline

STEP = 0.25
"""Curves are sampled at this step (m)."""


def ring(radius: float, centre: float = 0.0) -> BSpline:
    """A closed curve about a circle around (centre, 0)."""
    phi = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    points = radius * np.column_stack([np.cos(phi), np.sin(phi)]) + [centre, 0.0]
    return BSpline.periodic_from(np.arange(25.0) * radius * 2.0 * np.pi / 24, points, 3)


@pytest.mark.parametrize(
    ("centre", "crosses"), [(0.0, False), (2.0, False), (4.0, True), (20.0, True), (40.0, False)]
)
def test_two_rings_cross_where_neither_holds_the_other(centre: float, crosses: bool) -> None:
    """The radii are 13 and 10 m, so the smaller ring leaves the larger one at about 3 m."""
    assert boundaries_cross({LEFT: ring(13.0), RIGHT: ring(10.0, centre)}, STEP) == crosses
    assert boundaries_cross({LEFT: ring(10.0, centre), RIGHT: ring(13.0)}, STEP) == crosses


def test_segments_cross_where_both_are() -> None:
    level = np.column_stack([np.arange(10.0), np.zeros(10)])
    found = polyline_crossings(level, np.array([[4.3, -1.0], [4.6, 2.0]]))
    np.testing.assert_allclose(found, [[4.4, 0.0]], atol=1e-12)
    assert len(polyline_crossings(level, np.array([[4.3, 0.1], [4.6, 1.0]]))) == 0
    assert len(polyline_crossings(level, np.array([[9.3, -1.0], [9.6, 1.0]]))) == 0


@pytest.mark.parametrize(("angle", "counts"), [(np.pi / 3.0, True), (np.pi / 6.0, False)])
def test_only_steep_crossings_count(angle: float, counts: bool) -> None:
    level = np.column_stack([np.arange(10.0), np.zeros(10)])
    steep = np.array([4.5, 0.0]) + np.outer([-2.0, 2.0], [np.cos(angle), np.sin(angle)])
    assert len(polyline_crossings(level, steep, 0.7)) == int(counts)


def eight(side: float) -> tuple[BSpline, Array]:
    """Return a figure of eight, the curve at a distance to the left of it, and the figure's points (n, 2)."""
    phi = np.linspace(0.0, 2.0 * np.pi, 400, endpoint=False)
    line = 40.0 * np.column_stack([np.sin(phi), 0.5 * np.sin(2.0 * phi)])
    tangent = np.column_stack([np.cos(phi), np.cos(2.0 * phi)])
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]]) / np.hypot(*tangent.T)[:, None]
    return BSpline.periodic_from(np.arange(401.0), line + side * normal, 3), line


def test_boundaries_cross_at_a_level_crossing_of_their_road_and_that_is_no_fault() -> None:
    (left, driven), (right, _) = eight(2.0), eight(-2.0)
    both = {LEFT: left, RIGHT: right}
    assert boundaries_cross(both, STEP)
    assert not boundaries_cross(both, STEP, driven)
    twice = np.concatenate([driven, driven + 0.3])
    assert not boundaries_cross(both, STEP, twice)
    assert boundaries_cross({LEFT: left, RIGHT: ring(13.0, 40.0)}, STEP, driven)  # far from the crossing


def test_samples_lie_on_the_curve_and_are_a_step_apart() -> None:
    points = sampled(ring(20.0), STEP)
    steps = np.hypot(*np.diff(points, axis=0).T)
    assert steps.min() > 0.9 * STEP and steps.max() < 1.2 * STEP
    np.testing.assert_allclose(points[0], points[-1], atol=1e-9)
