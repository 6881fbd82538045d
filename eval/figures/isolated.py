"""The paper's isolated tests as figures: expansion and fit, and all of them with captions."""

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
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.io.files import atomic_folder
from pathspace_graph.io.map import SplineBoundary
from pathspace_graph.mapping.belief import cubature_points, square_root
from pathspace_graph.settings.batch import CkfSettings
from pathspace_graph.sim.curves import left_normals, unit
from pathspace_graph.spline.bspline import BSpline, end_change_matrix
from pathspace_graph.spline.knots import fit_spline

from . import style
from .curves import plot_simplification, plot_uncertainty, posterior
from .style import BLUE, DARK, GREEN, LIGHT, MARKER_SIZE, ORANGE, PURPLE, RED, THIN_WIDTH, WIDTH

SIGMA_DETECTION: Final = 0.2
RIDGE: Final = 0.05
MARKER: Final = "captions.md"  # file by which a folder of these figures is known
_INVISIBLE: Final = 1e-3  # value of a basis function below which it can't be seen
_DIAMOND: Final = 0.8 * MARKER_SIZE


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
    detections = curve.evaluate(beside) + offsets * style.normals(curve, beside)
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
        (folder / MARKER).write_text("\n".join(captions), encoding="utf-8")
