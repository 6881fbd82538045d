"""Places of cones on closed curves: where they are, and which detections are of them."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.factors.bspline import periodic_knots
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.mapping.cone_places import ConePlaces, lay_out_places
from pathspace_graph.mapping.detections import NOWHERE
from pathspace_graph.mapping.state import State
from pathspace_graph.settings.mapper import GaugeSettings, SplineSettings
from pathspace_graph.spline.boundary import Boundary

Array = NDArray[np.float64]

U = {LEFT: np.array([1.0, 6.0, 9.0, 35.5]), RIGHT: np.array([2.0, 20.0])}
"""These are the places (m) on two circles of 36 m."""


def circles() -> State:
    """Returns a state with two closed curves of twelve control points each."""
    state, angle = State(), 2.0 * np.pi * np.arange(12) / 12.0
    for label, radius in ((LEFT, 5.0), (RIGHT, 8.0)):
        knots = periodic_knots(3.0 * np.arange(13.0), 3)
        boundary = Boundary(knots, True, SplineSettings(), GaugeSettings())
        state.add_boundary(label, boundary, radius * np.column_stack([np.cos(angle), np.sin(angle)]))
    return state


@pytest.fixture(scope="module")
def places() -> ConePlaces:
    return lay_out_places(circles().curves, U)


def test_a_place_is_the_point_of_its_curve_at_its_parameter(places: ConePlaces) -> None:
    state = circles()
    for label, own in ((LEFT, slice(0, 4)), (RIGHT, slice(4, 6))):
        for order, basis in enumerate((places.basis, places.basis_slope)):
            at = np.einsum("mj,mjd->md", basis[own], state.map_points[places.columns[own]])
            expected = state.boundaries[label].evaluate(state.control_points(label), U[label], order)
            np.testing.assert_allclose(at, expected, atol=1e-12)
        np.testing.assert_array_equal(np.isin(places.keys[own], state.keys(label)), True)


def test_a_detection_past_its_place_has_a_positive_residual(places: ConePlaces) -> None:
    state = circles()
    boundary, points = state.boundaries[RIGHT], state.control_points(RIGHT)
    seen = boundary.evaluate(points, U[RIGHT] + np.array([0.1, -0.2]))
    rows = places.along(np.array([4, 5]), state.map_points, seen, np.zeros((2, 3)))
    speed = np.hypot(*boundary.evaluate(points, U[RIGHT], 1).T)
    np.testing.assert_allclose(rows.residual, speed * [0.1, -0.2], atol=1e-3)


@pytest.mark.parametrize(
    "label, u, place",
    [
        (LEFT, 1.4, 0),
        (LEFT, 0.4, 0),  # the next place before it is 0.9 m away, across the seam
        (LEFT, 0.2, NOWHERE),  # two places are about as near
        (LEFT, 36.0 + 6.5, 1),  # a lap later
        (LEFT, 7.5, NOWHERE),
        (LEFT, 20.0, NOWHERE),
        (RIGHT, 20.0, 5),
        (RIGHT, 1.4, 4),
    ],
)
def test_a_detection_is_of_the_place_next_to_it(places: ConePlaces, label: int, u: float, place: int) -> None:
    curve = circles().curves.number(np.array([label]))
    assert places.nearest(curve, np.array([u]), 1.0, 1.4).tolist() == [place]
