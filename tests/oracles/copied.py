"""Copies of an estimator in memory, to which it goes back where an update fails.

A copy shares what nothing changes: frozen dataclasses of arrays, classes that say that they are `constant`,
arrays that cannot be written, and GTSAM's factors.
"""

from collections import deque
from collections.abc import Callable
from functools import partial
from types import MethodType
from typing import Any, Final

import gtsam
import numpy as np

Memo = dict[int, Any]  # copies by the `id` of what they are copies of
Copier = Callable[[Any, Memo], Any]
Call = partial[Any]


class Recovery:
    """Return of an estimator to what it was before its newest call, by a copy and the few calls since then.

    A call is repeated to the bit if it has got nothing from outside, such as another process.
    """

    EVERY: Final = 10  # number of calls from one copy to the next: a copy takes a quarter of a call's time

    def __init__(self, failures: int = 0) -> None:
        self.failures = failures
        self._copy: dict[str, Any] | None = None
        self._calls: list[Call] = []
        self._outside: object = None

    def before(self, estimator: object, *shared: object, outside: object = None) -> None:
        """Make a copy of an estimator before a call where one is due; it shares itself and some objects.

        One is due as well where `outside` has changed, which says what calls have got from there.
        """
        if self._copy is None or len(self._calls) >= self.EVERY or outside != self._outside:
            self._copy, self._calls = self._held(vars(estimator), estimator, shared), []
            self._outside = outside

    def called(self, again: Call) -> None:
        """Note a call that has changed the estimator."""
        self._calls.append(again)

    def take_back(self, estimator: object, *shared: object) -> None:
        """Take an estimator back to what it was after the last call that was noted."""
        if self._copy is None:
            raise RuntimeError("expected a copy of the estimator, found none")
        attributes = self._held(self._copy, estimator, shared)  # the copy stays, for the next failure
        vars(estimator).clear()
        vars(estimator).update(attributes)
        for done, again in enumerate(self._calls):
            try:
                again()
            except Exception:  # it did not fail before: something outside has changed
                self._calls = self._calls[:done]
                self.take_back(estimator, *shared)
                return

    def _held(self, values: dict[str, Any], estimator: object, shared: tuple[object, ...]) -> dict[str, Any]:
        memo = {id(one): one for one in (self, estimator, *shared)}
        return {name: copied(own, memo) for name, own in values.items()}


def copied(value: Any, memo: Memo) -> Any:
    """Return a copy of a value; what is held twice is held twice in the copy."""
    copier = _copier_of(value)
    if copier is None:
        return value
    found = memo.get(id(value))
    if found is None:
        found = memo[id(value)] = copier(value, memo)
    return found


def is_shared(value: object) -> bool:
    return all(map(is_shared, value)) if isinstance(value, tuple) else _copier_of(value) is None


def _copier_of(value: object) -> Copier | None:
    """Return how a value is copied; a frozen dataclass is shared unless it holds what may change."""
    kind = type(value)
    if kind not in _COPIERS:
        copier = _COPIERS[kind] = _copier(kind)
        if copier is None and hasattr(kind, "__dataclass_params__") and not getattr(kind, "constant", False):
            held = [own for own in vars(value).values() if type(own) is not np.ndarray]
            _COPIERS[kind] = None if all(map(is_shared, held)) else _object
    return _COPIERS[kind]


def _copier(kind: type) -> Copier | None:
    if issubclass(kind, (list, tuple, set, deque)):
        return _sequence
    if issubclass(kind, dict):
        return _mapping
    parameters = getattr(kind, "__dataclass_params__", None)
    is_frozen = (parameters is not None and parameters.frozen) or getattr(kind, "constant", False)
    return _object if kind.__module__.startswith(f"{__package__}.") and not is_frozen else None


def _array(value: Any, memo: Memo) -> Any:
    """Return a copy of an array in the same order; views of one array are views of its copy."""
    if not value.flags.writeable:
        return value
    base = value.base
    if type(base) is not np.ndarray:
        return value.copy(order="K")
    begin = value.__array_interface__["data"][0] - base.__array_interface__["data"][0]
    return np.ndarray(value.shape, value.dtype, copied(base, memo), begin, value.strides)


def _sequence(value: Any, memo: Memo) -> Any:
    """Return a copy of a list, a tuple, a set or a deque; one of shared values is copied at once."""
    kinds = set(map(type, value))
    arrays = [one for one in value if type(one) is np.ndarray] if np.ndarray in kinds else []
    fixed = all(_COPIERS.get(kind, _object) is None for kind in kinds - {np.ndarray})
    if fixed and not any(one.flags.writeable for one in arrays):
        return value if type(value) is tuple else value.copy()
    if isinstance(value, tuple):
        items = [copied(one, memo) for one in value]
        return type(value)._make(items) if hasattr(value, "_make") else tuple(items)
    found = memo[id(value)] = value.copy()
    found.clear()
    add = found.add if isinstance(found, set) else found.append
    for one in value:
        add(copied(one, memo))
    return found


def _mapping(value: Any, memo: Memo) -> Any:
    found = memo[id(value)] = value.copy()
    for key, own in value.items():
        found[key] = copied(own, memo)
    return found


def _graph(value: Any, _: Memo) -> Any:
    found = type(value)()
    found.push_back(value)
    return found


def _object(value: Any, memo: Memo) -> Any:
    found = memo[id(value)] = object.__new__(type(value))
    for name, own in vars(value).items():
        object.__setattr__(found, name, copied(own, memo))
    return found


_COPIERS: Final[dict[type, Copier | None]] = {  # how each type that was met is copied; None if it is shared
    np.ndarray: _array,
    MethodType: lambda method, memo: MethodType(method.__func__, copied(method.__self__, memo)),
    gtsam.GaussianFactorGraph: _graph,  # factors are added to these in place
    gtsam.GaussianBayesNet: _graph,
}
