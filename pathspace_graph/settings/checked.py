"""Settings whose values are checked where they are made."""

from collections.abc import Callable
from dataclasses import fields
from functools import cache
from math import inf
from numbers import Integral, Real
from types import NoneType, UnionType
from typing import Annotated, Any, ClassVar, Final, Literal, Union, get_args, get_origin, get_type_hints

from pathspace_graph.errors import SettingsError

POSITIVE: Final = "a positive number"
AT_LEAST_0: Final = "a number of at least 0"
RULES: Final[dict[str, Callable[[Any], bool]]] = {  # checks of numbers, by the words of their message
    POSITIVE: lambda value: 0 < value < inf,
    "a positive number or inf": lambda value: value > 0,
    AT_LEAST_0: lambda value: 0 <= value < inf,
    "a number in [0, 1]": lambda value: 0 <= value <= 1,
    "a number": lambda value: -inf < value < inf,
}
Unlimited = Annotated[float, "a positive number or inf"]
AtLeast0 = Annotated[float, AT_LEAST_0]
Share = Annotated[float, "a number in [0, 1]"]
Signed = Annotated[float, "a number"]

_NUMBER_KINDS: Final[dict[Any, tuple[type[Any], str]]] = {
    float: (Real, "a number"),
    int: (Integral, "a whole number"),
}


class Checked:
    """Settings of the types that they declare, whose numbers keep the rule of their annotation.

    A single number without a rule is positive and finite. A rule of a tuple holds for each of its numbers.
    """

    prefix: ClassVar[str]  # what stands before the names of the settings on the command line

    def __init_subclass__(cls, group: str | None = None) -> None:
        """Set the prefix from the name of the group, which is by default that of the class."""
        group = cls.__name__.removesuffix("Settings").lower() if group is None else group
        cls.prefix = f"{group}." if group else ""

    def __post_init__(self) -> None:
        """Raise a SettingsError that names the first wrong setting, as the command line knows it."""
        types = _types(type(self))  # type: ignore[arg-type]  # a class has a hash, whatever its heirs'
        for entry in fields(self):  # type: ignore[arg-type]  # every heir is a dataclass
            value, (kind, stated) = getattr(self, entry.name), types[entry.name]
            if not is_of(value, kind):
                expected = f"expected {in_words(kind)}, found {value!r}"
                raise SettingsError(f"{self.prefix}{entry.name}: {expected:.200}")
            numbers = value if isinstance(value, tuple) else (value,)
            rule = stated or ("" if isinstance(value, tuple) else POSITIVE)
            for number in numbers:
                if rule and is_of(number, float) and not RULES[rule](number):
                    raise SettingsError(f"{self.prefix}{entry.name}: expected {rule}, found {number}")


@cache
def _types(settings: Any) -> dict[str, tuple[Any, str]]:
    """Type of each setting, and the rule of its annotation; empty without one."""
    types = {}
    for name, hint in get_type_hints(settings, include_extras=True).items():
        kind, *stated = get_args(hint) if get_origin(hint) is Annotated else (hint,)
        types[name] = kind, next((rule for rule in stated if isinstance(rule, str)), "")
    return types


def is_of(value: Any, kind: Any) -> bool:
    """Whether a value is of the type of a field; NumPy's numbers are numbers."""
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
    return isinstance(value, get_origin(kind) or kind)


def in_words(kind: Any) -> str:
    options = get_args(kind)
    if get_origin(kind) in (Union, UnionType):
        return " or ".join(map(in_words, options))
    if get_origin(kind) is Literal:
        return " or ".join(map(repr, options))
    if get_origin(kind) is tuple:
        count = "" if options[-1] is ... else f"{len(options)} "
        return f"a list of {count}values, each {in_words(options[0])}"
    if kind in _NUMBER_KINDS:
        return _NUMBER_KINDS[kind][1]
    return {bool: "True or False", NoneType: "None"}.get(kind) or f"a {getattr(kind, '__name__', kind)}"
