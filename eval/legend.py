"""One legend for several panels, in columns of what belongs together."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from pathspace_graph.labels import BOUNDARIES, NAMES

_SIDES = tuple(NAMES[label] for label in BOUNDARIES)


def grouped_legend(figure: Figure, panels: Iterable[Axes]) -> int:
    """Below all panels, each entry once: a column for the left boundary, one for the right, then the rest.

    Gives the number of rows.
    """
    entries: dict[str, Any] = {}
    for axes in panels:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    sides = [[label for label in entries if label.startswith(side)] for side in _SIDES]
    rest = [label for label in entries if not label.startswith(_SIDES)]
    rows = max(1, *(len(side) for side in sides))
    columns = [*(side for side in sides if side), *(rest[i : i + rows] for i in range(0, len(rest), rows))]
    blank = Line2D([], [], linestyle="none")
    padded = [label for column in columns for label in column + [""] * (rows - len(column))]
    figure.legend(
        [entries.get(label, blank) for label in padded],
        padded,
        loc="outside lower center",
        ncols=max(len(columns), 1),
        frameon=False,
        handlelength=1.8,
        columnspacing=1.4,
    )
    return rows
