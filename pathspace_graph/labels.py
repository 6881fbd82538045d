"""Boundary labels: the side of the track that a detected cone marks."""

from __future__ import annotations

from typing import Final

LEFT: Final = 0
RIGHT: Final = 1
UNKNOWN: Final = 2

NAMES: Final = ("left", "right", "unknown")
"""These are the words of the file format, indexed by label."""

BOUNDARIES: Final = (LEFT, RIGHT)
"""These labels name a boundary."""

_CODES: Final = {"left": LEFT, "blue": LEFT, "right": RIGHT, "yellow": RIGHT}


def label_from_name(name: str) -> int:
    """Returns LEFT for `left` or `blue`, RIGHT for `right` or `yellow`, UNKNOWN for any other word
    (FORMATS)."""
    return _CODES.get(name.strip().lower(), UNKNOWN)
