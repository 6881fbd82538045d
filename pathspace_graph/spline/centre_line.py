"""The centre line between two boundaries: the points that are equally far from both."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.errors import SettingsError
from pathspace_graph.factors.footpoint import FootPoints, refine_foot_points
from pathspace_graph.factors.se2 import left_of

from .bspline import BSpline

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

LEAST_STEP: Final = 0.01
"""Points of the line are at least this far apart (m)."""
MOST_POINTS: Final = 200_000
"""A line has at most this number of fine points, which bounds the memory."""
_FINE_STEP: Final = 0.25
"""The line is found at points that are at most this far apart (m)."""
_SEARCH_STEP: Final = 0.5
"""The points across are searched among samples of the boundaries that are this far apart (m)."""
_CHUNK: Final = 1 << 20
"""At most this number of distances between samples are held in memory at once."""
_SETTLING_STEPS: Final = 6
"""A point is moved to equal distances from both boundaries by this number of Newton steps."""
_RESAMPLINGS: Final = 3
"""The points are spaced evenly by arc length this number of times."""
_SETTLED: Final = 1e-6
"""A point is on the line where its foot points are perpendicular, and its distances equal, to this (m)."""
_LEAST_COSINE: Final = 0.1
"""Boundaries that diverge by more than the angle of this cosine are treated as if it were this one."""
_CROSSING_STEPS: Final = 8
"""The crossing of a normal of the line and a boundary is found by this number of Newton steps."""
_LONGEST: Final = 3.0
"""A centre line that is longer than this many times its boundaries has run astray."""
_LARGEST_GAP: Final = 4.0
"""Neighbours are at most this many mean distances apart; farther ones are on both sides of a break."""
_FEWEST_POINTS: Final = 4
"""A line has at least this number of fine points."""

_NOT_SIDE_BY_SIDE: Final = "expected boundaries side by side, the left one on the left, found none such"


@dataclass(frozen=True, eq=False)
class Stations:
    """Holds points of the centre line with their foot points on both boundaries."""

    points: Array
    """Each point (n, 2), in m, is equally far from both boundaries."""
    left: FootPoints
    """These are the foot points on the left boundary; its distances are negative."""
    right: FootPoints
    """These are the foot points on the right boundary; its distances are positive."""

    def where(self, rows: Bools | NDArray[np.intp] | slice) -> Stations:
        """Returns some of the stations."""
        return Stations(self.points[rows], self.left.where(rows), self.right.where(rows))

    @property
    def tangent(self) -> Array:
        """Returns the unit tangents (n, 2): the line bisects the angle between the boundaries' tangents."""
        return _unit(self.left.tangent_unit + self.right.tangent_unit)

    @property
    def normal(self) -> Array:
        """Returns the unit normals (n, 2) to the left."""
        return left_of(self.tangent)

    @property
    def on_line(self) -> Bools:
        """Returns where (n,) a point is between both boundaries, perpendicular to both and equally far."""
        good = np.abs(self.left.distance + self.right.distance) <= _SETTLED
        good &= (self.left.distance < 0.0) & (self.right.distance > 0.0)
        for foot in (self.left, self.right):
            along = np.einsum("kd,kd->k", self.points - foot.position, foot.tangent_unit)
            good &= np.abs(along) <= _SETTLED
        return np.asarray(good)


@dataclass(frozen=True, eq=False)
class Line:
    """Holds a centre line without its uncertainty: its fine points, and which of them a planner is given."""

    stations: Stations
    """The fine points (k,) are evenly spaced by arc length."""
    arc_length: Array
    """This is the arc length (k,) from the first point, in m."""
    length: float
    """The whole line has this length (m), the way back to the first point included where it is closed."""
    every: int
    """Every so-manyth fine point is a point of the result."""
    closed: bool
    """The line is a loop where this is true."""


def find_line(left: BSpline, right: BSpline, closed: bool, step: float) -> Line:
    """Returns the points that are equally far from both boundaries, `step` (m) apart along the line.

    An open line leads from where both boundaries begin to where both end. A line has a whole number of steps,
    as near to `step` as can be. SettingsError is raised where the step is out of its range, the line
    would be too long, or the boundaries aren't side by side.
    """
    if not LEAST_STEP <= step < np.inf:
        raise SettingsError(f"step: expected a number of at least {LEAST_STEP:g} m, found {step:g}")
    if max(left.length(), right.length()) > MOST_POINTS * min(step, _FINE_STEP):
        raise SettingsError(
            f"expected boundaries of at most {MOST_POINTS * min(step, _FINE_STEP):g} m at this step, "
            f"found {max(left.length(), right.length()):.6g} m"
        )
    every = int(np.ceil(step / _FINE_STEP))
    stations = _in_order(left, right, _first_stations(left, right, closed), closed)
    for _ in range(_RESAMPLINGS):
        lengths = arc_lengths(stations, closed)
        if not lengths[-1] < _LONGEST * max(left.length(), right.length()):
            raise SettingsError(_NOT_SIDE_BY_SIDE)
        count = max(round(lengths[-1] / step), _FEWEST_POINTS) * every
        stations = _resampled(left, right, stations, lengths, count, closed)
    lengths = arc_lengths(stations, closed)
    _check(stations, closed)
    return Line(stations, lengths[: len(stations.points)], float(lengths[-1]), every, closed)


