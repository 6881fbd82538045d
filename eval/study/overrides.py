"""Dotted fields of a tree of settings, such as `spline.degree`, and overrides of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from pathspace_graph.errors import SettingsError, check_name
from pathspace_graph.io.limits import shown

T = TypeVar("T")
Overrides = Mapping[str, Any]
"""These are new values by dotted field."""


def leaves(settings: Any, prefix: str = "") -> dict[str, Any]:
    """Returns the value of every dotted field of a settings dataclass, in order."""
    found: dict[str, Any] = {}
    for entry in fields(settings):
        value = getattr(settings, entry.name)
        name = f"{prefix}{entry.name}"
        found |= leaves(value, f"{name}.") if is_dataclass(value) else {name: value}
    return found


def flatten(table: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Returns nested tables with dotted names, which mean the same as TOML's dotted keys."""
    flat: dict[str, Any] = {}
    for key, value in table.items():
        name = f"{prefix}{key}"
        flat |= flatten(value, f"{name}.") if isinstance(value, Mapping) else {name: value}
    return flat


def override(settings: T, overrides: Overrides, where: str) -> T:
    """Returns the settings with some dotted fields overridden; SettingsError if a field or a value is
    wrong."""
    known = leaves(settings)
    for name, value in overrides.items():
        check_name(name, known, f"{where}: expected a known setting")
        settings = _set(settings, name.split("."), value, f"{where}.{name}")
    return settings


def _set(settings: Any, path: list[str], value: Any, where: str) -> Any:
    name, *rest = path
    if rest:
        new = _set(getattr(settings, name), rest, value, where)
    else:
        new = as_type(value, get_type_hints(type(settings))[name], where)
    try:
        return replace(settings, **{name: new})
    except SettingsError as error:
        raise SettingsError(f"{where}: {error}") from error


def as_type(value: Any, hint: Any, where: str) -> Any:
    """Returns a value of TOML in the type of a field: a list as a tuple, a whole number as a float."""
    arguments = get_args(hint)
    if get_origin(hint) is Literal and value in arguments:
        return value
    if get_origin(hint) in (Union, UnionType):
        (hint,) = (entry for entry in arguments if entry is not NoneType)
        return as_type(value, hint, where)
    if get_origin(hint) is tuple and isinstance(value, list | tuple):
        each = arguments[:1] * len(value) if arguments[-1] is Ellipsis else arguments
        if len(each) == len(value):
            return tuple(as_type(v, h, where) for v, h in zip(value, each, strict=True))
    if hint is float and isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    if isinstance(hint, type) and type(value) is hint:
        return value
    name = hint.__name__ if isinstance(hint, type) else str(hint)
    raise SettingsError(f"{where}: expected a value of type {name}, found {shown(value)}")
