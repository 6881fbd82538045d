"""The cubature rule: exact for linear and cubic functions, and its slope for what is only correlated."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.baselines.ckf import square_root, transform

Array = NDArray[np.float64]


def random_covariance(rng: np.random.Generator, size: int) -> Array:
    root = rng.normal(size=(size, size))
    return root @ root.T + 0.1 * np.eye(size)


def test_a_linear_function_is_transformed_exactly() -> None:
    rng = np.random.default_rng(1)
    mean, covariance, matrix = rng.normal(size=4), random_covariance(rng, 4), rng.normal(size=(3, 4))
    result = transform(lambda x: x @ matrix.T + 1.0, mean, covariance)
    np.testing.assert_allclose(result.mean, matrix @ mean + 1.0, atol=1e-12)
    np.testing.assert_allclose(result.covariance, matrix @ covariance @ matrix.T, atol=1e-12)
    np.testing.assert_allclose(result.slope, matrix, atol=1e-12)


def test_the_mean_of_a_cubic_is_exact() -> None:
    """E[(m + s z)^3] = m^3 + 3 m s^2."""
    result = transform(lambda x: x**3, np.array([0.7]), np.array([[0.25]]))
    assert result.mean[0] == pytest.approx(0.7**3 + 3 * 0.7 * 0.25)


def test_the_slope_gives_the_covariance_with_correlated_variables() -> None:
    """Cov(f(x), y) of jointly Gaussian x, y is E[f'(x)] Cov(x, y) (Stein): 2 m s_xy of a parabola."""
    result = transform(lambda x: x**2 - x, np.array([0.7]), np.array([[0.25]]))
    assert (result.slope @ np.array([0.1]))[0] == pytest.approx((2.0 * 0.7 - 1.0) * 0.1)


def test_a_singular_covariance_has_a_square_root() -> None:
    direction = np.array([[1.0, 2.0, -1.0]])
    covariance = direction.T @ direction
    root = square_root(covariance)
    np.testing.assert_allclose(root @ root.T, covariance, atol=1e-9)
    np.testing.assert_allclose(root, np.tril(root), atol=1e-12)
