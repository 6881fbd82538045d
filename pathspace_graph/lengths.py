"""Records and texts of a scene of another size, by the power of a length that each of their numbers has."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final, Self, TypeVar

import numpy as np

T = TypeVar("T")

POSE_LENGTHS: Final = (1, 1, 0)  # powers of the length in a pose, or in a twist


@dataclass(frozen=True)
class Length:
    """A number of a text in m or m/s, or in a power of m: `f"{Length(0.3):.2f} m"`."""

    value: float
    power: int = 1

    def scaled(self, factor: float) -> Self:
        return replace(self, value=self.value * factor**self.power)

    def __format__(self, form: str) -> str:
        return format(self.value, form or "g")


class Text(str):
    """A text with lengths, made again of its figures for a scene of another size.

    An example is `Text("{place} is {far:.2f} m away", place="the end", far=Length(0.3))`.
    """

    template: str
    figures: dict[str, Any]  # by their names in the template; a Length or a Text changes with the scale

    def __new__(cls, template: str, **figures: Any) -> Self:
        text = super().__new__(cls, template.format(**figures))
        text.template, text.figures = template, figures
        return text

    def scaled(self, factor: float) -> Self:
        return type(self)(self.template, **times(self.figures, 0, factor))

    def __getnewargs_ex__(self) -> tuple[tuple[str], dict[str, Any]]:
        """Return what a copy is made of: it comes back from worker processes."""
        return (self.template,), self.figures


def joined(texts: Iterable[str], separator: str = "; ") -> str:
    """Return the texts that are not empty as one, in which lengths still change with the scale."""
    figures = {f"part{k}": text for k, text in enumerate(filter(None, texts))}
    return Text(separator.join(f"{{{name}}}" for name in figures), **figures)


def scaled(one: T, factor: float) -> T:
    """Return a record of a scene that is `factor` times as large; time does not change.

    A dataclass says in `LENGTHS` which of its fields have a length: its power, or one for each last index.
    A matrix under a name in `COVARIANCES` has one power for each row and column. With the power 0 only
    records and texts inside are changed.
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
    if isinstance(value, Length | Text):
        return value.scaled(factor)
    if isinstance(value, Mapping):
        return {key: times(own, power, factor) for key, own in value.items()}
    if isinstance(value, tuple):
        each = power if isinstance(power, tuple) else (power,) * len(value)
        return tuple(times(own, one, factor) for own, one in zip(value, each, strict=True))
    if value is None or power == 0 or np.size(value) == 0:
        return value
    return value * factor ** (np.array(power, float) if isinstance(power, tuple) else float(power))
