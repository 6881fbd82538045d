"""A digest of everything that an estimator holds, to see that two are the same to the last bit."""

from __future__ import annotations

import hashlib
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import is_dataclass
from functools import cached_property
from typing import Any

import gtsam
import numpy as np
from scipy.spatial import KDTree

from pathspace_graph.factors._kernels import MotionCheck, RowStore
from pathspace_graph.front_end.gate import Gate

NOT_ESTIMATED = (
    *("lap_seconds", "late_cycles", "failures", "_unused"),
    *("_first_pose", "_curves", "_whole_curves", "_steps"),
)
"""These attributes are times of the machine, what is kept for a failure, caches, and steps to come."""

COMPILED: dict[type, Callable[[Any], Any]] = {
    KDTree: lambda tree: np.array(tree.data),
    RowStore: RowStore.parts,
    MotionCheck: lambda check: (check.pose, check.errors),  # every cycle changes its errors of the sensor
}
"""What each compiled object holds."""


def digest(estimator: object) -> str:
    """Identifies everything that an estimator holds, but for the counts of the gate."""
    found = hashlib.sha256()
    for part in _parts(estimator, set()):
        found.update(part)
    return found.hexdigest()


def _parts(value: Any, seen: set[int]) -> Iterator[bytes]:
    """The contents of an object, each once that can change: equal frozen ones may be one or several."""
    if isinstance(value, np.ndarray):
        yield f"{value.dtype}{value.shape}".encode() + value.tobytes()
    elif isinstance(value, dict):
        for key in sorted(value, key=repr):
            yield repr(key).encode()
            yield from _parts(value[key], seen)
    elif isinstance(value, list | tuple | deque | set | frozenset):
        for entry in sorted(value) if isinstance(value, set | frozenset) else value:
            yield from _parts(entry, seen)
    elif type(value).__module__.startswith("pathspace_graph") and not isinstance(
        value, Gate | MotionCheck | RowStore
    ):
        if _is_frozen(value) or id(value) not in seen:
            seen.add(id(value))
            yield type(value).__qualname__.encode()
            yield from _parts(_held(value), seen)
    elif isinstance(value, gtsam.GaussianFactorGraph | gtsam.GaussianBayesNet):
        for k in range(value.size()):
            yield from _parts(value.at(k), seen)
    elif isinstance(value, gtsam.GaussianFactor):
        yield repr(list(value.keys())).encode() + value.augmentedInformation().tobytes()
    elif isinstance(value, tuple(COMPILED)):
        yield from _parts(COMPILED[type(value)](value), seen)
    elif not isinstance(value, Gate | Future):
        yield repr(value).encode()


def _is_frozen(value: object) -> bool:
    return is_dataclass(value) and bool(value.__dataclass_params__.frozen)  # type: ignore[attr-defined]


def _held(value: object) -> dict[str, Any]:
    """The attributes of an object, but for those that are computed where they are asked for."""
    kind = type(value)
    return {
        name: held
        for name, held in vars(value).items()
        if name not in NOT_ESTIMATED and not isinstance(getattr(kind, name, None), cached_property)
    }
