"""How all figures look: sizes, colours, the frame of a panel, legends."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any, Final

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from pathspace_graph.labels import BOUNDARIES, NAMES

Array = NDArray[np.float64]

WIDTH: Final = 7.0
"""A figure is this wide (in): two columns of a paper."""
FONT_SIZE: Final = 8.0
"""Text has this size (pt)."""
LEGEND_SIZE: Final = 7.5
"""The text of a legend has this size (pt)."""
CURVE_WIDTH: Final = 1.3
"""A curve has this width (pt)."""
THIN_WIDTH: Final = 0.5
"""The line of one sample among many has this width (pt)."""
MARKER_SIZE: Final = 4.0
"""A control point or a detection has this size (pt)."""
ALPHA: Final = 0.25
"""A filled area has this opacity."""

BLUE: Final = "#0067A9"
ORANGE: Final = "#D98200"
GREEN: Final = "#009E73"
RED: Final = "#CC0000"
PURPLE: Final = "#7B3294"
DARK: Final = "#4D4D4D"
GREY: Final = "#8C8C8C"
LIGHT: Final = "#B0B0B0"
# every kind of colour vision tells blue from orange, and so does a print without colours
PALETTE: Final = (BLUE, ORANGE, RED, PURPLE, GREEN, DARK)
"""Things that are compared have these colours, one after the other."""
MARKERS: Final = "os^Dv*<>PXphd"
"""Things that are compared have these shapes, one after the other."""

_RC: Final = {
    "font.size": FONT_SIZE,
    "figure.labelsize": FONT_SIZE,
    "axes.titlesize": FONT_SIZE,
    "axes.titlelocation": "left",
    "axes.linewidth": 0.6,
    "grid.linewidth": 0.3,
    "grid.alpha": 0.5,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "legend.fontsize": LEGEND_SIZE,
    "legend.frameon": False,
    "legend.handlelength": 1.8,
    "legend.columnspacing": 1.4,
}
_LAYOUT_ROUNDS: Final = 2
"""The height is fitted this many times, since the layout moves a little when the height changes."""
_SIDES: Final = tuple(NAMES[label] for label in BOUNDARIES)


@contextmanager
def figure_context() -> Iterator[None]:
    """Sets the fonts and lines that all figures share."""
    with mpl.rc_context(_RC):
        yield


def set_frame(axes: Axes, low: Array, high: Array) -> None:
    """Shows the rectangle between two corners (2,), m, with equal scales."""
    axes.set_aspect("equal")
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])


def shared_legend(figure: Figure, columns: int = 1, loc: str = "outside lower center") -> None:
    """Adds one legend for all panels, below them by default, with each entry once."""
    entries = _entries(figure.axes)
    figure.legend(entries.values(), entries.keys(), loc=loc, ncols=columns)


def grouped_legend(figure: Figure) -> None:
    """Adds a legend below all panels: a column for the left boundary, one for the right, then the rest."""
    entries = _entries(figure.axes)
    sides = [[label for label in entries if label.startswith(side)] for side in _SIDES]
    rest = [label for label in entries if not label.startswith(_SIDES)]
    rows = max(1, *(len(side) for side in sides))
    columns = [*(side for side in sides if side), *(rest[i : i + rows] for i in range(0, len(rest), rows))]
    padded = [label for column in columns for label in column + [""] * (rows - len(column))]
    blank = Line2D([], [], linestyle="none")
    handles = [entries.get(label, blank) for label in padded]
    figure.legend(handles, padded, loc="outside lower center", ncols=max(len(columns), 1))


def _entries(panels: Iterable[Axes]) -> dict[str, Any]:
    """Returns the first artist of each label."""
    entries: dict[str, Any] = {}
    for axes in panels:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    return entries


def fit_height(figure: Figure, margin: float = 0.05) -> None:
    """Makes a figure as high as what is drawn on it, plus a margin (in) on both sides.

    This is for figures whose width decides how large the panels are.
    """
    for _ in range(_LAYOUT_ROUNDS):
        figure.draw_without_rendering()
        width, _ = figure.get_size_inches()
        figure.set_size_inches(width, figure.get_tightbbox().height + 2.0 * margin)
