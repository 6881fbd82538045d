"""One legend for several panels, and a figure no higher than it has to be."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from pathspace_graph.labels import BOUNDARIES, NAMES

_ROUNDS = 2
"""The layout moves a little when the height changes."""
_SIDES = tuple(NAMES[label] for label in BOUNDARIES)


def legend_below(figure: Figure, columns: int) -> None:
    """Below all panels, each entry once."""
    entries = _entries(figure.axes)
    figure.legend(
        entries.values(), entries.keys(), loc="outside lower center", ncols=columns, handlelength=1.8
    )


def grouped_legend(figure: Figure, panels: Iterable[Axes]) -> None:
    """The same with a column for the left boundary, one for the right, then the rest."""
    entries = _entries(panels)
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


def fit_height(figure: Figure, margin: float = 0.05) -> None:
    """As high as what is drawn and a margin (inches), where the width decides how large panels are."""
    for _ in range(_ROUNDS):
        figure.draw_without_rendering()
        width, _ = figure.get_size_inches()
        needed = figure.get_tightbbox().height + 2.0 * margin
        figure.set_size_inches(width, needed)


def _entries(panels: Iterable[Axes]) -> dict[str, Any]:
    """The first artist of each label."""
    entries: dict[str, Any] = {}
    for axes in panels:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    return entries
