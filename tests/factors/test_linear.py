"""Linear factors from arrays: the same to the last bit, and nothing that does not fit."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.linear import keys_of_factor, linear_factor

KEYS, WIDTHS = np.array([7, 3, 12, 5, 4], np.intp), np.array([2, 3, 2, 5, 2], np.intp)


def rows(count: int) -> tuple[Array, Array]:
    """A (count, 14) and b (count,)."""
    both = np.random.default_rng(0).normal(size=(count, int(WIDTHS.sum()) + 1))
    return both[:, :-1], both[:, -1]


@pytest.mark.parametrize("count", [1, 14, 40])
def test_a_factor_on_five_keys_comes_back(count: int) -> None:
    A, b = rows(count)
    found = linear_factor(KEYS, WIDTHS, A, b)
    np.testing.assert_array_equal(keys_of_factor(found), KEYS)
    np.testing.assert_array_equal(found.augmentedJacobian(), np.column_stack([A, b]))


def test_its_solution_is_that_of_least_squares() -> None:
    A, b = rows(40)
    graph = gtsam.GaussianFactorGraph()
    graph.push_back(linear_factor(KEYS, WIDTHS, A, b))
    solution = graph.optimize()
    found = np.concatenate([solution.at(int(key)) for key in KEYS])
    np.testing.assert_allclose(found, np.linalg.lstsq(A, b, rcond=None)[0], atol=1e-12)


def test_what_does_not_fit_is_refused() -> None:
    A, b = rows(3)
    with pytest.raises(ValueError, match="expected one or more different keys"):
        linear_factor(np.array([7, 7, 12, 5, 4], np.intp), WIDTHS, A, b)
    with pytest.raises(ValueError, match="expected a matrix of 3 rows, 14 columns"):
        linear_factor(KEYS, WIDTHS, A[:, 1:], b)
    with pytest.raises(ValueError, match="expected a matrix of 2 rows"):
        linear_factor(KEYS, WIDTHS, A, b[:2])
