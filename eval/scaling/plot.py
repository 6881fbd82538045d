"""The scalability figures: time per update against cones, against detections, and lap by lap."""

from __future__ import annotations

from itertools import cycle
from typing import Any, Final

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

from pathspace_graph.eval.figures.style import MARKERS, PALETTE, WIDTH, figure_context, shared_legend

from .points import CONES, LAPS, READINGS, Scaling, Sweep

_HEIGHT: Final = 3.1
"""A figure is this high (in)."""
_MARKER_SIZE: Final = 3.6
"""The estimators' points have this size (pt)."""
_CONES_TICKS: Final = (50, 100, 200, 500, 1000, 2000)
"""The axis of cones is labelled here, as far as it reaches."""
_TITLES: Final[dict[Sweep, tuple[str, str]]] = {
    CONES: ("cones seen", "(a) map size"),
    READINGS: ("detections per update", "(b) detections"),
    LAPS: ("lap", "time per lap on a closed road"),
}
"""Each panel has an axis title and a title."""


def plot_scaling(scaling: Scaling) -> Figure:
    """Draws two sweeps on logarithmic axes, with fitted lines, and a cross where an estimator was stopped."""
    with figure_context():
        figure = Figure(figsize=(WIDTH, _HEIGHT), layout="constrained")
        cones, detections = figure.subplots(1, 2, sharey=True)
        for axes, sweep in ((cones, CONES), (detections, READINGS)):
            for name, color in _draw_sweep(axes, scaling, sweep).items():
                _draw_power_law(axes, scaling, sweep, name, color)
                if sweep == CONES and scaling.slope(sweep, name).stopped:
                    last = scaling.of(sweep, name)[-1]
                    axes.plot(last.at, 1e3 * last.seconds, "x", color=color, markersize=3 * _MARKER_SIZE)
            axes.set_xscale("log")
        cones.set_ylabel("mean update (ms)")
        _label_ticks(cones, tuple(t for t in _CONES_TICKS if t <= scaling.settings.cones_max))
        _label_ticks(detections, scaling.settings.readings)
        shared_legend(figure, columns=min(len(scaling.estimators), 4))
    return figure


def plot_laps(scaling: Scaling) -> Figure:
    """Draws the time per update of each lap, from the first on."""
    with figure_context():
        figure = Figure(figsize=(WIDTH / 2, _HEIGHT), layout="constrained")
        axes = figure.subplots()
        _draw_sweep(axes, scaling, LAPS, linestyle="-")
        axes.set_ylabel("mean update (ms)")
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        shared_legend(figure, columns=2)
    return figure


def _draw_sweep(axes: Axes, scaling: Scaling, sweep: Sweep, linestyle: str = "none") -> dict[str, str]:
    """Draws the points of every estimator that has some, and returns the colours by name."""
    looks = zip(scaling.estimators, cycle(PALETTE), cycle(MARKERS), strict=False)
    drawn = {name: (color, marker) for name, color, marker in looks if scaling.of(sweep, name)}
    for name, (color, marker) in drawn.items():
        at, milliseconds = np.array([(p.at, 1e3 * p.seconds) for p in scaling.of(sweep, name)]).T
        line: dict[str, Any] = {"linestyle": linestyle, "linewidth": 0.7}
        points: dict[str, Any] = {"marker": marker, "markersize": _MARKER_SIZE}
        axes.plot(at, milliseconds, color=color, label=name, **line, **points)
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    abscissa, title = _TITLES[sweep]
    axes.set_xlabel(abscissa)
    axes.set_title(title)
    axes.grid(which="both")
    return {name: color for name, (color, _) in drawn.items()}


def _draw_power_law(axes: Axes, scaling: Scaling, sweep: Sweep, name: str, color: str) -> None:
    """Draws the fitted power law through the mean of its points' logarithms, over their range."""
    slope = scaling.slope(sweep, name)
    if not np.isfinite(slope.slope):
        return
    fitted = [(p.at, 1e3 * p.seconds) for p in scaling.of(sweep, name) if slope.low <= p.at <= slope.high]
    at, milliseconds = np.exp(np.mean(np.log(fitted), axis=0))
    ends = np.array([slope.low, slope.high])
    axes.plot(ends, milliseconds * (ends / at) ** slope.slope, color=color, linewidth=0.9, alpha=0.8)


def _label_ticks(axes: Axes, ticks: tuple[int, ...]) -> None:
    axes.xaxis.set_major_locator(FixedLocator(ticks))
    axes.xaxis.set_major_formatter(ScalarFormatter())
    axes.xaxis.set_minor_formatter(NullFormatter())
