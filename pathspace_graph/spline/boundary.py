"""A boundary of the track as the mapper holds it: a spline that grows, and then closes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.footpoint import FootPoints, joint_foot_points, refine_foot_points
from pathspace_graph.factors.gauge import greville, smoothness_coefficients, smoothness_matrix
from pathspace_graph.factors.spans import SpanPolynomials, Spans, lay_out
from pathspace_graph.settings.mapper import GaugeSettings, SplineSettings

from .bspline import BSpline

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]

ROUND_OFF = 1e-9
"""Parameters (m) this near to a knot are on it."""
SAME_DIRECTION = 0.5
"""Cosine of the largest angle between a vehicle's heading and the direction of the curve beside it."""


@dataclass(frozen=True, eq=False)
class Gauge:
    """Weak priors between the control points of a stretch, by their indices."""

    points: IntArray
    """(k,) the control points, in driving order."""
    pairs: IntArray
    """(r, 2) each and the next."""
    nominal: Array
    """(r,) nominal distance of these, m."""
    triples: IntArray
    """(t, 3) three in a row."""
    bending: Array
    """(t, 3) coefficients of their second difference in sigmas (1/m)."""


class Boundary:
    """Knots, and what follows from them; the control points are variables of the graph.

    An open boundary has uniform, floating knots whose interval is the spacing of its control points, so that
    the parameter is roughly a length in metres, from 0 at the first sighting.
    """

    def __init__(
        self, knots: Array, periodic: bool, settings: SplineSettings, gauge: GaugeSettings, first: int = 0
    ) -> None:
        self.first = first
        """Number of the first control point's key: new knots make new keys."""
        self.settings = settings
        self.gauge = gauge
        self.degree = settings.degree
        self.periodic = periodic
        self.confirmed_end = 0.0
        """Parameter up to which sightings hold the curve; beyond it is extrapolated."""
        self.observed: list[Array] = []
        """Every distinct sighting that the curve was led through, (2,), map frame, ..."""
        self.cone_parameters: list[float] = []
        """... and at which parameter."""
        self._set_tables(SpanPolynomials(knots, self.degree, periodic))

    def _set_tables(self, tables: SpanPolynomials) -> None:
        self.tables, knots = tables, tables.knots
        n = len(knots) - self.degree - 1
        self.size = n - self.degree if self.periodic else n
        """Distinct control points."""
        self.abscissae = greville(knots, self.degree)[: self.size]
        """(m,) where each control point acts, in parameter units."""
        following = self.abscissae[1:]
        if self.periodic:
            following = np.append(following, self.abscissae[0] + self.length)
        self.nominal = following - self.abscissae[: len(following)]
        """Nominal distance to the next control point, m."""
        self.everything = np.arange(self.size)
        """(m,) indices of all control points."""
        self._gauge: Gauge | None = None

    def gauge_on(self, points: IntArray) -> Gauge:
        """The gauge between control points (k,), in driving order; the last one asked for is kept."""
        if self._gauge is None or self._gauge.points is not points:
            self._gauge = self._new_gauge(points)
        return self._gauge

    def _new_gauge(self, points: IntArray) -> Gauge:
        """`D / (sigma_smoothness spacing)`, and the neighbours to keep apart."""
        whole = self.periodic and len(points) == self.size
        abscissae = self.abscissae[points]
        abscissae = abscissae + self.length * (abscissae < abscissae[:1])  # a stretch past the seam
        spacing = float(np.mean(self.nominal))
        bending = smoothness_coefficients(abscissae, self.length if whole else None, spacing)
        first = points if whole else points[:-1]
        return Gauge(
            points=points,
            pairs=np.stack([first, (first + 1) % self.size], axis=1),
            nominal=self.nominal[first],
            triples=(points[: len(bending), None] + np.arange(3)) % self.size,
            bending=bending / (self.gauge.sigma_smoothness * spacing),
        )

    @property
    def numbers(self) -> IntArray:
        """(m,) numbers of the control points' keys."""
        return self.first + self.everything

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
        s, spans = self.settings, self._spans_from(float(np.min(low, initial=np.inf)))
        alone, search = np.zeros(len(points), np.intp), (s.search_step, s.search_iterations)
        return joint_foot_points(spans, control_points, points, alone, low, high, *search)

    def _spans_from(self, u: float) -> Spans:
        """The curve's spans; of an open one those from u on, since the others are not looked at."""
        first = 0 if self.periodic else int(self.tables.locate(np.array([u]))[0][0])
        return lay_out([self.tables.tail(first) if first else self.tables], [first], [self.size])

    def refine(self, control_points: Array, points: Array, u: Array) -> FootPoints:
        """Foot points of points (m, 2) near the parameters (m,) they had."""
        s = self.settings
        low, high = u - s.refine_room, self.believed(u + s.refine_room)
        unwrapped = self.extended(control_points)
        return refine_foot_points(self.tables, unwrapped, points, u, low, high, s.refine_iterations)

    @property
    def trusted(self) -> float:
        """Parameter up to which the curve is believed: what an open one only extrapolates isn't."""
        return np.inf if self.periodic else self.confirmed_end + self.settings.confirmed_margin

    def believed(self, high: Array) -> Array:
        """Upper limits of stretches, (m,), kept off what an open curve only extrapolates."""
        return np.minimum(high, self.trusted)

    def evaluate(self, control_points: Array, u: Array, derivative: int = 0) -> Array:
        """S(u) or a derivative, (m, 2)."""
        values, span = self.tables.evaluate(np.asarray(u, float), derivative)
        return np.asarray(np.einsum("mj,mjd->md", values[derivative], control_points[self.columns(span)]))

    def closed(self, knots: Array) -> Boundary:
        """The boundary on periodic knots, all of it confirmed, with control points of new keys."""
        boundary = Boundary(knots, True, self.settings, self.gauge, self.first + self.size)
        boundary.confirmed_end = boundary.tables.high
        return boundary

    def grow(self, control_points: Array, targets_u: Array, targets: Array) -> Array:
        """Append control points until the domain holds `targets_u` (k,); bend the end to `targets` (k, 2).

        No basis function of the old curve changes; the old control points that act only beyond `confirmed`
        are placed anew with the new ones. Gives all control points (n', 2); the last target is `confirmed`
        now.
        """
        old, spacing = len(control_points), self.settings.spacing
        missing = int(np.ceil((targets_u[-1] - self.tables.high) / spacing - ROUND_OFF))
        if missing > 0:
            last = self.knots[-1] + spacing * np.arange(1, missing + 1)
            self._set_tables(self.tables.extended(np.concatenate([self.knots, last])))
        placed = self._place(control_points, self.settled(old), targets_u, targets)
        self.confirmed_end = float(targets_u[-1])
        return placed

    def settled(self, size: int) -> int:
        """How many of the first `size` control points act before `confirmed`."""
        return max(int(np.searchsorted(self.knots[:size], self.confirmed_end - ROUND_OFF)) - 1, 0)

    def take_back(self, kept: int) -> None:
        """Only the first `kept` sightings hold the curve."""
        self.confirmed_end = self.cone_parameters[kept - 1]
        del self.observed[kept:], self.cone_parameters[kept:]

    def _place(self, control_points: Array, kept: int, targets_u: Array, targets: Array) -> Array:
        """Least squares of the control points from index `kept` on, through targets and the kept stretch."""
        held_u = np.zeros(0)
        if len(control_points):
            start = max(self.confirmed_end - self.nominal[0], 0.0)
            held_u = np.linspace(start, self.confirmed_end, self.settings.fit_held)
        held = self._held(control_points, held_u)
        values, span = self.tables.evaluate(np.concatenate([held_u, targets_u]))
        columns = self.columns(span)
        first = max(min(int(columns.min()), kept - 2), 0)  # no row before it has a column that is free
        smooth = self.settings.fit_smoothness * smoothness_matrix(self.abscissae[first:], None)
        design = np.zeros((len(span), self.size - first))
        np.put_along_axis(design, columns - first, values[0], axis=1)
        matrix = np.concatenate([design, smooth])
        right = np.concatenate([held, targets, np.zeros((len(smooth), 2))])
        right = right - matrix[:, : kept - first] @ control_points[first:kept]
        free = np.linalg.lstsq(matrix[:, kept - first :], right, rcond=None)[0]
        return np.concatenate([control_points[:kept], free])

    def _held(self, control_points: Array, u: Array) -> Array:
        """(k, 2) the old curve at u (k,), by the old control points (n, 2) alone."""
        if len(u) == 0:
            return np.zeros((0, 2))
        values, span = self.tables.evaluate(u)
        columns = np.minimum(self.columns(span), len(control_points) - 1)
        return np.asarray(np.einsum("mj,mjd->md", values[0], control_points[columns]))


