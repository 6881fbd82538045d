"""Deep copies of whole object graphs, made without the `copy` methods of the classes that they are of."""

from __future__ import annotations

from collections import deque
from typing import Any, Final

import gtsam
import numpy as np

from pathspace_graph.factors._kernels import MotionCheck, RowStore

Memo = dict[int, Any]  # copies by the `id` of what they are copies of

GRAPHS: Final = (gtsam.GaussianFactorGraph, gtsam.GaussianBayesNet)
"""GTSAM's types to which factors are added in place; the factors themselves never change."""


def copied(value: Any, memo: Memo | None = None) -> Any:
    """Return a copy that shares nothing that may be written; what is held twice is held twice in the copy."""
    memo = {} if memo is None else memo
    if id(value) not in memo:
        memo[id(value)] = _copy_of(value, memo)
    return memo[id(value)]


def _copy_of(value: Any, memo: Memo) -> Any:
    if isinstance(value, np.ndarray):
        return _array(value, memo)
    if isinstance(value, list | set | deque | dict):
        return _collection(value, memo)
    if isinstance(value, tuple):
        items = [copied(one, memo) for one in value]
        return type(value)._make(items) if hasattr(value, "_make") else tuple(items)
    if isinstance(value, GRAPHS):
        graph = type(value)()
        graph.push_back(value)
        return graph
    if isinstance(value, MotionCheck | RowStore):
        return value.copy()
    is_own = hasattr(value, "__dict__") and type(value).__module__.startswith("pathspace_graph.")
    return _object(value, memo) if is_own and not isinstance(value, str) else value


def _array(value: Any, memo: Memo) -> Any:
    """Return a copy of an array in the same order; views of one array are views of its copy."""
    base = value.base
    if isinstance(base, np.ndarray):
        begin = value.__array_interface__["data"][0] - base.__array_interface__["data"][0]
        found = np.ndarray(value.shape, value.dtype, copied(base, memo), begin, value.strides)
    else:
        found = value.copy(order="K")
    found.flags.writeable = value.flags.writeable
    return found


def _collection(value: Any, memo: Memo) -> Any:
    found = memo[id(value)] = value.copy()
    found.clear()
    if isinstance(value, dict):
        found.update((key, copied(own, memo)) for key, own in value.items())
    else:
        add = found.add if isinstance(value, set) else found.append
        for one in value:
            add(copied(one, memo))
    return found


def _object(value: Any, memo: Memo) -> Any:
    found = memo[id(value)] = object.__new__(type(value))
    for name, own in vars(value).items():
        object.__setattr__(found, name, copied(own, memo))
    return found
