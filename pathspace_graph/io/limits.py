"""Limits of what is read: beyond them a file is refused, so that nothing strange gets as far as an estimator.

They are generous, since they guard against damage and mistakes. What a certain vehicle can do is a setting of
its estimator.
"""

from itertools import chain
from pathlib import Path
from reprlib import Repr
from typing import Any, Final

from pathspace_graph.errors import InputError

MAX_FILE_BYTES: Final = 2**30
MAX_HEADER_BYTES: Final = 2**22  # also of a study
MAX_TRACK_BYTES: Final = 2**23
MAX_DEPTH: Final = 32  # of lists and tables in each other
MAX_INTEGER: Final = 2**63 - 1
MAX_VARIANTS: Final = 10_000  # of a study's grid

MAX_STAMP: Final = 1e10  # s: 300 years; stamps in milliseconds or nanoseconds are beyond it
MAX_SPEED: Final = 1e3  # m/s
MAX_YAW_RATE: Final = 1e3  # rad/s
MAX_HELD: Final = 1e3  # m, moved by a twist until the next row
MAX_DRIVE: Final = 1e6  # m
MAX_RANGE: Final = 1e4  # m, each coordinate of a detection
MAX_DETECTIONS: Final = 10_000  # of one perception cycle
MAX_COORDINATE: Final = 1e8  # m, of a map, a trajectory or a track; any geodetic grid has room in it
MAX_DEGREE: Final = 20
MAX_ANGLE: Final = 1e6  # rad, of a heading that was not wrapped
MAX_NOISE: Final = 1e6  # a number in a log's header, in its own unit
MAX_TRACK_LENGTH: Final = 3e4  # m; rows are matched in a time that grows with its square
MAX_TRACK_WIDTH: Final = 100.0  # m, from the middle of a track to a boundary
MAX_CONES: Final = 6_000  # of each boundary of a track
SHOWN_CHARACTERS: Final = 120  # of what was found, in a message


def _short() -> Repr:
    short = Repr()
    short.maxlevel, short.maxstring, short.maxother, short.maxlong = 3, 80, 60, 40
    return short


_SHORT: Final = _short()


def shown(value: Any) -> str:
    """Return a value as a message shows it: short, whatever it holds."""
    text = _SHORT.repr(value)
    return text if len(text) <= SHOWN_CHARACTERS else text[: SHOWN_CHARACTERS - 3] + "..."


def check_content(content: Any, file: Path) -> None:
    """Raise an InputError where the content of a file is nested too deep or has too large a whole number."""
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
    """Return the message for a file that is nested deeper than allowed."""
    return f"expected lists and tables nested at most {MAX_DEPTH} deep, found deeper ones"


def _children(value: Any) -> Any:
    if isinstance(value, dict):
        return chain(value.keys(), value.values())
    return value if isinstance(value, list) else (value,)