def open_boundary(settings: SplineSettings, gauge: GaugeSettings) -> Boundary:
    """An open boundary of one span, from parameter 0 to the spacing."""
    p = settings.degree
    knots = settings.spacing * np.arange(-p, p + 2, dtype=float)
    return Boundary(knots, False, settings, gauge)


def relocate(boundary: Boundary, control_points: Array, pose: Array, room: float) -> float:
    """Parameter of the nearest point that runs the way of a pose (3,), to 60 degrees.

    Anywhere on a closed curve. On an open one, which grows with the vehicle, on its last `room` metres, and
    its end where nothing there runs that way.
    """
    low, high = boundary.tables.low, boundary.tables.high
    if not boundary.periodic:
        low, high = max(low, boundary.confirmed_end - room), float(boundary.believed(np.array(high)))
    u = np.append(np.arange(low, high, boundary.settings.search_step), high)
    offset = boundary.evaluate(control_points, u) - pose[:2]
    tangent = boundary.evaluate(control_points, u, 1)
    along = tangent @ np.array([np.cos(pose[2]), np.sin(pose[2])])
    same_direction = along > SAME_DIRECTION * np.hypot(tangent[:, 0], tangent[:, 1])
    if not same_direction.any():
        return high
    distance = np.where(same_direction, np.hypot(offset[:, 0], offset[:, 1]), np.inf)
    start = u[np.argmin(distance)]
    return float(boundary.refine(control_points, pose[None, :2], np.array([start])).u[0])
