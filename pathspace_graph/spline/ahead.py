"""The next metres of the track in the vehicle frame, for a controller.

The line is that of `centre_line`, computed a hundred times faster: each boundary is sampled once, and
approximated by its osculating circle near each sample.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import ClassVar, Final

import numpy as np

from pathspace_graph.errors import SettingsError
from pathspace_graph.factors.arrays import Array, BoolArray
from pathspace_graph.factors.bspline import SpanPolynomials
from pathspace_graph.factors.se2 import left_of, to_vehicle, wrap_angle
from pathspace_graph.labels import BOUNDARIES, LEFT, RIGHT

from .bspline import dot
from .centre_line import points_across

LEAST_STEP: Final = 0.01  # least distance of the points of a line (m)
MOST_POINTS: Final = 200_000  # largest number of points of a line; bounds the memory
_AHEAD_STEP: Final = 0.5  # distance of the samples of a boundary (m); keeps the circle's error below a mm
_ACROSS_STRIDE: Final = 2  # stride of the samples among which points across are searched
_SAMPLES_BEHIND: Final = 3.0  # distance of the first sample behind the vehicle (m), which may stand askew
_OUTER_LENGTH: Final = 1.8  # largest length of a turn's outer boundary, relative to the centre line
_SETTLING_STEPS: Final = 8  # largest number of Newton steps of the stations; two are mostly enough
_LINE_SETTLED: Final = 1e-3  # largest difference of the distances from both boundaries on the line (m)
_LARGEST_GAP: Final = 2.0  # largest distance of neighbours, in steps


@dataclass(frozen=True, eq=False)
class CurveAhead:
    """A boundary in the direction of travel, and the vehicle's place on it."""

    tables: SpanPolynomials  # basis; its parameter is about a length in m
    control_points: Array  # (n, 2) in m, map frame; unwrapped if the curve is closed
    beside: float  # parameter near the vehicle's foot point
    until: float = np.inf  # parameter up to which an open curve is confirmed
    tentative: Array | None = None
    """(k, 2) Points through which the boundary may continue from its end (m, map frame)."""
    confirmed: bool = True  # whether the curve can no longer be taken back


@dataclass(frozen=True, eq=False, repr=False)
class TrackAhead:
    """The next stretch of the track in the vehicle's frame (x forward, y left, m and rad).

    The centre line has n points, each equally far from both boundaries. It has none if only one boundary is
    known, and fewer than requested if the map ends before.
    """

    points: Array
    """Points (n, 2) in m; the first one is beside the vehicle."""
    heading: Array
    """Direction of travel (n,) in rad, relative to the vehicle's heading, in (-pi, pi]."""
    curvature: Array
    """Curvature (n,) in 1/m, positive in a left turn."""
    arc_length: Array
    """Length (n,) of the line from its first point, in m."""
    width_left: Array
    """Distance (n,) along the normal to the left boundary, in m."""
    width_right: Array
    """Distance (n,) along the normal to the right boundary, in m."""
    confirmed: BoolArray
    """Whether both boundaries are confirmed at each point (n,); other points may still change."""
    left: Array
    """Points (k, 2) of the left boundary from beside the vehicle on, in m."""
    right: Array
    """Points (h, 2) of the right boundary from beside the vehicle on, in m."""
    closed: ClassVar[bool] = False
    """The track ahead is an open stretch, also on a closed track."""

    def __repr__(self) -> str:
        return f"TrackAhead({len(self.points)} points on {self.length:.1f} m)"

    @property
    def length(self) -> float:
        """Length of the known centre line (m)."""
        return float(self.arc_length[-1]) if len(self.arc_length) else 0.0


def check_length(name: str, length: float, least: float = 0.0) -> None:
    """Raise a SettingsError unless a length (m) is positive and at least `least`."""
    if isinstance(length, Real) and least <= length < np.inf and length > 0.0:
        return
    expected = f"a number of at least {least:g} m" if least else "a positive number (m)"
    found = f"{float(length):g}" if isinstance(length, Real) else repr(length)
    raise SettingsError(f"{name}: expected {expected}, found {found}")


