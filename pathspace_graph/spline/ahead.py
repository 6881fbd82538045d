"""What lies ahead of a vehicle: the next metres of the track in its own frame, for a controller.

It is the line of `centre_line`, but only its next stretch, and a hundred times faster. All stations are
settled on both boundaries at once, by a few steps of Newton's method.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.errors import SettingsError
from pathspace_graph.factors.se2 import left_of, wrap_angle
from pathspace_graph.labels import BOUNDARIES, LEFT, RIGHT

from .bspline import BSpline
from .centre_line import LEAST_STEP, MOST_POINTS, points_across

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

_SAMPLE_STEP: Final = 1.0
"""The points across are searched among samples of the boundaries that are this far apart (m)."""
_BEHIND: Final = 3.0
"""The samples begin this far behind the vehicle (m), since it may stand askew."""
_OUTER: Final = 1.8
"""The outer boundary of a turn is at most this number of times as long as the centre line."""
_SETTLING_STEPS: Final = 8
"""The stations are settled by at most this number of Newton steps; mostly two are enough."""
_SETTLED: Final = 1e-3
"""A station is on the line where its distances are equal, and its foot points perpendicular, to this (m)."""
_LARGEST_GAP: Final = 2.0
"""Neighbours are at most this many steps apart."""


@dataclass(frozen=True, eq=False)
class CurveAhead:
    """Holds a boundary, and where the vehicle is on it."""

    spline: BSpline
    """The curve is in the map frame, in the direction of travel; its parameter is about a length in m."""
    beside: float
    """The vehicle's foot point is at about this parameter."""
    confirmed_until: float = np.inf
    """The curve is confirmed up to this parameter; beyond, it is tentative. A closed one is confirmed."""

    def is_confirmed(self, u: Array) -> Bools:
        """Returns where (n,) the curve is confirmed."""
        return (u <= self.confirmed_until) | self.spline.periodic


@dataclass(frozen=True, eq=False)
class TrackAhead:
    """Holds the next stretch of the track in the vehicle's frame (x forward, y left, m and rad).

    The centre line has n points: n is 0 where only one boundary is known, and smaller than what was asked for
    where the map ends. Each point is equally far from both boundaries.
    """

    points: Array
    """These are the points (n, 2) in m; the first one is beside the vehicle."""
    heading: Array
    """This is the direction of travel (n,) in rad from that of the vehicle, in (-pi, pi]."""
    curvature: Array
    """This is the curvature (n,) in 1/m, positive in a left turn."""
    arc_length: Array
    """This is the length (n,) of the line from its first point, in m."""
    width_left: Array
    """This is the distance (n,) along the normal to the left boundary, in m."""
    width_right: Array
    """This is the distance (n,) along the normal to the right boundary, in m."""
    confirmed: Bools
    """A point (n,) is confirmed where both boundaries are; another one may be taken back."""
    left: Array
    """These are points (k, 2) of the left boundary from beside the vehicle on, in m."""
    right: Array
    """These are points (h, 2) of the right boundary from beside the vehicle on, in m."""

    @property
    def closed(self) -> bool:
        """Returns false: what is ahead is a stretch, also of a closed track."""
        return False

    @property
    def length(self) -> float:
        """Returns how far the centre line is known, in m."""
        return float(self.arc_length[-1]) if len(self.arc_length) else 0.0


def track_ahead(curves: Mapping[int, CurveAhead], pose: Array, distance: float, step: float) -> TrackAhead:
    """Returns the next `distance` metres of a track from a pose (x, y, theta), at points `step` (m) apart.

    `curves` are the boundaries by label, as far as they are known. SettingsError is raised where a length is
    out of its range.
    """
    if not 0.0 < distance < np.inf:
        raise SettingsError(f"distance: expected a positive number (m), found {distance:g}")
    if not LEAST_STEP <= step < np.inf or distance > MOST_POINTS * step:
        least = max(LEAST_STEP, distance / MOST_POINTS)
        raise SettingsError(f"step: expected a number of at least {least:g} m, found {step:g}")
    samples = {label: _Samples.of(curve, distance) for label, curve in curves.items()}
    sides = [
        _in_frame(samples[label].beside(distance), pose) if label in samples else np.zeros((0, 2))
        for label in BOUNDARIES
    ]
    line = _first_line(samples[LEFT], samples[RIGHT]) if len(samples) == len(BOUNDARIES) else None
    if line is None or len(line.u) < 2:
        none = np.zeros(0)
        return TrackAhead(
            np.zeros((0, 2)), none, none, none, none, none, none > 0.0, sides[LEFT], sides[RIGHT]
        )
    line = _from_beside(line, pose[:2], distance, step)
    return _settled(curves[LEFT], curves[RIGHT], line, pose, step, sides)


