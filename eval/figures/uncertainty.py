"""Uncertainty along a spline (paper: Representing uncertainty), and what its formula leaves out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pathspace_graph.factors.gauge import greville, smoothness_matrix
from pathspace_graph.io.map import SplineBoundary
from pathspace_graph.spline.bspline import BSpline

from .marks import (
    draw_control_points,
    draw_curve,
    draw_ellipses,
    draw_points,
    normals,
    point_blocks,
    uncertainty_band,
)
from .style import BLUE, DARK, LIGHT, ORANGE, THIN_WIDTH, WIDTH, figure_context, set_frame

Array = NDArray[np.float64]


@dataclass(frozen=True)
class UncertaintyScene:
    """A curve was seen everywhere but on one stretch."""

    spacing: float = 5.5
    """Control points are this far apart (m)."""
    control_points: int = 13
    """The curve has this many control points."""
    swing: float = 6.0
    """The curve swings this far to either side (m)."""
    cones: int = 18
    """This many cones stand along the curve, at equal distances."""
    blind: tuple[float, float] = (0.52, 0.74)
    """No cone was seen between these shares of the curve's length."""
    sigma_detection: float = 0.3
    """A seen cone has this standard deviation across the curve (m)."""
    sigma_bend: float = 1.0
    """Second differences of the control points have a weak prior of this standard deviation (m)."""
    sigma_anchor: float = 2.0
    """Each control point has a weak prior of this standard deviation (m)."""
    samples: int = 2000
    """This many splines are drawn at random."""


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Holds a curve with its standard deviation across itself, computed in three ways."""

    boundary: SplineBoundary
    """This is the curve with the joint covariance of its control points."""
    cones: Array
    """Each row holds the position (x, y) of a seen cone (m)."""
    u: Array
    """These are the parameters (n,) that everything below is computed at."""
    length: Array
    """These are the lengths (n,) along the curve at the parameters (m)."""
    joint: Array
    """The joint covariance, B Sigma B', gives these standard deviations (n,), m."""
    marginals: Array
    """The paper's formula, the sum of beta_j^2 Sigma_j, gives these standard deviations (n,), m."""
    sampled: Array
    """The splines drawn at random have these standard deviations (n,), m."""
    curves: Array
    """These are points (s, n, 2) of the splines drawn at random (m)."""


def uncertainty(rng: np.random.Generator, scene: UncertaintyScene | None = None) -> Uncertainty:
    """Computes the posterior of a curve that cones hold across itself, and draws splines from it."""
    scene = scene or UncertaintyScene()
    x = scene.spacing * np.arange(scene.control_points)
    points = np.stack([x, scene.swing * np.sin(2.0 * np.pi * x / x[-1])], axis=1)
    spline = BSpline.open_uniform(points, interval=scene.spacing).clamp()
    share = (np.arange(scene.cones) + 0.5) / scene.cones
    seen = spline.parameters_at(spline.length() * share[(share < scene.blind[0]) | (share > scene.blind[1])])
    covariance = posterior(spline, seen, scene.sigma_detection, scene.sigma_bend, scene.sigma_anchor)
    u = np.linspace(*spline.domain, 301)
    drawn = rng.multivariate_normal(spline.control_points.ravel(), covariance, scene.samples)
    curves = np.einsum("nm,smd->snd", spline.basis_matrix(u), drawn.reshape(scene.samples, -1, 2))
    across = np.einsum("snd,nd->sn", curves - spline.evaluate(u), normals(spline, u))
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
    """Returns sqrt(n' (sum_j beta_j(u)^2 Sigma_j) n) (k,), m: the paper's formula, without cross terms."""
    own = covariance * np.kron(np.eye(spline.size), np.ones((2, 2)))
    return spline.normal_sigma(u, own)


def posterior(
    spline: BSpline, seen: Array, sigma_detection: float, sigma_bend: float, sigma_anchor: float
) -> Array:
    """Returns `(R'R / sigma_detection^2 + D'D / sigma_bend^2 + I / sigma_anchor^2)^-1` (2m, 2m), m^2.

    R maps control points to the displacement across the curve at the parameters `seen` (k,), and D to second
    differences. The sigmas are in m.
    """
    rows = (spline.basis_matrix(seen)[:, :, None] * normals(spline, seen)[:, None, :]).reshape(len(seen), -1)
    bend = np.kron(smoothness_matrix(greville(spline.knots, spline.degree), None), np.eye(2))
    information = rows.T @ rows / sigma_detection**2 + bend.T @ bend / sigma_bend**2
    return np.asarray(np.linalg.inv(information + np.eye(len(information)) / sigma_anchor**2))


# --- figure ----------------------------------------------------------------------------------------------

_SHOWN: Final = 40
"""This many of the splines drawn at random are shown."""
_EVERY: Final = 6
"""The spread of the samples is marked at every sixth parameter."""


def plot_uncertainty(data: Uncertainty) -> Figure:
    """Draws (a) the uncertainty of control points and curve, (b) its sigma across itself in three ways."""
    with figure_context():
        figure = Figure((WIDTH, 4.6), layout="constrained")
        above, below = figure.subplots(2, 1, height_ratios=(1.55, 1.0))
        _draw_curves(above, data)
        _draw_sigmas(below, data)
        above.set_title("(a) uncertainty of the control points, and of the curve that they make")
        below.set_title("(b) standard deviation across the curve")
    return figure


def _draw_curves(axes: Axes, data: Uncertainty) -> None:
    boundary, spline = data.boundary, data.boundary.spline
    for number, curve in enumerate(data.curves[:_SHOWN]):
        label = None if number else "sampled splines"
        axes.plot(*curve.T, color=LIGHT, linewidth=THIN_WIDTH, zorder=1.5, label=label)
    for number, edge in enumerate(uncertainty_band(boundary, data.u)):
        label = None if number else "2σ band"
        axes.plot(*edge.T, color=BLUE, linewidth=0.8, zorder=3, label=label)
    draw_curve(axes, spline, BLUE, "spline")
    draw_control_points(axes, spline.control_points, ORANGE, "control points, 2σ")
    draw_ellipses(axes, spline.control_points, point_blocks(boundary.covariance), ORANGE)
    draw_points(axes, data.cones, "x", DARK, "cones seen", zorder=5)
    set_frame(axes, spline.control_points.min(axis=0) - 3.0, spline.control_points.max(axis=0) + 3.0)
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    axes.legend(loc="upper right")


def _draw_sigmas(axes: Axes, data: Uncertainty) -> None:
    axes.plot(data.length, data.joint, color=BLUE, label="joint covariance, $BΣB^⊤$")
    marginals = r"marginals only, $\Sigma_j\, β_j^2 Σ_{C_j}$"
    axes.plot(data.length, data.marginals, color=ORANGE, linestyle="--", label=marginals)
    spread = np.stack([data.length, data.sampled], axis=1)[::_EVERY]
    draw_points(axes, spread, ".", "black", f"spread of {len(data.curves)} sampled splines", zorder=2)
    axes.set_xlim(0.0, data.length[-1])
    axes.set_ylim(0.0, 1.25 * float(data.joint.max()))
    axes.set_xlabel("length along the curve [m]")
    axes.set_ylabel("σ [m]")
    axes.legend(loc="upper left", ncols=3)
