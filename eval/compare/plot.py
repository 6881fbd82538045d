"""Figures of a comparison: every map over the truth, and one of a blind spot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pathspace_graph.eval.figures.map_plot import PlotStyle, draw_boundary, draw_start, draw_truth
from pathspace_graph.eval.figures.style import RED, fit_height, grouped_legend
from pathspace_graph.eval.metrics.blind_spot import BlindSpot
from pathspace_graph.eval.metrics.curves import mapped_points
from pathspace_graph.eval.metrics.measures import PAPER
from pathspace_graph.io.log import Log, Truth
from pathspace_graph.io.map import Map

from .comparison import Outcome

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ComparisonStyle:
    """How comparisons are drawn; lengths in inches, line widths and markers in points."""

    map: PlotStyle = field(default_factory=PlotStyle)
    """Of what a map is drawn with."""
    columns: tuple[int, ...] = (2, 3, 4)
    """Panels beside each other: as few of these as fit on the page, ..."""
    max_height: float = 10.0
    """... whose height this is."""
    panel_title: float = 0.6
    """Height of a panel's title and its free space."""
    tick_labels: float = 0.48
    """Width and height of the outer tick labels and axis titles."""
    legend: float = 2.0
    """Height that is more than enough for the legend; what it doesn't take is cut off."""
    gap: float = 0.12
    """Between panels."""
    missed_color: str = RED
    """Of the rings around missed cones."""
    ring_size: float = 8.0
    """Of those rings."""


_RC: Final = {"axes.linewidth": 0.6, "axes.titlelocation": "left"}


def plot_maps(outcomes: Sequence[Outcome], log: Log, style: ComparisonStyle | None = None) -> Figure:
    """A panel per map over the truth, all of the same stretch of the world; failures have none."""
    style = style or ComparisonStyle()
    drawn = [(outcome, outcome.result.map) for outcome in outcomes if outcome.result is not None]
    low, high = _extent([track for _, track in drawn], log.truth, style.map.margin)
    with mpl.rc_context(_RC | {"font.size": style.map.font_size, "axes.titlesize": style.map.font_size}):
        figure, panels, columns = _panels(len(drawn), (high - low) / 2.0, style)
        for axes, (outcome, track) in zip(panels, drawn, strict=False):
            _draw_map(axes, track, log.truth, style.map)
            axes.set_title(_caption(outcome))
            _frame(axes, low, high)
        _finish(figure, panels, len(drawn), columns)
    return figure


def plot_blind_spot(
    spot: BlindSpot, maps: Sequence[tuple[str, Map]], truth: Truth, style: ComparisonStyle | None = None
) -> Figure:
    """The same stretch of several maps beside each other, the cones that one of them misses ringed."""
    style = style or ComparisonStyle()
    large = PlotStyle(curve_width=1.1, marker_size=4.2, landmark_size=3.0, path_width=0.8)
    half = np.array(spot.half_size)
    with mpl.rc_context(_RC | {"font.size": large.font_size, "axes.titlesize": large.font_size}):
        figure, panels, columns = _panels(len(maps), half, style)
        for axes, (name, track), missed in zip(panels, maps, spot.missed, strict=False):
            _draw_map(axes, track, truth, large, start=bool((np.abs(spot.centre) < half).all()))
            _draw_missed(axes, missed, spot.distance, style)
            axes.set_title(f"{name}\n{len(missed)} of {spot.cones} true cones missed here")
            _frame(axes, spot.centre - half, spot.centre + half)
        _finish(figure, panels, len(maps), columns)
    return figure


def _panels(count: int, half_size: Array, style: ComparisonStyle) -> tuple[Figure, list[Axes], int]:
    """A figure with room for `count` panels of that shape, as large as the page allows."""
    for columns in style.columns:
        rows = -(-max(count, 1) // columns)
        width = (style.map.width - style.tick_labels) / columns - style.gap
        height = rows * (width * half_size[1] / half_size[0] + style.panel_title) + style.tick_labels
        if height <= style.max_height:
            break
    figure = Figure((style.map.width, float(height) + style.legend), layout="compressed")
    panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    return figure, list(panels.flat), columns


def _frame(axes: Axes, low: Array, high: Array) -> None:
    axes.set_aspect("equal")
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])


def _finish(figure: Figure, panels: list[Axes], used: int, columns: int) -> None:
    """Axis titles, the legend, and the room that it takes."""
    _label_outer(panels, used, columns)
    grouped_legend(figure, panels)
    fit_height(figure)


def _draw_missed(axes: Axes, missed: Array, distance: float, style: ComparisonStyle) -> None:
    """Rings around the cones (k, 2) that a map misses."""
    axes.plot(
        *missed.T,
        linestyle="none",
        marker="o",
        markersize=style.ring_size,
        markerfacecolor="none",
        markeredgecolor=style.missed_color,
        markeredgewidth=1.0,
        zorder=8,
        label=f"missed: nothing within {distance:g} m",
    )


def _draw_map(axes: Axes, track: Map, truth: Truth | None, style: PlotStyle, start: bool = True) -> None:
    for label, boundary in sorted(track.boundaries.items()):
        draw_boundary(axes, boundary, label, 1.0, style)
    if truth is not None:
        draw_truth(axes, truth, style)
    if start:
        draw_start(axes, style)
    axes.tick_params(width=0.6, length=2.5)


def _caption(outcome: Outcome) -> str:
    """Name and the paper's metrics, where they are known."""
    row = outcome.rows[-1]
    words = {
        metric.key: f"{metric.title} {metric.text(float(row[metric.key]))} {metric.unit}".strip()
        for metric in PAPER
        if metric.key in row
    }
    size = words.pop("size")
    return "\n".join([outcome.estimator, ", ".join(words.values()), size])


def _extent(maps: Sequence[Map], truth: Truth | None, margin: float) -> tuple[Array, Array]:
    """Lower and upper corner (2,) of the truth, or of all maps where there is none, and some space."""
    points = [np.zeros((1, 2))]
    if truth is not None and len(truth.cones):
        points.append(truth.cones)
    else:
        for track in maps:
            for boundary in track.boundaries.values():
                points.append(mapped_points(boundary))
    together = np.concatenate(points)
    return together.min(axis=0) - margin, together.max(axis=0) + margin


def _label_outer(panels: list[Axes], used: int, columns: int) -> None:
    """Labels at the outer panels only; what is left over shows nothing."""
    for number, axes in enumerate(panels):
        if number >= used:
            axes.set_visible(False)
            continue
        if number % columns == 0:
            axes.set_ylabel("y [m]")
        if number + columns >= used:
            axes.set_xlabel("x [m]")
            axes.tick_params(labelbottom=True)
