"""The prior of smoothness: straight lines, parabolas, and the seam."""

from __future__ import annotations

import numpy as np
import pytest

from pathspace_graph.factors.bspline import SpanPolynomials, uniform_knots
from pathspace_graph.factors.residuals import greville, smoothness_coefficients, smoothness_matrix
from pathspace_graph.settings.mapper import MapperSettings

from ..scenes.jacobians import assert_jacobians


def test_smoothness_is_zero_on_straight_lines_with_uneven_abscissae() -> None:
    abscissae = np.cumsum(np.random.default_rng(2).uniform(0.2, 5.0, 9))
    line = np.column_stack([2.0 - 0.3 * abscissae, 5.0 + 1.7 * abscissae])
    matrix = smoothness_matrix(abscissae, None)
    assert matrix.shape == (7, 9)
    np.testing.assert_allclose(matrix @ line, 0.0, atol=1e-12)


def test_smoothness_of_a_parabola_is_its_bend_whatever_the_spacing() -> None:
    """Second differences of `a t^2` at the mean spacing h are `2 a h^2`, everywhere."""
    abscissae = np.cumsum(np.random.default_rng(3).uniform(0.2, 5.0, 9))
    mean = np.diff(abscissae).mean()
    np.testing.assert_allclose(smoothness_matrix(abscissae, None) @ abscissae**2, 2.0 * mean**2, rtol=1e-10)


def test_smoothness_at_even_abscissae_is_the_second_difference() -> None:
    matrix = smoothness_matrix(3.5 * np.arange(4.0), None)
    np.testing.assert_allclose(matrix, [[1.0, -2.0, 1.0, 0.0], [0.0, 1.0, -2.0, 1.0]], atol=1e-12)


def test_periodic_smoothness_wraps_at_the_seam() -> None:
    """One row for every control point; those across the seam are the rows of the curve unrolled beyond it."""
    abscissae = np.array([0.0, 1.0, 3.0, 4.5, 7.0])
    period = 8.0
    matrix = smoothness_matrix(abscissae, period)
    assert matrix.shape == (5, 5)
    np.testing.assert_allclose(matrix @ np.ones(5), 0.0, atol=1e-12)
    rng = np.random.default_rng(4)
    values = rng.normal(size=5)
    turned = smoothness_matrix(np.append(abscissae[2:], abscissae[:2] + period), period)
    np.testing.assert_allclose(turned @ np.roll(values, -2), np.roll(matrix @ values, -2), atol=1e-12)
    even = smoothness_matrix(np.arange(4.0), 4.0)
    np.testing.assert_allclose(even[3], [-2.0, 1.0, 0.0, 1.0], atol=1e-12)


@pytest.mark.parametrize("spacing", [None, 2.5])
@pytest.mark.parametrize("period", [None, 30.0])
def test_coefficients_are_second_divided_differences(period: float | None, spacing: float | None) -> None:
    """`2 h^2 f[t_j, t_j+1, t_j+2]`, each by three points in a row: around the curve where it is closed."""
    rng = np.random.default_rng(6)
    abscissae = np.cumsum(rng.uniform(0.5, 4.0, 7))
    values = rng.normal(size=7)
    coefficients = smoothness_coefficients(abscissae, period, spacing)
    unrolled = abscissae if period is None else np.append(abscissae, abscissae[:2] + period)
    repeated = values if period is None else np.append(values, values[:2])
    mean = np.diff(abscissae).mean() if period is None else period / 7
    assert coefficients.shape == (len(unrolled) - 2, 3)
    for j, row in enumerate(coefficients):
        (a, b, c), (f, g, h) = unrolled[j : j + 3], repeated[j : j + 3]
        divided = ((h - g) / (c - b) - (g - f) / (b - a)) / (c - a)
        expected = 2.0 * (mean if spacing is None else spacing) ** 2 * divided
        assert row @ [f, g, h] == pytest.approx(expected, rel=1e-10)
    wrapped = np.stack([values, np.roll(values, -1), np.roll(values, -2)], axis=1)[: len(coefficients)]
    if spacing is None:
        found = smoothness_matrix(abscissae, period) @ values
        np.testing.assert_allclose(found, (coefficients * wrapped).sum(axis=1), atol=1e-12)


def test_two_points_have_no_second_difference() -> None:
    assert smoothness_coefficients(np.array([0.0, 2.0]), None).shape == (0, 3)
    assert smoothness_matrix(np.array([0.0, 2.0]), None).shape == (0, 2)


@pytest.mark.parametrize("period", [None, 30.0])
def test_smoothness_jacobians(period: float | None) -> None:
    rng = np.random.default_rng(5)
    abscissae = np.cumsum(rng.uniform(0.5, 4.0, 7))
    matrix = np.kron(smoothness_matrix(abscissae, period), np.eye(2))
    assert_jacobians(lambda c: (matrix @ c, matrix), [rng.normal(size=14) * 5.0])


@pytest.mark.parametrize("degree", [1, 2, 3, 4])
def test_greville_abscissae_give_the_parameter_back(degree: int) -> None:
    """`sum_j N_j(u) xi_j = u`: control points at their abscissae make a straight, evenly run curve."""
    knots = uniform_knots(8, degree, 1.5)
    knots[degree + 2] += 0.4
    tables = SpanPolynomials(knots, degree)
    u = np.linspace(tables.low, tables.high, 50)
    values, span = tables.evaluate(u)
    abscissae = greville(knots, degree)
    assert len(abscissae) == 8
    columns = span[:, None] + np.arange(-degree, 1)
    np.testing.assert_allclose(np.sum(values[0] * abscissae[columns], axis=1), u, atol=1e-12)


def test_the_anchors_of_a_long_track_leave_its_heading_to_the_odometry() -> None:
    """All of them together on a circle of 2.3 km, against a bias of the yaw rate after a lap at 12 m/s."""
    settings, length = MapperSettings(), 2300.0
    count = 2 * length / settings.spline.spacing
    by_anchors = settings.gauge.sigma_anchor / (np.sqrt(count) * length / (2.0 * np.pi))
    assert by_anchors > 1.5 * settings.odometry.sigma_bias * length / 12.0