def _check(stations: Stations, closed: bool) -> None:
    """Raises a SettingsError where the line breaks, since the boundaries cross or one runs astray."""
    points = stations.points
    ahead = np.roll(points, -1, axis=0) if closed else np.concatenate([points[1:], points[-1:]])
    gaps = np.linalg.norm(ahead - points, axis=1)
    bad = ~stations.on_line | (gaps > _LARGEST_GAP * gaps.mean())
    if bad.any():
        x, y = points[np.argmax(bad)]
        raise SettingsError(f"{_NOT_SIDE_BY_SIDE} near x = {x:.1f} m, y = {y:.1f} m")


def crossing(spline: BSpline, points: Array, normal: Array, foot: FootPoints) -> tuple[Array, Array]:
    """Returns where the normals of the line through points (n, 2) cross a boundary.

    These are the parameters (n,) and the signed offsets (n,) from the points, positive to the left. A normal
    that doesn't cross the boundary near the foot point has that and its distance in their place.
    """
    tangent = np.column_stack([normal[:, 1], -normal[:, 0]])
    u = foot.u
    for _ in range(_CROSSING_STEPS):
        slope = np.einsum("kd,kd->k", spline.evaluate(u, 1), tangent)
        ahead = np.einsum("kd,kd->k", spline.evaluate(u) - points, tangent)
        u = spline.tables.inside(u - np.divide(ahead, slope, out=np.zeros_like(u), where=slope != 0.0))
    offset = spline.evaluate(u) - points
    across = np.einsum("kd,kd->k", offset, normal)
    good = np.abs(np.einsum("kd,kd->k", offset, tangent)) <= _SETTLED
    good &= np.abs(across) <= np.abs(foot.distance) / _LEAST_COSINE
    good &= np.einsum("kd,kd->k", spline.tangent_unit(u), tangent) >= _LEAST_COSINE
    return np.where(good, u, foot.u), np.where(good, across, -foot.distance)


# --- the first points ------------------------------------------------------------------------------------


def _first_stations(left: BSpline, right: BSpline, closed: bool) -> Stations:
    """Returns stations, in no order, from the points across of samples of each boundary."""
    samples = [_samples(spline) for spline in (left, right)]
    lefts, rights = (spline.evaluate(u) for spline, u in zip((left, right), samples, strict=True))
    tangents = left.tangent_unit(samples[0]), right.tangent_unit(samples[1])
    lengths = left.arc_length(samples[0]), right.arc_length(samples[1])
    # an open map may overlap itself before its loop is closed
    apart = np.inf if closed else 0.5 * min(left.length(), right.length())
    i, j = points_across((lefts, rights), tangents, lengths, apart)
    k, h = points_across((rights, lefts), (-tangents[1], -tangents[0]), lengths[::-1], apart)
    if not len(i) + len(k):
        raise SettingsError(_NOT_SIDE_BY_SIDE)
    on_right, on_left = _refined(right, lefts[i], samples[1][j]), _refined(left, rights[k], samples[0][h])
    middles = 0.5 * np.concatenate([lefts[i] + on_right.position, on_left.position + rights[k]])
    u, v = np.append(samples[0][i], on_left.u), np.append(on_right.u, samples[1][k])
    return _settled(left, right, middles, u, v)


def _samples(spline: BSpline) -> Array:
    """Returns parameters (k,) about evenly spaced by arc length, both ends of the domain included."""
    length = spline.length()
    count = max(int(np.ceil(length / _SEARCH_STEP)), _FEWEST_POINTS)
    return spline.parameters_at(np.linspace(0.0, length, count + 1))


