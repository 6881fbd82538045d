"""Rescaling of records and texts by the power of length of each of their numbers."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final, Self, TypeVar

import numpy as np

T = TypeVar("T")

POSE_LENGTHS: Final = (1, 1, 0)  # powers of length in a pose or a twist


@dataclass(frozen=True)
class Length:
    """Number in a text with a power of length in its unit, such as m or m/s: `f"{Length(0.3):.2f} m"`."""

    value: float
    power: int = 1

    def scaled(self, factor: float) -> Self:
        return replace(self, value=self.value * factor**self.power)

    def __format__(self, form: str) -> str:
        return format(self.value, form or "g")


class Text(str):
    """Text with lengths that can be rescaled.

    An example is `Text("{place} is {far:.2f} m away", place="the end", far=Length(0.3))`.
    """

    template: str
    figures: dict[str, Any]  # by name in the template; a Length or a Text is rescaled

    def __new__(cls, template: str, **figures: Any) -> Self:
        text = super().__new__(cls, template.format(**figures))
        text.template, text.figures = template, figures
        return text

    def scaled(self, factor: float) -> Self:
        return type(self)(self.template, **times(self.figures, 0, factor))

    def __getnewargs_ex__(self) -> tuple[tuple[str], dict[str, Any]]:
        """Pickle the text for worker processes."""
        return (self.template,), self.figures


def joined(texts: Iterable[str], separator: str = "; ") -> str:
    """Join the texts that are not empty to one that can be rescaled."""
    parts = [*filter(None, texts)]
    if len(parts) <= 1:
        return parts[0] if parts else ""
    figures = {f"part{k}": text for k, text in enumerate(parts)}
    return Text(separator.join(f"{{{name}}}" for name in figures), **figures)


def scaled(one: T, factor: float) -> T:
    """Rescale the lengths of a record by `factor`; times do not change.

    The class attribute `LENGTHS` has the power of length of each field, or one for each last index. For a
    covariance in `COVARIANCES` there is a power for each row and column. A power of 0 rescales only nested
    records and texts.
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
