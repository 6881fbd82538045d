"""The paper's isolated tests as figures with captions: uncertainty, expansion, fit and simplification."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.linalg import block_diag

from pathspace_graph.baselines.ckf_curves import beyond_end, proximity_chain
from pathspace_graph.baselines.ckf_update import SplineMeasurement, fit_detections
from pathspace_graph.eval.metrics.accuracy import closest_points, root_mean_square
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.residuals import greville, smoothness_matrix
from pathspace_graph.io.files import atomic_folder, write_text
from pathspace_graph.io.map import SplineBoundary
from pathspace_graph.mapping.belief import cubature_points, square_root
from pathspace_graph.settings.mapper import CkfSettings
from pathspace_graph.sim.curves import left_normals, ring, unit
from pathspace_graph.sim.track_generator import TrackGeneratorSettings, generate_track
from pathspace_graph.spline.bspline import BSpline, end_change_matrix
from pathspace_graph.spline.knots import BASELINE, curvature_weighted_breaks, fit_spline, refit

from . import style
from .style import BLUE, DARK, GREEN, LIGHT, MARKER_SIZE, ORANGE, PURPLE, RED, THIN_WIDTH, WIDTH

BLIND: Final = (0.52, 0.74)  # shares of the length of the curve between which no cone was seen
SIGMA_DETECTION: Final = 0.2
RIDGE: Final = 0.05
MARKER: Final = "captions.md"  # file by which a folder of these figures is known
_INVISIBLE: Final = 1e-3  # value of a basis function below which it can't be seen
_DIAMOND: Final = 0.8 * MARKER_SIZE


# --- uncertainty -----------------------------------------------------------------------------------------


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


# --- expansion -------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class ExpansionFigure:
    """The three steps, on a curve with the joint covariance of its control points."""

    detections: Array  # (m, 2) positions (m)
    expands: BoolArray  # (m,) which mark an expansion in step (a)
    order: IntArray  # proximity chain of those; the curve is extended to the last one
    before: SplineBoundary
    extended: SplineBoundary
    updated: SplineBoundary


def expansion() -> ExpansionFigure:
    """Classify the detections, extend the curve to the last of their chain, update it with the others."""
    # a curve along the bend that drifts to its outside and ends beside the origin
    along, settings = np.linspace(-18.0, 0.0, 13), CkfSettings(threshold=2.0, separation=2.0)
    spline = fit_spline(_on_bend(along, -0.03 * (along - along[0])), 6, periodic=False)
    seen = np.linspace(*spline.domain, 12)
    before = SplineBoundary(spline, posterior(spline, seen, 0.3, 0.5, 1.0))
    detections = _on_bend(np.array([-5.5, -2.6, 2.2, 4.6, 7.0]), np.array([0.1, 0.25, 0.3, 0.05, 0.2]))
    covariances = np.tile(SIGMA_DETECTION**2 * np.eye(2), (len(detections), 1, 1))
    foot_u = spline.foot_points(detections).u
    expands = beyond_end(detections, foot_u, spline.domain[1], spline.control_points, settings)
    beyond = np.flatnonzero(expands)
    order = beyond[proximity_chain(detections[beyond], spline.control_points[-1])]
    extended = extend(before, detections[order[-1]], covariances[order[-1]])
    others = np.arange(len(detections)) != order[-1]
    updated = update(extended, detections[others], covariances[others])
    return ExpansionFigure(detections, expands, order, before, extended, updated)


def extend(boundary: SplineBoundary, detection: Array, covariance: Array) -> SplineBoundary:
    """Unclamp the curve, append the detection (2,), (2, 2) as last control point, and clamp it there."""
    spline = boundary.spline
    longer = spline.extend_to(detection)
    change = np.kron(end_change_matrix(spline.knots, spline.degree, longer.knots), np.eye(2))
    return SplineBoundary(longer, block_diag(change @ boundary.covariance @ change.T, covariance))


def update(boundary: SplineBoundary, detections: Array, covariances: Array) -> SplineBoundary:
    """Do one Kalman update of the control points with S_z of detections (m, 2), (m, 2, 2), map frame."""
    spline, n = boundary.spline, boundary.size
    basis = spline.basis_matrix(spline.foot_points(detections).u)
    measurement = fit_detections(basis, detections, covariances, spline.control_points, CkfSettings())
    combine = np.kron(measurement.range_basis(), np.eye(2)).T
    H = combine @ np.kron(measurement.taken, np.eye(2))
    R = combine @ measurement.covariance @ combine.T
    P = boundary.covariance
    gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    innovation = combine @ (measurement.points - spline.control_points).ravel()
    points = spline.control_points + (gain @ innovation).reshape(n, 2)
    keep = np.eye(2 * n) - gain @ H
    return SplineBoundary(spline.with_points(points), keep @ P @ keep.T + gain @ R @ gain.T)


def _on_bend(along: Array, inside: Array) -> Array:
    """Return points (m, 2) of a left bend of 30 m that passes the origin eastward, m."""
    angle, r = along / 30.0, 30.0 - inside
    return np.stack([r * np.sin(angle), 30.0 - r * np.cos(angle)], axis=1)


def plot_expansion() -> tuple[Figure, str]:
    """Draw (a) classified detections, (b) the curve extended to the last of their chain, (c) the update."""
    data = expansion()
    interpolated = np.arange(len(data.detections)) == data.order[-1]
    titles = (
        "(a) detections beyond the end expand the curve, the others update it",
        "(b) the curve is extended to the last of their chain; the others update it too",
        "(c) the curve after the update",
    )
    curves = (data.before, data.extended, data.updated)
    with style.figure_context():
        figure = Figure((WIDTH, 7.4), layout="compressed")
        panels = figure.subplots(3, 1, sharex=True)
        for axes, title, boundary, before in zip(panels, titles, curves, (None, *curves[:2]), strict=True):
            _draw_step(axes, data, boundary, data.expands if before is None else interpolated)
            if before is None:
                ends = (data.before.spline.control_points[-1:], data.detections[data.order])
                chain: dict[str, Any] = {"linestyle": ":", "zorder": 2, "label": "proximity chain"}
                axes.plot(*np.concatenate(ends).T, color=RED, linewidth=0.8, **chain)
            else:
                look: dict[str, Any] = {"linestyle": "--", "zorder": 3.5}
                style.draw_curve(axes, before.spline, DARK, "spline before the step", 0.9, **look)
            axes.set(ylabel="y [m]", title=title)
        panels[2].set_xlabel("x [m]")
        style.shared_legend(figure, 4)
        style.fit_height(figure)
    return figure, (
        "Expansion in its three steps. (a) Detections whose closest point is the end of the curve, beyond a "
        "threshold from the last two control points, mark an expansion. (b) The curve is extended to the "
        "last of their proximity chain, and is exactly as it was up to its old end; the others are "
        "detections of it now. (c) One update uses all of those."
    )


def _draw_step(axes: Axes, data: ExpansionFigure, boundary: SplineBoundary, expands: BoolArray) -> None:
    color, name = (PURPLE, "updated spline") if boundary is data.updated else (BLUE, "spline")
    style.draw_band(axes, boundary, color, f"{name}, 2σ", zorder=1)
    style.draw_curve(axes, boundary.spline, color, name)
    style.draw_control_points(axes, boundary.spline.control_points, color, f"{name}, control points")
    for chosen, of, text in (
        (~expands, GREEN, "detections that update, 2σ"),
        (expands, RED, "detections that expand, 2σ"),
    ):
        points = data.detections[chosen]
        style.draw_ellipses(axes, points, np.tile(SIGMA_DETECTION**2 * np.eye(2), (len(points), 1, 1)), of)
        style.draw_points(axes, points, "o", of, text)
    shown = np.concatenate([data.detections, data.updated.spline.control_points])
    style.set_frame(axes, shown.min(axis=0) - 1.0, shown.max(axis=0) + 0.8)


# --- fit -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Fit:
    """The four steps."""

    curve: BSpline  # S_mu, the state's curve
    detections: Array  # (m, 2) positions (m)
    covariances: Array  # (m, 2, 2) their covariances (m^2)
    foot_u: Array  # (m,) parameters of the closest points
    basis: Array  # (m, n) basis functions B there
    sigma_points: Array  # (4 m, m, 2) sigma points X of the detections (m)
    fitted_points: Array  # (4 m, n, 2) control points Z fitted to each sigma point (m)
    measurement: SplineMeasurement  # S_z

    @property
    def fitted(self) -> BSpline:
        return self.curve.with_points(self.measurement.points)


def fit() -> Fit:
    """Compute C = C_mu + (B' B + L)^-1 B' (y - B C_mu) of the detections and of their sigma points."""
    x = 3.5 * np.arange(9)
    points = np.stack([x, -3.0 * np.cos(2.0 * np.pi * x / x[-1])], axis=1)
    curve = BSpline.open_uniform(points, interval=3.5).clamp()
    beside = curve.parameters_at(np.array([0.36, 0.47, 0.58, 0.68]) * curve.length())
    offsets = np.array([[0.5], [1.2], [1.3], [0.6]])
    detections = curve.evaluate(beside) + offsets * curve.normal_unit(beside)
    along = unit(detections - np.array([2.0, 5.5]))
    covariances = np.zeros((len(along), 2, 2))
    for sigma, axis in ((0.45, along), (0.15, left_normals(along))):
        covariances += sigma**2 * axis[:, :, None] * axis[:, None, :]
    foot_u = curve.foot_points(detections).u
    basis = curve.basis_matrix(foot_u)
    settings = CkfSettings(ridge=RIDGE)
    measurement = fit_detections(basis, detections, covariances, curve.control_points, settings)
    root = square_root(block_diag(*covariances))
    sigma_points = cubature_points(detections.ravel(), root).reshape(-1, *detections.shape)
    innovations = sigma_points - basis @ curve.control_points
    fitted_points = curve.control_points + np.einsum("nm,kmd->knd", measurement.gain, innovations)
    return Fit(curve, detections, covariances, foot_u, basis, sigma_points, fitted_points, measurement)


def plot_fit() -> tuple[Figure, str]:
    """Draw (a) closest points, (b) sigma points and their fits, (c) S_z, (d) the basis functions there."""
    data = fit()
    with style.figure_context():
        figure = Figure((WIDTH, 4.0), layout="compressed")
        closest, sigma, fitted, basis = figure.subplots(2, 2).flat
        for axes in (closest, sigma, fitted):
            style.draw_curve(axes, data.curve, BLUE, r"$S_\mu$")
        _draw_closest(closest, data)
        _draw_sigma_points(sigma, data)
        _draw_fitted(fitted, data)
        _draw_basis(basis, data)
        shown = np.concatenate([data.curve.control_points, data.detections])
        low = shown.min(axis=0) - np.array([1.0, 1.6])
        high = shown.max(axis=0) + np.array([1.0, 1.9])
        for axes in (closest, sigma, fitted):
            style.draw_points(axes, data.detections, "o", GREEN, "detections $z$ (a: 2σ)")
            style.set_frame(axes, low, high)
            axes.set(xlabel="x [m]", ylabel="y [m]")
        width, height = high - low
        basis.set_box_aspect(height / width)
        style.shared_legend(figure, 5)
        style.fit_height(figure)
    return figure, (
        "The fit of S_z. (a) The closest points on the state's curve to the detections. (b) Sigma points of "
        "the detections, and the curve fitted to each by ridge regression. (c) Mean and covariance of their "
        "control points make one measurement of the curve. (d) The basis functions at the closest points: a "
        "control point whose function is zero there (grey) stays where it was."
    )


def _draw_closest(axes: Axes, data: Fit) -> None:
    style.draw_control_points(axes, data.curve.control_points, BLUE, r"$C_\mu$")
    nearest = data.curve.evaluate(data.foot_u)
    for ends in np.stack([data.detections, nearest], axis=1):
        axes.plot(*ends.T, color=DARK, linewidth=0.7, zorder=4)
    style.draw_ellipses(axes, data.detections, data.covariances, GREEN)
    style.draw_points(axes, nearest, "D", ORANGE, "closest points", markersize=_DIAMOND)
    axes.set_title("(a) closest points on the state's curve")


def _draw_sigma_points(axes: Axes, data: Fit) -> None:
    for number, points in enumerate(data.fitted_points):
        label = None if number else "splines $Z$"
        style.draw_curve(axes, data.curve.with_points(points), LIGHT, label, THIN_WIDTH, zorder=2)
    style.draw_points(axes, data.sigma_points.reshape(-1, 2), ".", RED, "sigma points $X$", zorder=5)
    axes.set_title("(b) sigma points, and a fit to each")


def _draw_fitted(axes: Axes, data: Fit) -> None:
    points = data.measurement.points
    style.draw_curve(axes, data.fitted, PURPLE, "$S_z$", zorder=3.5)
    style.draw_control_points(axes, points, PURPLE, "$C_z$, 2σ")
    style.draw_ellipses(axes, points, style.point_blocks(data.measurement.covariance), PURPLE)
    axes.set_title("(c) $S_z$: their mean and covariance")


def _draw_basis(axes: Axes, data: Fit) -> None:
    u = np.linspace(*data.curve.domain, 400)
    for j, values in enumerate(data.curve.basis_matrix(u).T):
        color = PURPLE if data.basis[:, j].sum() > _INVISIBLE else LIGHT
        axes.plot(np.where(values > _INVISIBLE, u, np.nan), values, color=color, linewidth=0.9, zorder=2)
    rows, columns = np.nonzero(data.basis > _INVISIBLE)
    values = np.stack([data.foot_u[rows], data.basis[rows, columns]], axis=1)
    style.draw_points(axes, values, "D", ORANGE, "basis at the closest points", markersize=_DIAMOND, zorder=3)
    for foot in data.foot_u:
        axes.axvline(foot, color=ORANGE, linewidth=0.7, linestyle=":", zorder=1)
    axes.set(xlim=data.curve.domain, ylim=(0.0, 1.0), xlabel="parameter $u$ [m]", ylabel="basis $β_j(u)$")
    axes.set_title("(d) basis: how freely each control point moves")


# --- simplification --------------------------------------------------------------------------------------


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


# --- all figures -----------------------------------------------------------------------------------------


FIGURES: Final[Mapping[str, Callable[[], tuple[Figure, str]]]] = {  # each returns a figure and its caption
    "uncertainty": plot_uncertainty,
    "expansion": plot_expansion,
    "fit": plot_fit,
    "simplification": plot_simplification,
}


def write_figures(out: Path, on_figure: Callable[[], None] = lambda: None) -> None:
    """Write every figure and the captions, or nothing; `on_figure` is called after each figure."""
    captions = []
    with atomic_folder(out, MARKER) as folder:
        for name, make in FIGURES.items():
            figure, caption = make()
            style.save_figures(folder, {name: figure})
            captions.append(f"![{name}]({name}.png)\n\n{caption}\n")
            on_figure()
        write_text(folder / MARKER, "\n".join(captions))
