"""Uncertainty along a spline (paper: Representing uncertainty), and what its formula leaves out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pathspace_graph.factors.gauge import greville, smoothness_matrix
from pathspace_graph.io.map import SplineBoundary
from pathspace_graph.spline.bspline import BSpline

from .map_plot import uncertainty_band
from .style import FigureStyle, draw_control_points, draw_ellipses, figure_context, frame, point_blocks

Array = NDArray[np.float64]


@dataclass(frozen=True)
class UncertaintyScene:
    """A curve that was seen but for one stretch."""

    spacing: float = 5.5
    """Of the control points (m)."""
    control_points: int = 13
    """Their number."""
    swing: float = 6.0
    """Half the width that the curve swings across (m)."""
    cones: int = 18
    """Cones along the curve, evenly."""
    blind: tuple[float, float] = (0.52, 0.74)
    """Share of the curve between which none was seen."""
    sigma_reading: float = 0.3
    """Of each cone (m)."""
    sigma_bend: float = 1.0
    """Second difference of the control points (m), a weak prior."""
    sigma_anchor: float = 2.0
    """Of each control point (m), a weak prior."""
    samples: int = 2000
    """Splines drawn at random."""


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """A curve with its uncertainty, three ways."""

    boundary: SplineBoundary
    """The curve with the joint covariance of its control points."""
    cones: Array
    """(k, 2) m, what was seen."""
    u: Array
    """(n,) parameters."""
    length: Array
    """(n,) m along the curve."""
    joint: Array
    """(n,) m, sigma across the curve by B Sigma B'."""
    marginals: Array
    """(n,) m, the same by the paper's sum of beta_j^2 Sigma_j."""
    sampled: Array
    """(n,) m, the same of splines drawn at random."""
    curves: Array
    """(s, n, 2) m, those splines."""


def uncertainty(rng: np.random.Generator, scene: UncertaintyScene | None = None) -> Uncertainty:
    """The posterior of a curve that cones hold across itself, and splines drawn at random from it."""
    scene = scene or UncertaintyScene()
    x = scene.spacing * np.arange(scene.control_points)
    points = np.stack([x, scene.swing * np.sin(2.0 * np.pi * x / x[-1])], axis=1)
    spline = BSpline.open_uniform(points, interval=scene.spacing).clamp()
    low, high = spline.domain
    share = (np.arange(scene.cones) + 0.5) / scene.cones
    seen = spline.parameters_at(spline.length() * share[(share < scene.blind[0]) | (share > scene.blind[1])])
    covariance = posterior(spline, seen, scene.sigma_reading, scene.sigma_bend, scene.sigma_anchor)
    u = np.linspace(low, high, 301)
    drawn = rng.multivariate_normal(spline.control_points.ravel(), covariance, scene.samples)
    curves = np.einsum("nm,smd->snd", spline.basis_matrix(u), drawn.reshape(scene.samples, -1, 2))
    normal = _normals(spline, u)
    across = np.einsum("snd,nd->sn", curves - spline.evaluate(u), normal)
    return Uncertainty(
        boundary=SplineBoundary(spline, covariance),
        cones=spline.evaluate(seen),
        u=u,
        length=spline.arc_length(u),
        joint=spline.normal_sigma(u, covariance),
        marginals=marginal_sigma(spline, u, covariance),
        sampled=across.std(axis=0),
        curves=curves,
    )


def marginal_sigma(spline: BSpline, u: Array, covariance: Array) -> Array:
    """sqrt(n' (sum_j beta_j(u)^2 Sigma_j) n) (k,), m: the paper's equation, which has no cross terms."""
    own = covariance * np.kron(np.eye(spline.size), np.ones((2, 2)))
    return spline.normal_sigma(u, own)


