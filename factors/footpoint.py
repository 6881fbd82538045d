"""Foot points: the nearest points of a stretch of a spline, by a coarse grid and safeguarded Newton steps."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Final

import numpy as np

from ._kernels import Curves
from .arrays import Array, BoolArray, IntArray
from .bspline import SpanPolynomials

SEARCH_ITERATIONS: Final = 50  # largest number of steps in a bracket; the search ends once all rows converge


@dataclass(frozen=True, eq=False)
class FootPoints:
    """Nearest curve point to each of m points, within a stretch of the curve for each."""

    u: Array  # (m,) parameters, inside the domain; wrapped on a periodic curve
    position: Array  # (m, 2) curve points S(u), in m
    tangent_unit: Array  # (m, 2) in the direction of travel
    normal_unit: Array  # (m, 2) to the left of the direction of travel
    distance: Array  # (m,) `normal_unit . (point - S(u))` in m, positive left of the curve
    interior: BoolArray  # (m,) false at the end of an open curve, and at a limit with nearer points beyond
    basis: Array  # (m, p + 1) basis values at u of the control points `columns`
    span: IntArray  # (m,) knot spans of u, numbered consecutively over several curves
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
    """Find `u_i = argmin |S(u) - p_i|` over u in [u_low_i, u_high_i].

    The minimum is global as far as a grid of step `coarse_step` in u resolves it. control_points (n, 2) are
    unwrapped if the curve is periodic; points (m, 2) are in the same frame, in m. The limits (m,) are clipped
    to the domain of an open curve. On a periodic curve they may cross the seam, and a stretch as long as the
    period has no limits. Finite input gives finite output, also at vanishing tangents, centres of curvature
    and kinks.
    """
    curve = np.zeros(len(points), np.intp)
    search = u_low, u_high, coarse_step, iterations
    return FootPoints(*Curves([tables]).search(control_points, points, curve, *search))
