"""The fit of S_z (paper: Update): readings become one reading of the control points, with a covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pathspace_graph.ckf.fit import SplineMeasurement, fit_detections
from pathspace_graph.mapping.cubature import cubature_points, square_root
from pathspace_graph.settings.comparison import CkfSettings
from pathspace_graph.spline.bspline import BSpline

from .style import (
    FigureStyle,
    draw_control_points,
    draw_detections,
    draw_ellipses,
    figure_context,
    fit_height,
    frame,
    legend_below,
    point_blocks,
)

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FitScene:
    """A curve, and readings beside a part of it."""

    control_points: int = 9
    """Of the curve."""
    spacing: float = 3.5
    """Of the control points (m)."""
    swing: float = 3.0
    """Half the width that the curve swings across (m)."""
    shares: tuple[float, ...] = (0.36, 0.47, 0.58, 0.68)
    """Where along the curve the readings are, ..."""
    offsets: tuple[float, ...] = (0.5, 1.2, 1.3, 0.6)
    """... and how far to its left (m)."""
    sigmas: tuple[float, float] = (0.45, 0.15)
    """Of each reading, along the ray from the vehicle and across it (m)."""
    vehicle: tuple[float, float] = (2.0, 5.5)
    """Where the vehicle stands (m)."""
    ridge: float = 0.05
    """lambda of the ridge regression."""


@dataclass(frozen=True, eq=False)
class Fit:
    """The four steps."""

    curve: BSpline
    """S_mu."""
    detections: Array
    """z (m, 2), m."""
    covariances: Array
    """(m, 2, 2), m^2."""
    feet: Array
    """(m,) parameters of the closest points."""
    basis: Array
    """B (m, n), the basis functions there."""
    sigma_points: Array
    """X (4 m, m, 2), m."""
    fitted_points: Array
    """Z (4 m, n, 2): control points fitted to each, m."""
    reading: SplineMeasurement
    """S_z."""

    @property
    def fitted(self) -> BSpline:
        """S_z as a curve."""
        return self.curve.with_points(self.reading.points)


def fit(scene: FitScene | None = None) -> Fit:
    """C = C_mu + (B' B + L)^-1 B' (y - B C_mu) of the readings, and of each sigma point of theirs."""
    scene = scene or FitScene()
    x = scene.spacing * np.arange(scene.control_points)
    points = np.stack([x, -scene.swing * np.cos(2.0 * np.pi * x / x[-1])], axis=1)
    curve = BSpline.open_uniform(points, interval=scene.spacing).clamp()
    detections = _beside(curve, np.array(scene.shares), np.array(scene.offsets))
    covariances = _ray_covariances(detections - np.array(scene.vehicle), scene.sigmas)
    feet = curve.foot_points(detections).u
    basis = curve.basis_matrix(feet)
    reading = fit_detections(
        basis,
        detections,
        covariances,
        curve.control_points,
        CkfSettings(ridge=scene.ridge, penalty="solution"),
    )
    m = len(detections)
    joint = np.zeros((m, 2, m, 2))
    joint[np.arange(m), :, np.arange(m), :] = covariances
    sigma_points = cubature_points(detections.ravel(), square_root(joint.reshape(2 * m, 2 * m))).reshape(
        -1, m, 2
    )
    moved = np.einsum("nm,kmd->knd", reading.gain, sigma_points - basis @ curve.control_points)
    return Fit(
        curve, detections, covariances, feet, basis, sigma_points, curve.control_points + moved, reading
    )


def _beside(curve: BSpline, shares: Array, offsets: Array) -> Array:
    """Points (m, 2) to the left of the curve."""
    u = curve.parameters_at(shares * curve.length())
    tangent = curve.tangent_unit(u)
    return curve.evaluate(u) + offsets[:, None] * np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)


def _ray_covariances(rays: Array, sigmas: tuple[float, float]) -> Array:
    """(m, 2, 2) m^2, of sigmas (m) along each ray (m, 2) and across it."""
    along = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    parts = zip(sigmas, (along, across), strict=True)
    return np.asarray(sum(s**2 * v[:, :, None] * v[:, None, :] for s, v in parts))


# --- figure ----------------------------------------------------------------------------------------------


_NOTHING = 1e-3
"""A basis below this can't be seen."""


def plot_fit(data: Fit, style: FigureStyle | None = None) -> Figure:
    """(a) closest points, (b) sigma points and their fits, (c) S_z, (d) the basis at the closest points."""
    style = style or FigureStyle()
    with figure_context(style):
        figure = Figure((style.width, 4.0), layout="compressed")
        panels = figure.subplots(2, 2)
        closest, sigma, fitted, basis = panels.flat
        _draw_closest(closest, data, style)
        _draw_sigma_points(sigma, data, style)
        _draw_fitted(fitted, data, style)
        _draw_basis(basis, data, style)
        shown = np.concatenate([data.curve.control_points, data.detections])
        low, high = shown.min(axis=0) - (1.0, 1.6), np.add(shown.max(axis=0), (1.0, 1.9))
        for axes in (closest, sigma, fitted):
            frame(axes, (low[0], low[1]), (high[0], high[1]))
            axes.set_ylabel("y [m]")
        basis.set_box_aspect((high[1] - low[1]) / (high[0] - low[0]))
        legend_below(figure, 5)
        fit_height(figure)
    return figure


def _draw_state(axes: Axes, data: Fit, style: FigureStyle) -> None:
    u = np.linspace(*data.curve.domain, 300)
    axes.plot(
        *data.curve.evaluate(u).T,
        color=style.curve_color,
        linewidth=style.curve_width,
        zorder=3,
        label=r"$S_\mu$",
    )


def _draw_closest(axes: Axes, data: Fit, style: FigureStyle) -> None:
    _draw_state(axes, data, style)
    draw_control_points(axes, data.curve.control_points, style.curve_color, style, r"$C_\mu$")
    nearest = data.curve.evaluate(data.feet)
    for reading, foot in zip(data.detections, nearest, strict=True):
        axes.plot(*np.stack([reading, foot]).T, color=style.truth_color, linewidth=0.7, zorder=4)
    draw_ellipses(axes, data.detections, data.covariances, style.detection_color, style)
    draw_detections(axes, data.detections, style.detection_color, style, "readings $z$ (a: 2σ)")
    axes.plot(
        *nearest.T,
        linestyle="none",
        marker="D",
        markersize=0.8 * style.marker_size,
        color=style.other_color,
        zorder=6,
        label="closest points",
    )
    axes.set_title("(a) closest points on the state's curve")


def _draw_sigma_points(axes: Axes, data: Fit, style: FigureStyle) -> None:
    u = np.linspace(*data.curve.domain, 300)
    for number, points in enumerate(data.fitted_points):
        curve = data.curve.with_points(points).evaluate(u)
        label = None if number else "splines $Z$"
        axes.plot(*curve.T, color=style.faint_color, linewidth=style.thin_width, zorder=2, label=label)
    _draw_state(axes, data, style)
    draw_detections(axes, data.detections, style.detection_color, style, "readings $z$ (a: 2σ)")
    axes.plot(
        *data.sigma_points.reshape(-1, 2).T,
        linestyle="none",
        marker=".",
        markersize=style.marker_size,
        color=style.sigma_color,
        zorder=5,
        label="sigma points $X$",
    )
    axes.set_title("(b) sigma points, and a fit to each")


def _draw_fitted(axes: Axes, data: Fit, style: FigureStyle) -> None:
    _draw_state(axes, data, style)
    u = np.linspace(*data.curve.domain, 300)
    axes.plot(
        *data.fitted.evaluate(u).T,
        color=style.fitted_color,
        linewidth=style.curve_width,
        zorder=3.5,
        label="$S_z$",
    )
    draw_control_points(axes, data.reading.points, style.fitted_color, style, "$C_z$, 2σ")
    draw_ellipses(axes, data.reading.points, point_blocks(data.reading.covariance), style.fitted_color, style)
    draw_detections(axes, data.detections, style.detection_color, style, "readings $z$ (a: 2σ)")
    axes.set_title("(c) their mean and covariance: the reading $S_z$")


def _draw_basis(axes: Axes, data: Fit, style: FigureStyle) -> None:
    """The basis functions over the parameter; how much of each there is at the readings."""
    u = np.linspace(*data.curve.domain, 400)
    everywhere = data.curve.basis_matrix(u)
    for j, values in enumerate(everywhere.T):
        moves = data.basis[:, j].sum() > _NOTHING
        color = style.fitted_color if moves else style.faint_color
        axes.plot(np.where(values > _NOTHING, u, np.nan), values, color=color, linewidth=0.9, zorder=2)
    for number, (foot, row) in enumerate(zip(data.feet, data.basis, strict=True)):
        used = row > _NOTHING
        axes.axvline(foot, color=style.other_color, linewidth=0.7, linestyle=":", zorder=1)
        axes.plot(
            np.full(used.sum(), foot),
            row[used],
            linestyle="none",
            marker="D",
            markersize=0.8 * style.marker_size,
            color=style.other_color,
            zorder=3,
            label=None if number else "basis at the closest points",
        )
    axes.set_xlim(*data.curve.domain)
    axes.set_ylim(0.0, 1.0)
    axes.set_xlabel("parameter $u$ [m]")
    axes.set_ylabel("basis $β_j(u)$")
    axes.set_title("(d) basis: how freely each control point moves")
