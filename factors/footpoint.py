"""Foot points: the nearest point of a stretch of a spline, by a coarse grid and safeguarded Newton steps."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Final

import numpy as np

from ._kernels import Curves
from .arrays import Array, BoolArray, IntArray
from .bspline import SpanPolynomials

SEARCH_ITERATIONS: Final = 50  # most steps of a search in a bracket, which ends once all rows have converged
REFINE_ITERATIONS: Final = 2  # Newton steps of a refinement from a known parameter


@dataclass(frozen=True, eq=False)
class FootPoints:
    """Curve point that is nearest to each of m points, within each point's own stretch."""

    u: Array  # (m,) parameters inside the domain; those of a periodic curve are wrapped
    position: Array  # (m, 2) curve points S(u), in m
    tangent_unit: Array  # (m, 2) in the direction of travel
    normal_unit: Array  # (m, 2) to the left of the direction of travel
    distance: Array  # (m,) normal_unit . (point - S(u)), in m: positive left of the curve
    interior: (
        BoolArray  # (m,) false at an open curve's end, and at a limit beyond which the curve comes nearer
    )
    basis: Array  # (m, p + 1) basis values at u, of the control points `columns`
    span: IntArray  # (m,) knot spans of u; the spans of several curves are numbered consecutively
    columns: IntArray  # (m, p + 1) indices of the control points

    def where(self, rows: IntArray | BoolArray | slice) -> FootPoints:
        return FootPoints(*(getattr(self, f.name)[rows] for f in fields(self)))


def foot_points(
    tables: SpanPolynomials,
    control_points: Array,
    points: Array,
    u_low: Array,
    u_high: Array,
    coarse_step: float,
    iterations: int = SEARCH_ITERATIONS,
) -> FootPoints:
    """Return `u_i = argmin |S(u) - p_i|` over u in [u_low_i, u_high_i], and the curve there.

    The minimum is global as far as a coarse grid of step `coarse_step` in u resolves it. control_points
    (n, 2) are unwrapped where the curve is periodic, points (m, 2) are in the same frame, in m. The limits
    (m,) are clipped to the domain of an open curve. On a periodic curve they may run past the seam, and a
    stretch as long as the period has no limits. Finite input gives finite output, also where the tangent
    vanishes, at centres of curvature and at kinks.
    """
    curve = np.zeros(len(points), np.intp)
    alone = Curves([tables])
    return joint_foot_points(alone, control_points, points, curve, u_low, u_high, coarse_step, iterations)


def joint_foot_points(
    curves: Curves,
    control_points: Array,
    points: Array,
    curve: IntArray,
    u_low: Array,
    u_high: Array,
    coarse_step: float,
    iterations: int = SEARCH_ITERATIONS,
) -> FootPoints:
    """Return `foot_points` on several curves; `curve` (m,) is the number of each row's own."""
    search = u_low, u_high, coarse_step, iterations
    return FootPoints(*curves.search(control_points, points, curve, *search))


def refine_joint_foot_points(
    curves: Curves,
    control_points: Array,
    points: Array,
    curve: IntArray,
    u_start: Array,
    u_low: Array,
    u_high: Array,
    iterations: int = REFINE_ITERATIONS,
) -> FootPoints:
    """Return the local minimum of |S(u) - p_i| downhill from u_start, by a few safeguarded Newton steps.

    The arguments are those of `joint_foot_points`. A start (m,) outside its stretch is moved into it first. A
    step is never longer than one mean knot interval, and no row ends farther from the curve than it began.
    """
    search = u_start, u_low, u_high, iterations
    return FootPoints(*curves.refine(control_points, points, curve, *search))
