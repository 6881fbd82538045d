"""Expansion (paper) in its three steps: classify, extend the curve, update it with the other detections."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.linalg import block_diag

from pathspace_graph.ckf.expansion import beyond_end, proximity_chain
from pathspace_graph.ckf.update import fit_detections
from pathspace_graph.factors.bspline import end_change_matrix
from pathspace_graph.io.map import SplineBoundary
from pathspace_graph.settings.comparison import CkfSettings
from pathspace_graph.spline.knots import fit_spline

from .marks import draw_band, draw_control_points, draw_curve, draw_ellipses, draw_points
from .style import BLUE, DARK, GREEN, PURPLE, RED, WIDTH, figure_context, fit_height, set_frame, shared_legend
from .uncertainty import posterior

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class ExpansionScene:
    """A curve ends on a left bend, and detections lie on it and beyond its end."""

    radius: float = 30.0
    """The bend has this radius (m)."""
    control_points: int = 6
    """The curve has this many control points so far."""
    spacing: float = 3.0
    """Its control points are this far apart (m); it ends at the origin."""
    drift: float = 0.03
    """The curve leaves the bend to the outside by this share of the length from its beginning."""
    detections_along: tuple[float, ...] = (-5.5, -2.6, 2.2, 4.6, 7.0)
    """The detections lie at these lengths along the bend (m)."""
    detections_inside: tuple[float, ...] = (0.1, 0.25, 0.3, 0.05, 0.2)
    """The detections lie this far to the inside of the bend (m)."""
    sigma_known: float = 0.3
    """The detections that the curve was made of have this standard deviation (m)."""
    sigma_bend: float = 0.5
    """Second differences of the control points have a prior of this standard deviation (m)."""
    sigma_anchor: float = 1.0
    """Each control point has a prior of this standard deviation (m)."""
    sigma_detection: float = 0.2
    """The detections have this standard deviation (m)."""
    threshold: float = 2.0
    """A detection expands the curve where it is farther than this from C_n (m)."""
    separation: float = 2.0
    """A detection expands the curve where it is farther than this from C_(n-1) (m)."""


@dataclass(frozen=True, eq=False)
class Expansion:
    """Holds the three steps."""

    detections: Array
    """Each row holds the position (x, y) of a detection (m)."""
    sigma: float
    """Each detection has this standard deviation (m)."""
    expands: Bools
    """In step (a) these detections (m,) mark an expansion of the curve."""
    order: NDArray[np.intp]
    """This is the proximity chain of those detections; the curve is extended to the last one."""
    before: SplineBoundary
    """This is the curve of step (a), with the joint covariance of its control points."""
    extended: SplineBoundary
    """This is the curve of step (b)."""
    updated: SplineBoundary
    """This is the curve of step (c)."""


def expansion(scene: ExpansionScene | None = None) -> Expansion:
    """Classifies the detections, extends the curve to the last of their chain, updates it with the others."""
    scene = scene or ExpansionScene()
    before = _known_curve(scene)
    detections = _on_bend(scene, np.array(scene.detections_along), np.array(scene.detections_inside))
    covariances = np.tile(scene.sigma_detection**2 * np.eye(2), (len(detections), 1, 1))
    spline, high = before.spline, before.spline.domain[1]
    foot_u = spline.foot_points(detections).u
    settings = CkfSettings(threshold=scene.threshold, separation=scene.separation)
    expands = beyond_end(detections, foot_u, high, spline.control_points, settings)
    beyond = np.flatnonzero(expands)
    order = beyond[proximity_chain(detections[beyond], spline.control_points[-1])]
    extended = extend(before, detections[order[-1]], covariances[order[-1]])
    others = np.arange(len(detections)) != order[-1]
    updated = update(extended, detections[others], covariances[others])
    return Expansion(detections, scene.sigma_detection, expands, order, before, extended, updated)


def extend(boundary: SplineBoundary, detection: Array, covariance: Array) -> SplineBoundary:
    """Unclamps the curve, appends the detection (2,), (2, 2) as last control point, and clamps it there."""
    spline = boundary.spline
    longer = spline.extend_to(detection)
    change = np.kron(end_change_matrix(spline.knots, spline.degree, longer.knots), np.eye(2))
    return SplineBoundary(longer, block_diag(change @ boundary.covariance @ change.T, covariance))


def update(boundary: SplineBoundary, detections: Array, covariances: Array) -> SplineBoundary:
    """Does one Kalman update of the control points with S_z of detections (m, 2), (m, 2, 2), map frame."""
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


def _known_curve(scene: ExpansionScene) -> SplineBoundary:
    """Returns a clamped curve along the bend that drifts to its outside and ends beside the origin."""
    count = scene.control_points
    along = np.linspace(-scene.spacing * count, 0.0, 2 * count + 1)
    row = _on_bend(scene, along, -scene.drift * (along - along[0]))
    spline = fit_spline(row, count, periodic=False)
    seen = np.linspace(*spline.domain, 2 * count)
    covariance = posterior(spline, seen, scene.sigma_known, scene.sigma_bend, scene.sigma_anchor)
    return SplineBoundary(spline, covariance)


def _on_bend(scene: ExpansionScene, along: Array, inside: Array) -> Array:
    """Returns points (m, 2) of a left bend that passes the origin eastward, m."""
    angle = along / scene.radius
    r = scene.radius - inside
    return np.stack([r * np.sin(angle), scene.radius - r * np.cos(angle)], axis=1)


# --- figure ----------------------------------------------------------------------------------------------


def plot_expansion(data: Expansion) -> Figure:
    """Draws (a) classified detections, (b) the curve extended to the last of their chain, (c) the update."""
    interpolated = np.arange(len(data.detections)) == data.order[-1]
    with figure_context():
        figure = Figure((WIDTH, 7.4), layout="compressed")
        panels = figure.subplots(3, 1, sharex=True)
        _draw_step(panels[0], data, data.before, data.expands)
        _draw_step(panels[1], data, data.extended, interpolated)
        _draw_step(panels[2], data, data.updated, interpolated)
        _draw_chain(panels[0], data)
        for axes, before in ((panels[1], data.before), (panels[2], data.extended)):
            draw_curve(axes, before.spline, DARK, "spline before the step", 0.9, linestyle="--", zorder=3.5)
        panels[0].set_title("(a) detections beyond the end expand the curve, the others update it")
        panels[1].set_title("(b) the curve is extended to the last of their chain; the others update it too")
        panels[2].set_title("(c) the curve after the update")
        panels[2].set_xlabel("x [m]")
        for axes in panels:
            axes.set_ylabel("y [m]")
        shared_legend(figure, 4)
        fit_height(figure)
    return figure


def _draw_step(axes: Axes, data: Expansion, boundary: SplineBoundary, expands: Bools) -> None:
    color, name = (PURPLE, "updated spline") if boundary is data.updated else (BLUE, "spline")
    draw_band(axes, boundary, color, f"{name}, 2σ", zorder=1)
    draw_curve(axes, boundary.spline, color, name)
    draw_control_points(axes, boundary.spline.control_points, color, f"{name}, control points")
    for chosen, of, text in (
        (~expands, GREEN, "detections that update, 2σ"),
        (expands, RED, "detections that expand, 2σ"),
    ):
        points = data.detections[chosen]
        draw_ellipses(axes, points, np.tile(data.sigma**2 * np.eye(2), (len(points), 1, 1)), of)
        draw_points(axes, points, "o", of, text)
    shown = np.concatenate([data.detections, data.updated.spline.control_points])
    set_frame(axes, shown.min(axis=0) - 1.0, shown.max(axis=0) + 0.8)


def _draw_chain(axes: Axes, data: Expansion) -> None:
    """Draws the proximity chain, from the end of the curve on."""
    chain = np.concatenate([data.before.spline.control_points[-1:], data.detections[data.order]])
    axes.plot(*chain.T, color=RED, linewidth=0.8, linestyle=":", zorder=2, label="proximity chain")
