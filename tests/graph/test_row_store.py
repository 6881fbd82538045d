"""The store of rows, held against one in numpy over sequences of what a window does with it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pathspace_graph.factors._kernels import RowStore, summed
from pathspace_graph.graph.rows import Rows
from pathspace_graph.graph.variables import Layout, control_keys, pose_keys

from ..oracles import rows as oracle

POINTS, POSES = control_keys(0, np.arange(6)), pose_keys(np.arange(5))
LAYOUT = Layout(np.concatenate([POINTS, POSES]))
OWNERS = np.arange(5)


def some_rows(rng: np.random.Generator, owners: Sequence[int]) -> list[Rows]:
    """Return rows on a pose and two points, on two poses, and again on the former, of some owners."""
    groups = []
    for kinds, width in (((POSES, POINTS), 5), ((POSES, POSES), 6), ((POSES, POINTS), 5)):
        count = int(rng.integers(0, 4)) if len(owners) else 0
        keys = np.array([[rng.choice(kind) for kind in kinds] for _ in range(count)], np.intp).reshape(-1, 2)
        keys[keys[:, 0] == keys[:, 1], 1] = kinds[1][0]
        keys[keys[:, 0] == keys[:, 1], 0] = kinds[0][1]
        own = rng.choice(np.array([*owners, 0]), count) if count else np.zeros(0, np.intp)
        groups.append(Rows(keys, rng.normal(size=(count, width)), rng.normal(size=count), own))
    return groups


def assert_same(store: RowStore, other: oracle.RowStore) -> None:
    assert bool(store) == bool(other)
    assert len(store.parts()) == len(other.parts())
    for own, expected in zip(store.parts(), other.parts(), strict=True):
        for found, column in zip(own, expected, strict=True):
            np.testing.assert_allclose(found, column, rtol=0.0, atol=1e-12)


@given(st.integers(0, 2**32 - 1), st.lists(st.sampled_from(["replace", "drop", "pop", "copy"]), max_size=12))
def test_a_store_does_what_the_one_in_numpy_does(seed: int, operations: list[str]) -> None:
    rng, store, other = np.random.default_rng(seed), RowStore(), oracle.RowStore()
    for operation in ["replace", *operations]:
        owners = np.sort(rng.choice(OWNERS, int(rng.integers(0, 4)), replace=False))
        arguments: dict[str, tuple[Any, ...]] = {
            "replace": (owners, some_rows(rng, owners.tolist()), LAYOUT, rng.normal(size=LAYOUT.size)),
            "drop": (owners,),
            "pop": (int(rng.choice(OWNERS)), LAYOUT),
            "copy": (),
        }
        found, expected = (getattr(one, operation)(*arguments[operation]) for one in (store, other))
        if operation == "copy":
            earlier, store, other = store, found, expected
            earlier.drop(OWNERS)  # which the copy does not see
        elif operation == "pop":
            for one, column in zip(found, expected, strict=True):
                np.testing.assert_array_equal(one, column)
        assert_same(store, other)
        keys = np.sort(rng.choice(LAYOUT.keys, 3, replace=False))
        np.testing.assert_array_equal(np.sort(store.owners()), np.sort(other.owners()))
        np.testing.assert_array_equal(np.sort(store.holding(keys)), np.sort(other.holding(keys)))
        np.testing.assert_array_equal(store.stale(OWNERS, keys), other.stale(OWNERS, keys))


def test_fresh_rows_are_moved_to_where_the_unknowns_are_and_come_after_those_that_stay() -> None:
    """By hand: `r - J c`."""
    store, keys = RowStore(), np.array([[POSES[0], POINTS[0]]])
    jacobian = np.array([[1.0, 2.0, 3.0, 4.0, 5.0]])
    rows = Rows(keys, jacobian, np.array([10.0]), np.array([7]))
    change = np.zeros(LAYOUT.size)
    change[LAYOUT.entries(POSES[:1])] = 0.1, 0.2, 0.3
    change[LAYOUT.entries(POINTS[:1])] = 1.0, -1.0
    store.replace(np.zeros(0, np.intp), [rows], LAYOUT, change)
    store.replace(np.array([3]), [Rows(keys, jacobian, np.array([0.0]), np.array([3]))], LAYOUT, 0.0 * change)
    ((_, _, residual, owner),) = store.parts()
    np.testing.assert_allclose(residual, [10.0 - (0.1 + 0.4 + 0.9 + 4.0 - 5.0), 0.0])
    np.testing.assert_array_equal(owner, [7, 3])


def test_rows_on_unknown_variables_are_refused_and_nothing_changes() -> None:
    store, keys = RowStore(), np.array([[POSES[0], control_keys(1, np.array(0))]])
    strange = Rows(keys, np.ones((1, 5)), np.ones(1), np.zeros(1, np.intp))
    with pytest.raises(ValueError, match="expected rows on known variables"):
        store.replace(OWNERS, [strange], LAYOUT, np.zeros(LAYOUT.size))
    assert not store
    with pytest.raises(ValueError, match="expected rows on known variables"):
        summed(LAYOUT, [], [RowStore([strange])], np.zeros(LAYOUT.size))


def test_a_store_of_rows_that_do_not_fit_their_keys_is_refused() -> None:
    narrow = Rows(np.array([[POSES[0], POINTS[0]]]), np.ones((1, 4)), np.ones(1), np.zeros(1, np.intp))
    with pytest.raises(ValueError, match="shapes that fit"):
        RowStore([narrow])
