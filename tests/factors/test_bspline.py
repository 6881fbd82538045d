"""B-spline bases as polynomials on spans against scipy."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import BSpline as ScipyBSpline

from pathspace_graph.factors._kernels import Curves
from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.bspline import (
    SpanPolynomials,
    clamped_knots,
    domain,
    periodic_knots,
    scatter,
    uniform_knots,
)
from pathspace_graph.factors.footpoint import SEARCH_ITERATIONS, FootPoints, foot_points
from pathspace_graph.spline.bspline import end_change_matrix

TOLERANCE = 1e-12
KINDS = ("random", "repeated", "clamped", "uniform")


def make_knots(kind: str, degree: int, rng: np.random.Generator) -> Array:
    """A random knot vector of one kind with a domain that is not empty."""
    n = degree + 1 + int(rng.integers(0, 12))
    if kind == "random":
        return np.sort(rng.uniform(0.0, 10.0, n + degree + 1))
    if kind == "clamped":
        return clamped_knots(np.sort(rng.uniform(0.0, 10.0, n - degree + 1)), degree)
    if kind == "uniform":
        return uniform_knots(n, degree, 0.7, -2.0)
    knots = np.sort(rng.integers(0, 6, n + degree + 1)).astype(np.float64)
    return knots if knots[n] > knots[degree] else make_knots(kind, degree, rng)


def parameters(knots: Array, degree: int, rng: np.random.Generator) -> Array:
    """Random parameters, and all knots of the domain but its right end."""
    low, high = domain(knots, degree)
    u = np.concatenate([rng.uniform(low, high, 60), knots[degree : len(knots) - degree - 1]])
    return u[(u >= low) & (u < high)]


def basis(knots: Array, degree: int, u: Array, derivatives: int = 0) -> tuple[Array, IntArray]:
    return SpanPolynomials(knots, degree).evaluate(u, derivatives)


def basis_matrix(knots: Array, degree: int, u: Array, n: int, derivative: int = 0) -> Array:
    values, span = basis(knots, degree, u, derivative)
    return scatter(values[derivative], span - degree, n)


def relative_error(found: Array, expected: Array) -> float:
    return float(np.abs(found - expected).max() / max(1.0, float(np.abs(expected).max())))


@pytest.mark.parametrize("degree", [1, 2, 3, 4, 5])
@pytest.mark.parametrize("kind", KINDS)
def test_values_and_derivatives_are_scipys(degree: int, kind: str) -> None:
    rng = np.random.default_rng(degree)
    for _ in range(15):
        knots = make_knots(kind, degree, rng)
        n = len(knots) - degree - 1
        u = parameters(knots, degree, rng)
        coefficients = np.eye(n)
        for order in range(degree + 2):
            columns = [ScipyBSpline(knots, row, degree)(u, nu=order) for row in coefficients]
            expected = np.stack(columns, axis=1)
            assert relative_error(basis_matrix(knots, degree, u, n, order), expected) < TOLERANCE


@pytest.mark.parametrize("kind", KINDS)
def test_parameters_beyond_the_domain_are_clipped(kind: str) -> None:
    knots = make_knots(kind, 3, np.random.default_rng(100))
    low, high = domain(knots, 3)
    outside, ends = (basis(knots, 3, np.array(u), 4) for u in ((low - 1.0, high + 1.0), (low, high)))
    for one, other in zip(outside, ends, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("kind", ["clamped", "uniform", "random"])
def test_right_end_is_the_limit_from_the_left(kind: str) -> None:
    knots = make_knots(kind, 3, np.random.default_rng(2))
    n, (_, high) = len(knots) - 4, domain(knots, 3)
    ends = np.array([high, high - 1e-9])
    matrix = basis_matrix(knots, 3, ends, n)
    assert np.abs(matrix[0] - matrix[1]).max() < 1e-6
    assert matrix[0].sum() == pytest.approx(1.0, abs=TOLERANCE)


def test_a_repeated_end_knot_of_an_unclamped_spline_belongs_to_the_last_span_that_is_not_empty() -> None:
    knots = np.array([0.0, 1.0, 2.0, 3.0, 4.0, 4.0, 5.0, 6.0])
    assert basis(knots, 2, np.array([4.0, 9.0]))[1].tolist() == [3, 3]
    matrix = basis_matrix(knots, 2, np.array([4.0]), 5)
    assert matrix.sum() == pytest.approx(1.0)


@given(seed=st.integers(0, 2**32 - 1), degree=st.integers(1, 5), kind=st.sampled_from(KINDS))
def test_partition_of_unity_locality_and_spans(seed: int, degree: int, kind: str) -> None:
    rng = np.random.default_rng(seed)
    knots = make_knots(kind, degree, rng)
    n = len(knots) - degree - 1
    low, high = domain(knots, degree)
    u = np.append(rng.uniform(low - 1.0, high + 1.0, 50), [low, high])
    values, span = basis(knots, degree, u, 1)
    assert values.shape == (2, len(u), degree + 1)
    assert np.isfinite(values).all()
    np.testing.assert_allclose(values[0].sum(axis=1), 1.0, atol=TOLERANCE)
    assert (values[0] >= -TOLERANCE).all()
    assert np.abs(values[1].sum(axis=1)).max() < 1e-10 * max(1.0, float(np.abs(values[1]).max()))
    inside = np.clip(u, low, high)
    assert ((degree <= span) & (span < n)).all()
    assert (knots[span] < knots[span + 1]).all()
    assert ((knots[span] <= inside) & (inside <= knots[span + 1])).all()
    assert ((inside < knots[span + 1]) | (inside == high)).all()
    used = (basis_matrix(knots, degree, u, n) != 0.0).nonzero()
    assert (knots[used[1]] <= inside[used[0]]).all()
    assert (inside[used[0]] <= knots[used[1] + degree + 1]).all()


@pytest.mark.parametrize("degree", [1, 2, 3, 4])
def test_periodic_matrix_is_scipys_periodic_spline(degree: int) -> None:
    rng = np.random.default_rng(5)
    m = 9
    breaks = np.concatenate([[0.0], np.cumsum(rng.uniform(0.2, 2.0, m))])
    knots = periodic_knots(breaks, degree)
    points = rng.normal(size=(m, 2))
    unwrapped = np.concatenate([points, points[:degree]])
    u = rng.uniform(-2.0 * breaks[-1], 3.0 * breaks[-1], 200)
    expected = ScipyBSpline(knots, unwrapped, degree, extrapolate="periodic")(u)
    values, span = SpanPolynomials(knots, degree, periodic=True).evaluate(u)
    found = scatter(values[0], span - degree, m, periodic=True) @ points
    np.testing.assert_allclose(found, expected, atol=1e-11)
    columns = (span[:, None] - degree + np.arange(degree + 1)) % m
    folded = np.einsum("kj,kjd->kd", values[0], points[columns])
    np.testing.assert_allclose(folded, expected, atol=1e-11)


def test_wrapped_parameters_stay_inside_the_domain() -> None:
    knots = periodic_knots(np.linspace(0.3, 7.9, 8), 3)
    low, high = domain(knots, 3)
    u = np.array([low - 1e-18, high, high + 1e-16, -1e9, 1e9, low])
    inside = SpanPolynomials(knots, 3, periodic=True).inside(u)
    assert ((inside >= low) & (inside <= high)).all()
    assert inside[1] == pytest.approx(low)


def test_cubic_values_in_the_middle_of_uniform_knots_are_the_textbook_ones() -> None:
    values, _ = basis(np.arange(8.0), 3, np.array([3.0, 3.5]), 2)
    np.testing.assert_allclose(values[0], np.array([[8, 32, 8, 0], [1, 23, 23, 1]]) / 48.0, atol=TOLERANCE)
    np.testing.assert_allclose(values[1, 0], [-0.5, 0.0, 0.5, 0.0], atol=TOLERANCE)
    np.testing.assert_allclose(values[2, 0], [1.0, -2.0, 1.0, 0.0], atol=TOLERANCE)


def test_end_change_of_unchanged_knots_is_the_identity() -> None:
    knots = uniform_knots(7, 3)
    np.testing.assert_array_equal(end_change_matrix(knots, 3, knots), np.eye(7))
    clamped = end_change_matrix(knots, 3, clamped_knots(knots[3:-3], 3))
    np.testing.assert_allclose(clamped.sum(axis=1), 1.0, atol=TOLERANCE)
    np.testing.assert_allclose(clamped[0, :4], [1 / 6, 4 / 6, 1 / 6, 0.0], atol=TOLERANCE)


DEGREE = 3
STEP = 0.5
FIELDS = ("position", "tangent_unit", "normal_unit", "distance", "interior", "basis")


def two_curves(periodic: bool) -> tuple[list[SpanPolynomials], list[Array]]:
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


def side_by_side(tables: list[SpanPolynomials], points: list[Array]) -> tuple[Curves, Array]:
    sizes = [len(own) for own in points]
    return Curves(tables, [0, sizes[0]], sizes), np.concatenate(points)


def unwrapped(tables: SpanPolynomials, points: Array) -> Array:
    return np.concatenate([points, points[:DEGREE]]) if tables.periodic else points


def rows(tables: list[SpanPolynomials], curve: IntArray, rng: np.random.Generator) -> tuple[Array, ...]:
    """Points, and stretches past both ends or the seam; some are longer than the period."""
    points = rng.normal(0.0, 6.0, (len(curve), 2))
    low = np.array([own.low for own in tables])[curve]
    length = np.array([own.length for own in tables])[curve]
    u = low + length * rng.uniform(-0.2, 1.1, len(curve))
    return points, u, u - rng.uniform(0.0, 3.0, len(curve)), u + length * rng.uniform(0.0, 1.2, len(curve))


def assert_same(joint: FootPoints, alone: FootPoints, of: IntArray, offset: int, size: int) -> None:
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
    found = FootPoints(*spans.search(together, points, curve, low, high, STEP, SEARCH_ITERATIONS))
    refined = FootPoints(*spans.refine(together, points, curve, u, low, high, 3))
    for k, offset in enumerate((0, len(control[0]))):
        of, own = np.flatnonzero(curve == k), unwrapped(tables[k], control[k])
        alone = foot_points(tables[k], own, points[of], low[of], high[of], STEP)
        assert_same(found, alone, of, offset, len(control[k]))
        first, stretch = np.zeros(len(of), np.intp), (low[of], high[of])
        alone = FootPoints(*Curves([tables[k]]).refine(own, points[of], first, u[of], *stretch, 3))
        assert_same(refined, alone, of, offset, len(control[k]))


def test_the_tail_of_an_open_curve_is_that_curve() -> None:
    tables, control = (of[0] for of in two_curves(False))
    rng = np.random.default_rng(5)
    first = 3
    low, points = np.full(50, tables.knots[DEGREE + first]), rng.normal(0.0, 6.0, (50, 2))
    high = np.full(50, tables.high)
    whole = foot_points(tables, control, points, low, high, STEP)
    laid = Curves([tables.tail(first)], [first])
    stretch = low, high, STEP, SEARCH_ITERATIONS
    tail = FootPoints(*laid.search(control, points, np.zeros(50, np.intp), *stretch))
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