# --- the first line --------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Samples:
    """Holds points (n, 2) of a boundary and its tangents, at parameters (n,) that are evenly spaced."""

    u: Array
    points: Array
    tangents: Array
    ahead: Array
    """(n,) These parameters are counted from beside the vehicle."""

    @classmethod
    def of(cls, curve: CurveAhead, distance: float) -> _Samples:
        """Returns samples from behind the vehicle to where the curve is no longer needed."""
        low, high = curve.spline.domain
        begin, end = curve.beside - _BEHIND, curve.beside + _OUTER * distance + _BEHIND
        if curve.spline.periodic:
            end = min(end, begin + (high - low))  # at most once round
        else:
            begin, end = max(begin, low), min(end, high)
        u = np.linspace(begin, max(end, begin), max(int((end - begin) / _SAMPLE_STEP), 0) + 1)
        points, tangents = _derivatives(curve.spline, u, 1)
        return cls(u, points, tangents, u - curve.beside)

    def along(self, points: Array, rows: NDArray[np.intp]) -> Array:
        """Returns how far (k,) in the parameter the foot points of points (k, 2) are ahead of samples."""
        tangents = self.tangents[rows]
        return _dot(points - self.points[rows], tangents) / _dot(tangents, tangents)

    def beside(self, distance: float) -> Array:
        """Returns the points (k, 2) from beside the vehicle on, along a distance (m)."""
        along = self.points[self.ahead >= 0.0]
        return np.asarray(along[np.cumsum(_distances(along)) <= distance + _SETTLED])


@dataclass(frozen=True, eq=False)
class _Line:
    """Holds points (n, 2) near the centre line, with the parameters (n,) of their foot points."""

    points: Array
    u: Array
    v: Array


def _first_line(left: _Samples, right: _Samples) -> _Line:
    """Returns the middles between samples of each boundary and the points across, in the order of travel."""
    u, v, lefts, rights = left.u, right.u, left.points, right.points
    along = left.ahead, right.ahead
    apart = 0.5 * min(u[-1] - u[0], v[-1] - v[0])  # a loop must not be paired across its ends
    i, j = points_across((lefts, rights), (left.tangents, right.tangents), along, apart)
    k, h = points_across((rights, lefts), (-right.tangents, -left.tangents), along[::-1], apart)
    own, other = np.concatenate([i, h]), np.concatenate([j, k])
    order = np.argsort(u[own] + v[other], kind="stable")
    own, other = own[order], other[order]
    forward = np.append(True, (np.diff(u[own]) >= 0.0) & (np.diff(v[other]) >= 0.0))
    own, other = own[forward], other[forward]
    points = 0.5 * (lefts[own] + rights[other])
    apart = np.append(True, _distances(points)[1:] > _SETTLED)
    own, other, points = own[apart], other[apart], points[apart]
    return _Line(points, u[own] + left.along(points, own), v[other] + right.along(points, other))


def _from_beside(line: _Line, position: Array, distance: float, step: float) -> _Line:
    """Returns the line at even steps, from the point beside a position (2,) on."""
    edges = np.diff(line.points, axis=0)
    squares = np.einsum("kd,kd->k", edges, edges)
    offset = position - line.points[:-1]
    share = np.minimum(np.maximum(np.einsum("kd,kd->k", offset, edges) / squares, 0.0), 1.0)
    away = offset - share[:, None] * edges
    nearest = int(np.einsum("kd,kd->k", away, away).argmin())
    lengths = np.append(0.0, np.cumsum(np.sqrt(squares)))
    begin = lengths[nearest] + share[nearest] * (lengths[nearest + 1] - lengths[nearest])
    count = int(min(distance, lengths[-1] - begin) / step + _SETTLED)
    at = begin + step * np.arange(count + 1)
    x, y, u, v = (np.interp(at, lengths, values) for values in (*line.points.T, line.u, line.v))
    return _Line(np.column_stack([x, y]), u, v)


# --- on both boundaries ----------------------------------------------------------------------------------


