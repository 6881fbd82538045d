"""Boundary labels: which side of the track a detected cone marks."""

from __future__ import annotations

from typing import Final

LEFT: Final = 0
RIGHT: Final = 1
UNKNOWN: Final = 2

NAMES: Final = ("left", "right", "unknown")
"""The words of the file format, indexed by label."""

BOUNDARIES: Final = (LEFT, RIGHT)
"""The labels that name a boundary."""

_CODES: Final = {"left": LEFT, "blue": LEFT, "right": RIGHT, "yellow": RIGHT}


def label_from_name(name: str) -> int:
    """`left`/`blue` -> LEFT, `right`/`yellow` -> RIGHT, any other word -> UNKNOWN (FORMATS: a log)."""
    return _CODES.get(name.strip().lower(), UNKNOWN)
