"""Several curves on one axis: each row is found as on its own curve alone; stretches of them by hand."""

from __future__ import annotations

import numpy as np
import pytest

from pathspace_graph.factors.bspline import Floats, Ints, periodic_knots, uniform_knots
from pathspace_graph.factors.footpoint import (
    FootPoints,
    foot_points,
    joint_foot_points,
    refine_foot_points,
    refine_joint_foot_points,
)
from pathspace_graph.factors.spans import SpanPolynomials, Spans, Stretch, lay_out, stretch_of

DEGREE = 3
STEP = 0.5
FIELDS = ("position", "tangent_unit", "normal_unit", "distance", "interior", "basis")


def two_curves(periodic: bool) -> tuple[list[SpanPolynomials], list[Floats]]:
    """Of different sizes and knot intervals, with distinct control points on two circles or arcs."""
    tables, points = [], []
    for size, interval, radius in ((9, 2.0, 8.0), (14, 1.7, 5.0)):
        knots = uniform_knots(size, DEGREE, interval, 0.3)
        if periodic:
            knots = periodic_knots(0.3 + interval * np.arange(size + 1.0), DEGREE)
        tables.append(SpanPolynomials(knots, DEGREE, periodic))
        angle = 2.0 * np.pi * np.arange(size) / (size if periodic else 1.3 * size)
        points.append(radius * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    return tables, points


def side_by_side(tables: list[SpanPolynomials], points: list[Floats]) -> tuple[Spans, Floats]:
    sizes = [len(own) for own in points]
    return lay_out(tables, [0, sizes[0]], sizes), np.concatenate(points)


def unwrapped(tables: SpanPolynomials, points: Floats) -> Floats:
    return np.concatenate([points, points[:DEGREE]]) if tables.periodic else points


def rows(tables: list[SpanPolynomials], curve: Ints, rng: np.random.Generator) -> tuple[Floats, ...]:
    """Points, and stretches past both ends or the seam; some are longer than the period."""
    points = rng.normal(0.0, 6.0, (len(curve), 2))
    low = np.array([own.low for own in tables])[curve]
    length = np.array([own.length for own in tables])[curve]
    u = low + length * rng.uniform(-0.2, 1.1, len(curve))
    return points, u, u - rng.uniform(0.0, 3.0, len(curve)), u + length * rng.uniform(0.0, 1.2, len(curve))


def assert_same(joint: FootPoints, alone: FootPoints, of: Ints, offset: int, size: int) -> None:
    np.testing.assert_allclose(joint.u[of], alone.u, rtol=0.0, atol=1e-9)
    for name in FIELDS:
        np.testing.assert_allclose(getattr(joint, name)[of], getattr(alone, name), rtol=0.0, atol=1e-9)
    np.testing.assert_array_equal(joint.columns[of], offset + alone.columns % size)


@pytest.mark.parametrize("periodic", [False, True])
def test_rows_of_two_curves_are_found_as_on_each_alone(periodic: bool) -> None:
    rng = np.random.default_rng(4)
    tables, control = two_curves(periodic)
    spans, together = side_by_side(tables, control)
    curve = rng.integers(0, 2, 200)
    points, u, low, high = rows(tables, curve, rng)
    found = joint_foot_points(spans, together, points, curve, low, high, STEP)
    refined = refine_joint_foot_points(spans, together, points, curve, u, low, high, 3)
    for k, offset in enumerate((0, len(control[0]))):
        of, own = np.flatnonzero(curve == k), unwrapped(tables[k], control[k])
        alone = foot_points(tables[k], own, points[of], low[of], high[of], STEP)
        assert_same(found, alone, of, offset, len(control[k]))
        alone = refine_foot_points(tables[k], own, points[of], u[of], low[of], high[of], 3)
        assert_same(refined, alone, of, offset, len(control[k]))


def test_the_tail_of_an_open_curve_is_that_curve() -> None:
    tables, control = (of[0] for of in two_curves(False))
    rng = np.random.default_rng(5)
    first = 3
    low, points = np.full(50, tables.knots[DEGREE + first]), rng.normal(0.0, 6.0, (50, 2))
    high = np.full(50, tables.high)
    whole = foot_points(tables, control, points, low, high, STEP)
    laid = lay_out([tables.tail(first)], [first])
    tail = joint_foot_points(laid, control, points, np.zeros(50, np.intp), low, high, STEP)
    np.testing.assert_allclose(tail.u, whole.u, rtol=0.0, atol=1e-9)
    inside = whole.interior
    np.testing.assert_array_equal(tail.span[inside], whole.span[inside])
    np.testing.assert_array_equal(tail.columns[inside], whole.columns[inside])


def test_an_extended_curve_is_that_of_all_its_knots() -> None:
    knots = np.cumsum(np.random.default_rng(6).uniform(0.5, 2.0, 20))
    extended, whole = SpanPolynomials(knots[:14], DEGREE).extended(knots), SpanPolynomials(knots, DEGREE)
    np.testing.assert_array_equal(extended.coefficients, whole.coefficients)
    u = np.linspace(whole.low, whole.high, 40)
    np.testing.assert_array_equal(extended.evaluate(u, 2)[0], whole.evaluate(u, 2)[0])


# --- stretches -------------------------------------------------------------------------------------------

OPEN = SpanPolynomials(uniform_knots(13, 3), 3)
"""An open curve with the domain [0, 10] and knots one apart."""
CLOSED = SpanPolynomials(periodic_knots(np.linspace(0.0, 8.0, 5), 3), 3, True)
"""A closed curve with the domain [0, 8] and knots two apart."""


def stretches(spans: Spans, limits: list[tuple[float, float]], curve: Ints | None = None) -> Stretch:
    """Returns the stretches with these limits, all on the first curve where none is given."""
    low, high = np.array(limits).T
    return stretch_of(spans, np.zeros(len(limits), np.intp) if curve is None else curve, low, high)


def assert_limits(stretch: Stretch, low: list[float], high: list[float]) -> None:
    np.testing.assert_allclose(stretch.low, low, atol=1e-12)
    np.testing.assert_allclose(stretch.high, high, atol=1e-12)


def test_on_an_open_curve_limits_are_clipped_to_the_domain() -> None:
    stretch = stretches(OPEN.alone, [(2.0, 4.0), (-3.0, 1.0), (9.0, 30.0), (12.0, 15.0)])
    assert_limits(stretch, [2.0, 0.0, 9.0, 10.0], [4.0, 1.0, 10.0, 10.0])
    np.testing.assert_array_equal(stretch.length, 10.0)
    np.testing.assert_array_equal(stretch.interval, 1.0)


def test_reversed_limits_give_a_stretch_of_no_length() -> None:
    assert_limits(stretches(OPEN.alone, [(5.0, 3.0)]), [5.0], [5.0])
    assert_limits(stretches(CLOSED.alone, [(5.0, 3.0)]), [5.0], [5.0])


def test_around_a_closed_curve_a_stretch_begins_in_the_domain_and_may_end_beyond_the_seam() -> None:
    stretch = stretches(CLOSED.alone, [(1.0, 3.0), (7.0, 9.5), (-1.0, 1.0), (17.0, 18.0)])
    assert_limits(stretch, [1.0, 7.0, 7.0, 1.0], [3.0, 9.5, 9.0, 2.0])


def test_a_stretch_of_a_period_is_the_whole_curve_and_has_no_limits() -> None:
    stretch = stretches(CLOSED.alone, [(3.0, 11.0), (3.0, 5.0), (-100.0, 100.0)])
    assert_limits(stretch, [0.0, 3.0, 0.0], [8.0, 5.0, 8.0])
    np.testing.assert_array_equal(stretch.floor, [-np.inf, 3.0, -np.inf])
    np.testing.assert_array_equal(stretch.ceiling, [np.inf, 5.0, np.inf])
    np.testing.assert_array_equal(stretch.within(np.array([-50.0, 9.0, 50.0])), [-50.0, 5.0, 50.0])


def test_a_start_is_moved_to_the_nearest_limit_of_an_open_curve() -> None:
    stretch = stretches(OPEN.alone, [(2.0, 4.0)] * 3)
    np.testing.assert_array_equal(stretch.moved_into(np.array([-7.0, 3.0, 4.5])), [2.0, 3.0, 4.0])


def test_a_start_is_moved_by_whole_periods_or_to_the_limit_that_is_nearer_around_the_curve() -> None:
    """From 7 to 10 on a curve of length 8: 1 is inside, 3 is one past the end, 6 is one before the start."""
    stretch = stretches(CLOSED.alone, [(7.0, 10.0)] * 5)
    found = stretch.moved_into(np.array([7.5, 1.0, -15.0, 3.0, 6.0]))
    np.testing.assert_allclose(found, [7.5, 9.0, 9.0, 10.0, 7.0], atol=1e-12)


def test_places_come_back_into_the_domain() -> None:
    v = np.array([-1.0, 3.0, 19.0])
    np.testing.assert_array_equal(stretches(OPEN.alone, [(0.0, 10.0)] * 3).in_domain(v), [0.0, 3.0, 10.0])
    np.testing.assert_allclose(stretches(CLOSED.alone, [(0.0, 8.0)] * 3).in_domain(v), [7.0, 3.0, 3.0])


def test_each_row_s_stretch_lies_on_the_axis_of_its_own_curve() -> None:
    spans = lay_out([OPEN, OPEN], [0, 13])
    shift: Floats = spans.shift
    stretch = stretches(spans, [(2.0, 4.0), (2.0, 40.0)], np.array([0, 1]))
    assert_limits(stretch, [2.0, 2.0 + shift[1]], [4.0, 10.0 + shift[1]])
    assert shift[1] > 10.0
    second = stretch.where(np.array([False, True]))
    assert_limits(second, [2.0 + shift[1]], [10.0 + shift[1]])
    assert second.begin.tolist() == [shift[1]]
