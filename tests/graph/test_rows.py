"""Rows as GTSAM factors: the dense system, an owner a factor, and memory that is the factor's own."""

from __future__ import annotations

import gc

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from pathspace_graph.graph.gaussian import graph_of, normal_equations
from pathspace_graph.graph.keys import POSE, control_keys, pose_keys
from pathspace_graph.graph.rows import Rows, jacobian_factors, stacked_factor
from pathspace_graph.graph.variables import UNKNOWN, Layout, Variables

from ..scenes.graph import (
    KEYS,
    LEFT_KEYS,
    POSE_KEYS,
    columns_of,
    dense_rows,
    random_groups,
    random_rows,
    random_variables,
)

Array = NDArray[np.float64]


def rows_of(factor: gtsam.GaussianConditional) -> Array:
    """`[A b]` of a factor, sorted by b: a copy."""
    A, b = gtsam.JacobianFactor(factor).jacobian()
    both = np.column_stack([A, b])
    return both[np.argsort(both[:, -1])]


def expected_rows(A: Array, b: Array) -> Array:
    both = np.column_stack([A, b])
    return both[np.argsort(both[:, -1])]


@pytest.mark.parametrize("seed", range(5))
def test_all_factors_together_are_the_dense_normal_equations(seed: int) -> None:
    """`J'J` and `J'(J d - r)`, d = value - reference: `J x + r` is what it is at any value."""
    rng = np.random.default_rng(seed)
    variables, groups = random_variables(rng), random_groups(rng)
    factors = jacobian_factors(groups, variables)
    J, r, _ = dense_rows(groups, KEYS)
    hessian, vector = normal_equations(
        graph_of(*(factor.linear for factor in factors.values())), variables.layout
    )
    moved = variables.values - variables.reference
    np.testing.assert_allclose(hessian, J.T @ J, atol=1e-10)
    np.testing.assert_allclose(vector, J.T @ (J @ moved - r), atol=1e-10)
    step = np.linalg.lstsq(J, -r, rcond=None)[0]
    np.testing.assert_allclose(np.linalg.solve(hessian, vector), moved + step, atol=1e-9)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 12))
def test_each_owner_s_factor_holds_its_rows_and_no_other(seed: int, owners: int) -> None:
    """On the keys of its rows alone, in ascending order; also where owners' rows are mixed, and many lack."""
    rng = np.random.default_rng(seed)
    variables, groups = random_variables(rng), random_groups(rng, owners)
    J, r, owner = dense_rows(groups, KEYS)
    b = J @ (variables.values - variables.reference) - r
    factors = jacobian_factors(groups, variables)
    assert sorted(factors) == np.unique(owner).tolist()
    for number, factor in factors.items():
        own = owner == number
        touched = {int(key) for rows in groups for key in rows.keys[rows.owner == number].ravel()}
        assert factor.keys == touched
        assert list(factor.linear.keys()) == sorted(touched)
        columns = columns_of(np.array(sorted(touched)), KEYS)
        expected = expected_rows(J[np.ix_(own, columns)], b[own])
        np.testing.assert_allclose(rows_of(factor.linear), expected, atol=1e-10)


def test_stacked_factor_is_all_rows() -> None:
    rng = np.random.default_rng(1)
    variables, groups = random_variables(rng), random_groups(rng)
    J, r, _ = dense_rows(groups, KEYS)
    (factor,) = stacked_factor(groups, variables)
    expected = expected_rows(J, J @ (variables.values - variables.reference) - r)
    np.testing.assert_allclose(rows_of(factor), expected, atol=1e-10)
    assert stacked_factor(groups[1:2], variables) == []


def test_no_rows_are_no_factor() -> None:
    variables = random_variables(np.random.default_rng(2))
    assert jacobian_factors([], variables) == {}
    assert jacobian_factors(random_groups(np.random.default_rng(2))[1:2], variables) == {}


