"""JSON files: strict JSON is written whole or not at all, and an error names the row of what is read."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .files import write_text
from .parsing import parse_json, read_text


def to_plain(value: Any) -> Any:
    """Returns the value in the types of strict JSON.

    Arrays and tuples become lists, numpy's scalars become numbers, and paths become texts. JSON has no number
    that is not finite: NaN becomes null, since it is no value, and infinity becomes the text "inf".
    """
    if isinstance(value, Mapping):
        return {str(key): to_plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return to_plain(value.tolist())
    if isinstance(value, list | tuple):
        return [to_plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None if math.isnan(value) else str(value)
    return str(value) if isinstance(value, Path) else value


def write_json(file: Path, content: Any, indent: int | None = 2) -> None:
    """Writes the content as strict JSON, see `to_plain`, and replaces an earlier file."""
    write_text(file, json.dumps(to_plain(content), indent=indent, allow_nan=False) + "\n")


def read_json(file: Path, expected: str) -> Any:
    """Returns the content of a JSON file; an InputError says that `expected` was expected where it fails."""
    return parse_json(read_text(file, expected), file)