def check_line(distance: float, step: float) -> None:
    """Raise a SettingsError unless distance and step (m) are in range."""
    check_length("step", step, LEAST_STEP)
    check_length("distance", distance)
    check_length("step", step, distance / MOST_POINTS)


def track_ahead(curves: Mapping[int, CurveAhead], pose: Array, distance: float, step: float) -> TrackAhead:
    """Return the next `distance` metres from a pose (x, y, theta), at points `step` (m) apart.

    `curves` are the known boundaries by label. The lengths have passed `check_line`.
    """
    samples = {label: _sampled(curve, distance) for label, curve in curves.items()}
    sides = [np.zeros((0, 2)) for _ in BOUNDARIES]
    for label, one in samples.items():
        beside = (one.station >= -_LINE_SETTLED) & (one.station <= distance + _LINE_SETTLED)
        sides[label] = to_vehicle(one.points[beside][::_ACROSS_STRIDE], pose[None])
    line = _first_line(samples[LEFT], samples[RIGHT]) if len(samples) == len(BOUNDARIES) else None
    if line is None or len(line) < 2:
        no, none = np.zeros(0), np.zeros((0, 2))
        return TrackAhead(none, no, no, no, no, no, no > 0.0, sides[LEFT], sides[RIGHT])
    line = _from_beside(line, pose[:2], distance, step)
    return _settled(samples[LEFT], samples[RIGHT], line, pose, step, sides)


@dataclass(frozen=True, eq=False)
class _Samples:
    """Samples (n,) of a boundary, map frame; stations (m) begin beside the vehicle."""

    points: Array
    tangents: Array
    curvature: Array
    station: Array
    confirmed: BoolArray


def _sampled(curve: CurveAhead, distance: float) -> _Samples:
    tables = curve.tables
    begin, end = curve.beside - _SAMPLES_BEHIND, curve.beside + _OUTER_LENGTH * distance + _SAMPLES_BEHIND
    if tables.periodic:
        end = min(end, begin + tables.length)  # at most one period
    else:
        begin, end = max(begin, tables.low), min(end, tables.high, curve.until)
    # put a sample beside the vehicle, unless the curve begins or ends there
    first = int(np.floor((begin - curve.beside) / _AHEAD_STEP + _LINE_SETTLED))
    last = int(np.ceil((end - curve.beside) / _AHEAD_STEP - _LINE_SETTLED))
    u = curve.beside + _AHEAD_STEP * np.arange(first, last + 1)
    u = np.minimum(np.maximum(u, begin), max(end, begin))
    values, span = tables.evaluate(u, 2)
    columns = span[:, None] + np.arange(-tables.degree, 1)
    parts = list(np.einsum("rkj,kjd->rkd", values, curve.control_points[columns]))
    confirmed = np.full(len(u), curve.confirmed)
    if curve.tentative is not None and len(curve.tentative):
        on = _continued(parts[0][-1], parts[1][-1], curve.tentative)
        parts = [np.concatenate(pair) for pair in zip(parts, on, strict=True)]
        confirmed = np.append(confirmed, np.zeros(len(on[0]), bool))
    points, first_order, second = parts
    square = dot(first_order, first_order)
    speed = np.sqrt(square)
    station = float(u[0] - curve.beside) + np.cumsum(_distances(points))
    curvature = dot(left_of(first_order), second) / (square * speed)
    return _Samples(points, first_order / speed[:, None], curvature, station, confirmed)


