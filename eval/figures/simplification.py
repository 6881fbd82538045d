"""Simplification (paper): a closed curve of 100 control points on 32 knots, and what it costs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pathspace_graph.eval.metrics.table1 import closest_points
from pathspace_graph.settings.knots import BreakSettings
from pathspace_graph.sim.track_generator import TrackGeneratorSettings, generate_track
from pathspace_graph.spline.bspline import BSpline
from pathspace_graph.spline.knots import curvature_weighted_breaks, fit_spline, refit

from .style import FigureStyle, draw_control_points, figure_context, frame

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SimplificationScene:
    """What is simplified."""

    seed: int = 3
    """Of the generated track whose left boundary it is."""
    lap_length: tuple[float, float] = (200.0, 260.0)
    """Of that track (m)."""
    before: int = 100
    """Control points."""
    after: int = 32
    """Control points."""
    samples: int = 1500
    """Points that the cost is measured at."""


@dataclass(frozen=True, eq=False)
class Simplified:
    """A curve on fewer knots, and how far it is off the old one."""

    curve: BSpline
    """The new curve."""
    errors: Array
    """(n,) m, from points evenly along the old curve to the new one."""

    @property
    def rms(self) -> float:
        """m."""
        return float(np.sqrt(np.mean(self.errors**2)))


@dataclass(frozen=True, eq=False)
class Simplification:
    """The paper's simplification beside one that ignores curvature."""

    old: BSpline
    """Of many control points."""
    length: Array
    """(n,) m along it, where the errors are taken."""
    curvature: Array
    """(n,) 1/m there."""
    weighted: Simplified
    """On curvature-weighted knots."""
    uniform: Simplified
    """On as many knots, equal lengths apart."""


def simplification(scene: SimplificationScene | None = None) -> Simplification:
    """A generated boundary as a spline of many control points, and that on few."""
    scene = scene or SimplificationScene()
    track = generate_track(
        np.random.default_rng(scene.seed), TrackGeneratorSettings(lap_length=scene.lap_length)
    )
    old = fit_spline(np.asarray(track.left), scene.before, periodic=True)
    length = old.length() * (np.arange(scene.samples) + 0.5) / scene.samples
    u = old.parameters_at(length)

    def simplified(baseline: float) -> Simplified:
        curve = simplify_curve(old, scene.after, BreakSettings(baseline))
        points = old.evaluate(u)
        errors = np.linalg.norm(points - closest_points(curve, points).position, axis=1)
        return Simplified(curve, errors)

    return Simplification(
        old, length, old.curvature(u), simplified(BreakSettings().baseline), simplified(1.0)
    )


def simplify_curve(old: BSpline, size: int, settings: BreakSettings) -> BSpline:
    """The least-squares curve of `size` control points on curvature-weighted knots."""
    breaks = curvature_weighted_breaks(old, size, settings)
    empty = BSpline.periodic_from(breaks, np.zeros((size, 2)), old.degree)
    return empty.with_points(refit(old, empty).new_from_old @ old.distinct_control_points)


# --- figure ----------------------------------------------------------------------------------------------


def plot_simplification(data: Simplification, style: FigureStyle | None = None) -> Figure:
    """(a) before, (b) after, (c) the distance between the two along the curve, (d) its curvature."""
    style = style or FigureStyle()
    with figure_context(style):
        points = data.old.evaluate(np.linspace(*data.old.domain, 400))
        low, high = points.min(axis=0) - 6.0, points.max(axis=0) + 6.0
        height = 0.5 * style.width * (high[1] - low[1]) / (high[0] - low[0])
        figure = Figure((style.width, height + 3.0), layout="constrained")
        grid = figure.add_gridspec(3, 2, height_ratios=(height, 1.1, 0.7))
        before, after = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[0, 1])
        _draw_curve(before, data.old, "(a) before", style.curve_color, style)
        _draw_curve(after, data.weighted.curve, "(b) after", style.fitted_color, style)
        after.plot(*points.T, color=style.truth_color, linewidth=0.8, linestyle="--", zorder=3.5)
        for axes in (before, after):
            frame(axes, (low[0], low[1]), (high[0], high[1]))
        before.set_ylabel("y [m]")
        after.tick_params(labelleft=False)
        error = figure.add_subplot(grid[1, :])
        curvature = figure.add_subplot(grid[2, :], sharex=error)
        _draw_errors(error, data, style)
        _draw_curvature(curvature, data, style)
    return figure


def _draw_curve(axes: Axes, spline: BSpline, title: str, color: str, style: FigureStyle) -> None:
    axes.plot(
        *spline.evaluate(np.linspace(*spline.domain, 1000)).T,
        color=color,
        linewidth=style.curve_width,
        zorder=3,
    )
    points = spline.distinct_control_points
    draw_control_points(axes, np.concatenate([points, points[:1]]), color, style)
    axes.set_title(f"{title}: {spline.size} control points")


def _draw_errors(axes: Axes, data: Simplification, style: FigureStyle) -> None:
    for simplified, color, line, name in (
        (data.uniform, style.other_color, "--", "uniform knots"),
        (data.weighted, style.fitted_color, "-", "curvature-weighted knots"),
    ):
        label = f"{name}: rms {100 * simplified.rms:.1f} cm, largest {100 * simplified.errors.max():.1f} cm"
        axes.plot(
            data.length, 100 * simplified.errors, color=color, linestyle=line, linewidth=0.9, label=label
        )
    axes.set_xlim(0.0, data.old.length())
    axes.set_ylim(0.0, 170.0 * float(data.uniform.errors.max()))
    axes.set_ylabel("distance [cm]")
    axes.tick_params(labelbottom=False)
    axes.set_title("(c) distance between before and after")
    axes.legend(loc="upper right")


def _draw_curvature(axes: Axes, data: Simplification, style: FigureStyle) -> None:
    curve = data.weighted.curve
    knots = data.old.arc_length(curve.breaks)
    axes.fill_between(data.length, np.abs(data.curvature), color=style.faint_color, linewidth=0.0)
    axes.plot(
        knots,
        np.zeros(len(knots)),
        linestyle="none",
        marker="|",
        markersize=9.0,
        color=style.fitted_color,
        clip_on=False,
        label="knots",
    )
    axes.set_ylim(0.0)
    axes.set_xlabel("length along the curve [m]")
    axes.set_ylabel("curvature\n[1/m]")
    axes.set_title("(d) curvature, and the knots that follow it")