def _settled(
    left: CurveAhead, right: CurveAhead, line: _Line, pose: Array, step: float, sides: Sequence[Array]
) -> TrackAhead:
    """Returns the track ahead at the points of the line, moved along its normals to equal distances.

    With the foot point S(u) of c, F = S'(u) . (c - S(u)) vanishes; the signed distance is N . (c - S(u)).
    """
    points, feet = line.points, (_Foot(left.spline, line.u), _Foot(right.spline, line.v))
    for _ in range(_SETTLING_STEPS):
        both = feet[0].normal + feet[1].normal
        normal = both / np.linalg.norm(both, axis=1, keepdims=True)
        moved = -(feet[0].distance(points) + feet[1].distance(points)) / _dot(both, normal)
        feet = feet[0].refined(points, normal, moved), feet[1].refined(points, normal, moved)
        points = points + moved[:, None] * normal
        distances = -feet[0].distance(points), feet[1].distance(points)
        off = np.abs(distances[1] - distances[0]) + sum(np.abs(foot.along(points)) for foot in feet)
        if off.max() <= _SETTLED:
            break
    good = (off <= _SETTLED) & (distances[0] > 0.0) & (distances[1] > 0.0)
    good &= _distances(points) <= _LARGEST_GAP * step
    both = feet[0].tangent + feet[1].tangent
    tangent = both / np.linalg.norm(both, axis=1, keepdims=True)
    cosine = _dot(tangent, feet[0].tangent)
    bend = 0.5 * cosine * (feet[0].offset_curvature(points) + feet[1].offset_curvature(points))
    turned = np.arctan2(tangent[:, 1], tangent[:, 0]) - pose[2]
    widths = [foot.width(points, tangent) for foot in feet]
    confirmed = left.is_confirmed(feet[0].u) & right.is_confirmed(feet[1].u)
    n = len(good) if good.all() else int(good.argmin())
    return TrackAhead(
        points=_in_frame(points[:n], pose),
        heading=wrap_angle(turned[:n]),
        curvature=bend[:n],
        arc_length=_lengths(points[:n], turned[:n]),
        width_left=widths[0][:n],
        width_right=widths[1][:n],
        confirmed=confirmed[:n],
        left=sides[LEFT],
        right=sides[RIGHT],
    )


class _Foot:
    """Holds a boundary at the foot points (n,) of stations."""

    def __init__(self, spline: BSpline, u: Array) -> None:
        self.spline, self.u = spline, u
        self.position, self.first, self.second = _derivatives(spline, u, 2)
        self.speed = np.sqrt(_dot(self.first, self.first))
        self.tangent = self.first / self.speed[:, None]
        self.normal = left_of(self.tangent)

    def distance(self, points: Array) -> Array:
        """Returns the signed distances (n,) of points (n, 2), positive to the left."""
        return _dot(self.normal, points - self.position)

    def along(self, points: Array) -> Array:
        """Returns how far points (n, 2) are ahead of their foot points, in m."""
        return _dot(self.tangent, points - self.position)

    def refined(self, points: Array, normal: Array, moved: Array) -> _Foot:
        """Returns the foot points of points (n, 2), moved along the normals, after a Newton step."""
        offset = points - self.position
        slope = _dot(self.first, offset) + moved * _dot(self.first, normal)
        bend = self.speed**2 - _dot(self.second, offset)
        return _Foot(self.spline, self.u + slope / np.where(bend > 0.0, bend, self.speed**2))

    def offset_curvature(self, points: Array) -> Array:
        """Returns k / (1 - k d) (n,), the curvature of the parallel curve through each point."""
        curvature = _dot(left_of(self.first), self.second) / self.speed**3
        spread = 1.0 - curvature * self.distance(points)
        return np.asarray(np.divide(curvature, spread, out=np.zeros_like(spread), where=spread != 0.0))

    def width(self, points: Array, tangent: Array) -> Array:
        """Returns how far (n,) along the normals of the line the boundary is, by two Newton steps."""
        ahead = _dot(self.position - points, tangent) / _dot(self.first, tangent)
        position, first = _derivatives(self.spline, self.u - ahead, 1)
        rest = _dot(position - points, tangent) / _dot(first, tangent)
        return np.abs(_dot(position - rest[:, None] * first - points, left_of(tangent)))


def _derivatives(spline: BSpline, u: Array, orders: int) -> Array:
    """Returns S(u) and its derivatives up to an order (orders + 1, n, 2)."""
    values, span = spline.tables.evaluate(u, orders)
    columns = span[:, None] + np.arange(-spline.degree, 1)
    return np.asarray(np.einsum("rkj,kjd->rkd", values, spline.control_points[columns]))


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(np.einsum("kd,kd->k", a, b))


def _distances(points: Array) -> Array:
    """Returns the distance (n,) of each point from the one before, and 0 for the first."""
    edges = np.diff(points, axis=0, prepend=points[:1])
    return np.asarray(np.hypot(edges[:, 0], edges[:, 1]))


def _lengths(points: Array, heading: Array) -> Array:
    """Returns the arc length (n,) at points (n, 2), which are joined by circular arcs."""
    half = 0.5 * wrap_angle(np.diff(heading, prepend=heading[:1]))
    return np.asarray(np.cumsum(_distances(points) / np.sinc(half / np.pi)))


def _in_frame(points: Array, pose: Array) -> Array:
    """Returns points (n, 2) of the map frame in the frame of a pose (3,)."""
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    return np.asarray((points - pose[:2]) @ np.array([[cos, -sin], [sin, cos]]))
