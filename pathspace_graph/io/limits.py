"""Limits of what is read: beyond them a file is refused, so that nothing strange gets as far as an estimator.

They are generous, since they guard against damage and mistakes. What a certain vehicle can do is a setting of
its estimator.
"""

from __future__ import annotations

from itertools import chain
from pathlib import Path
from reprlib import Repr
from typing import Any, Final

from pathspace_graph.errors import InputError

MAX_FILE_BYTES: Final = 2**30
"""A file of data has at most this size (bytes)."""
MAX_HEADER_BYTES: Final = 2**22
"""A header or a study has at most this size (bytes)."""
MAX_TRACK_BYTES: Final = 2**23
"""A track file has at most this size (bytes)."""
MAX_DEPTH: Final = 32
"""Lists and tables are nested at most this deep."""
MAX_INTEGER: Final = 2**63 - 1
"""A whole number is at most this large, which has 19 digits."""
MAX_VARIANTS: Final = 10_000
"""A grid of a study has at most this number of combinations."""

MAX_STAMP: Final = 1e10
"""A stamp is at most this (s), which is 300 years; stamps in milliseconds or nanoseconds are beyond it."""
MAX_SPEED: Final = 1e3
"""A measured speed is at most this (m/s)."""
MAX_YAW_RATE: Final = 1e3
"""A measured yaw rate is at most this (rad/s)."""
MAX_HELD: Final = 1e3
"""A twist that is held until the next row moves the vehicle by at most this (m)."""
MAX_DRIVE: Final = 1e6
"""A drive is at most this long (m)."""
MAX_RANGE: Final = 1e4
"""Each coordinate of a detection is at most this (m), vehicle frame."""
MAX_DETECTIONS: Final = 10_000
"""A perception cycle has at most this number of detections."""
MAX_COORDINATE: Final = 1e8
"""A coordinate of a map, a trajectory or a track is at most this (m); any geodetic grid has room in it."""
MAX_DEGREE: Final = 20
"""A spline has at most this degree."""
MAX_ANGLE: Final = 1e6
"""A heading that was not wrapped is at most this (rad)."""
MAX_NOISE: Final = 1e6
"""A standard deviation, a range or a rate in a log's header is at most this, in its own unit."""
MAX_TRACK_LENGTH: Final = 3e4
"""A track is at most this long (m); its rows are matched in a time that grows with the square of it."""
MAX_TRACK_WIDTH: Final = 100.0
"""A boundary is at most this far from the middle of a track (m)."""
MAX_CONES: Final = 6_000
"""Each boundary of a track has at most this number of cones."""

SHOWN_CHARACTERS: Final = 120
"""A message shows at most this number of characters of what was found."""


def _short() -> Repr:
    short = Repr()
    short.maxlevel, short.maxstring, short.maxother, short.maxlong = 3, 80, 60, 40
    return short


_SHORT: Final = _short()


def shown(value: Any) -> str:
    """Returns a value as a message shows it: short, whatever it holds."""
    text = _SHORT.repr(value)
    return text if len(text) <= SHOWN_CHARACTERS else text[: SHOWN_CHARACTERS - 3] + "..."


def check_content(content: Any, file: Path) -> None:
    """Raises an InputError where the content of a file is nested too deep or has too large a whole number."""
    level, seen = [content], set[int]()
    for _ in range(MAX_DEPTH):
        values = list(chain.from_iterable(map(_children, level)))
        for value in values:
            if isinstance(value, int) and abs(value) > MAX_INTEGER:
                raise InputError(file, f"expected whole numbers up to {MAX_INTEGER}, found {shown(value)}")
        # what an alias names more than once is looked at once
        inner = {id(value): value for value in values if isinstance(value, dict | list)}
        level = [value for key, value in inner.items() if key not in seen]
        seen |= inner.keys()
        if not level:
            return
    raise InputError(file, too_deep())


def too_deep() -> str:
    """Returns the message for a file that is nested deeper than allowed."""
    return f"expected lists and tables nested at most {MAX_DEPTH} deep, found deeper ones"


def _children(value: Any) -> Any:
    if isinstance(value, dict):
        return chain(value.keys(), value.values())
    return value if isinstance(value, list) else (value,)