def _continued(end: Array, slope: Array, points: Array) -> tuple[Array, Array, Array]:
    """Return positions and two derivatives (n, 2) of a Catmull-Rom cubic from an end (2,) through points."""
    nodes = np.concatenate([end[None], points])
    edges = np.diff(nodes, axis=0)
    lengths = np.hypot(edges[:, 0], edges[:, 1])
    unit = edges / lengths[:, None]
    share = (lengths[:-1] / (lengths[:-1] + lengths[1:]))[:, None]
    inner = unit[:-1] * (1.0 - share) + unit[1:] * share
    slopes = np.concatenate([slope[None] / np.hypot(*slope), inner, unit[-1:]])
    counts = np.maximum(np.ceil(lengths / _AHEAD_STEP).astype(int), 1)
    piece = np.repeat(np.arange(len(counts)), counts)
    within = np.arange(len(piece)) - np.repeat(np.cumsum(counts) - counts, counts) + 1.0
    x, h = (within / counts[piece])[:, None], lengths[piece][:, None]
    a, c = nodes[piece], edges[piece]
    m, n = slopes[piece] * h, slopes[piece + 1] * h
    bend, twist = 3.0 * c - 2.0 * m - n, m + n - 2.0 * c
    position = a + x * (m + x * (bend + x * twist))
    return position, (m + x * (2.0 * bend + 3.0 * x * twist)) / h, (2.0 * bend + 6.0 * x * twist) / h**2


def _first_line(left: _Samples, right: _Samples) -> Array:
    """Return the midpoints of samples of the left boundary and the samples across, in driving order.

    Each row (4,) is a midpoint (m, map frame) and the stations of both samples (m).
    """
    of = slice(None, None, _ACROSS_STRIDE)
    lefts, rights = left.points[of], right.points[of]
    stations = left.station[of], right.station[of]
    apart = 0.5 * min(left.station[-1], right.station[-1])  # do not pair a loop across its ends
    i, j = points_across((lefts, rights), (left.tangents[of], right.tangents[of]), stations, apart)
    forward = j >= np.maximum.accumulate(j)
    i, j = i[forward], j[forward]
    line = np.column_stack([0.5 * (lefts[i] + rights[j]), stations[0][i], stations[1][j]])
    apart_enough = _distances(line[:, :2]) > _LINE_SETTLED
    apart_enough[:1] = True
    return line[apart_enough]


def _from_beside(line: Array, position: Array, distance: float, step: float) -> Array:
    """Resample the line (n, 4) at even steps, from the point beside a position (2,) on."""
    edges = np.diff(line[:, :2], axis=0)
    squares = dot(edges, edges)
    offset = position - line[:-1, :2]
    share = np.minimum(np.maximum(dot(offset, edges) / squares, 0.0), 1.0)
    away = offset - share[:, None] * edges
    nearest = int(dot(away, away).argmin())
    lengths = np.append(0.0, np.cumsum(np.sqrt(squares)))
    begin = lengths[nearest] + share[nearest] * (lengths[nearest + 1] - lengths[nearest])
    count = int(min(distance, lengths[-1] - begin) / step + _LINE_SETTLED)
    at = begin + step * np.arange(count + 1)
    return np.column_stack([np.interp(at, lengths, values) for values in line.T])


def _settled(
    left: _Samples, right: _Samples, line: Array, pose: Array, step: float, sides: Sequence[Array]
) -> TrackAhead:
    """Move the points of the line along its normals until both boundaries are equally far."""
    points, feet = line[:, :2], [_Feet(left, line[:, 2]), _Feet(right, line[:, 3])]
    for _ in range(_SETTLING_STEPS):
        for foot in feet:
            foot.find(points)
        off = feet[0].distance + feet[1].distance
        both = feet[0].normal + feet[1].normal
        square = np.maximum(dot(both, both), np.finfo(float).tiny)[:, None]
        inside = feet[0].inside & feet[1].inside
        if not (inside & ((np.abs(off) > _LINE_SETTLED) | feet[0].slid | feet[1].slid)).any():
            break
        points = points - off[:, None] / square * both
    good = (np.abs(off) <= _LINE_SETTLED) & (feet[0].distance < 0.0) & (feet[1].distance > 0.0)
    good &= inside & (_distances(points) <= _LARGEST_GAP * step)
    n = len(good) if good.all() else int(good.argmin())
    normal = both / np.sqrt(square)
    heading = np.arctan2(-normal[:, 0], normal[:, 1]) - pose[2]
    half_turn = 0.5 * wrap_angle(np.diff(heading[:n], prepend=heading[:n][:1]))
    bend = 0.5 * dot(normal, feet[0].normal) * (feet[0].offset_curvature + feet[1].offset_curvature)
    return TrackAhead(
        points=to_vehicle(points[:n], pose[None]),
        heading=wrap_angle(heading[:n]),
        curvature=bend[:n],
        arc_length=np.cumsum(_distances(points[:n]) / np.sinc(half_turn / np.pi)),  # along circular arcs
        width_left=feet[0].width(points, normal)[:n],
        width_right=feet[1].width(points, -normal)[:n],
        confirmed=(feet[0].confirmed & feet[1].confirmed)[:n],
        left=sides[LEFT],
        right=sides[RIGHT],
    )


