"""The basis kernels against scipy and against what defines a B-spline."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import BSpline as ScipyBSpline

from pathspace_graph.factors.bspline import (
    Floats,
    basis,
    basis_matrix,
    clamped_knots,
    domain,
    end_change_matrix,
    find_span,
    periodic_basis_matrix,
    periodic_knots,
    uniform_knots,
    wrap,
)
from pathspace_graph.factors.spans import SpanPolynomials

TOLERANCE = 1e-12
KINDS = ("random", "repeated", "clamped", "uniform")


def make_knots(kind: str, degree: int, rng: np.random.Generator) -> Floats:
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


def parameters(knots: Floats, degree: int, rng: np.random.Generator) -> Floats:
    """Random parameters, and all knots of the domain but its right end."""
    low, high = domain(knots, degree)
    u = np.concatenate([rng.uniform(low, high, 60), knots[degree : len(knots) - degree - 1]])
    return u[(u >= low) & (u < high)]


def relative_error(found: Floats, expected: Floats) -> float:
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


@pytest.mark.parametrize("degree", [1, 2, 3, 4, 5])
@pytest.mark.parametrize("kind", KINDS)
def test_span_polynomials_are_the_basis(degree: int, kind: str) -> None:
    rng = np.random.default_rng(100 + degree)
    for _ in range(15):
        knots = make_knots(kind, degree, rng)
        low, high = domain(knots, degree)
        u = np.concatenate([parameters(knots, degree, rng), [low - 1.0, low, high, high + 1.0]])
        values, span = basis(knots, degree, u, degree + 1)
        fast, fast_span = SpanPolynomials(knots, degree).evaluate(u, degree + 1)
        np.testing.assert_array_equal(fast_span, span)
        for order in range(degree + 2):
            assert relative_error(fast[order], values[order]) < TOLERANCE


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
    assert find_span(knots, 2, np.array([4.0, 9.0])).tolist() == [3, 3]
    matrix = basis_matrix(knots, 2, np.array([4.0]), 5)
    assert matrix.sum() == pytest.approx(1.0)


@settings(max_examples=60, deadline=None)
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
    found = periodic_basis_matrix(knots, degree, u, m) @ points
    np.testing.assert_allclose(found, expected, atol=1e-11)
    values, span = SpanPolynomials(knots, degree, periodic=True).evaluate(u)
    columns = (span[:, None] - degree + np.arange(degree + 1)) % m
    folded = np.einsum("kj,kjd->kd", values[0], points[columns])
    np.testing.assert_allclose(folded, expected, atol=1e-11)


def test_wrapped_parameters_stay_inside_the_domain() -> None:
    knots = periodic_knots(np.linspace(0.3, 7.9, 8), 3)
    low, high = domain(knots, 3)
    u = np.array([low - 1e-18, high, high + 1e-16, -1e9, 1e9, low])
    inside = wrap(knots, 3, u)
    assert ((inside >= low) & (inside <= high)).all()
    assert inside[1] == pytest.approx(low)


def test_curve_coefficients_give_the_curve() -> None:
    rng = np.random.default_rng(8)
    knots = make_knots("clamped", 3, rng)
    points = rng.normal(size=(len(knots) - 4, 2))
    tables = SpanPolynomials(knots, 3)
    u = rng.uniform(tables.low, tables.high, 30)
    number, s = tables.locate(u)
    terms = tables.alone.curve_coefficients(points)[..., number]
    curve = np.einsum("krdm,mk->rmd", terms, s[:, None] ** np.arange(4))
    for order in range(3):
        expected = basis_matrix(knots, 3, u, len(points), order) @ points
        assert relative_error(curve[order], expected) < TOLERANCE


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
