"""Expansion (paper) in its three steps: classify, lead the curve on, update with the rest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.linalg import block_diag

from pathspace_graph.ckf.expansion import proximity_chain
from pathspace_graph.ckf.fit import fit_detections
from pathspace_graph.factors.bspline import end_change_matrix
from pathspace_graph.io.map import SplineBoundary
from pathspace_graph.settings.comparison import CkfSettings
from pathspace_graph.spline.bspline import BSpline
from pathspace_graph.spline.knots import fit_spline

from .map_plot import uncertainty_band
from .style import (
    FigureStyle,
    draw_control_points,
    draw_detections,
    draw_ellipses,
    figure_context,
    fit_height,
    frame,
    legend_below,
)
from .uncertainty import posterior

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class ExpansionScene:
    """A curve that ends on a bend, and readings on it and beyond it."""

    radius: float = 30.0
    """Of the bend (m)."""
    control_points: int = 6
    """Of the curve so far."""
    spacing: float = 3.0
    """Of its control points (m); it ends at the origin."""
    drift: float = 0.03
    """How far the curve is to the outside of the bend, as a share of the length from its beginning."""
    seen: tuple[float, ...] = (-5.5, -2.6, 2.2, 4.6, 7.0)
    """Where along the bend the readings are (m), ..."""
    inside: tuple[float, ...] = (0.1, 0.25, 0.3, 0.05, 0.2)
    """... and how far to its inside (m)."""
    sigma_known: float = 0.3
    """Of what held the curve so far (m)."""
    sigma_bend: float = 0.5
    """Second difference of its control points (m)."""
    sigma_anchor: float = 1.0
    """Of each of its control points (m)."""
    sigma_reading: float = 0.2
    """Of the readings (m)."""
    threshold: float = 2.0
    """Growth threshold, from C_n (m), ..."""
    separation: float = 2.0
    """... and from C_(n-1) (m)."""


@dataclass(frozen=True, eq=False)
class Expansion:
    """The three steps."""

    detections: Array
    """(m, 2) m."""
    sigma: float
    """Of each reading (m)."""
    expands: Bools
    """(m,) readings that mark an expansion of the curve in (a)."""
    order: NDArray[np.intp]
    """Of those: the proximity chain; the last one is what the curve is led on to."""
    before: SplineBoundary
    """(a) the curve, with the joint covariance of its control points."""
    extended: SplineBoundary
    """(b)"""
    updated: SplineBoundary
    """(c)"""


def expansion(scene: ExpansionScene | None = None) -> Expansion:
    """Classify the readings, lead the curve on to the last of their chain, update it with all others."""
    scene = scene or ExpansionScene()
    before = _known_curve(scene)
    detections = _on_bend(scene, np.array(scene.seen), np.array(scene.inside))
    covariances = np.tile(scene.sigma_reading**2 * np.eye(2), (len(detections), 1, 1))
    expands = expanding(before.spline, detections, scene.threshold, scene.separation)
    beyond = np.flatnonzero(expands)
    end = before.spline.evaluate(np.array([before.spline.domain[1]]))[0]
    order = beyond[proximity_chain(detections[beyond], end)]
    extended = extend(before, detections[order[-1]], covariances[order[-1]])
    rest = np.arange(len(detections)) != order[-1]
    updated = update(extended, detections[rest], covariances[rest])
    return Expansion(detections, scene.sigma_reading, expands, order, before, extended, updated)


def expanding(spline: BSpline, detections: Array, threshold: float, separation: float) -> Bools:
    """(m,) the paper's three conditions: closest to S(1), beyond a threshold from C_n, and from C_(n-1)."""
    feet = spline.foot_points(detections)
    last, before = spline.control_points[-1], spline.control_points[-2]
    far = np.linalg.norm(detections - last, axis=1) > threshold
    apart = np.linalg.norm(detections - before, axis=1) > separation
    return np.asarray((feet.u >= spline.domain[1] - _AT_END) & far & apart)


def extend(boundary: SplineBoundary, reading: Array, covariance: Array) -> SplineBoundary:
    """Unclamp, take the reading (2,) with its covariance (2, 2) as the last control point, clamp on it."""
    spline = boundary.spline
    longer = spline.extend_to(reading)
    change = np.kron(end_change_matrix(spline.knots, spline.degree, longer.knots), np.eye(2))
    return SplineBoundary(longer, block_diag(change @ boundary.covariance @ change.T, covariance))


def update(boundary: SplineBoundary, detections: Array, covariances: Array) -> SplineBoundary:
    """One Kalman update of the control points with S_z of readings (m, 2), (m, 2, 2) in the map frame."""
    spline, n = boundary.spline, boundary.size
    basis = spline.basis_matrix(spline.foot_points(detections).u)
    fitted = fit_detections(basis, detections, covariances, spline.control_points, CkfSettings())
    combine = np.kron(fitted.range_basis(), np.eye(2)).T
    H = combine @ np.kron(fitted.taken, np.eye(2))
    P = boundary.covariance
    gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + combine @ fitted.covariance @ combine.T)
    innovation = combine @ (fitted.points - spline.control_points).ravel()
    points = spline.control_points + (gain @ innovation).reshape(n, 2)
    keep = np.eye(2 * n) - gain @ H
    noise = gain @ combine @ fitted.covariance @ combine.T @ gain.T
    return SplineBoundary(spline.with_points(points), keep @ P @ keep.T + noise)


