"""The uncertainty along a spline, with what its formula leaves out, and the simplification of a curve."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pathspace_graph.eval.metrics.accuracy import closest_points, root_mean_square
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.residuals import greville, smoothness_matrix
from pathspace_graph.io.map import SplineBoundary
from pathspace_graph.sim.curves import ring
from pathspace_graph.sim.track_generator import TrackGeneratorSettings, generate_track
from pathspace_graph.spline.bspline import BSpline
from pathspace_graph.spline.knots import BASELINE, curvature_weighted_breaks, fit_spline, refit

from . import style
from .style import BLUE, DARK, LIGHT, ORANGE, PURPLE, THIN_WIDTH, WIDTH

BLIND: Final = (0.52, 0.74)  # shares of the length of the curve between which no cone was seen


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Curve with its standard deviation (m) across itself at n places, computed in three ways."""

    boundary: SplineBoundary
    cones: Array  # (k, 2) positions of the seen cones (m)
    u: Array  # (n,) parameters of the places
    length: Array  # (n,) lengths along the curve (m)
    joint: Array  # (n,) sigmas by B Sigma B'
    marginals: Array  # (n,) sigmas by the paper's sum of beta_j^2 Sigma_j
    sampled: Array  # (n,) sigmas of splines drawn at random
    curves: Array  # (s, n, 2) points of the splines drawn at random (m)


def uncertainty(rng: np.random.Generator, samples: int = 2000) -> Uncertainty:
    """Compute the posterior of a curve that cones hold across itself, and draw splines from it."""
    x = 5.5 * np.arange(13)
    points = np.stack([x, 6.0 * np.sin(2.0 * np.pi * x / x[-1])], axis=1)
    spline = BSpline.open_uniform(points, interval=5.5).clamp()
    share = (np.arange(18) + 0.5) / 18
    seen = spline.parameters_at(spline.length() * share[(share < BLIND[0]) | (share > BLIND[1])])
    covariance = posterior(spline, seen, 0.3, 1.0, 2.0)
    boundary, u = SplineBoundary(spline, covariance), np.linspace(*spline.domain, 301)
    drawn = rng.multivariate_normal(spline.control_points.ravel(), covariance, samples)
    curves = np.einsum("nm,smd->snd", spline.basis_matrix(u), drawn.reshape(samples, -1, 2))
    across = np.einsum("snd,nd->sn", curves - spline.evaluate(u), spline.normal_unit(u))
    without_cross_terms = covariance * np.kron(np.eye(spline.size), np.ones((2, 2)))
    return Uncertainty(
        boundary,
        spline.evaluate(seen),
        u,
        spline.arc_length(u),
        joint=spline.normal_sigma(u, covariance),
        marginals=spline.normal_sigma(u, without_cross_terms),
        sampled=across.std(axis=0),
        curves=curves,
    )


def posterior(
    spline: BSpline, seen: Array, sigma_detection: float, sigma_bend: float, sigma_anchor: float
) -> Array:
    """Return `(R'R / sigma_detection^2 + D'D / sigma_bend^2 + I / sigma_anchor^2)^-1` (2m, 2m), m^2.

    R maps control points to the displacement across the curve at the parameters `seen` (k,), and D to second
    differences. The sigmas are in m.
    """
    across = spline.basis_matrix(seen)[:, :, None] * spline.normal_unit(seen)[:, None, :]
    rows = across.reshape(len(seen), -1)
    bend = np.kron(smoothness_matrix(greville(spline.knots, spline.degree), None), np.eye(2))
    information = rows.T @ rows / sigma_detection**2 + bend.T @ bend / sigma_bend**2
    return np.asarray(np.linalg.inv(information + np.eye(len(information)) / sigma_anchor**2))


