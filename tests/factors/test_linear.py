"""Linear factors as arrays and back: the same to the last bit, and nothing that does not fit."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.linear import (
    conditional_of,
    frontals_of,
    hessian_factor_of,
    hessian_matrix,
    jacobian_factor_of,
    jacobian_matrix,
    keys_of_factor,
)

KEYS, WIDTHS = np.array([7, 3, 12, 5, 4], np.intp), np.array([2, 3, 2, 5, 2], np.intp)


def rows(count: int, seed: int = 0) -> Array:
    return np.random.default_rng(seed).normal(size=(count, int(WIDTHS.sum()) + 1))


@pytest.mark.parametrize("frontals", [1, 2, 5])
@pytest.mark.parametrize("count", [1, 14, 40])
def test_a_conditional_comes_back(frontals: int, count: int) -> None:
    known = conditional_of(KEYS, WIDTHS, frontals, rows(count))
    assert frontals_of(known, WIDTHS.tolist()) == frontals
    found = conditional_of(keys_of_factor(known), WIDTHS, frontals, jacobian_matrix(known))
    assert found.keys() == known.keys() == KEYS.tolist()
    np.testing.assert_array_equal(jacobian_matrix(found), rows(count))
    assert found.R().shape == known.R().shape


def test_an_eliminated_conditional_solves_the_same() -> None:
    graph = gtsam.GaussianFactorGraph()
    graph.push_back(conditional_of(KEYS, WIDTHS, 1, rows(40)))
    net, _ = graph.eliminatePartialSequential(gtsam.Ordering(KEYS[:3].tolist()))
    for k in range(net.size()):
        known = net.at(k)
        keys = keys_of_factor(known)
        widths = WIDTHS[[KEYS.tolist().index(key) for key in keys]]
        found = conditional_of(keys, widths, frontals_of(known, widths.tolist()), jacobian_matrix(known))
        np.testing.assert_array_equal(found.R(), known.R())
        np.testing.assert_array_equal(found.S(), known.S())
        np.testing.assert_array_equal(found.d(), known.d())


def test_a_hessian_factor_comes_back() -> None:
    graph = gtsam.GaussianFactorGraph()
    graph.push_back(conditional_of(KEYS, WIDTHS, 1, rows(9)))  # singular
    graph.push_back(conditional_of(KEYS, WIDTHS, 1, rows(2, seed=1)).negate())
    known = gtsam.HessianFactor(graph)
    keys = keys_of_factor(known)
    widths = WIDTHS[[KEYS.tolist().index(key) for key in keys]]
    found = hessian_factor_of(keys, widths, hessian_matrix(known))
    assert found.keys() == known.keys()
    np.testing.assert_array_equal(hessian_matrix(found), hessian_matrix(known))
    assert found.constantTerm() == known.constantTerm()


def test_a_jacobian_factor_comes_back() -> None:
    found = jacobian_factor_of(KEYS, WIDTHS, rows(6))
    assert type(found) is gtsam.JacobianFactor
    np.testing.assert_array_equal(jacobian_matrix(found), rows(6))


def test_a_noise_model_is_refused() -> None:
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.5, 0.5]))
    with pytest.raises(ValueError, match="expected whitened rows"):
        jacobian_matrix(gtsam.JacobianFactor(1, np.eye(2), np.zeros(2), noise))


def test_what_does_not_fit_is_refused() -> None:
    twice = np.array([7, 7, 12, 5, 4], np.intp)
    with pytest.raises(ValueError, match="expected one or more different keys"):
        conditional_of(twice, WIDTHS, 1, rows(3))
    with pytest.raises(ValueError, match="expected 1 to 5 frontal keys, found 6"):
        conditional_of(KEYS, WIDTHS, 6, rows(3))
    with pytest.raises(ValueError, match="expected a matrix of 15 columns"):
        conditional_of(KEYS, WIDTHS, 1, rows(3)[:, 1:])
    with pytest.raises(ValueError, match="expected a square matrix of 15 rows, found 3"):
        hessian_factor_of(KEYS, WIDTHS, rows(3))