_AT_END = 1e-6
"""A parameter (m) this near to the end is the end."""


def _known_curve(scene: ExpansionScene) -> SplineBoundary:
    """A clamped curve along the bend that drifts to its outside, and ends at the origin's station."""
    count = scene.control_points
    along = np.linspace(-scene.spacing * count, 0.0, 2 * count + 1)
    row = _on_bend(scene, along, -scene.drift * (along - along[0]))
    spline = fit_spline(row, count, periodic=False)
    seen = np.linspace(*spline.domain, 2 * count)
    covariance = posterior(spline, seen, scene.sigma_known, scene.sigma_bend, scene.sigma_anchor)
    return SplineBoundary(spline, covariance)


def _on_bend(scene: ExpansionScene, along: Array, inside: Array) -> Array:
    """(m, 2) m, points along a left bend that passes the origin eastward."""
    angle = along / scene.radius
    r = scene.radius - inside
    return np.stack([r * np.sin(angle), scene.radius - r * np.cos(angle)], axis=1)


# --- figure ----------------------------------------------------------------------------------------------


def plot_expansion(data: Expansion, style: FigureStyle | None = None) -> Figure:
    """(a) readings classified, (b) the curve led on to the last of the chain, (c) updated with all others."""
    style = style or FigureStyle()
    nothing = np.zeros(len(data.detections), dtype=bool)
    led = nothing.copy()
    led[data.order[-1]] = True
    with figure_context(style):
        figure = Figure((style.width, 7.4), layout="compressed")
        panels = figure.subplots(3, 1, sharex=True)
        _draw_step(panels[0], data, data.before, data.expands, style.curve_color, style)
        _draw_step(panels[1], data, data.extended, led, style.curve_color, style)
        _draw_step(panels[2], data, data.updated, led, style.fitted_color, style)
        _draw_chain(panels[0], data, style)
        _draw_earlier(panels[1], data.before, style)
        _draw_earlier(panels[2], data.extended, style)
        panels[0].set_title("(a) readings beyond the end expand the curve, the others update it")
        panels[1].set_title(
            "(b) the curve is led on to the last of their chain; the others update it as well"
        )
        panels[2].set_title("(c) the curve after the update")
        for axes in panels:
            axes.set_ylabel("y [m]")
        for axes in panels[:-1]:
            axes.set_xlabel("")
        legend_below(figure, 4)
        fit_height(figure)
    return figure


def _draw_step(
    axes: Axes, data: Expansion, boundary: SplineBoundary, expands: Bools, color: str, style: FigureStyle
) -> None:
    spline = boundary.spline
    u = np.linspace(*spline.domain, 300)
    left, right = uncertainty_band(boundary, u)
    outline = np.concatenate([left, right[::-1]])
    name = "updated spline" if color == style.fitted_color else "spline"
    axes.fill(*outline.T, color=color, alpha=style.alpha, linewidth=0.0, zorder=1, label=f"{name}, 2σ")
    axes.plot(*spline.evaluate(u).T, color=color, linewidth=style.curve_width, zorder=3, label=name)
    draw_control_points(axes, spline.control_points, color, style, f"{name}, control points")
    for chosen, of, what in (
        (~expands, style.detection_color, "readings that update, 2σ"),
        (expands, style.sigma_color, "readings that expand, 2σ"),
    ):
        own = data.detections[chosen]
        draw_ellipses(axes, own, np.tile(data.sigma**2 * np.eye(2), (len(own), 1, 1)), of, style)
        draw_detections(axes, own, of, style, what)
    together = np.concatenate([data.detections, data.updated.spline.control_points])
    low, high = together.min(axis=0) - 1.0, together.max(axis=0) + 0.8
    frame(axes, (low[0], low[1]), (high[0], high[1]))


def _draw_chain(axes: Axes, data: Expansion, style: FigureStyle) -> None:
    """From the end along the proximity chain."""
    spline = data.before.spline
    end = spline.evaluate(np.array([spline.domain[1]]))
    chain = np.concatenate([end, data.detections[data.order]])
    axes.plot(
        *chain.T, color=style.sigma_color, linewidth=0.8, linestyle=":", zorder=2, label="proximity chain"
    )


def _draw_earlier(axes: Axes, boundary: SplineBoundary, style: FigureStyle) -> None:
    spline = boundary.spline
    axes.plot(
        *spline.evaluate(np.linspace(*spline.domain, 300)).T,
        color=style.truth_color,
        linewidth=0.9,
        linestyle="--",
        zorder=3.5,
        label="spline before the step",
    )
