"""Settings whose numbers are checked where they are made."""

from dataclasses import fields
from functools import cache
from math import inf
from numbers import Integral, Real
from types import NoneType, UnionType
from typing import Any, ClassVar, Final, Literal, Union, get_args, get_origin, get_type_hints

from pathspace_graph.errors import NUMBERS, SettingsError

_NUMBER_KINDS: Final[dict[Any, tuple[type[Any], str]]] = {
    float: (Real, "a number"),
    int: (Integral, "a whole number"),
}


class Positive:
    """Settings whose numbers are all positive and, unless they are listed as unlimited, finite."""

    UNLIMITED: ClassVar[tuple[str, ...]] = ()  # numbers that may be infinite: there is no limit then
    SIGNED: ClassVar[tuple[str, ...]] = ()  # numbers that may have either sign
    prefix: ClassVar[str]  # what stands before the names of the settings on the command line

    def __init_subclass__(cls, group: str | None = None) -> None:
        """Set the prefix from the name of the group, which is by default that of the class."""
        group = cls.__name__.removesuffix("Settings").lower() if group is None else group
        cls.prefix = "" if group == "mapper" else f"{group}."

    def __post_init__(self) -> None:
        """Raise a SettingsError that names the first wrong setting, as the command line knows it."""
        types = _types(type(self))  # type: ignore[arg-type]  # a class has a hash, whatever its heirs'
        for entry in fields(self):  # type: ignore[arg-type]  # every heir is a dataclass
            value = getattr(self, entry.name)
            if not is_of(value, types[entry.name]):
                expected = f"expected {in_words(types[entry.name])}, found {value!r}"
                raise SettingsError(f"{self.prefix}{entry.name}: {expected:.200}")
            if isinstance(value, bool) or not isinstance(value, int | float):
                continue
            expected = "a number" if entry.name in self.SIGNED else "a positive number"
            is_unlimited = value == inf and entry.name in self.UNLIMITED
            if not is_unlimited and not NUMBERS[expected](value):
                raise SettingsError(f"{self.prefix}{entry.name}: expected {expected}, found {value}")


@cache
def _types(settings: Any) -> dict[str, Any]:
    return get_type_hints(settings)


def is_of(value: Any, kind: Any) -> bool:
    """Return whether a value is of the type of a field; NumPy's numbers are numbers."""
    options = get_args(kind)
    if get_origin(kind) in (Union, UnionType):
        return any(is_of(value, option) for option in options)
    if get_origin(kind) is Literal:
        return value in options
    if get_origin(kind) is tuple:
        each = options[:1] * len(value) if isinstance(value, tuple) and options[-1] is ... else options
        return isinstance(value, tuple) and len(value) == len(each) and all(map(is_of, value, each))
    if kind in _NUMBER_KINDS:
        return isinstance(value, _NUMBER_KINDS[kind][0]) and not isinstance(value, bool)
    return isinstance(value, kind)


def in_words(kind: Any) -> str:
    options = get_args(kind)
    if get_origin(kind) in (Union, UnionType):
        return " or ".join(map(in_words, options))
    if get_origin(kind) is Literal:
        return " or ".join(map(repr, options))
    if get_origin(kind) is tuple:
        return f"a list, each {in_words(options[0])}"
    if kind in _NUMBER_KINDS:
        return _NUMBER_KINDS[kind][1]
    return {bool: "True or False", NoneType: "None"}.get(kind) or f"a {getattr(kind, '__name__', kind)}"
