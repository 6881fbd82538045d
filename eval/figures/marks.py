"""What figures are drawn with: curves, bands, points and ellipses."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline
from numpy.typing import NDArray

from pathspace_graph.io.map import SplineBoundary
from pathspace_graph.sim.geometry import left_normals
from pathspace_graph.spline.bspline import BSpline

from .style import ALPHA, CURVE_WIDTH, MARKER_SIZE, THIN_WIDTH

Array = NDArray[np.float64]

SIGMAS: Final = 2.0
"""A band reaches this many standard deviations across its curve, and an ellipse this many along its axes."""
SAMPLES_PER_SPAN: Final = 24
"""Each span of a spline is drawn as this many lines."""


def curve_parameters(spline: BSpline, samples_per_span: int = SAMPLES_PER_SPAN) -> Array:
    """Returns parameters (k,) at equal steps on each span, both ends of the domain included."""
    breaks = spline.breaks
    fractions = np.arange(samples_per_span) / samples_per_span
    inner = breaks[:-1, None] + np.diff(breaks)[:, None] * fractions
    return np.append(inner.ravel(), breaks[-1])


def normals(spline: BSpline, u: Array) -> Array:
    """Returns the unit normals (k, 2) at parameters u (k,), to the left of the direction of travel."""
    return left_normals(spline.tangent_unit(u))


def uncertainty_band(
    boundary: SplineBoundary, u: Array, scale: float = 1.0, widest: float = np.inf
) -> tuple[Array, Array]:
    """Returns S(u) +- 2 scale sigma(u) n(u), the band's left and right edge (k, 2), m, at u (k,).

    The edges are at most `widest` (m) away from the curve.
    """
    spline = boundary.spline
    half = np.minimum(SIGMAS * scale * spline.normal_sigma(u, boundary.covariance), widest)
    offsets = half[:, None] * normals(spline, u)
    centre = spline.evaluate(u)
    return centre + offsets, centre - offsets


def point_blocks(covariance: Array) -> Array:
    """Returns each point's covariance (m, 2, 2) from the joint one (2m, 2m) over x0, y0, x1, y1 and so on."""
    m = len(covariance) // 2
    index = np.arange(m)
    return np.asarray(covariance.reshape(m, 2, m, 2)[index, :, index, :])


def draw_curve(
    axes: Axes,
    spline: BSpline,
    color: str,
    label: str | None = None,
    width: float = CURVE_WIDTH,
    stretch: tuple[float, float] = (-np.inf, np.inf),
    **line: Any,
) -> None:
    """Draws a spline over its whole domain, or over a stretch of it, from one parameter to another."""
    u = curve_parameters(spline)
    low, high = np.clip(stretch, u[0], u[-1])
    points = spline.evaluate(np.concatenate([[low], u[(u > low) & (u < high)], [high]]))
    axes.plot(*points.T, color=color, linewidth=width, label=label, **{"zorder": 3, **line})


def draw_points(
    axes: Axes, points: Array, marker: str, color: str, label: str | None = None, **options: Any
) -> None:
    """Draws a marker at each point (k, 2)."""
    options = {"markersize": MARKER_SIZE, "zorder": 6, **options}
    axes.plot(*points.T, linestyle="none", marker=marker, color=color, label=label, **options)


def draw_control_points(
    axes: Axes, points: Array, color: str, label: str | None = None, polygon: bool = True, **options: Any
) -> None:
    """Draws a square at each control point (k, 2), and the control polygon as a thin line if asked to."""
    if polygon:
        axes.plot(*points.T, color=color, linewidth=THIN_WIDTH, linestyle=(0, (4, 3)), zorder=2)
    shape = {"markerfacecolor": "white", "markeredgewidth": 0.8, "zorder": 4}
    draw_points(axes, points, "s", color, label, **shape | options)


def draw_band(
    axes: Axes,
    boundary: SplineBoundary,
    color: str,
    label: str,
    scale: float = 1.0,
    alpha: float = ALPHA,
    zorder: float = 2,
    widest: float = np.inf,
) -> None:
    """Fills the 2-sigma band around a curve, `scale` times as wide as it is, up to `widest` (m) on a side."""
    left, right = uncertainty_band(boundary, curve_parameters(boundary.spline), scale, widest)
    outline = _band_outline(left, right, boundary.spline.periodic)
    look: dict[str, Any] = {"alpha": alpha, "linewidth": 0.0, "zorder": zorder}
    axes.add_patch(PathPatch(outline, facecolor=color, label=label, **look))


def _band_outline(left: Array, right: Array, closed: bool) -> Outline:
    """Returns a polygon around an open band, or a ring with edges in opposite directions for a closed one."""
    if not closed:
        return Outline(np.concatenate([left, right[::-1], left[:1]]), closed=True)
    return Outline.make_compound_path(Outline(left, closed=True), Outline(right[::-1], closed=True))


def ellipse_outlines(points: Array, joint: Array, corners: int = 16) -> Array:
    """Returns the 2-sigma ellipse of each point (m, 2) as a closed line (m, corners + 1, 2).

    The joint covariance (2m, 2m) is over x0, y0, x1, y1 and so on.
    """
    variances, vectors = np.linalg.eigh(point_blocks(joint))
    angles = np.linspace(0.0, 2.0 * np.pi, corners + 1)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    axes = vectors * np.sqrt(np.maximum(variances, 0.0))[:, None, :]
    return np.asarray(points[:, None] + SIGMAS * np.einsum("cj,mij->mci", circle, axes))


def draw_ellipses(
    axes: Axes, centres: Array, covariances: Array, color: str, scale: float = 1.0, **options: Any
) -> None:
    """Draws the 2-sigma ellipses of points (k, 2) with covariances (k, 2, 2), `scale` times as large."""
    variances, vectors = np.linalg.eigh(covariances)
    widths, heights = 2.0 * SIGMAS * scale * np.sqrt(np.maximum(variances, 0.0)).T
    angles = np.degrees(np.arctan2(vectors[:, 1, 0], vectors[:, 0, 0]))
    look = {"facecolor": color, "edgecolor": color, "alpha": ALPHA, "linewidth": 0.5, "zorder": 1} | options
    place: dict[str, Any] = {"offsets": centres, "offset_transform": axes.transData}
    axes.add_collection(EllipseCollection(widths, heights, angles, units="xy", **place, **look))
