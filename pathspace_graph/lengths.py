"""Records of a scene of another size, by the power of a length that each of their fields has."""

import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final, TypeVar

import numpy as np

T = TypeVar("T")

POSE: Final = (1, 1, 0)  # powers of the length in a pose, or in a twist
_METRES: Final = re.compile(r"(?<![\w.])(\d+(?:\.\d+)?(?:e[+-]?\d+)?)(?=(?: to [\d.e+-]+)? m\b)")


def scaled(one: T, factor: float) -> T:
    """Return a record of a scene that is `factor` times as large; time does not change.

    A dataclass says in `LENGTHS` which of its fields have a length: its power, or one for each last index.
    A matrix under a name in `COVARIANCES` has one power for each row and column. A text has its metres
    changed. With the power 0 only records inside are.
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
    """Return a value times a power of a factor, or one power for each last index; it may hold others."""
    if hasattr(type(value), "LENGTHS"):
        return scaled(value, factor)
    if isinstance(value, Mapping):
        return {key: times(own, power, factor) for key, own in value.items()}
    if isinstance(value, tuple):
        each = power if isinstance(power, tuple) else (power,) * len(value)
        return tuple(times(own, one, factor) for own, one in zip(value, each, strict=True))
    if isinstance(value, str):
        return _METRES.sub(lambda found: f"{float(found[1]) * factor**power:.3g}", value)
    if value is None or power == 0 or np.size(value) == 0:
        return value
    return value * factor ** (np.array(power, float) if isinstance(power, tuple) else float(power))
