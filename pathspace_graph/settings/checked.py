"""Settings whose values msgspec checks where they are made, and overrides by dotted fields."""

import typing
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, asdict, fields, is_dataclass, replace
from functools import cache
from sys import float_info
from types import NoneType, UnionType
from typing import Annotated, Any, ClassVar, Final, Literal, TypeVar

import msgspec
from msgspec import Meta

from pathspace_graph.brief import notebook_html
from pathspace_graph.errors import SettingsError, check_name, check_type

LARGEST: Final = float_info.max  # largest finite number
Positive = Annotated[float, Meta(gt=0.0, le=LARGEST, description="a positive number")]
AtLeast0 = Annotated[float, Meta(ge=0.0, le=LARGEST, description="a number of at least 0")]
Unlimited = Annotated[float, Meta(gt=0.0, description="a positive number or inf")]
Share = Annotated[float, Meta(ge=0.0, le=1.0, description="a number in [0, 1]")]
Signed = Annotated[float, Meta(ge=-LARGEST, le=LARGEST, description="a number")]
Count = Annotated[int, Meta(gt=0, description="a positive whole number")]
WORDS: Final[dict[Any, str]] = {float: "a number", int: "a whole number", bool: "True or False"}


class Checked:
    """Settings of the types that they declare; a single number without limits is positive and finite."""

    prefix: ClassVar[str]  # what stands before the names of the settings on the command line

    def __init_subclass__(cls, group: str | None = None) -> None:
        """Set the prefix from the name of the group, which is by default that of the class."""
        group = cls.__name__.removesuffix("Settings").lower() if group is None else group
        cls.prefix = f"{group}." if group else ""
        setattr(cls, "__repr__", Checked._changed)  # noqa: B010 - or `dataclass` would make its own

    def _changed(self) -> str:
        """Call that makes these settings, with those that are not the default."""
        changed = []
        for entry in fields(self):  # type: ignore[arg-type]  # every heir is a dataclass
            value, make = getattr(self, entry.name), entry.default_factory
            if value != (entry.default if make is MISSING else make()):
                changed.append(f"{entry.name}={value!r}")
        return f"{type(self).__name__}({', '.join(changed)})"

    _repr_html_ = notebook_html

    def __post_init__(self) -> None:
        """Raise a SettingsError that names the first wrong setting, as the command line knows it."""
        for entry in fields(self):  # type: ignore[arg-type]  # every heir is a dataclass
            as_setting(getattr(self, entry.name), type(self), entry.name, f"{self.prefix}{entry.name}")


def as_setting(value: Any, settings: type[Any], name: str, where: str) -> Any:
    """Convert plain data, or a number of NumPy, to the type of a setting; a SettingsError says `where`."""
    kind = _types(settings)[name]  # type: ignore[arg-type]  # a class has a hash, whatever its heirs'
    if is_dataclass(kind):
        check_type(where, value, kind)  # type: ignore[arg-type]
    listed = [value] if not isinstance(value, tuple) else [*value]
    plain = [one.tolist() if hasattr(one, "tolist") else one for one in listed]
    try:
        return msgspec.convert(plain if isinstance(value, tuple) else plain[0], kind)
    except (msgspec.ValidationError, OverflowError):
        raise SettingsError(f"{where}: expected {_in_words(kind)}, found {value!r:.120}") from None


@cache
def _types(settings: type[Any]) -> dict[str, Any]:
    """Type of each setting, with the default limits of the numbers where it is `Checked`."""
    limits = {float: Positive, int: Count} if issubclass(settings, Checked) else {}
    types, hints = {}, typing.get_type_hints(settings, include_extras=True)
    for entry in fields(settings):
        hint = hints[entry.name]
        parts = typing.get_args(hint) if typing.get_origin(hint) in (typing.Union, UnionType) else (hint,)
        types[entry.name] = typing.Union[tuple(limits.get(part, part) for part in parts)]  # noqa: UP007
    return types


def _in_words(kind: Any) -> str:
    parts = typing.get_args(kind)
    if typing.get_origin(kind) is Literal:
        return " or ".join(map(repr, parts))
    if typing.get_origin(kind) is tuple:
        return f"a list of {'' if parts[-1] is ... else f'{len(parts)} '}values, each {_in_words(parts[0])}"
    if typing.get_origin(kind) is Annotated:
        described = (part.description for part in parts if isinstance(part, Meta))
        return next(described, None) or _in_words(parts[0])
    words = " or ".join(_in_words(part) for part in parts if part is not NoneType)
    return words or WORDS.get(kind) or f"a {getattr(kind, '__name__', kind)}"


# --- overrides -------------------------------------------------------------------------------------------

T = TypeVar("T")
Overrides = Mapping[str, Any]  # new values by dotted field


def leaves(settings: Any) -> dict[str, Any]:
    """Value of every dotted field of a settings dataclass, in order."""
    return flatten(asdict(settings))


def flatten(table: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Flatten nested tables to dotted names, which mean the same as TOML's dotted keys."""
    flat: dict[str, Any] = {}
    for key, value in table.items():
        name = f"{prefix}{key}"
        flat |= flatten(value, f"{name}.") if isinstance(value, Mapping) else {name: value}
    return flat


def override(settings: T, overrides: Overrides, where: str) -> T:
    """Override some dotted fields of settings; a wrong field or value is a SettingsError."""
    known, before = leaves(settings), f"{where}." if where else ""
    for name, value in overrides.items():
        if name not in known:
            check_name(name, known, f"{where}: expected a known setting" if where else "expected a setting")
        settings = _set(settings, name.split("."), value, f"{before}{name}")
    return settings


def apart(
    overrides: Overrides, estimators: Iterable[str], settings: Any
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Overrides of settings, and those of estimators' own parameters, `NAME.field`."""
    known, names = leaves(settings), set(estimators)
    own = {k: v for k, v in overrides.items() if k not in known and k.partition(".")[0] in names}
    return {k: v for k, v in overrides.items() if k not in own}, own


def _set(settings: Any, path: list[str], value: Any, where: str) -> Any:
    name, *rest = path
    if rest:
        new = _set(getattr(settings, name), rest, value, where)
    else:  # JSON has infinity as a text
        new = as_setting(float(value) if value in ("inf", "-inf") else value, type(settings), name, where)
    try:
        return replace(settings, **{name: new})
    except SettingsError as error:
        raise error if str(error).startswith(where) else SettingsError(f"{where}: {error}") from error