def plot_uncertainty() -> tuple[Figure, str]:
    """Draw (a) the uncertainty of control points and curve, (b) its sigma across itself in three ways."""
    data = uncertainty(np.random.default_rng(0))
    with style.figure_context():
        figure = Figure((WIDTH, 4.6), layout="constrained")
        above, below = figure.subplots(2, 1, height_ratios=(1.55, 1.0))
        _draw_curves(above, data)
        _draw_sigmas(below, data)
    off = np.abs(data.marginals / data.joint - 1.0)
    return figure, (
        "Uncertainty along a spline. (a) Control points with their uncertainty make a continuous "
        "distribution of splines, wide where nothing was seen. (b) Its standard deviation across the curve "
        "by the joint covariance is that of splines drawn at random; the sum of squared basis functions, "
        f"which leaves the cross terms out, is off by up to {100 * off.max():.0f} %."
    )


def _draw_curves(axes: Axes, data: Uncertainty) -> None:
    points = data.boundary.spline.control_points
    for number, curve in enumerate(data.curves[:40]):
        label = None if number else "sampled splines"
        axes.plot(*curve.T, color=LIGHT, linewidth=THIN_WIDTH, zorder=1.5, label=label)
    edges = style.uncertainty_band(data.boundary, data.u)
    for edge, label in zip(edges, ("2σ band", None), strict=True):
        axes.plot(*edge.T, color=BLUE, linewidth=0.8, zorder=3, label=label)
    style.draw_curve(axes, data.boundary.spline, BLUE, "spline")
    style.draw_control_points(axes, points, ORANGE, "control points, 2σ")
    style.draw_ellipses(axes, points, style.point_blocks(data.boundary.covariance), ORANGE)
    style.draw_points(axes, data.cones, "x", DARK, "cones seen", zorder=5)
    style.set_frame(axes, points.min(axis=0) - 3.0, points.max(axis=0) + 3.0)
    axes.set(xlabel="x [m]", ylabel="y [m]")
    axes.set_title("(a) uncertainty of the control points, and of the curve that they make")
    axes.legend(loc="upper right")


def _draw_sigmas(axes: Axes, data: Uncertainty) -> None:
    axes.plot(data.length, data.joint, color=BLUE, label="joint covariance, $BΣB^⊤$")
    marginals = r"marginals only, $\Sigma_j\, β_j^2 Σ_{C_j}$"
    axes.plot(data.length, data.marginals, color=ORANGE, linestyle="--", label=marginals)
    spread = np.stack([data.length, data.sampled], axis=1)[::6]
    style.draw_points(axes, spread, ".", "black", f"spread of {len(data.curves)} sampled splines", zorder=2)
    axes.set(xlim=(0.0, data.length[-1]), ylim=(0.0, 1.25 * float(data.joint.max())))
    axes.set(xlabel="length along the curve [m]", ylabel="σ [m]")
    axes.set_title("(b) standard deviation across the curve")
    axes.legend(loc="upper left", ncols=3)


@dataclass(frozen=True, eq=False)
class Simplified:
    """Curve on fewer knots and its distance from the old one."""

    curve: BSpline
    errors: Array  # distances (n,) of points of the old curve, at equal lengths, from the new one (m)

    @property
    def rms(self) -> float:
        return root_mean_square(self.errors)


@dataclass(frozen=True, eq=False)
class Simplification:
    """The paper's simplification beside one that ignores curvature."""

    old: BSpline
    length: Array  # (n,) lengths along the curve (m)
    curvature: Array  # (n,) curvature of the old curve there (1/m)
    weighted: Simplified
    uniform: Simplified  # curve on as many knots at equal lengths


