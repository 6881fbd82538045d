"""Figures of a comparison: every map over the truth, and one of a blind spot."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pathspace_graph.eval.figures.map_plot import (
    MARGIN,
    WHOLE_TRACK,
    MapStyle,
    draw_boundary,
    draw_start,
    draw_truth,
)
from pathspace_graph.eval.figures.marks import draw_points
from pathspace_graph.eval.figures.style import (
    RED,
    WIDTH,
    figure_context,
    fit_height,
    grouped_legend,
    set_frame,
)
from pathspace_graph.eval.metrics.curves import mapped_points
from pathspace_graph.eval.metrics.measures import PAPER
from pathspace_graph.io.log import Log, Truth
from pathspace_graph.io.map import Map

from .blind_spot import BlindSpot
from .comparison import Outcome

Array = NDArray[np.float64]

COLUMNS: Final = (2, 3, 4)
"""So many panels may stand beside each other; the first number with which the figure fits a page is taken."""
MAX_HEIGHT: Final = 10.0
"""A page is this high (in)."""
CLOSE_UP: Final = MapStyle(curve_width=1.1, marker_size=4.2, landmark_size=3.0, path_width=0.8)
"""This is the style of a panel that shows a short stretch of a track."""

_TITLE_HEIGHT: Final = 0.6
"""A panel's title and its free space take this height (in)."""
_TICK_LABELS: Final = 0.48
"""The outer tick labels and axis titles take this width and height (in)."""
_LEGEND_HEIGHT: Final = 2.0
"""This is more than enough height for the legend (in); what it doesn't take is cut off."""
_GAP: Final = 0.12
"""Panels are this far apart (in)."""
_RING_SIZE: Final = 8.0
"""The ring around a missed cone has this size (pt)."""


def plot_maps(outcomes: Sequence[Outcome], log: Log) -> Figure:
    """Draws a panel for each map over the truth, all of the same area; failures have no panel."""
    drawn = [(outcome, outcome.result.map) for outcome in outcomes if outcome.result is not None]
    low, high = _extent([track for _, track in drawn], log.truth)
    with figure_context():
        figure, panels, columns = _panels(len(drawn), (high - low) / 2.0)
        for axes, (outcome, track) in zip(panels, drawn, strict=False):
            _draw_map(axes, track, log.truth, WHOLE_TRACK)
            draw_start(axes, WHOLE_TRACK)
            axes.set_title(_caption(outcome))
            set_frame(axes, low, high)
        _finish(figure, panels, len(drawn), columns)
    return figure


def plot_blind_spot(spot: BlindSpot, maps: Sequence[tuple[str, Map]], truth: Truth) -> Figure:
    """Draws the same area of several maps side by side, with rings around the cones that a map misses."""
    half_size = np.array(spot.half_size)
    shows_start = bool((np.abs(spot.centre) < half_size).all())
    with figure_context():
        figure, panels, columns = _panels(len(maps), half_size)
        for axes, (name, track), missed in zip(panels, maps, spot.missed, strict=False):
            _draw_map(axes, track, truth, CLOSE_UP)
            if shows_start:
                draw_start(axes, CLOSE_UP)
            _draw_missed(axes, missed, spot.distance)
            axes.set_title(f"{name}\n{len(missed)} of {spot.cones} true cones missed here")
            set_frame(axes, spot.centre - half_size, spot.centre + half_size)
        _finish(figure, panels, len(maps), columns)
    return figure


def _panels(count: int, half_size: Array) -> tuple[Figure, list[Axes], int]:
    """Returns a figure, its panels and columns: `count` panels of that shape, as large as a page allows."""
    half_width, half_height = half_size
    for columns in COLUMNS:
        rows = -(-max(count, 1) // columns)
        width = (WIDTH - _TICK_LABELS) / columns - _GAP
        height = rows * (width * half_height / half_width + _TITLE_HEIGHT) + _TICK_LABELS
        if height <= MAX_HEIGHT:
            break
    figure = Figure((WIDTH, float(height) + _LEGEND_HEIGHT), layout="compressed")
    panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    return figure, list(panels.flat), columns


def _finish(figure: Figure, panels: list[Axes], used: int, columns: int) -> None:
    """Adds axis titles to the outer panels and a legend, hides unused panels, and cuts the figure."""
    for number, axes in enumerate(panels):
        axes.set_visible(number < used)
        if number % columns == 0:
            axes.set_ylabel("y [m]")
        if number + columns >= used:
            axes.set_xlabel("x [m]")
            axes.tick_params(labelbottom=True)
    grouped_legend(figure)
    fit_height(figure)


def _draw_missed(axes: Axes, missed: Array, distance: float) -> None:
    """Draws rings around the cones (k, 2) that a map misses."""
    ring: dict[str, Any] = {
        "markersize": _RING_SIZE,
        "markerfacecolor": "none",
        "markeredgewidth": 1.0,
        "zorder": 8,
    }
    draw_points(axes, missed, "o", RED, f"missed: nothing within {distance:g} m", **ring)


def _draw_map(axes: Axes, track: Map, truth: Truth | None, style: MapStyle) -> None:
    for label, boundary in sorted(track.boundaries.items()):
        draw_boundary(axes, boundary, label, style)
    if truth is not None:
        draw_truth(axes, truth, style)


def _caption(outcome: Outcome) -> str:
    """Returns the estimator's name and the paper's metrics, where they are known."""
    row = outcome.rows[-1]
    words = {
        metric.key: f"{metric.title} {metric.text(float(row[metric.key]))} {metric.unit}".strip()
        for metric in PAPER
        if metric.key in row
    }
    size = words.pop("size")
    return "\n".join([outcome.estimator, ", ".join(words.values()), size])


def _extent(maps: Sequence[Map], truth: Truth | None) -> tuple[Array, Array]:
    """Returns two corners (2,) around the true cones and a margin, or around all maps without true cones."""
    points = [np.zeros((1, 2))]
    if truth is not None and len(truth.cones):
        points.append(truth.cones)
    else:
        points += [mapped_points(boundary) for track in maps for boundary in track.boundaries.values()]
    together = np.concatenate(points)
    return together.min(axis=0) - MARGIN, together.max(axis=0) + MARGIN
