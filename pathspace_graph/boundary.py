"""A boundary of the track as the mapper holds it: a spline that grows, and then closes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.bspline import SpanPolynomials
from pathspace_graph.factors.footpoint import FootPoints, foot_points, refine_foot_points
from pathspace_graph.factors.gauge import greville, smoothness_matrix
from .spline import BSpline
from .settings import GaugeSettings, SplineSettings

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]

FIT_SMOOTHNESS = 0.1
"""Weight of second differences when new control points are placed through sightings."""


class Boundary:
    """Knots, and what follows from them; the control points are entries of the mapper's state.

    An open boundary has uniform, floating knots whose interval is the spacing of its control points, so that the
    parameter is roughly a length in metres, from 0 at the first sighting.
    """

    def __init__(self, knots: Array, degree: int, periodic: bool, gauge: GaugeSettings) -> None:
        self.degree = degree
        self.periodic = periodic
        self.gauge = gauge
        self.confirmed = 0.0
        """Parameter up to which sightings hold the curve; beyond it is extrapolated."""
        self.sighted: list[Array] = []
        """Every distinct sighting that the curve was led through, (2,), map frame."""
        self._set_knots(knots)

    def _set_knots(self, knots: Array) -> None:
        self.tables = SpanPolynomials(knots, self.degree, self.periodic)
        n = len(knots) - self.degree - 1
        self.size = n - self.degree if self.periodic else n
        """Distinct control points."""
        self.abscissae = greville(knots, self.degree)[: self.size]
        period = self.length if self.periodic else None
        following = (
            np.append(self.abscissae[1:], self.abscissae[0] + self.length)
            if self.periodic
            else self.abscissae[1:]
        )
        self.nominal = following - self.abscissae[: len(following)]
        """Nominal distance to the next control point, m."""
        smooth = smoothness_matrix(self.abscissae, period)
        spacing = float(np.mean(self.nominal))
        scaled = smooth / (self.gauge.sigma_smoothness * spacing)
        hessian = scaled.T @ scaled + np.eye(self.size) / self.gauge.sigma_anchor**2
        self.smooth_only = np.kron(scaled.T @ scaled, np.eye(2))
        self.gauge_hessian = np.kron(hessian, np.eye(2))
        """Constant part of the normal equations of its control points: smoothness and anchor."""

    @property
    def knots(self) -> Array:
        return self.tables.knots

    @property
    def length(self) -> float:
        """Length of the domain, in parameter units (about metres)."""
        return self.tables.high - self.tables.low

    def extended(self, control_points: Array) -> Array:
        """Control points (n, 2) as the kernels take them: unwrapped where periodic."""
        return (
            np.concatenate([control_points, control_points[: self.degree]])
            if self.periodic
            else control_points
        )

    def columns(self, span: IntArray) -> IntArray:
        """(m, degree + 1) control points that matter on each span."""
        columns = span[:, None] - self.degree + np.arange(self.degree + 1)
        return columns % self.size if self.periodic else columns

    def spline(self, control_points: Array) -> BSpline:
        """The curve as users have it."""
        return BSpline(self.knots, self.extended(control_points), self.degree, self.periodic)

    def find(self, control_points: Array, points: Array, low: Array, high: Array) -> FootPoints:
        """Foot points of points (m, 2) in their stretches, searched for globally."""
        return foot_points(self.tables, self.extended(control_points), points, low, high, 1.0, 4)

    def refine(self, control_points: Array, points: Array, u: Array, room: float) -> FootPoints:
        """Foot points of points (m, 2) near the parameters they had."""
        low, high = u - room, u + room
        if not self.periodic:
            high = np.minimum(high, self.confirmed + 0.5)
        return refine_foot_points(self.tables, self.extended(control_points), points, u, low, high, 1)

    def evaluate(self, control_points: Array, u: Array, derivative: int = 0) -> Array:
        """S(u) or a derivative, (m, 2)."""
        values, span = self.tables.evaluate(np.asarray(u, float), derivative)
        return np.einsum("mj,mjd->md", values[derivative], control_points[self.columns(span)])

    def grow(self, control_points: Array, targets_u: Array, targets: Array, spacing: float) -> Array:
        """Append control points until the domain holds all `targets_u`, bent so that the curve meets `targets` (k, 2).

        No basis function of the old curve changes; the old control points that act only beyond `confirmed` are
        placed anew with the new ones. Gives all control points (n', 2).
        """
        old = len(control_points)
        missing = int(np.ceil((targets_u.max() - self.tables.high) / spacing - 1e-9))
        if missing > 0:
            last = self.knots[-1] + spacing * np.arange(1, missing + 1)
            self._set_knots(np.concatenate([self.knots, last]))
        kept = max(int(np.searchsorted(self.knots[:old], self.confirmed - 1e-9)) - 1, 0) if old else 0
        kept = min(kept, old)
        return self._place(control_points, kept, targets_u, targets)

    def _place(self, control_points: Array, kept: int, targets_u: Array, targets: Array) -> Array:
        """Least squares of the control points from index `kept` on, through targets and the kept stretch."""
        held_u = (
            np.linspace(max(self.confirmed - self.nominal[0], 0.0), self.confirmed, 4)
            if len(control_points)
            else np.zeros(0)
        )
        held = self._held(control_points, held_u)
        u = np.concatenate([held_u, targets_u])
        values, span = self.tables.evaluate(u)
        design = np.zeros((len(u), self.size))
        np.put_along_axis(design, span[:, None] - self.degree + np.arange(self.degree + 1), values[0], axis=1)
        smooth = FIT_SMOOTHNESS * smoothness_matrix(self.abscissae, None)
        matrix = np.concatenate([design, smooth])
        right = np.concatenate([held, targets, np.zeros((len(smooth), 2))])
        right = right - matrix[:, :kept] @ control_points[:kept]
        free = np.linalg.lstsq(matrix[:, kept:], right, rcond=None)[0]
        return np.concatenate([control_points[:kept], free])

    def _held(self, control_points: Array, u: Array) -> Array:
        if len(u) == 0:
            return np.zeros((0, 2))
        values, span = self.tables.evaluate(u)
        columns = np.minimum(self.columns(span), len(control_points) - 1)
        return np.einsum("mj,mjd->md", values[0], control_points[columns])


def open_boundary(settings: SplineSettings, gauge: GaugeSettings) -> Boundary:
    """An open boundary of one span, from parameter 0 to the spacing."""
    p = settings.degree
    knots = settings.spacing * np.arange(-p, p + 2, dtype=float)
    return Boundary(knots, p, False, gauge)