class _Feet:
    """Foot points (n,) on a boundary, by its osculating circle at the nearest sample.

    In the frame of the sample, a point is at (a, b), a along and b to the left. With the curvature k, the
    centre of the circle is at (0, 1 / k), and with q = |(k a, 1 - k b)| the distance is
    `(2 b - k (a^2 + b^2)) / (1 + q)`.
    """

    def __init__(self, samples: _Samples, station: Array) -> None:
        self._samples = samples
        self._at = np.minimum(samples.station.searchsorted(station), len(samples.station) - 1)
        self._normals = left_of(samples.tangents)

    def find(self, points: Array) -> None:
        """Find the foot points of points (n, 2), each by its nearest sample."""
        samples, last = self._samples, len(self._samples.station) - 1
        self._frame(points)
        ahead = self.a / self.spread
        now = samples.station[self._at] + ahead
        nearest = np.minimum(samples.station.searchsorted(now), last)
        before = np.maximum(nearest - 1, 0)
        nearest -= now - samples.station[before] < samples.station[nearest] - now
        nearest = np.maximum(nearest, 0)
        self.slid = nearest != self._at
        self._at = nearest
        self._frame(points)
        sine, cosine = self.k * self.a, 1.0 - self.k * self.b  # of the turn to the foot point, times q
        q = np.hypot(sine, cosine)
        self.distance = (2.0 * self.b - self.k * (self.a**2 + self.b**2)) / (1.0 + q)
        tangent, normal = samples.tangents[nearest], self._normals[nearest]
        self.normal = (cosine / q)[:, None] * normal - (sine / q)[:, None] * tangent
        beyond = np.abs(self.a / self.spread) > 0.5 * _AHEAD_STEP + _LINE_SETTLED
        self.inside = ~(beyond & ((nearest == 0) | (nearest == last)))
        self.confirmed = samples.confirmed[nearest]

    def _frame(self, points: Array) -> None:
        samples, at = self._samples, self._at
        offset = points - samples.points[at]
        self.a, self.b = dot(offset, samples.tangents[at]), dot(offset, self._normals[at])
        self.k = samples.curvature[at]
        self.spread = self._spread(self.b)

    def _spread(self, distance: Array) -> Array:
        spread = 1.0 - self.k * distance
        return np.where(np.abs(spread) > _LINE_SETTLED, spread, _LINE_SETTLED)

    @property
    def offset_curvature(self) -> Array:
        """Curvature `k / (1 - k d)` (n,) of the parallel curve through each point."""
        return np.asarray(self.k / self._spread(self.distance))

    def width(self, points: Array, way: Array) -> Array:
        """Distance (n,) of the circle from points (n, 2) along unit vectors (n, 2).

        The distance w along (s, t) solves `k w^2 + 2 w (k (a s + b t) - t) + k (a^2 + b^2) - 2 b = 0`.
        """
        s, t = dot(way, self._samples.tangents[self._at]), dot(way, self._normals[self._at])
        half = self.k * (self.a * s + self.b * t) - t
        rest = self.k * (self.a**2 + self.b**2) - 2.0 * self.b
        root = np.sqrt(np.maximum(half**2 - self.k * rest, 0.0))
        return np.abs(rest / (half + np.where(half < 0.0, -root, root)))


def _distances(points: Array) -> Array:
    """Distance (n,) of each point from the one before, 0 for the first."""
    edges = np.diff(points, axis=0, prepend=points[:1])
    return np.asarray(np.hypot(edges[:, 0], edges[:, 1]))
