"""Texts of records in a notebook; pictures and frames come from rooms above, imported on demand."""

from dataclasses import fields, is_dataclass
from importlib import import_module
from typing import Any, Final

LONGEST: Final = 3  # most values of an array that its text lists


def pictures() -> Any:
    return import_module("pathspace_graph.eval.figures.drawing")


def frames() -> Any:
    return import_module("pathspace_graph.frames")


def notebook() -> Any:
    return import_module("pathspace_graph.eval.figures.notebook")


def notebook_html(record: Any) -> str | None:
    """HTML of a record for a notebook, which shows its text where this is None: without the extra `eval`."""
    try:
        return str(notebook().html(record))
    except ModuleNotFoundError:
        return None


class Shown:
    """A record that a notebook shows as HTML."""

    _repr_html_ = notebook_html


class Brief:
    """A record whose text has the shapes of its arrays in place of their numbers."""

    def __repr__(self) -> str:
        return brief(self)


def brief(value: Any) -> str:
    """One-line text of a value, with shapes and lengths in place of many numbers."""
    shape = getattr(value, "shape", None)
    if shape is not None and getattr(value, "size", 0) > LONGEST:
        return f"array {shape}"
    if isinstance(value, tuple | list | dict) and len(value) > LONGEST:
        first = next(iter(value))
        return f"{type(value).__name__} of {len(value)} {type(first).__name__}"
    if is_dataclass(value) and not isinstance(value, type):
        values = (f"{entry.name}={brief(getattr(value, entry.name))}" for entry in fields(value))
        return f"{type(value).__name__}({', '.join(values)})"
    return " ".join(repr(value).split())