def points_across(
    points: tuple[Array, Array], tangents: tuple[Array, Array], lengths: tuple[Array, Array], apart: float
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Returns the samples of the first curve that have a point across, and that sample of the second curve.

    The point across is the nearest one to the right of the first curve, which is to the left of the second
    and goes the same way. Their arc lengths differ by at most `apart` (m).
    """
    nearest, found = np.zeros(len(points[0]), np.intp), np.zeros(len(points[0]), bool)
    normals = left_of(tangents[0]), left_of(tangents[1])
    own = np.einsum("kd,kd->k", points[0], normals[0])
    other = np.einsum("kd,kd->k", points[1], normals[1])
    rows = max(_CHUNK // len(points[1]), 1)
    for begin in range(0, len(points[0]), rows):
        of = slice(begin, begin + rows)
        square = ((points[0][of, None] - points[1]) ** 2).sum(axis=2)
        good = normals[0][of] @ points[1].T < own[of, None]
        good &= points[0][of] @ normals[1].T > other
        good &= tangents[0][of] @ tangents[1].T > 0.0
        good &= np.abs(lengths[0][of, None] - lengths[1]) <= apart
        nearest[of] = np.where(good, square, np.inf).argmin(axis=1)
        found[of] = good.any(axis=1)
    return np.flatnonzero(found), nearest[found]


def _settled(left: BSpline, right: BSpline, points: Array, u: Array, v: Array) -> Stations:
    """Moves points (n, 2) across the line until they are equally far from both boundaries.

    The foot points are followed downhill from the parameters u and v (n,).
    """
    for _ in range(_SETTLING_STEPS):
        feet = _refined(left, points, u), _refined(right, points, v)
        u, v = feet[0].u, feet[1].u
        normal = _unit(feet[0].normal_unit + feet[1].normal_unit)
        cosine = np.maximum(np.einsum("kd,kd->k", normal, feet[0].normal_unit), _LEAST_COSINE)
        points = points - normal * (0.5 * (feet[0].distance + feet[1].distance) / cosine)[:, None]
    return Stations(points, _refined(left, points, u), _refined(right, points, v))


def _refined(spline: BSpline, points: Array, u: Array) -> FootPoints:
    low, high = (np.full(len(u), end) for end in spline.domain)
    return refine_foot_points(spline.tables, spline.control_points, points, u, low, high)


# --- order and spacing -----------------------------------------------------------------------------------


def _in_order(left: BSpline, right: BSpline, stations: Stations, closed: bool) -> Stations:
    """Returns the stations that are on the line, in the direction of travel: both foot points advance."""
    stations = stations.where(stations.on_line)
    if len(stations.points) < _FEWEST_POINTS:
        raise SettingsError(_NOT_SIDE_BY_SIDE)
    along = left.arc_length(stations.left.u), right.arc_length(stations.right.u)
    order = _turns(along, (left.length(), right.length())) if closed else along[0] + along[1]
    stations = stations.where(np.argsort(order, kind="stable"))
    moved = np.linalg.norm(np.diff(stations.points, axis=0), axis=1) > _SETTLED
    return stations.where(np.append(True, moved))


def _turns(along: tuple[Array, Array], lengths: tuple[float, float]) -> Array:
    """Returns how far round a loop the stations (n,) are, by the arc lengths of both foot points.

    The boundaries begin at different places, by the circular mean of the differences. Without them a station
    has about the same angle on both, so that their seams don't matter.
    """
    angles = [2 * np.pi * s / length for s, length in zip(along, lengths, strict=True)]
    ahead = np.exp(1j * (angles[1] - angles[0]))
    return np.asarray(angles[0] + 0.5 * np.angle(ahead * np.conj(ahead.mean())))


def arc_lengths(stations: Stations, closed: bool) -> Array:
    """Returns the arc length (n,) at each station, in m, and one more (n + 1,) for the way back of a loop.

    Between two stations the line is a circular arc: chord * a / sin a, where the heading turns by 2 a.
    """
    points, tangent = stations.points, stations.tangent
    if closed:
        points, tangent = np.concatenate([points, points[:1]]), np.concatenate([tangent, tangent[:1]])
    cross = tangent[:-1, 0] * tangent[1:, 1] - tangent[:-1, 1] * tangent[1:, 0]
    half = 0.5 * np.arctan2(cross, np.einsum("kd,kd->k", tangent[:-1], tangent[1:]))
    chord = np.linalg.norm(np.diff(points, axis=0), axis=1)
    return np.append(0.0, np.cumsum(chord / np.sinc(half / np.pi)))


def _resampled(
    left: BSpline, right: BSpline, stations: Stations, lengths: Array, count: int, closed: bool
) -> Stations:
    """Returns `count` stations evenly spaced on a closed line, or one more from end to end of an open one."""
    at = np.linspace(0.0, lengths[-1], count + 1)[: count if closed else count + 1]
    u = _interpolated(at, lengths, stations.left.u, left, closed)
    v = _interpolated(at, lengths, stations.right.u, right, closed)
    points = np.concatenate([stations.points, stations.points[:1]]) if closed else stations.points
    between = np.column_stack([np.interp(at, lengths, points[:, d]) for d in range(2)])
    stations = _settled(left, right, between, u, v)
    if closed:
        return stations
    good = np.flatnonzero(stations.on_line)
    if len(good) < _FEWEST_POINTS:
        raise SettingsError(_NOT_SIDE_BY_SIDE)
    return stations.where(slice(good[0], good[-1] + 1))


def _interpolated(at: Array, lengths: Array, u: Array, spline: BSpline, closed: bool) -> Array:
    """Returns the parameters of foot points between those of stations, across the seam of a closed curve."""
    if closed:
        low, high = spline.domain
        u = np.unwrap(np.append(u, u[0]), period=high - low)
        return spline.tables.inside(np.interp(at, lengths, u))
    return np.interp(at, lengths, u)


def _unit(vectors: Array) -> Array:
    norm = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(np.divide(vectors, norm, out=np.zeros_like(vectors), where=norm > 0.0))
