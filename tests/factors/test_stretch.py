"""Stretches on an open curve and around a closed one: every answer by hand."""

from __future__ import annotations

import numpy as np

from pathspace_graph.factors.bspline import Floats, Ints, periodic_knots, uniform_knots
from pathspace_graph.factors.spans import SpanPolynomials, Spans, lay_out
from pathspace_graph.factors.stretch import Stretch, stretch_of

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
