"""A track as a ribbon: one B-spline for its centre line and half its width, and the edges that follow."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.bspline import periodic_knots, scatter, uniform_knots
from pathspace_graph.factors.gauge import greville, smoothness_coefficients, smoothness_matrix
from pathspace_graph.factors.ribbon import RIBBON
from pathspace_graph.factors.se2 import left_of
from pathspace_graph.factors.spans import SpanPolynomials
from pathspace_graph.labels import LEFT, RIGHT

from .bspline import BSpline
from .centre_line import find_line

Array = NDArray[np.float64]

DEGREE: Final = 3
"""A ribbon is cubic."""
SIDE: Final = {LEFT: 1.0, RIGHT: -1.0}
"""The edge of each label is on this side of the centre line."""
_SAMPLE_STEP: Final = 0.5
"""A ribbon is fitted to a centre line, and an edge to a ribbon, at points about this far apart (m)."""
_EDGE_BREAKS: Final = 2
"""An edge has this number of knot intervals for each one of the ribbon, since it is no B-spline itself."""
_FIT_SMOOTHNESS: Final = 1e-3
"""Second differences have this weight in a fit, which decides only what the points leave open."""
_FEWEST: Final = 4
"""A ribbon has at least this number of knot intervals."""


@dataclass(frozen=True, eq=False)
class Ribbon:
    """Holds a ribbon (x, y, h)(u) = sum_j N_j(u) c_j, with C = (x, y) and the edges C + h n and C - h n."""

    knots: Array
    """(n + p + 1,) The knots are those of the parameter u, which is about a length (m) along the line."""
    control_points: Array
    """(n, 3) These are x, y (m, map frame) and half the width h (m); those of a closed ribbon repeat."""
    periodic: bool

    @property
    def size(self) -> int:
        """Returns the number m of distinct control points."""
        return len(self.control_points) - (DEGREE if self.periodic else 0)

    @property
    def distinct(self) -> Array:
        """Returns the distinct control points (m, 3)."""
        return self.control_points[: self.size]

    @cached_property
    def tables(self) -> SpanPolynomials:
        """Returns the basis as polynomials on each span."""
        return SpanPolynomials(self.knots, DEGREE, self.periodic)

    @property
    def centre(self) -> BSpline:
        """Returns the centre line alone."""
        return BSpline(self.knots, self.control_points[:, :2], DEGREE, self.periodic)

    def with_points(self, distinct: Array) -> Ribbon:
        """Returns the ribbon of the same basis with other distinct control points (m, 3)."""
        points = np.concatenate([distinct, distinct[:DEGREE]]) if self.periodic else distinct
        ribbon = replace(self, control_points=points)
        ribbon.__dict__["tables"] = self.tables
        return ribbon

    def basis_matrix(self, u: Array, derivative: int = 0) -> Array:
        """Returns B (k, m) for the distinct control points."""
        return _basis(self.tables, u, self.size, derivative)

    @cached_property
    def bending(self) -> Array:
        """Returns the second differences of the control points j, j + 1 and j + 2, by row (r, 3)."""
        period = self.tables.length if self.periodic else None
        return smoothness_coefficients(greville(self.knots, DEGREE)[: self.size], period)

    @property
    def spacing(self) -> float:
        """Returns the mean distance of neighbouring knots (m)."""
        return self.tables.length / len(self.tables.starts)

    def edge(self, u: Array, side: float) -> tuple[Array, Array]:
        """Returns points (k, 2) of an edge, and their derivatives (k, 2, 3 m) by the control points.

        With dn = -t (n . dC') / |C'|, the derivatives of `C + s h n` by c_j and h_j are
        `beta_j I - s h / |C'| beta'_j t n'` and `s beta_j n`.
        """
        B, slope = self.basis_matrix(u), self.basis_matrix(u, 1)
        at, first = B @ self.distinct, slope @ self.distinct[:, :2]
        speed = np.hypot(first[:, 0], first[:, 1])
        t = first / speed[:, None]
        n = left_of(t)
        half = side * at[:, 2]
        by_control = np.zeros((len(u), 2, self.size, RIBBON))
        by_control[:, 0, :, 0] = by_control[:, 1, :, 1] = B
        turned = (half / speed)[:, None] * slope
        by_control[:, :, :, :2] -= t[:, :, None, None] * turned[:, None, :, None] * n[:, None, None, :]
        by_control[:, :, :, 2] = side * n[:, :, None] * B[:, None, :]
        return at[:, :2] + half[:, None] * n, by_control.reshape(len(u), 2, -1)

    def edge_spline(self, label: int) -> tuple[BSpline, Array]:
        """Returns an edge as a B-spline of m' control points, and their derivatives (2m', 3m).

        It is the least-squares fit to the edge, on twice the knots, at the same parameters. The derivatives
        are by the ribbon's control points.
        """
        low, high, count = self.tables.low, self.tables.high, len(self.tables.starts)
        knots = _knots(np.linspace(low, high, _EDGE_BREAKS * count + 1), self.periodic)
        tables = SpanPolynomials(knots, DEGREE, self.periodic)
        u = _spaced(low, high, _SAMPLE_STEP, self.periodic)
        points, jacobian = self.edge(u, SIDE[label])
        size = len(knots) - DEGREE - 1 - (DEGREE if self.periodic else 0)
        fit = np.linalg.pinv(_basis(tables, u, size))
        distinct = fit @ points
        unwrapped = np.concatenate([distinct, distinct[:DEGREE]]) if self.periodic else distinct
        by_ribbon = np.einsum("ik,kdc->idc", fit, jacobian).reshape(2 * size, -1)
        return BSpline(knots, unwrapped, DEGREE, self.periodic), by_ribbon


def ribbon_between(
    left: BSpline, right: BSpline, closed: bool, spacing: float
) -> tuple[Ribbon, Array, Array]:
    """Returns the ribbon between two boundaries, with knots about `spacing` (m) apart, and two tables.

    Each table (k, 2) leads from the parameter of a boundary, ascending, to that of the ribbon. SettingsError
    is raised where the boundaries are not side by side.
    """
    line = find_line(left, right, closed, _SAMPLE_STEP)
    stations, u = line.stations, line.arc_length
    half = 0.5 * (stations.right.distance - stations.left.distance)
    values = np.column_stack([stations.points, half])
    count = max(round(line.length / spacing), _FEWEST)
    breaks = np.linspace(0.0, line.length, count + 1)
    knots = _knots(breaks, closed)
    blank = Ribbon(knots, np.zeros((len(knots) - DEGREE - 1, RIBBON)), closed)
    B = blank.basis_matrix(u)
    period = line.length if closed else None
    D = smoothness_matrix(greville(knots, DEGREE)[: blank.size], period)
    A = np.concatenate([B, _FIT_SMOOTHNESS * D])
    b = np.concatenate([values, np.zeros((len(D), RIBBON))])
    ribbon = blank.with_points(np.linalg.lstsq(A, b, rcond=None)[0])
    by_left, by_right = (
        _ascending(foot.u, u, spline, line.length if closed else None)
        for foot, spline in ((stations.left, left), (stations.right, right))
    )
    return ribbon, by_left, by_right


def along_ribbon(table: Array, u: Array, boundary: BSpline, ribbon: Ribbon) -> Array:
    """Returns the parameters (k,) of a ribbon beside the parameters u (k,) of one of its boundaries."""
    if ribbon.periodic:
        low, high = boundary.domain
        u = table[0, 0] + np.mod(u - table[0, 0], high - low)
    return np.interp(u, table[:, 0], table[:, 1])


def _ascending(u: Array, at: Array, boundary: BSpline, length: float | None) -> Array:
    """Returns the table (k, 2) of boundary and ribbon parameters, once round and one more where closed."""
    if length is not None:
        low, high = boundary.domain
        u = np.unwrap(np.append(u, u[0]), period=high - low)
        at = np.append(at, length)
        if u[-1] <= u[0]:  # all the way round back to the first one
            u[-1] += high - low
    return np.column_stack([np.maximum.accumulate(u), at])


def _knots(breaks: Array, closed: bool) -> Array:
    if closed:
        return periodic_knots(breaks, DEGREE)
    interval = breaks[1] - breaks[0]
    return uniform_knots(len(breaks) - 1 + DEGREE, DEGREE, interval, breaks[0])


def _spaced(low: float, high: float, step: float, closed: bool) -> Array:
    """Returns evenly spaced parameters, without the last one of a closed curve, which is the first one."""
    count = int(np.ceil((high - low) / step))
    return np.linspace(low, high, count + 1)[: count if closed else None]


def _basis(tables: SpanPolynomials, u: Array, size: int, derivative: int = 0) -> Array:
    values, span = tables.evaluate(u, derivative)
    return scatter(values[derivative], span - DEGREE, size, tables.periodic)
