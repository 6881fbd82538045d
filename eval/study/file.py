"""Studies in TOML files: those that ship with the package, and a user's own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, Final

from pathspace_graph.errors import InputError, PathspaceError, SettingsError, check_name
from pathspace_graph.io.limits import MAX_HEADER_BYTES, shown
from pathspace_graph.io.parsing import parse_toml, read_text
from pathspace_graph.overrides import flatten

from .study import ALL, Baseline, Study

SHIPPED: Final = Path(__file__).parents[1] / "studies"
"""The studies that ship with the package lie here."""

_KEYS: Final = tuple("grid" if entry.name == "grids" else entry.name for entry in fields(Study))


def shipped_studies() -> list[str]:
    """Returns the names of the studies that ship with the package."""
    return sorted(file.stem for file in SHIPPED.glob("*.toml"))


def find_study(name: Path) -> Path:
    """Returns the file itself, or that of the shipped study of this name."""
    if name.is_file():
        return name
    if name.suffix == "" and name.stem in shipped_studies():
        return SHIPPED / f"{name.stem}.toml"
    check_name(str(name), shipped_studies(), "expected a study's file, or one that is known by name")
    raise InputError(name, "expected a study's file")


def read_study(file: Path | str) -> Study:
    """Returns the study of a TOML file, with track files relative to it; InputError says what is wrong."""
    file = Path(file)
    content = parse_toml(read_text(file, "a study", MAX_HEADER_BYTES), file)
    try:
        return study_from(content, file.parent, file.stem)
    except PathspaceError as error:
        raise InputError(file, str(error)) from error


def study_from(content: Mapping[str, Any], folder: Path = Path(), name: str = "study") -> Study:
    """Returns the study with the content of a TOML file."""
    for key in content:
        check_name(key, _KEYS, "expected a known key")
    values: dict[str, Any] = {"name": name} | dict(content)
    if "tracks" not in values:
        raise SettingsError("tracks: expected track files, or seeds of generated tracks, found none")
    for key in ("tracks", "seeds", "estimators", "metrics", "columns"):
        if key in values:
            values[key] = (ALL,) if values[key] == ALL else tuple(_list(key, values[key]))
    for key in ("name", "question"):
        _check_text(key, values.get(key, ""))
    values["tracks"] = tuple(folder / t if isinstance(t, str) else t for t in values["tracks"])
    for key in ("noise", "variants"):
        if key in values:
            values[key] = {k: flatten(_table(f"{key}.{k}", v)) for k, v in _table(key, values[key]).items()}
    if "grid" in values:
        grids = values.pop("grid")
        grids = grids if isinstance(grids, list) else [grids]
        values["grids"] = tuple(flatten(_table("grid", grid)) for grid in grids)
    if "baseline" in values:
        values["baseline"] = _baseline(_table("baseline", values["baseline"]))
    return Study(**values)


def _baseline(table: Mapping[str, Any]) -> Baseline:
    for key, value in table.items():
        check_name(key, ("variant", "estimator"), "baseline: expected a known key")
        _check_text(f"baseline.{key}", value)
    return Baseline(**table)


def _list(key: str, value: Any) -> list[Any]:
    if not isinstance(value, list):
        raise SettingsError(f"{key}: expected a list, found {shown(value)}")
    return value


def _table(key: str, value: Any) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise SettingsError(f"{key}: expected a table, found {shown(value)}")
    return value


def _check_text(key: str, value: Any) -> None:
    if not isinstance(value, str):
        raise SettingsError(f"{key}: expected text, found {shown(value)}")
