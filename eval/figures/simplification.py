"""Simplification (paper): a closed curve of 100 control points on 32 knots, and what it costs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pathspace_graph.eval.metrics.table1 import closest_points, root_mean_square
from pathspace_graph.settings.knots import BreakSettings
from pathspace_graph.sim.geometry import ring
from pathspace_graph.sim.track_generator import TrackGeneratorSettings, generate_track
from pathspace_graph.spline.bspline import BSpline
from pathspace_graph.spline.knots import curvature_weighted_breaks, fit_spline, refit

from .marks import draw_control_points, draw_curve, draw_points
from .style import BLUE, DARK, LIGHT, ORANGE, PURPLE, WIDTH, figure_context, set_frame

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SimplificationScene:
    """The left boundary of a generated track is simplified."""

    seed: int = 3
    """The track is generated from this seed."""
    lap_length: tuple[float, float] = (200.0, 260.0)
    """The track's length lies between these limits (m)."""
    before: int = 100
    """The curve has this many control points before."""
    after: int = 32
    """The curve has this many control points after."""
    samples: int = 1500
    """The distance between the curves is measured at this many points."""


@dataclass(frozen=True, eq=False)
class Simplified:
    """Holds a curve on fewer knots and its distance from the old one."""

    curve: BSpline
    """This is the new curve."""
    errors: Array
    """These are the distances (n,) of points of the old curve, at equal lengths, from the new one (m)."""

    @property
    def rms(self) -> float:
        """Returns the root mean square of the distances (m)."""
        return root_mean_square(self.errors)


@dataclass(frozen=True, eq=False)
class Simplification:
    """Holds the paper's simplification beside one that ignores curvature."""

    old: BSpline
    """This is the curve of many control points."""
    length: Array
    """The errors are taken at these lengths (n,) along the old curve (m)."""
    curvature: Array
    """This is the old curve's curvature (n,) there (1/m)."""
    weighted: Simplified
    """This curve has curvature-weighted knots."""
    uniform: Simplified
    """This curve has as many knots at equal lengths."""


def simplification(scene: SimplificationScene | None = None) -> Simplification:
    """Fits a spline of many control points to a generated boundary, and simplifies it in two ways."""
    scene = scene or SimplificationScene()
    settings = TrackGeneratorSettings(lap_length=scene.lap_length)
    track = generate_track(np.random.default_rng(scene.seed), settings)
    old = fit_spline(np.asarray(track.left), scene.before, periodic=True)
    length = old.length() * (np.arange(scene.samples) + 0.5) / scene.samples
    u = old.parameters_at(length)
    points = old.evaluate(u)

    def simplified(settings: BreakSettings) -> Simplified:
        curve = simplify_curve(old, scene.after, settings)
        return Simplified(curve, np.linalg.norm(points - closest_points(curve, points).position, axis=1))

    uniform = BreakSettings(baseline=1.0)
    return Simplification(old, length, old.curvature(u), simplified(BreakSettings()), simplified(uniform))


def simplify_curve(old: BSpline, size: int, settings: BreakSettings) -> BSpline:
    """Returns the least-squares curve of `size` control points on curvature-weighted knots."""
    breaks = curvature_weighted_breaks(old, size, settings)
    empty = BSpline.periodic_from(breaks, np.zeros((size, 2)), old.degree)
    return empty.with_points(refit(old, empty).new_from_old @ old.distinct_control_points)


# --- figure ----------------------------------------------------------------------------------------------


def plot_simplification(data: Simplification) -> Figure:
    """Draws (a) before, (b) after, (c) the distance between the two along the curve, (d) its curvature."""
    with figure_context():
        points = data.old.evaluate(np.linspace(*data.old.domain, 400))
        low, high = points.min(axis=0) - 6.0, points.max(axis=0) + 6.0
        width, height = high - low
        panel_height = 0.5 * WIDTH * height / width
        figure = Figure((WIDTH, panel_height + 3.0), layout="constrained")
        grid = figure.add_gridspec(3, 2, height_ratios=(panel_height, 1.1, 0.7))
        before, after = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[0, 1])
        _draw_closed(before, data.old, "(a) before", BLUE)
        _draw_closed(after, data.weighted.curve, "(b) after", PURPLE)
        draw_curve(after, data.old, DARK, width=0.8, linestyle="--", zorder=3.5)
        for axes in (before, after):
            set_frame(axes, low, high)
            axes.set_xlabel("x [m]")
        before.set_ylabel("y [m]")
        after.tick_params(labelleft=False)
        errors = figure.add_subplot(grid[1, :])
        _draw_errors(errors, data)
        _draw_curvature(figure.add_subplot(grid[2, :], sharex=errors), data)
    return figure


def _draw_closed(axes: Axes, spline: BSpline, title: str, color: str) -> None:
    draw_curve(axes, spline, color)
    draw_control_points(axes, ring(spline.distinct_control_points), color)
    axes.set_title(f"{title}: {spline.size} control points")


def _draw_errors(axes: Axes, data: Simplification) -> None:
    for simplified, color, line, name in (
        (data.uniform, ORANGE, "--", "uniform knots"),
        (data.weighted, PURPLE, "-", "curvature-weighted knots"),
    ):
        errors_cm = 100.0 * simplified.errors
        label = f"{name}: rms {100 * simplified.rms:.1f} cm, largest {errors_cm.max():.1f} cm"
        axes.plot(data.length, errors_cm, color=color, linestyle=line, linewidth=0.9, label=label)
    axes.set_xlim(0.0, data.old.length())
    axes.set_ylim(0.0, 170.0 * float(data.uniform.errors.max()))
    axes.set_ylabel("distance [cm]")
    axes.tick_params(labelbottom=False)
    axes.set_title("(c) distance between before and after")
    axes.legend(loc="upper right")


def _draw_curvature(axes: Axes, data: Simplification) -> None:
    axes.fill_between(data.length, np.abs(data.curvature), color=LIGHT, linewidth=0.0)
    knots = data.old.arc_length(data.weighted.curve.breaks)
    on_axis = np.stack([knots, np.zeros(len(knots))], axis=1)
    draw_points(axes, on_axis, "|", PURPLE, markersize=9.0, clip_on=False)
    axes.set_ylim(0.0)
    axes.set_xlabel("length along the curve [m]")
    axes.set_ylabel("curvature\n[1/m]")
    axes.set_title("(d) curvature, and the knots that follow it")