@pytest.mark.parametrize(
    ("key", "name"),
    [(int(control_keys(0, np.array(9))), "l9"), (0, "0"), (int(pose_keys(np.array(99))), "x99")],
)
def test_rows_on_an_unknown_variable_are_refused_by_its_name(key: int, name: str) -> None:
    """Between known keys, before the first, and past the last one."""
    rng = np.random.default_rng(3)
    variables = random_variables(rng)
    rows = random_rows(rng, [POSE_KEYS, LEFT_KEYS], 6, 2)
    rows.keys[4, 0 if name == "x99" else 1] = key
    with pytest.raises(ValueError, match=f"known variables, found {name}$"):
        jacobian_factors([rows], variables)


def test_a_factor_outlives_all_that_it_was_made_of() -> None:
    """A block of the buffer is copied into the factor: neither rows nor buffer nor variables stay its own."""
    rng = np.random.default_rng(4)
    variables, groups = random_variables(rng), random_groups(rng)
    factors = [factor.linear for factor in jacobian_factors(groups, variables).values()]
    expected = [rows_of(factor) for factor in factors]
    for rows in groups:
        rows.jacobian[:], rows.residual[:], rows.keys[:] = np.nan, np.nan, 0
    variables.values[:] = np.nan
    del rows, groups, variables
    gc.collect()
    rubbish = [np.full(5000, np.nan) for _ in range(200)]
    for factor, before in zip(factors, expected, strict=True):
        np.testing.assert_array_equal(rows_of(factor), before)
    assert len(rubbish) == 200


def test_a_conditional_on_many_keys_copies_the_block_that_it_is_given() -> None:
    """The memory of the factors depends on this behaviour of the binding."""
    block = np.asfortranarray(np.random.default_rng(5).normal(size=(4, 11)))
    matrix = gtsam.VerticalBlockMatrix([2, 2, 3, 3, 1], block, False)
    factor, before = gtsam.GaussianConditional([1, 2, 3, 4], 1, matrix), block.copy()
    block[:] = np.nan
    del matrix
    gc.collect()
    np.testing.assert_array_equal(np.column_stack(gtsam.JacobianFactor(factor).jacobian()), before)


def test_columns_are_where_the_variables_lie() -> None:
    """UNKNOWN where a key isn't in the layout; a pose has three entries, all others two."""
    rng = np.random.default_rng(6)
    rows = random_rows(rng, [POSE_KEYS, LEFT_KEYS, KEYS[:1]], 20, 3)
    expected = np.stack([columns_of(keys, KEYS) for keys in rows.keys])
    np.testing.assert_array_equal(rows.columns(Layout(KEYS)), expected)
    less = np.delete(KEYS, np.flatnonzero(np.isin(KEYS, [POSE_KEYS[0], LEFT_KEYS[1]])))
    found = rows.columns(Layout(less))
    for i, keys in enumerate(rows.keys):
        gone = np.repeat(np.isin(keys, [POSE_KEYS[0], LEFT_KEYS[1]]), [POSE, 2, 2])
        assert (found[i, gone] == UNKNOWN).all()
        known = keys[np.isin(keys, less)]
        np.testing.assert_array_equal(found[i, ~gone], columns_of(known, less))


def test_where_takes_rows_by_mask_and_by_number() -> None:
    rows = random_rows(np.random.default_rng(7), [POSE_KEYS, LEFT_KEYS], 8, 2)
    chosen = np.array([1, 4, 5])
    for some in (rows.where(chosen), rows.where(np.isin(np.arange(8), chosen))):
        assert len(some) == 3
        np.testing.assert_array_equal(some.jacobian, rows.jacobian[chosen])
        np.testing.assert_array_equal(some.keys, rows.keys[chosen])
        np.testing.assert_array_equal(some.residual, rows.residual[chosen])
        np.testing.assert_array_equal(some.owner, rows.owner[chosen])


def test_the_size_of_a_variable_is_its_letter_s() -> None:
    """So a key can't have two sizes, which GTSAM would take: nobody tells the builder a size."""
    variables = Variables()
    variables.insert(np.append(LEFT_KEYS[:1], pose_keys(np.array([3]))), np.zeros(5))
    rows = Rows(LEFT_KEYS[None, :1], np.ones((1, 3)), np.zeros(1), np.zeros(1, np.intp))
    with pytest.raises(ValueError):
        jacobian_factors([rows], variables)