def posterior(
    spline: BSpline, seen: Array, sigma_reading: float, sigma_bend: float, sigma_anchor: float
) -> Array:
    """(2m, 2m) m^2: `(R'R / sigma_reading^2 + D'D / sigma_bend^2 + I / sigma_anchor^2)^-1`, sigmas in m.

    R: displacement across the curve at the parameters seen (k,); D: second differences of control points.
    """
    rows = (spline.basis_matrix(seen)[:, :, None] * _normals(spline, seen)[:, None, :]).reshape(len(seen), -1)
    bend = np.kron(smoothness_matrix(greville(spline.knots, spline.degree), None), np.eye(2))
    information = rows.T @ rows / sigma_reading**2 + bend.T @ bend / sigma_bend**2
    return np.asarray(np.linalg.inv(information + np.eye(len(information)) / sigma_anchor**2))


def _normals(spline: BSpline, u: Array) -> Array:
    tangent = spline.tangent_unit(u)
    return np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)


# --- figure ----------------------------------------------------------------------------------------------

_SHOWN = 40
"""Of the splines drawn at random."""
_EVERY = 6
"""Of the parameters at which their spread is marked."""


def plot_uncertainty(data: Uncertainty, style: FigureStyle | None = None) -> Figure:
    """(a) the control points' uncertainty, and the curve's; (b) its sigma across itself, three ways."""
    style = style or FigureStyle()
    with figure_context(style):
        figure = Figure((style.width, 4.6), layout="constrained")
        above, below = figure.subplots(2, 1, height_ratios=(1.55, 1.0))
        _draw_curve(above, data, style)
        below.plot(data.length, data.joint, color=style.curve_color, label="joint covariance, $BΣB^⊤$")
        below.plot(
            data.length,
            data.marginals,
            color=style.other_color,
            linestyle="--",
            label=r"marginals only, $\Sigma_j\, β_j^2 Σ_{C_j}$",
        )
        below.plot(
            data.length[::_EVERY],
            data.sampled[::_EVERY],
            linestyle="none",
            marker=".",
            markersize=style.marker_size,
            color="black",
            label=f"spread of {len(data.curves)} sampled splines",
        )
        below.set_xlim(0.0, data.length[-1])
        below.set_ylim(0.0, 1.25 * float(data.joint.max()))
        below.set_xlabel("length along the curve [m]")
        below.set_ylabel("σ [m]")
        below.legend(loc="upper left", ncols=3, columnspacing=1.4)
        above.set_title("(a) uncertainty of the control points, and of the curve that they make")
        below.set_title("(b) standard deviation across the curve")
    return figure


def _draw_curve(axes: Axes, data: Uncertainty, style: FigureStyle) -> None:
    boundary = data.boundary
    spline = boundary.spline
    for number, curve in enumerate(data.curves[:_SHOWN]):
        label = None if number else "sampled splines"
        axes.plot(*curve.T, color=style.faint_color, linewidth=style.thin_width, zorder=1.5, label=label)
    left, right = uncertainty_band(boundary, data.u)
    for number, edge in enumerate((left, right)):
        label = None if number else "2σ band"
        axes.plot(*edge.T, color=style.curve_color, linewidth=0.8, zorder=3, label=label)
    axes.plot(
        *spline.evaluate(data.u).T,
        color=style.curve_color,
        linewidth=style.curve_width,
        zorder=3,
        label="spline",
    )
    draw_control_points(axes, spline.control_points, style.other_color, style, "control points, 2σ")
    draw_ellipses(axes, spline.control_points, point_blocks(boundary.covariance), style.other_color, style)
    axes.plot(
        *data.cones.T,
        linestyle="none",
        marker="x",
        markersize=style.marker_size,
        color=style.truth_color,
        zorder=5,
        label="cones seen",
    )
    low, high = spline.control_points.min(axis=0), spline.control_points.max(axis=0)
    frame(axes, (low[0] - 3.0, low[1] - 3.0), (high[0] + 3.0, high[1] + 3.0))
    axes.set_ylabel("y [m]")
    axes.legend(loc="upper right", ncols=1)
