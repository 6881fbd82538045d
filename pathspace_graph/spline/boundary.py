"""A boundary of the map: an open spline that grows and becomes periodic at closure; and crossings."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
from scipy.spatial import KDTree

from pathspace_graph.factors._kernels import Curves
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.bspline import SpanPolynomials, scatter
from pathspace_graph.factors.footpoint import FootPoints
from pathspace_graph.factors.residuals import greville, smoothness_matrix
from pathspace_graph.factors.se2 import move_points, path_lengths
from pathspace_graph.labels import LEFT, NAMES, RIGHT
from pathspace_graph.settings.mapper import SplineSettings

from .bspline import BSpline, cross, dot, segments_cross, side_of

KNOT_ROUND_OFF = 1e-9  # tolerance of a parameter that lies on a knot (m)

SAME_DIRECTION = 0.5  # least cosine of the angle between a curve and the heading of a vehicle beside it


@dataclass(frozen=True, eq=False)
class Placement:
    """Placement of control points by an extension, a linear map of what they are fitted to.

    Control points from index `kept` on are `by_known @ known[first:] + by_target @ targets`. The fit assumes
    second differences of zero; `by_bend` is the derivative by these.
    """

    first: int  # index of the first known control point that the fit depends on
    kept: int  # number of control points that do not move
    by_known: Array  # (f, n - first) derivative of the placed control points by the known ones
    by_target: Array  # (f, k) derivative by the targets
    by_bend: Array  # (f, t) derivative by the second differences

    def place(self, known: Array, targets: Array) -> Array:
        """Return all control points (n', 2), given the known ones (n, 2) and the targets (k, 2)."""
        placed = self.by_known @ known[self.first :] + self.by_target @ targets
        return np.concatenate([known[: self.kept], placed])


class Boundary:
    """A B-spline that grows until the loop closes; its control points are variables of the graph.

    An open boundary has uniform, floating (unclamped) knots. Its parameter is about the length (m) from the
    first cone.
    """

    def __init__(self, knots: Array, periodic: bool, settings: SplineSettings, first: int = 0) -> None:
        self.first = first  # number of the first control point's key; new knots get new numbers
        self.settings = settings
        self.degree, self.periodic = settings.degree, periodic
        self.confirmed_end = 0.0  # parameter up to which cones support the curve (m)
        self.observed: Array = np.zeros((0, 2))  # (n, 2) cones it was grown through, map frame (m)
        self.cone_parameters: Array = np.zeros(0)  # (n,) their parameters on the curve (m)
        self._set_tables(SpanPolynomials(knots, self.degree, periodic))

    def _set_tables(self, tables: SpanPolynomials) -> None:
        self.tables, knots = tables, tables.knots
        n = len(knots) - self.degree - 1
        self.size = n - self.degree if self.periodic else n  # number of distinct control points
        self.abscissae = greville(knots, self.degree)[: self.size]  # (m,) where control points act (m)
        following = self.abscissae[1:]
        if self.periodic:
            following = np.append(following, self.abscissae[0] + self.length)
        self.nominal = following - self.abscissae[: len(following)]  # (m,) distances of neighbours (m)
        self.everything = np.arange(self.size)

    @property
    def numbers(self) -> IntArray:
        """Numbers (m,) of the control points' keys."""
        return self.first + self.everything

    @property
    def knots(self) -> Array:
        """All knots; those of a periodic curve continue past both ends of its domain."""
        return self.tables.knots

    @property
    def length(self) -> float:
        """Length of the domain in parameter units (about metres)."""
        return self.tables.high - self.tables.low

    def extended(self, control_points: Array) -> Array:
        """Unwrap control points for the kernels: those of a periodic curve repeat at the end."""
        if not self.periodic:
            return control_points
        return np.concatenate([control_points, control_points[: self.degree]])

    def columns(self, span: IntArray) -> IntArray:
        """Indices (m, degree + 1) of the control points that shape the curve on each span (m,)."""
        columns = span[:, None] - self.degree + np.arange(self.degree + 1)
        return columns % self.size if self.periodic else columns

    def stretch(self, low: float, high: float) -> IntArray:
        """Indices (k,) of the control points that shape a closed curve between two parameters, in order."""
        first, last = self.tables.span_of(low), self.tables.span_of(high)
        is_long = high - low > 0.5 * self.length  # it may end on the span where it begins
        last += self.degree + (self.size if last < first or (last == first and is_long) else 0)
        if high - low >= self.length or last - first >= self.size - 1:
            return self.everything
        return np.arange(first, last + 1) % self.size

    def spline(self, control_points: Array) -> BSpline:
        return BSpline.on(self.tables, self.extended(control_points))

    def find(self, control_points: Array, points: Array, low: Array, high: Array) -> FootPoints:
        """Find the foot points of points (m, 2) in the stretches [low, high], each (m,)."""
        s, curve = self.settings, np.zeros(len(points), np.intp)
        search = low, high, s.search_step, s.search_iterations
        if self.periodic:
            curves = Curves([self.tables], [0], [self.size])
        else:  # from the least limit on
            first = int(self.tables.locate(np.min(low, initial=np.inf, keepdims=True))[0][0])
            curves = Curves([self.tables.tail(first) if first else self.tables], [first])
        return FootPoints(*curves.search(control_points, points, curve, *search))

    def find_anywhere(self, control_points: Array, points: Array) -> FootPoints:
        low, high = np.full((len(points), 2), [self.tables.low, self.tables.high]).T
        return self.find(control_points, points, low, high)

    def refine(self, control_points: Array, points: Array, u: Array) -> FootPoints:
        """Refine the foot points of points (m, 2), starting at the parameters u (m,)."""
        s, curve = self.settings, np.zeros(len(points), np.intp)
        search = u, u - s.refine_room, self.within_trusted(u + s.refine_room), s.refine_iterations
        unwrapped = self.extended(control_points)
        return FootPoints(*Curves([self.tables]).refine(unwrapped, points, curve, *search))

    @property
    def trusted(self) -> float:
        """Parameter up to which foot points are allowed: half a metre past the last cone of an open curve."""
        return np.inf if self.periodic else self.confirmed_end + 0.5

    @property
    def unseen(self) -> float:
        """Length (m) without a cone at the end of the confirmed curve."""
        return self.confirmed_end - float(self.cone_parameters[-1:].sum())

    def within_trusted(self, high: Array) -> Array:
        """Clip upper limits (m,) of stretches, so that they exclude the extrapolated end."""
        return np.minimum(high, self.trusted)

    def evaluate(self, control_points: Array, u: Array, derivative: int = 0) -> Array:
        values, span = self.tables.evaluate(np.asarray(u, float), derivative)
        return np.asarray(np.einsum("mj,mjd->md", values[derivative], control_points[self.columns(span)]))

    def basis(self, u: Array) -> Array:
        """Weights (k, m) of the distinct control points at parameters (k,)."""
        (values,), span = self.tables.evaluate(u)
        return scatter(values, span - self.degree, self.size, self.periodic)

    def closed(self, knots: Array) -> "Boundary":
        """Make a closed boundary on periodic knots. It is confirmed, and its keys are new."""
        boundary = Boundary(knots, True, self.settings, self.first + self.size)
        boundary.confirmed_end = boundary.tables.high
        return boundary

    def grow(self, control_points: Array, targets_u: Array, targets: Array) -> Array:
        """Extend the curve through targets (k, 2) at parameters (k,); return its control points (n', 2).

        Knots are appended until the domain contains the last parameter, the new `confirmed_end`. Control
        points that act only beyond the previous last cone are placed again, since the direction there was a
        guess.
        """
        from_u = self.last_cone(self.confirmed_end)
        return self.extend(len(control_points), targets_u, from_u).place(control_points, targets)

    def last_cone(self, end: float) -> float:
        """Parameter (m) of the last cone before an end, or the end itself without one."""
        before = int(self.cone_parameters.searchsorted(end - KNOT_ROUND_OFF))
        return float(self.cone_parameters[before - 1]) if before else end

    def extend(self, old: int, targets_u: Array, from_u: float | None = None) -> Placement:
        """Extend a curve of `old` control points to targets at parameters (k,); return how to place them.

        The curve is placed again from `from_u` on, by default from its confirmed end. The confirmed end does
        not move.
        """
        spacing, end = self.settings.spacing, self.confirmed_end
        missing = int(np.ceil((targets_u[-1] - self.tables.high) / spacing - KNOT_ROUND_OFF))
        if missing > 0:
            last = self.knots[-1] + spacing * np.arange(1, missing + 1)
            self._set_tables(self.tables.extended(np.append(self.knots, last)))
        self.confirmed_end = float(targets_u[-1])
        from_u = end if from_u is None else from_u
        kept, held_u = self.settled(old, from_u), np.zeros(0)
        if old:
            # four points of the known curve's end keep its shape
            held_u = np.linspace(max(from_u - self.nominal[0], 0.0), from_u, 4)
            held_u = np.append(held_u, end) if from_u < end else held_u
        values, span = self.tables.evaluate(np.concatenate([held_u, targets_u]))
        columns = self.columns(span)
        first = max(min(int(columns.min()), kept - 2), 0)  # earlier rows have no free column
        weight, held, bent = 0.1, len(held_u), len(columns)  # the weight is that of second differences
        matrix = np.zeros((bent, self.size - first))
        np.put_along_axis(matrix, columns - first, values[0], axis=1)
        matrix = np.concatenate([matrix, weight * smoothness_matrix(self.abscissae[first:], None)])
        fit = np.asarray(np.linalg.pinv(matrix[:, kept - first :]), float)
        design = np.zeros((held, old - first))  # basis of the old curve, whose control points end at `old`
        known = np.minimum(columns[:held], old - 1) - first
        np.add.at(design, (np.arange(held)[:, None], known), values[0][:held])
        by_known = fit[:, :held] @ design
        by_known[:, : kept - first] -= fit @ matrix[:, : kept - first]
        return Placement(first, kept, by_known, fit[:, held:bent], weight * fit[:, bent:])

    def settled(self, size: int, u: float | None = None) -> int:
        """Number of the first `size` control points that act before u, by default `confirmed_end`."""
        u = self.confirmed_end if u is None else u
        return max(int(np.searchsorted(self.knots[:size], u - KNOT_ROUND_OFF)) - 1, 0)

    def move(self, motion: Array) -> None:
        self.observed = move_points(motion, self.observed)

    def add_cones(self, points: Array, u: Array) -> None:
        self.observed = np.concatenate([self.observed, points])
        self.cone_parameters = np.append(self.cone_parameters, u)

    def take_back(self, kept: int) -> None:
        """Remove all cones but the first `kept`, up to which the curve stays confirmed."""
        self.confirmed_end = float(self.cone_parameters[kept - 1])
        self.observed, self.cone_parameters = self.observed[:kept], self.cone_parameters[:kept]


def open_boundary(settings: SplineSettings) -> Boundary:
    p = settings.degree
    knots = settings.spacing * np.arange(-p, p + 2, dtype=float)
    return Boundary(knots, False, settings)


def ahead_of(at: Array | float, u: Array, length: float) -> Array:
    """Signed distance (m) from parameters `at` to u, the shorter way around a curve of a length."""
    return np.asarray(np.mod(u - at + 0.5 * length, length) - 0.5 * length)


def relocate(boundary: Boundary, control_points: Array, pose: Array, room: float) -> float:
    """Find the parameter of the nearest point whose tangent is within 60 degrees of a pose's heading.

    A closed curve is searched everywhere, an open one on its last `room` metres. Without such a point, the
    result is the end.
    """
    low, high = boundary.tables.low, boundary.tables.high
    if not boundary.periodic:
        low, high = max(low, boundary.confirmed_end - room), float(boundary.within_trusted(np.array(high)))
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


# --- whether boundaries cross ----------------------------------------------------------------------------


def sampled(spline: BSpline, step: float) -> Array:
    """Sample points (n, 2) of a spline from its beginning to its end, about `step` (m) apart."""
    low, high = spline.domain
    return spline.evaluate(np.linspace(low, high, max(int((high - low) / step), 1) + 1))


def boundaries_cross(splines: Mapping[int, BSpline], step: float, path: Array | None = None) -> bool:
    """Whether the boundaries, sampled at a step (m), cross elsewhere than where the path driven does."""
    found = polyline_crossings(sampled(splines[LEFT], step), sampled(splines[RIGHT], step))
    if len(found) == 0 or path is None or len(path) < 2:
        return len(found) > 0
    _, kept = np.unique(path_lengths(path) // 1.0, return_index=True)  # of the path, a pose per metre
    level = KDTree(polyline_crossings(path[kept], path[kept], 0.7))  # laps on one road cross at a less sine
    return bool(np.max(level.query(found)[0]) >= 8.0)  # a road's boundaries cross within 8 m of its middle


def polyline_crossings(a: Array, b: Array, sine: float = 0.0) -> Array:
    """Points (k, 2) where two polylines cross at an angle of at least this sine."""
    i, j, share = crossing_segments(a, b)
    (p, q), (r, s) = (a[i], a[i + 1]), (b[j], b[j + 1])
    turned = np.abs(side_of(p, q, p + s - r)) > sine * np.hypot(*(q - p).T) * np.hypot(*(s - r).T)
    return np.asarray((p + share[:, None] * (q - p))[turned])


def crossing_segments(a: Array, b: Array) -> tuple[IntArray, IntArray, Array]:
    """Return the crossing segments (k,) of two polylines, and where on the first one they cross (k,)."""
    middle_a, middle_b = 0.5 * (a[1:] + a[:-1]), 0.5 * (b[1:] + b[:-1])
    reach = 0.5 * (np.hypot(*np.diff(a, axis=0).T).max() + np.hypot(*np.diff(b, axis=0).T).max())
    near = KDTree(middle_a).query_ball_tree(KDTree(middle_b), reach)
    i = np.repeat(np.arange(len(near)), [len(own) for own in near])
    j = np.array([k for own in near for k in own], np.intp)
    cross = segments_cross(a[i], a[i + 1], b[j], b[j + 1])
    i, j = i[cross], j[cross]
    before, after = side_of(b[j], b[j + 1], a[i]), side_of(b[j], b[j + 1], a[i + 1])
    return i, j, before / (before - after)


# --- where the vehicle crossed a boundary; lengths are relative to its median distance from them ------------

CROSSING_STEP: Final = 0.15  # distance of the samples of curves and drive
CROSSED_DEPTH: Final = 0.35  # least depth beyond a boundary that counts as across: drivers cut corners
ROADSIDE: Final = 2.5  # largest distance of a road's boundary from the drive along it
PASSES_APART: Final = 15.0  # least length driven between two passes of one place
ALONG_COSINE: Final = 0.9  # least cosine of the angle between a boundary and the drive along it


class Crossing(NamedTuple):
    """A place where the vehicle crossed a boundary of the map."""

    label: int
    place: Array  # (2,) in m, map frame
    driven: float  # length of the drive up to this place (m)


def crossings_told(found: list[Crossing]) -> str:
    """Describe where the vehicle crossed boundaries; empty without a crossing."""
    if not found:
        return ""
    first, more = found[0], f", and at {len(found) - 1} more" if len(found) > 1 else ""
    x, y = first.place.tolist()
    return (
        f"the {NAMES[first.label]} boundary lies across the driven path at x = {x:.3g} m, y = {y:.3g} m, "
        f"after {first.driven:.3g} m{more}"
    )


def crossed_boundaries(
    curves: Mapping[int, BSpline], path: Array, known: BoolArray | None = None
) -> list[Crossing]:
    """Find where a path driven (n, 2) crosses the boundaries of the map, in driving order.

    Poses that are not `known` (n,), as of a lost vehicle, are a gap. Not counted: a corner that is
    cut; the place where the vehicle enters or finally leaves the road; a place where the path crosses itself,
    since roads that cross have boundaries there; and the boundary of another lap of an open map, whose laps
    may lie beside each other.
    """
    known = np.ones(len(path), bool) if known is None else known
    before = np.cumsum(~known)[known]  # number of unknown poses before each known one
    path = path[known]
    moves = (np.diff(path, axis=0) != 0.0).any(axis=1)
    kept = np.append(moves[:1], moves)
    path, before = path[kept], before[kept]
    if len(path) < 2 or not curves:
        return []
    coarse = [curve.evaluate(np.linspace(*curve.domain, 8 * curve.size)) for curve in curves.values()]
    aside = float(np.median([KDTree(points).query(path)[0] for points in coarse]))
    drive = _drive(path, np.diff(before) > 0, aside)
    lines = {label: _line(curve, CROSSING_STEP * aside) for label, curve in curves.items()}
    found = [one for label in lines for one in _crossings(label, lines, drive, aside)]
    return sorted(found, key=lambda one: one.driven)


@dataclass(frozen=True, eq=False)
class _Way:
    """Samples of a curve or of a drive, in driving order."""

    points: Array  # (n, 2) in m, map frame
    heading: Array  # (n, 2) unit vectors
    length: Array  # (n,) length up to each sample (m)
    pieces: list[slice]  # stretches without a gap
    closed: bool = False


def _line(curve: BSpline, step: float) -> _Way:
    u = np.linspace(*curve.domain, max(int(curve.length() / step), 2) + 1)
    points = curve.evaluate(u)
    return _Way(points, curve.tangent_unit(u), path_lengths(points), [slice(0, len(u))], curve.periodic)


def _drive(path: Array, unknown: BoolArray, aside: float) -> _Way:
    """Sample a path (n, 2); the way to the next pose may be `unknown` (n - 1,)."""
    length = path_lengths(path)
    missing = np.flatnonzero(unknown | (np.diff(length) > 5.0 * aside)) + 1  # the path between is unknown
    known = [rows for rows in np.split(length, missing) if len(rows) > 1]
    at = [np.linspace(rows[0], rows[-1], int(np.ptp(rows) / (CROSSING_STEP * aside)) + 2) for rows in known]
    ends = np.cumsum([0, *map(len, at)]).tolist()
    where = np.concatenate([np.zeros(0), *at])
    points = np.column_stack([np.interp(where, length, column) for column in path.T])
    pieces = [slice(*of) for of in pairwise(ends)]
    step = np.concatenate([np.zeros((0, 2)), *(np.gradient(points[piece], axis=0) for piece in pieces)])
    return _Way(points, step / np.maximum(np.hypot(*step.T), np.finfo(float).tiny)[:, None], where, pieces)


def _crossings(label: int, lines: Mapping[int, _Way], drive: _Way, aside: float) -> list[Crossing]:
    """Find the crossings of one boundary."""
    line, found = lines[label], []
    distance, foot = map(np.asarray, KDTree(line.points).query(drive.points))
    inside = (foot > 0) & (foot < len(line.points) - 1)
    depth = CROSSED_DEPTH * aside
    deep = (line.closed | inside) & (distance > depth)  # no sample is beside a curve beyond its end
    reaches = np.asarray(KDTree(drive.points).query(line.points)[0]) > depth
    for piece in drive.pieces:
        rows, at, share = crossing_segments(drive.points[piece], line.points)
        order = np.argsort(rows + share)
        rows, at, share = rows[order] + piece.start, at[order], share[order]
        # parts of the drive, by the number of crossings before each, in which drive and curve move apart
        apart = {*rows.searchsorted(np.arange(piece.start, piece.stop))[deep[piece]].tolist()}
        apart |= {k for k, ends in enumerate(pairwise(at), 1) if reaches[_between(*ends, line)].any()}
        # from one to the next, an odd number of crossings changes the side of the curve
        changes = [a for a, b in pairwise(sorted(apart)) if (b - a) % 2]
        ends = [piece.start, *rows[changes].tolist(), piece.stop]
        for k, change in enumerate(changes):
            row, on_line = int(rows[change]), int(at[change])
            step = drive.points[row + 1] - drive.points[row]
            one = Crossing(label, drive.points[row] + share[change] * step, float(drive.length[row]))
            leaves = (cross(line.heading[on_line], step) > 0.0) == (label == LEFT)
            beyond = slice(row + 1, ends[k + 2]) if leaves else slice(ends[k], row + 1)
            allowed = _meets_itself(one.place, drive, aside)
            if k == (len(changes) - 1 if leaves else 0):  # off the road, the drive is along no other boundary
                others = [(other, own) for other, own in lines.items() if other != label]
                along = [_beside(*other, drive, beyond, aside).mean() for other in others]
                allowed |= max(along, default=1.0) < 0.5
            allowed |= not line.closed and _is_of_another_lap(one, line.heading[on_line], drive, aside)
            if not allowed:
                found.append(one)
    return found


def _between(first: int, second: int, line: _Way) -> IntArray:
    """Samples of a curve between two of its samples, the shorter way around a closed one."""
    low, high = sorted((first, second))
    rows = np.arange(low + 1, high + 1)
    around = np.append(np.arange(high + 1, len(line.points)), np.arange(low + 1))
    return around if line.closed and len(around) < len(rows) else rows


def _beside(label: int, line: _Way, drive: _Way, rows: slice, aside: float) -> BoolArray:
    """Whether a boundary lies beside each sample (m,) of a stretch of the drive, on its own side."""
    distance, foot = map(np.asarray, KDTree(line.points).query(drive.points[rows]))
    heading, off = drive.heading[rows], line.points[foot] - drive.points[rows]
    on_side = (cross(heading, off) > 0.0) == (label == LEFT)
    along = np.abs(dot(heading, line.heading[foot])) > ALONG_COSINE
    return np.asarray(on_side & along & (distance < ROADSIDE * aside))


def _meets_itself(place: Array, drive: _Way, aside: float) -> bool:
    """Whether the drive crosses itself near a place (2,)."""
    near = np.flatnonzero(np.hypot(*(drive.points - place).T) < 7.0 * aside)
    near = near[:: 1 + len(near) // 500]
    points, heading, length = drive.points[near], drive.heading[near], drive.length[near]
    parted = np.abs(heading @ heading.T) < 0.87  # two parts that cross at 30 degrees at least
    parted &= np.abs(length[:, None] - length) > PASSES_APART * aside
    offset = points[:, None] - points
    return bool((parted & (np.hypot(offset[..., 0], offset[..., 1]) < 0.5 * aside)).any())


def _is_of_another_lap(one: Crossing, heading: Array, drive: _Way, aside: float) -> bool:
    """Whether a boundary with a heading (2,) lies beside another part of the drive, on its own side."""
    off = one.place - drive.points
    across = cross(drive.heading, off) * (1.0 if one.label == LEFT else -1.0)
    beside = (across > CROSSED_DEPTH * aside) & (across < ROADSIDE * aside)
    beside &= np.abs(dot(drive.heading, off)) < CROSSING_STEP * aside
    beside &= np.abs(drive.heading @ heading) > ALONG_COSINE
    return bool((beside & (np.abs(drive.length - one.driven) > PASSES_APART * aside)).any())
