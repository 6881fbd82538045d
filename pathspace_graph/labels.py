"""Labels: the boundary that a detection belongs to, and the kind of detections."""

from typing import Final, Literal, get_args

LEFT, RIGHT, UNKNOWN, ORANGE, BIG_ORANGE = range(5)
NAMES: Final = ("left", "right", "unknown", "orange", "big_orange")  # of the file format, by label
LABELS: Final = {name: label for label, name in enumerate(NAMES)}
BOUNDARIES: Final = (LEFT, RIGHT)
POINTS: Final = (ORANGE, BIG_ORANGE)  # of no boundary: at gates, and along lanes to a track

Kind = Literal["cones", "line"]  # of detections: they stay where they are, or lie anywhere along a line
KINDS: Final = get_args(Kind)

_CODES: Final = LABELS | {
    **{"blue": LEFT, "yellow": RIGHT, "small_orange": ORANGE},
    **{"large_orange": BIG_ORANGE, "orange_big": BIG_ORANGE},
}


def label_from_name(name: str) -> int:
    """Label of a word, ignoring case and with `-` as `_`; UNKNOWN for any other word."""
    return _CODES.get(name.strip().lower().replace("-", "_"), UNKNOWN)