def simplification() -> Simplification:
    """Fit a spline of many control points to a generated boundary, and simplify it in two ways."""
    track = generate_track(np.random.default_rng(3), TrackGeneratorSettings(lap_length=(200.0, 260.0)))
    old = fit_spline(np.asarray(track.left), 100, periodic=True)
    length = old.length() * (np.arange(1500) + 0.5) / 1500
    u = old.parameters_at(length)
    points = old.evaluate(u)

    def simplified(baseline: float) -> Simplified:
        breaks = curvature_weighted_breaks(old, 32, baseline)
        empty = BSpline.periodic_from(breaks, np.zeros((32, 2)), old.degree)
        curve = empty.with_points(refit(old, empty).new_from_old @ old.distinct_control_points)
        return Simplified(curve, np.linalg.norm(points - closest_points(curve, points).position, axis=1))

    return Simplification(old, length, old.curvature(u), simplified(BASELINE), simplified(1.0))


def plot_simplification() -> tuple[Figure, str]:
    """Draw (a) before, (b) after, (c) the distance between the two along the curve, (d) its curvature."""
    data = simplification()
    with style.figure_context():
        points = data.old.evaluate(np.linspace(*data.old.domain, 400))
        low, high = points.min(axis=0) - 6.0, points.max(axis=0) + 6.0
        panel_height = 0.5 * WIDTH * (high - low)[1] / (high - low)[0]
        figure = Figure((WIDTH, panel_height + 3.0), layout="constrained")
        grid = figure.add_gridspec(3, 2, height_ratios=(panel_height, 1.1, 0.7))
        before, after = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[0, 1])
        steps = (before, data.old, "(a) before", BLUE), (after, data.weighted.curve, "(b) after", PURPLE)
        for axes, spline, title, color in steps:
            style.draw_curve(axes, spline, color)
            style.draw_control_points(axes, ring(spline.distinct_control_points), color)
            style.set_frame(axes, low, high)
            axes.set(xlabel="x [m]", title=f"{title}: {spline.size} control points")
        style.draw_curve(after, data.old, DARK, width=0.8, linestyle="--", zorder=3.5)
        before.set_ylabel("y [m]")
        after.tick_params(labelleft=False)
        errors = figure.add_subplot(grid[1, :])
        _draw_errors(errors, data)
        _draw_curvature(figure.add_subplot(grid[2, :], sharex=errors), data)
    weighted, uniform = (100.0 * simplified.rms for simplified in (data.weighted, data.uniform))
    return figure, (
        f"Simplification of a closed curve of {data.old.size} control points (a) to "
        f"{data.weighted.curve.size} (b, the curve before dashed). (c) The distance between the two: "
        f"{weighted:.1f} cm rms with curvature-weighted knots, {uniform:.1f} cm with uniform ones. "
        "(d) Curvature, and the knots."
    )


def _draw_errors(axes: Axes, data: Simplification) -> None:
    for simplified, color, line, name in (
        (data.uniform, ORANGE, "--", "uniform knots"),
        (data.weighted, PURPLE, "-", "curvature-weighted knots"),
    ):
        errors_cm = 100.0 * simplified.errors
        label = f"{name}: rms {100 * simplified.rms:.1f} cm, largest {errors_cm.max():.1f} cm"
        axes.plot(data.length, errors_cm, color=color, linestyle=line, linewidth=0.9, label=label)
    axes.set(xlim=(0.0, data.old.length()), ylim=(0.0, 170.0 * float(data.uniform.errors.max())))
    axes.set(ylabel="distance [cm]", title="(c) distance between before and after")
    axes.tick_params(labelbottom=False)
    axes.legend(loc="upper right")


def _draw_curvature(axes: Axes, data: Simplification) -> None:
    axes.fill_between(data.length, np.abs(data.curvature), color=LIGHT, linewidth=0.0)
    knots = data.old.arc_length(data.weighted.curve.breaks)
    on_axis = np.stack([knots, np.zeros(len(knots))], axis=1)
    style.draw_points(axes, on_axis, "|", PURPLE, markersize=9.0, clip_on=False)
    axes.set(ylim=(0.0, None), xlabel="length along the curve [m]", ylabel="curvature\n[1/m]")
    axes.set_title("(d) curvature, and the knots that follow it")
