"""Boundary labels: the side of the track that a detection marks; and what detections are of."""

from typing import Final, Literal, get_args

LEFT, RIGHT, UNKNOWN, ORANGE, BIG_ORANGE = range(5)
NAMES: Final = ("left", "right", "unknown", "orange", "big_orange")  # of the file format, by label
LABELS: Final = {name: label for label, name in enumerate(NAMES)}
BOUNDARIES: Final = (LEFT, RIGHT)
POINTS: Final = (ORANGE, BIG_ORANGE)  # they bound no road: they stand at gates, and along lanes to a track

Kind = Literal["cones", "line", "line-left", "line-right"]  # what detections are of, on both sides or on one
KINDS: Final = get_args(Kind)

_CODES: Final = LABELS | {
    **{"blue": LEFT, "yellow": RIGHT, "small_orange": ORANGE},
    **{"large_orange": BIG_ORANGE, "orange_big": BIG_ORANGE},
}


def label_from_name(name: str) -> int:
    """Return the label of a word, of either case and with `-` for `_`; UNKNOWN for any other (FORMATS)."""
    return _CODES.get(name.strip().lower().replace("-", "_"), UNKNOWN)
