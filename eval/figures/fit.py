"""The fit of S_z (paper: Update): detections become one measurement of the control points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.linalg import block_diag

from pathspace_graph.ckf.fit import SplineMeasurement, fit_detections
from pathspace_graph.mapping.belief import cubature_points, square_root
from pathspace_graph.settings.comparison import CkfSettings
from pathspace_graph.sim.geometry import left_normals, unit
from pathspace_graph.spline.bspline import BSpline

from .marks import draw_control_points, draw_curve, draw_ellipses, draw_points, normals, point_blocks
from .style import (
    BLUE,
    DARK,
    GREEN,
    LIGHT,
    MARKER_SIZE,
    ORANGE,
    PURPLE,
    RED,
    THIN_WIDTH,
    WIDTH,
    figure_context,
    fit_height,
    set_frame,
    shared_legend,
)

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FitScene:
    """A vehicle detects cones beside a part of a curve."""

    control_points: int = 9
    """The curve has this many control points."""
    spacing: float = 3.5
    """Control points are this far apart (m)."""
    swing: float = 3.0
    """The curve swings this far to either side (m)."""
    shares: tuple[float, ...] = (0.36, 0.47, 0.58, 0.68)
    """The detections lie beside these shares of the curve's length."""
    offsets: tuple[float, ...] = (0.5, 1.2, 1.3, 0.6)
    """The detections lie this far to the left of the curve (m)."""
    sigmas: tuple[float, float] = (0.45, 0.15)
    """A detection has these standard deviations along the ray from the vehicle and across it (m)."""
    vehicle: tuple[float, float] = (2.0, 5.5)
    """The vehicle stands at this position (m)."""
    ridge: float = 0.05
    """This is lambda of the ridge regression."""


@dataclass(frozen=True, eq=False)
class Fit:
    """Holds the four steps."""

    curve: BSpline
    """This is S_mu, the state's curve."""
    detections: Array
    """Each row holds the position (x, y) of a detection z (m)."""
    covariances: Array
    """These are the detections' covariances (m, 2, 2), m^2."""
    foot_u: Array
    """These are the parameters (m,) of the closest points."""
    basis: Array
    """This is B (m, n), the basis functions at the closest points."""
    sigma_points: Array
    """These are the sigma points X (4 m, m, 2) of the detections (m)."""
    fitted_points: Array
    """These are the control points Z (4 m, n, 2) fitted to each sigma point (m)."""
    measurement: SplineMeasurement
    """This is S_z."""

    @property
    def fitted(self) -> BSpline:
        """Returns S_z as a curve."""
        return self.curve.with_points(self.measurement.points)


def fit(scene: FitScene | None = None) -> Fit:
    """Computes C = C_mu + (B' B + L)^-1 B' (y - B C_mu) of the detections and of their sigma points."""
    scene = scene or FitScene()
    x = scene.spacing * np.arange(scene.control_points)
    points = np.stack([x, -scene.swing * np.cos(2.0 * np.pi * x / x[-1])], axis=1)
    curve = BSpline.open_uniform(points, interval=scene.spacing).clamp()
    beside = curve.parameters_at(np.array(scene.shares) * curve.length())
    detections = curve.evaluate(beside) + np.array(scene.offsets)[:, None] * normals(curve, beside)
    covariances = _ray_covariances(detections - np.array(scene.vehicle), scene.sigmas)
    foot_u = curve.foot_points(detections).u
    basis = curve.basis_matrix(foot_u)
    settings = CkfSettings(ridge=scene.ridge, penalty="solution")
    measurement = fit_detections(basis, detections, covariances, curve.control_points, settings)
    sigma_points = _sigma_points(detections, covariances)
    innovations = sigma_points - basis @ curve.control_points
    fitted_points = curve.control_points + np.einsum("nm,kmd->knd", measurement.gain, innovations)
    return Fit(curve, detections, covariances, foot_u, basis, sigma_points, fitted_points, measurement)


def _ray_covariances(rays: Array, sigmas: tuple[float, float]) -> Array:
    """Returns covariances (m, 2, 2), m^2, of standard deviations (m) along each ray (m, 2) and across it."""
    along = unit(rays)
    parts = zip(sigmas, (along, left_normals(along)), strict=True)
    return np.asarray(sum(s**2 * v[:, :, None] * v[:, None, :] for s, v in parts))


