"""The figure of the suite: the ratio of the rmse against the strength of each fault."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from pathspace_graph.eval.figures.style import BLUE, DARK, GREEN, ORANGE, WIDTH, figure_context, shared_legend

from .outcome import FaultyRun, Outcome
from .suite import CLEAN

_COLUMNS: Final = 4
"""This many panels stand side by side."""
_LEGEND_COLUMNS: Final = 6
"""Every look of a mark, and the mean, stand in one row of the legend."""
_PANEL_HEIGHT: Final = 1.45
"""A panel is this high (in)."""
_LEGEND_HEIGHT: Final = 0.5
"""The legend and the title of the axis take this height (in)."""
_SPREAD: Final = 0.15
"""The runs of one strength are spread over this much to both sides, so that they can be told apart."""
_MARKER_SIZE: Final = 4.0
"""The marker of a run has this size (pt)."""
_ROOM: Final = 1.15
"""The axis reaches beyond the smallest and the largest ratio by this factor."""
_TITLE_LENGTH: Final = 30
"""The title of a panel is broken at this number of characters."""


def plot_faults(outcomes: Sequence[Outcome]) -> Figure:
    """Draws a panel for each kind of fault: every run, with its look saying what was said, and the mean."""
    panels = [(kind, list(of)) for kind, of in groupby(outcomes, key=lambda o: o.fault.kind) if kind != CLEAN]
    rows = max(1, -(-len(panels) // _COLUMNS))
    with figure_context():
        figure = Figure(figsize=(WIDTH, _LEGEND_HEIGHT + _PANEL_HEIGHT * rows), layout="constrained")
        every = figure.subplots(rows, _COLUMNS, sharey=True, squeeze=False).ravel()
        for axes, (kind, of) in zip(every, panels, strict=False):
            _draw(axes, kind, of)
        for axes in every[len(panels) :]:
            axes.set_visible(False)
        _scale(every[0], np.concatenate([np.ones(1), *(o.ratios for o in outcomes)]))
        figure.supylabel("rmse by that of the clean run")
        shared_legend(figure, columns=_LEGEND_COLUMNS)
    return figure


def _scale(axes: Axes, ratios: np.ndarray) -> None:
    """Sets the logarithmic axis that all panels share."""
    axes.set_yscale("log")
    axes.set_ylim(ratios.min() / _ROOM, ratios.max() * _ROOM)
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())


def _draw(axes: Axes, kind: str, outcomes: Sequence[Outcome]) -> None:
    axes.axhline(1.0, color=DARK, linewidth=0.6)
    for at, outcome in enumerate(outcomes):
        spread = _SPREAD if len(outcome.runs) > 1 else 0.0
        places = at + np.linspace(-spread, spread, len(outcome.runs))
        for place, run in zip(places, outcome.runs, strict=True):
            _draw_run(axes, float(place), run)
    means = [(at, o.values()["ratio_mean"]) for at, o in enumerate(outcomes) if len(o.ratios)]
    if means:
        axes.plot(*np.array(means).T, color=BLUE, linewidth=0.9, label="mean", zorder=1)
    axes.set_xticks(range(len(outcomes)), [f"{outcome.fault.value:g}" for outcome in outcomes])
    axes.set_xlim(-0.5, len(outcomes) - 0.5)
    unit = outcomes[0].fault.unit
    axes.set_title(_broken(f"{kind} [{unit}]" if unit else kind))
    axes.grid(axis="y")


def _draw_run(axes: Axes, at: float, run: FaultyRun) -> None:
    """Draws a run: filled where something was said, a triangle where the vehicle is lost at the end, and a
    cross on the upper edge where there is no map."""
    if np.isnan(run.ratio):
        edge = axes.get_xaxis_transform()
        axes.plot(at, 0.95, "x", color=ORANGE, markersize=_MARKER_SIZE, transform=edge, label="no map")
        return
    color = ORANGE if run.lost else GREEN
    label = f"{'lost at the end' if run.lost else 'not lost'}{', said so' if run.is_told else ''}"
    axes.plot(
        at,
        run.ratio,
        "^" if run.lost else "o",
        color=color,
        markerfacecolor=color if run.is_told else "none",
        markersize=_MARKER_SIZE,
        markeredgewidth=0.8,
        label=label,
    )


def _broken(title: str) -> str:
    """Returns the title in two lines where it is long."""
    if len(title) <= _TITLE_LENGTH:
        return title
    cut = title.rfind(" ", 0, _TITLE_LENGTH)
    return f"{title[:cut]}\n{title[cut + 1 :]}" if cut > 0 else title
