"""Rescaling of records by the power of length of each of their numbers.

Estimators know scenes of the size of a Formula Student track. The lengths of another one, such as of a model
car, are divided by its scale where a log is handed to an estimator, and multiplied in the result.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final, TypeVar

import numpy as np

T = TypeVar("T")

POSE_LENGTHS: Final = (1, 1, 0)  # powers of length in a pose or a twist


def scaled(one: T, factor: float) -> T:
    """Rescale the lengths of a record by `factor`; times do not change.

    The class attribute `LENGTHS` has the power of length of each field, or one for each last index. For a
    covariance in `COVARIANCES` there is a power for each row and column. A power of 0 rescales only nested
    records.
    """
    if factor == 1.0 or not hasattr(type(one), "LENGTHS"):
        return one
    powers: Mapping[str, Any] = type(one).LENGTHS  # type: ignore[attr-defined]
    outer: Mapping[str, Any] = getattr(type(one), "COVARIANCES", {})
    changed = {name: times(getattr(one, name), power, factor) for name, power in powers.items()}
    for name, power in outer.items():
        weights = factor ** np.array(power, float)
        value = getattr(one, name)
        changed[name] = value * np.outer(weights, weights) if value.size else value
    return replace(one, **changed)  # type: ignore[type-var]


def times(value: Any, power: Any, factor: float) -> Any:
    """Multiply a value by a power of a factor, or by one power for each last index; nested values as well."""
    if hasattr(type(value), "LENGTHS"):
        return scaled(value, factor)
    if isinstance(value, Mapping):
        return {key: times(own, power, factor) for key, own in value.items()}
    if isinstance(value, tuple):
        each = power if isinstance(power, tuple) else (power,) * len(value)
        return tuple(times(own, one, factor) for own, one in zip(value, each, strict=True))
    if value is None or power == 0 or np.size(value) == 0:
        return value
    return value * factor ** (np.array(power, float) if isinstance(power, tuple) else float(power))
