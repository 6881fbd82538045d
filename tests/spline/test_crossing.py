"""Whether boundaries cross."""

from __future__ import annotations

import numpy as np
import pytest

from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.spline.bspline import BSpline, boundaries_cross, polylines_cross, sampled

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


def test_polylines_that_would_cross_farther_on_do_not() -> None:
    level = np.column_stack([np.arange(10.0), np.zeros(10)])
    assert polylines_cross(level, np.array([[4.3, -1.0], [4.6, 1.0]]))
    assert not polylines_cross(level, np.array([[4.3, 0.1], [4.6, 1.0]]))
    assert not polylines_cross(level, np.array([[9.3, -1.0], [9.6, 1.0]]))


def test_samples_lie_on_the_curve_and_are_a_step_apart() -> None:
    points = sampled(ring(20.0), STEP)
    steps = np.hypot(*np.diff(points, axis=0).T)
    assert steps.min() > 0.9 * STEP and steps.max() < 1.2 * STEP
    np.testing.assert_allclose(points[0], points[-1], atol=1e-9)