def _sigma_points(detections: Array, covariances: Array) -> Array:
    """Returns the cubature points (4 m, m, 2) of all detections (m, 2), (m, 2, 2) together."""
    root = square_root(block_diag(*covariances))
    return cubature_points(detections.ravel(), root).reshape(-1, *detections.shape)


# --- figure ----------------------------------------------------------------------------------------------

_INVISIBLE: Final = 1e-3
"""A basis function below this can't be seen."""
_DETECTIONS: Final = "detections $z$ (a: 2σ)"
_DIAMOND: Final = 0.8 * MARKER_SIZE


def plot_fit(data: Fit) -> Figure:
    """Draws (a) closest points, (b) sigma points and their fits, (c) S_z, (d) the basis functions there."""
    with figure_context():
        figure = Figure((WIDTH, 4.0), layout="compressed")
        closest, sigma, fitted, basis = figure.subplots(2, 2).flat
        for axes in (closest, sigma, fitted):
            draw_curve(axes, data.curve, BLUE, r"$S_\mu$")
        _draw_closest(closest, data)
        _draw_sigma_points(sigma, data)
        _draw_fitted(fitted, data)
        _draw_basis(basis, data)
        shown = np.concatenate([data.curve.control_points, data.detections])
        low = shown.min(axis=0) - np.array([1.0, 1.6])
        high = shown.max(axis=0) + np.array([1.0, 1.9])
        for axes in (closest, sigma, fitted):
            draw_points(axes, data.detections, "o", GREEN, _DETECTIONS)
            set_frame(axes, low, high)
            axes.set_xlabel("x [m]")
            axes.set_ylabel("y [m]")
        width, height = high - low
        basis.set_box_aspect(height / width)
        shared_legend(figure, 5)
        fit_height(figure)
    return figure


def _draw_closest(axes: Axes, data: Fit) -> None:
    draw_control_points(axes, data.curve.control_points, BLUE, r"$C_\mu$")
    nearest = data.curve.evaluate(data.foot_u)
    for ends in np.stack([data.detections, nearest], axis=1):
        axes.plot(*ends.T, color=DARK, linewidth=0.7, zorder=4)
    draw_ellipses(axes, data.detections, data.covariances, GREEN)
    draw_points(axes, nearest, "D", ORANGE, "closest points", markersize=_DIAMOND)
    axes.set_title("(a) closest points on the state's curve")


def _draw_sigma_points(axes: Axes, data: Fit) -> None:
    for number, points in enumerate(data.fitted_points):
        label = None if number else "splines $Z$"
        draw_curve(axes, data.curve.with_points(points), LIGHT, label, THIN_WIDTH, zorder=2)
    draw_points(axes, data.sigma_points.reshape(-1, 2), ".", RED, "sigma points $X$", zorder=5)
    axes.set_title("(b) sigma points, and a fit to each")


def _draw_fitted(axes: Axes, data: Fit) -> None:
    points = data.measurement.points
    draw_curve(axes, data.fitted, PURPLE, "$S_z$", zorder=3.5)
    draw_control_points(axes, points, PURPLE, "$C_z$, 2σ")
    draw_ellipses(axes, points, point_blocks(data.measurement.covariance), PURPLE)
    axes.set_title("(c) $S_z$: their mean and covariance")


def _draw_basis(axes: Axes, data: Fit) -> None:
    """Draws the basis functions over the parameter, and marks their values at the detections."""
    u = np.linspace(*data.curve.domain, 400)
    for j, values in enumerate(data.curve.basis_matrix(u).T):
        color = PURPLE if data.basis[:, j].sum() > _INVISIBLE else LIGHT
        axes.plot(np.where(values > _INVISIBLE, u, np.nan), values, color=color, linewidth=0.9, zorder=2)
    rows, columns = np.nonzero(data.basis > _INVISIBLE)
    values = np.stack([data.foot_u[rows], data.basis[rows, columns]], axis=1)
    draw_points(axes, values, "D", ORANGE, "basis at the closest points", markersize=_DIAMOND, zorder=3)
    for foot in data.foot_u:
        axes.axvline(foot, color=ORANGE, linewidth=0.7, linestyle=":", zorder=1)
    axes.set_xlim(*data.curve.domain)
    axes.set_ylim(0.0, 1.0)
    axes.set_xlabel("parameter $u$ [m]")
    axes.set_ylabel("basis $β_j(u)$")
    axes.set_title("(d) basis: how freely each control point moves")
