"""The scalability figure: time per update against cones and against readings, both axes logarithmic."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import (
    FixedLocator,
    LogLocator,
    MaxNLocator,
    NullFormatter,
    ScalarFormatter,
    StrMethodFormatter,
)

from pathspace_graph.eval.figures.style import (
    BLUE,
    DARK,
    GREEN,
    ORANGE,
    PURPLE,
    RED,
    FigureStyle,
    figure_context,
)

from .points import CONES, LAPS, READINGS, Sweep
from .scaling import Scaling


@dataclass(frozen=True, slots=True)
class ScalingPlotStyle:
    """Beside what all figures share."""

    height: float = 3.1
    """Of the figure, in."""
    colors: tuple[str, ...] = (BLUE, ORANGE, RED, PURPLE, GREEN, DARK)
    """Of the estimators, one after the other."""
    markers: str = "os^Dv*"
    """Shapes of their points."""
    marker_size: float = 3.6
    """Points."""
    cones_ticks: tuple[int, ...] = (50, 100, 200, 500, 1000, 2000)
    """Named on the axis of cones, as far as it reaches."""


_TITLES: dict[Sweep, tuple[str, str]] = {
    CONES: ("cones seen", "(a) map size"),
    READINGS: ("readings per update", "(b) readings"),
    LAPS: ("lap", "time per lap on a closed road"),
}
"""What stands below a panel and above it."""


def plot_scaling(
    scaling: Scaling, style: FigureStyle | None = None, own: ScalingPlotStyle | None = None
) -> Figure:
    """Points, and the fitted lines where they were fitted; a cross where an estimator was stopped."""
    style, own = style or FigureStyle(), own or ScalingPlotStyle()
    with figure_context(style):
        figure = Figure(figsize=(style.width, own.height), layout="constrained")
        left, right = figure.subplots(1, 2, sharey=True)
        for axes, sweep in ((left, CONES), (right, READINGS)):
            _draw(axes, scaling, sweep, own)
            axes.set_xscale("log")
        left.set_ylabel("mean update (ms)")
        _name_ticks(left, tuple(t for t in own.cones_ticks if t <= scaling.settings.cones_max))
        _name_ticks(right, scaling.settings.readings)
        _legend(figure, left)
    return figure


def plot_laps(
    scaling: Scaling, style: FigureStyle | None = None, own: ScalingPlotStyle | None = None
) -> Figure:
    """Time per update of each lap, from the first on."""
    style, own = style or FigureStyle(), own or ScalingPlotStyle()
    with figure_context(style):
        figure = Figure(figsize=(style.width / 2, own.height), layout="constrained")
        axes = figure.subplots()
        _draw(axes, scaling, LAPS, own)
        axes.set_ylabel("mean update (ms)")
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        _legend(figure, axes)
    return figure


def _draw(axes: Axes, scaling: Scaling, sweep: Sweep, own: ScalingPlotStyle) -> None:
    """All estimators of a sweep."""
    for number, name in enumerate(scaling.estimators):
        points = scaling.of(sweep, name)
        if not points:
            continue
        color, marker = own.colors[number % len(own.colors)], own.markers[number % len(own.markers)]
        at, milliseconds = np.array([(p.at, 1e3 * p.seconds) for p in points]).T
        joined = "-" if sweep == LAPS else "none"
        axes.plot(
            at,
            milliseconds,
            color=color,
            marker=marker,
            markersize=own.marker_size,
            ls=joined,
            lw=0.7,
            label=name,
        )
        if sweep != LAPS:
            _draw_line(axes, scaling, sweep, name, color)
        if sweep == CONES and scaling.slope(sweep, name).stopped:
            axes.plot(at[-1], milliseconds[-1], "x", color=color, markersize=3 * own.marker_size)
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    below, above = _TITLES[sweep]
    axes.set_xlabel(below)
    axes.set_title(above)
    axes.grid(which="both", linewidth=0.3, alpha=0.5)


def _draw_line(axes: Axes, scaling: Scaling, sweep: Sweep, name: str, color: str) -> None:
    """The fitted power law through the middle of its points, over their range."""
    slope = scaling.slope(sweep, name)
    if not np.isfinite(slope.slope):
        return
    fitted = [(p.at, 1e3 * p.seconds) for p in scaling.of(sweep, name) if slope.low <= p.at <= slope.high]
    middle = np.exp(np.mean(np.log(fitted), axis=0))
    ends = np.array([slope.low, slope.high])
    axes.plot(ends, middle[1] * (ends / middle[0]) ** slope.slope, color=color, linewidth=0.9, alpha=0.8)


def _name_ticks(axes: Axes, ticks: tuple[int, ...]) -> None:
    axes.xaxis.set_major_locator(FixedLocator(ticks))
    axes.xaxis.set_major_formatter(ScalarFormatter())
    axes.xaxis.set_minor_formatter(NullFormatter())


def _legend(figure: Figure, axes: Axes) -> None:
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 4))
