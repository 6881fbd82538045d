"""Dotted fields of a tree of settings, such as `spline.degree`, and overrides of them, also from a file."""

from collections.abc import Iterable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, TypeVar

from pathspace_graph.errors import InputError, SettingsError, check_name
from pathspace_graph.io.parsing import MAX_HEADER_BYTES, parse_json, parse_toml, read_text, shown
from pathspace_graph.settings.checked import as_setting

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


def read_settings(file: Path, settings: T, estimators: Iterable[str] = ()) -> tuple[T, dict[str, Any]]:
    """Settings with those of a file, and the own parameters of some estimators that it has.

    The file is TOML or a run's `summary.json`. An InputError says what is wrong with the settings.
    """
    text = read_text(file, "a file of settings", MAX_HEADER_BYTES)
    content = parse_json(text, file) if file.suffix == ".json" else parse_toml(text, file)
    table = content.get("settings", content) if isinstance(content, dict) else content
    if not isinstance(table, dict):
        raise InputError(file, f"expected a table of settings, found {shown(table)}")
    try:
        overrides, own = apart(flatten(table), estimators, settings)
        return override(settings, overrides, ""), own
    except SettingsError as error:
        raise InputError(file, str(error)) from error


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
