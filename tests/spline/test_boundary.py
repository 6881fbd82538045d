"""The boundary: how it grows and closes, what it believes, and where it finds foot points."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import BSpline as ScipyBSpline

from pathspace_graph.factors.arrays import Array
from pathspace_graph.settings.mapper import SplineSettings
from pathspace_graph.spline.boundary import Boundary, ahead_of, open_boundary, relocate

from ..scenes.maps import boundary_through

SPLINE = SplineSettings(spacing=3.0)


def line(length: float) -> tuple[Boundary, Array]:
    """Returns a boundary through cones 4 m apart along x, and its control points."""
    x = np.arange(0.0, length + 0.1, 4.0)
    return boundary_through(np.column_stack([x, np.zeros(len(x))]), SPLINE)


def u_turn(radius: float = 4.0, straight: float = 20.0) -> tuple[Boundary, Array]:
    """Returns a boundary along x, half around to the left, and back, through points 1 m apart."""
    x, angle = np.arange(0.0, straight), np.linspace(-np.pi / 2, np.pi / 2, 13)
    bend = np.column_stack([straight + radius * np.cos(angle), radius + radius * np.sin(angle)])
    there, back = np.zeros((len(x), 2)), np.full((len(x), 2), 2.0 * radius)
    there[:, 0], back[:, 0] = x, x[::-1]
    return boundary_through(np.concatenate([there, bend, back]), SPLINE)


# --- growing -------------------------------------------------------------------------------------------


def test_an_open_boundary_begins_with_one_span_at_its_first_cone() -> None:
    boundary = open_boundary(SPLINE)
    assert (boundary.tables.low, boundary.tables.high) == (0.0, SPLINE.spacing)
    assert boundary.size == boundary.degree + 1
    assert (np.diff(boundary.knots) == SPLINE.spacing).all()


@pytest.mark.parametrize(("last", "size"), [(3.0, 4), (3.0001, 5), (6.0, 5), (11.9, 7), (12.0, 7), (12.1, 8)])
def test_it_has_as_many_spans_as_its_last_cone_needs(last: float, size: int) -> None:
    """Spans of 3 m: one span has 4 control points, each further one has one more."""
    boundary = open_boundary(SPLINE)
    points = boundary.grow(np.zeros((0, 2)), np.array([0.0, last]), np.array([[0.0, 0.0], [last, 0.0]]))
    assert boundary.size == len(points) == size
    assert boundary.confirmed_end == last


def test_growing_is_linear_in_the_known_points_and_in_the_targets() -> None:
    """Moving both by any offset moves the placed control points as the placement says."""
    rng = np.random.default_rng(0)
    boundary, known = line(20.0)
    u, targets = boundary.confirmed_end + np.array([3.0, 8.0]), np.array([[23.0, 0.5], [28.0, 1.0]])
    placement = boundary.extend(len(known), u)
    points = placement.place(known, targets)
    assert len(points) == boundary.size
    by_known, by_target = rng.normal(size=known.shape), rng.normal(size=targets.shape)
    moved = placement.place(known + by_known, targets + by_target)
    kept, first = placement.kept, placement.first
    np.testing.assert_allclose(moved[:kept], known[:kept] + by_known[:kept])
    change = placement.by_known @ by_known[first:] + placement.by_target @ by_target
    np.testing.assert_allclose(moved[kept:] - points[kept:], change, atol=1e-12)
    # rigid motion: the curve moves as its points and targets do
    np.testing.assert_allclose(placement.place(known + 1.0, targets + 1.0), points + 1.0, atol=1e-9)


def test_a_curve_that_grows_is_placed_anew_from_its_last_cone_but_one() -> None:
    """A straight row turns off behind a gap: the last stretch bends, the one before and the cones stay."""
    boundary, known = line(20.0)
    boundary.cone_parameters = np.array([0.0, 4.0, 8.0, 12.0, 20.0])
    before, last = boundary.evaluate(known, np.array([4.0, 8.0, 11.9])), np.array([15.0, 16.0, 17.0])
    straight = boundary.evaluate(known, last)
    points = boundary.grow(known.copy(), np.array([29.0]), np.array([[28.0, 4.0]]))
    np.testing.assert_allclose(boundary.evaluate(points, np.array([4.0, 8.0, 11.9])), before, atol=0.03)
    np.testing.assert_allclose(boundary.evaluate(points, np.array([20.0])), [[20.0, 0.0]], atol=0.1)
    assert np.abs(boundary.evaluate(points, last) - straight).max() > 0.05


@settings(max_examples=25)
@given(st.lists(st.tuples(st.floats(2.0, 6.0), st.floats(-0.3, 0.3)), min_size=3, max_size=6))
def test_growth_reaches_for_the_cones_and_keeps_what_was_confirmed(steps: list[tuple[float, float]]) -> None:
    """Cone by cone along a bending line; before the confirmed end the curve may not change."""
    headings = np.cumsum([bend for _, bend in steps])
    offsets = np.array([length for length, _ in steps])[:, None] * np.column_stack(
        [np.cos(headings), np.sin(headings)]
    )
    cones = np.concatenate([[[0.0, 0.0]], np.cumsum(offsets, axis=0)])
    u = np.append(0.0, np.cumsum(np.hypot(*offsets.T)))
    boundary = open_boundary(SPLINE)
    points = boundary.grow(np.zeros((0, 2)), u[:2], cones[:2])
    for k in range(2, len(cones)):
        held = np.linspace(0.0, max(boundary.confirmed_end - 2.0 * SPLINE.spacing, 0.0), 20)
        before = boundary.evaluate(points, held)
        points = boundary.grow(points, u[k : k + 1], cones[k : k + 1])
        np.testing.assert_allclose(boundary.evaluate(points, held), before, atol=1e-9)
        assert np.hypot(*(boundary.evaluate(points, u[k : k + 1])[0] - cones[k])) < 1.1


def test_taking_back_leaves_the_first_cones() -> None:
    boundary, _ = line(24.0)
    boundary.take_back(4)
    assert boundary.confirmed_end == 12.0
    np.testing.assert_array_equal(boundary.cone_parameters, [0.0, 4.0, 8.0, 12.0])
    np.testing.assert_array_equal(boundary.observed[:, 0], [0.0, 4.0, 8.0, 12.0])


@pytest.mark.parametrize("confirmed", [0.5, 2.9, 3.1, 12.0, 20.0])
def test_settled_control_points_alone_hold_the_curve_before_the_confirmed_end(confirmed: float) -> None:
    """All others may be placed anew; they act from less than two knot intervals before the end on."""
    boundary, points = line(24.0)
    boundary.confirmed_end = confirmed
    settled = boundary.settled(boundary.size)
    u = np.linspace(0.0, max(confirmed - 2.0 * SPLINE.spacing, 0.0), 20)
    before = boundary.evaluate(points, u)
    points[settled:] += 1.0
    kept = u <= boundary.knots[settled]
    np.testing.assert_array_equal(boundary.evaluate(points, u)[kept], before[kept])
    assert kept[u > 0.0].all()
    assert (boundary.knots[:settled] < confirmed).all()


# --- what it believes ----------------------------------------------------------------------------------


def test_the_extrapolated_end_is_not_believed() -> None:
    boundary, points = line(16.0)
    assert (boundary.trusted, boundary.tables.high) == (16.5, 18.0)
    np.testing.assert_array_equal(boundary.within_trusted(np.array([3.0, 16.4, 99.0])), [3.0, 16.4, 16.5])
    foot = boundary.refine(points, np.array([[16.4, 1.0], [17.5, 1.0]]), np.array([16.0, 16.0]))
    assert foot.interior.tolist() == [True, False]


def test_a_closed_boundary_is_believed_everywhere() -> None:
    closed = line(24.0)[0].closed(np.arange(-9.0, 34.0, 3.0))
    assert closed.periodic and closed.trusted == np.inf
    assert closed.confirmed_end == closed.tables.high


# --- closing -------------------------------------------------------------------------------------------


def test_new_knots_have_new_keys() -> None:
    boundary, _ = line(24.0)
    closed = boundary.closed(np.arange(-9.0, 34.0, 3.0))
    assert set(boundary.numbers).isdisjoint(closed.numbers)
    assert closed.size == 8 and closed.length == 24.0


@pytest.mark.parametrize(
    ("low", "high"),
    [(4.0, 7.0), (22.0, 29.0), (-2.0, 1.0), (46.0, 50.0), (3.0, 15.0), (1.0, 24.9), (0.0, 70.0)],
)
def test_a_stretch_of_a_closed_curve_has_every_control_point_that_shapes_it(low: float, high: float) -> None:
    closed = line(24.0)[0].closed(np.arange(-9.0, 34.0, 3.0))
    found = closed.stretch(low, high)
    columns = closed.columns(closed.tables.evaluate(np.linspace(low, high, 500))[1])
    assert set(found.tolist()) == set(columns.ravel().tolist())
    assert (np.diff(found) % closed.size == 1).all()


def test_a_closed_curve_is_scipy_s() -> None:
    closed = line(24.0)[0].closed(np.arange(-9.0, 34.0, 3.0))
    points = np.random.default_rng(0).normal(size=(8, 2))
    scipy = ScipyBSpline(closed.knots, np.concatenate([points, points[:3]]), 3)
    u = np.linspace(0.0, 23.99, 40)
    np.testing.assert_allclose(closed.evaluate(points, u), scipy(u), atol=1e-12)
    np.testing.assert_allclose(closed.evaluate(points, u + 48.0), scipy(u), atol=1e-9)
    np.testing.assert_allclose(closed.spline(points).evaluate(u), scipy(u), atol=1e-12)


# --- foot points ---------------------------------------------------------------------------------------


def test_a_foot_point_is_found_in_its_own_stretch() -> None:
    """A point between the legs of a U-turn is 3 m beside one leg and 5 m beside the other."""
    boundary, points = u_turn()
    between = np.array([[10.0, 3.0], [10.0, 3.0]])
    middle = 0.5 * boundary.confirmed_end
    foot = boundary.find(points, between, np.array([0.0, middle]), np.array([middle, 2.0 * middle]))
    np.testing.assert_allclose(foot.u, [10.0, boundary.confirmed_end - 10.0], atol=0.1)
    np.testing.assert_allclose(foot.distance, [3.0, 5.0], atol=0.02)
    assert foot.interior.all()


@settings(max_examples=25)
@given(st.floats(2.0, 40.0), st.floats(-1.5, 1.5))
def test_a_refined_foot_point_is_perpendicular(u: float, side: float) -> None:
    boundary, points = u_turn()
    at = np.array([u])
    position, tangent = boundary.evaluate(points, at)[0], boundary.evaluate(points, at, 1)[0]
    point = position + side * np.array([-tangent[1], tangent[0]]) / np.hypot(*tangent)
    foot = boundary.find(points, point[None], at - 2.0, at + 2.0)
    foot = boundary.refine(points, point[None], foot.u)
    assert foot.u[0] == pytest.approx(u, abs=2e-3)
    assert foot.distance[0] == pytest.approx(side, abs=1e-4)


@pytest.mark.parametrize(("heading", "x"), [(0.0, 10.0), (np.pi, 10.0)])
def test_a_pose_is_relocated_on_the_leg_that_leads_its_way(heading: float, x: float) -> None:
    """The pose is in the middle between the legs."""
    boundary, points = u_turn()
    found = relocate(boundary, points, np.array([x, 4.0, heading]), 100.0)
    expected = x if heading == 0.0 else boundary.confirmed_end - x
    assert found == pytest.approx(expected, abs=0.1)


def test_an_open_curve_is_searched_only_at_its_end() -> None:
    """On its last 15 m the U-turn leads back only: a pose on the way there is given its end."""
    boundary, points = u_turn()
    assert relocate(boundary, points, np.array([5.0, 0.0, 0.0]), 15.0) == boundary.trusted


def test_around_a_closed_curve_the_shorter_way_counts() -> None:
    """On a curve of 10 m, 9.5 is half a metre behind 0, and 21 is one ahead of it."""
    np.testing.assert_allclose(ahead_of(0.0, np.array([9.5, 21.0, 3.0]), 10.0), [-0.5, 1.0, 3.0])
    np.testing.assert_allclose(ahead_of(np.array([9.0, 2.0]), np.array([1.0, 8.0]), 10.0), [2.0, -4.0])
