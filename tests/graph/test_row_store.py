"""The store of rows, against dense ones over sequences of what a window does with it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pathspace_graph.factors._kernels import RowStore, summed
from pathspace_graph.factors.arrays import Array
from pathspace_graph.graph.rows import Rows
from pathspace_graph.graph.variables import Layout, control_keys, pose_keys

POINTS, POSES = control_keys(0, np.arange(6)), pose_keys(np.arange(5))
LAYOUT = Layout(np.concatenate([POINTS, POSES]))
OWNERS = np.arange(5)
NOTHING = np.zeros(LAYOUT.size)


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


def dense(groups: Sequence[Rows], change: Array) -> Array:
    """Return `[owner | J | r - J c]` (m, n + 2) of all rows, in ascending order."""
    found = [np.zeros((0, LAYOUT.size + 2))]
    for rows in groups:
        for keys, jacobian, residual, owner in zip(*rows.parts, strict=True):
            row = np.zeros(LAYOUT.size + 2)
            row[1 + LAYOUT.entries(keys)], row[0] = jacobian, owner
            row[-1] = residual - row[1:-1] @ change
            found.append(row[None])
    return ascending(np.concatenate(found))


def ascending(rows: Array) -> Array:
    return rows[np.lexsort(rows.T[::-1])]


@given(st.integers(0, 2**32 - 1), st.lists(st.sampled_from(["replace", "drop", "pop", "copy"]), max_size=12))
def test_a_store_has_the_rows_that_were_added_and_not_taken_out(seed: int, operations: list[str]) -> None:
    rng, store, expected, still = np.random.default_rng(seed), RowStore(), dense([], NOTHING), NOTHING
    for operation in ["replace", *operations]:
        owners = np.sort(rng.choice(OWNERS, int(rng.integers(0, 4)), replace=False))
        if operation == "replace":
            fresh, change = some_rows(rng, owners.tolist()), rng.normal(size=LAYOUT.size)
            store.replace(owners, fresh, LAYOUT, change)
            kept = expected[~np.isin(expected[:, 0], owners)]
            expected = ascending(np.concatenate([kept, dense(fresh, change)]))
        elif operation == "drop":
            store.drop(owners)
            expected = expected[~np.isin(expected[:, 0], owners)]
        elif operation == "copy":
            earlier, store = store, store.copy()
            earlier.drop(OWNERS)  # which the copy does not see
        else:
            owner = int(rng.choice(OWNERS))
            held, block = store.pop(owner, LAYOUT)
            is_own = expected[:, 0] == owner
            popped, expected = expected[is_own], expected[~is_own]
            found = np.zeros((len(block), LAYOUT.size + 2))
            found[:, 0], found[:, -1] = owner, -block[:, -1]
            found[:, 1 + LAYOUT.entries(LAYOUT.keys[held])] = block[:, :-1]
            np.testing.assert_allclose(ascending(found), popped, rtol=0.0, atol=1e-12)
            used = np.flatnonzero(popped[:, 1:-1].any(axis=0))
            assert set(used) <= set(LAYOUT.entries(LAYOUT.keys[held]).tolist())
        groups = [Rows(*parts) for parts in store.parts()]
        np.testing.assert_allclose(dense(groups, still), expected, rtol=0.0, atol=1e-12)
        keys = np.sort(rng.choice(LAYOUT.keys, 3, replace=False))
        holds = expected[:, 1 + LAYOUT.entries(keys)].any(axis=1)
        np.testing.assert_array_equal(np.sort(store.holding(keys)), expected[holds, 0])
        stale = ~np.isin(OWNERS, expected[:, 0]) | np.isin(OWNERS, expected[holds, 0])
        np.testing.assert_array_equal(store.stale(OWNERS, keys), stale)


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
    assert not store.parts()
    store.replace(OWNERS, [strange], Layout(np.union1d(LAYOUT.keys, strange.keys)), np.zeros(99))
    with pytest.raises(ValueError, match="expected rows on known variables"):
        summed(LAYOUT, [], store, NOTHING)


def test_a_store_of_rows_that_do_not_fit_their_keys_is_refused() -> None:
    narrow = Rows(np.array([[POSES[0], POINTS[0]]]), np.ones((1, 4)), np.ones(1), np.zeros(1, np.intp))
    with pytest.raises(ValueError, match="shapes that fit"):
        RowStore().replace(OWNERS, [narrow], LAYOUT, NOTHING)
