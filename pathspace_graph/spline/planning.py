"""Input of planners and controllers: the centre line of a map, the next metres of it, and a speed profile."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from math import ceil, floor, sqrt
from numbers import Real
from typing import TYPE_CHECKING, ClassVar, Final

import numpy as np

from pathspace_graph.errors import SettingsError
from pathspace_graph.factors.arrays import Array, BoolArray
from pathspace_graph.factors.bspline import SpanPolynomials
from pathspace_graph.factors.footpoint import foot_points
from pathspace_graph.factors.se2 import left_of, path_lengths, to_vehicle, wrap_angle
from pathspace_graph.labels import BOUNDARIES, LEFT, RIGHT
from pathspace_graph.settings.mapper import SpeedSettings

from . import centre_line as lines
from .bspline import BSpline, cross, dot, sparse_rows

if TYPE_CHECKING:
    import pandas as pd


LEAST_STEP: Final = 0.01  # least distance of the points of a line (m)
MOST_POINTS: Final = 200_000  # largest number of points of a line; bounds the memory


def check_length(name: str, length: float, least: float = 0.0) -> None:
    """Raise a SettingsError unless a length (m) is positive and at least `least`."""
    if isinstance(length, Real) and least <= length < np.inf and length > 0.0:
        return
    expected = f"a number of at least {least:g} m" if least else "a positive number (m)"
    found = f"{float(length):g}" if isinstance(length, Real) else repr(length)
    raise SettingsError(f"{name}: expected {expected}, found {found}")


@dataclass(frozen=True, eq=False, repr=False)
class Line:
    """Centre line at n points."""

    points: Array
    """Points (n, 2) in m; a closed line does not repeat the first one."""
    heading: Array
    """Direction of travel (n,) in rad, in (-pi, pi]."""
    curvature: Array
    """Curvature (n,) in 1/m, positive in a left turn."""
    arc_length: Array
    """Length (n,) of the line from its first point, in m."""
    width_left: Array
    """Distance (n,) along the normal to the left boundary, in m."""
    width_right: Array
    """Distance (n,) along the normal to the right boundary, in m."""


# --- the centre line of a map ----------------------------------------------------------------------------

_WIDTH_SHARE: Final = 0.95  # largest width, as a share of the distance to where two normals cross


@dataclass(frozen=True, eq=False, repr=False)
class CentreLine(Line):
    """Smooth centre line of a track (`find_line`) at n evenly spaced points, map frame.

    Widths are shortened where normals would meet. Standard deviations are those of the point where the line
    crosses its normal; NaN without covariance.
    """

    closed: bool
    """Whether the line is a loop."""
    length: float
    """Length of the whole line (m); a closed one includes the way back to its first point."""
    points_sigma: Array
    """Standard deviation (n,) across the line, in m."""
    heading_sigma: Array
    """Standard deviation (n,) of the heading, in rad."""
    curvature_sigma: Array
    """Standard deviation (n,) of the curvature, in 1/m."""
    arc_length_sigma: Array
    """Standard deviation (n,) of the arc length, in m; the first one is 0."""
    width_left_sigma: Array
    """Standard deviation (n,) of the width to the left, in m."""
    width_right_sigma: Array
    """Standard deviation (n,) of the width to the right, in m."""
    length_sigma: float
    """Standard deviation of the whole length, in m."""

    def __repr__(self) -> str:
        ends = "closed" if self.closed else "open"
        return f"CentreLine({ends}, {len(self.points)} points on {self.length:.1f} m)"

    def to_frame(self) -> pd.DataFrame:
        """Convert the line to a frame: one row for each point; x, y and every other array are columns."""
        columns = {"x": self.points[:, 0], "y": self.points[:, 1], **vars(self)}
        arrays = {name: v for name, v in columns.items() if isinstance(v, np.ndarray) and name != "points"}
        frame: pd.DataFrame = import_module("pandas").DataFrame(arrays)
        return frame


def centre_line(left: BSpline, right: BSpline, covariance: Array | None, step: float) -> CentreLine:
    """Compute the centre line between two boundaries at points about `step` (m) apart, see `find_line`.

    The joint covariance (m^2) of the control points, left boundary first, in the order x0, y0, x1 and so on,
    is propagated to first order. SettingsError if the step is out of range.
    """
    check_length("step", step, LEAST_STEP)
    most, longest = MOST_POINTS * step, max(left.length(), right.length())
    if longest > most:
        raise SettingsError(f"expected boundaries of at most {most:g} m at this step, found {longest:.6g} m")
    line, closed = lines.find_line(left, right), left.periodic
    centre = line.ribbon.centre
    length = centre.length()
    count = max(round(length / step), 4)
    arc_length = np.linspace(0.0, length, count + 1)
    u, own = centre.parameters_at(arc_length), slice(count if closed else None)
    points, tangent, crossings = centre.evaluate(u)[own], centre.tangent_unit(u), line.crossings(u)
    across, turn, bend, along, to_left, to_right = _sigmas(line, u, crossings, covariance)
    offsets = [np.abs(one.offset[own]) for one in crossings]
    widths = _uncrossed(points, left_of(tangent)[own], offsets, closed)
    return CentreLine(
        points=points,
        heading=np.arctan2(tangent[own, 1], tangent[own, 0]),
        curvature=centre.curvature(u)[own],
        arc_length=arc_length[own],
        width_left=widths[0],
        width_right=widths[1],
        closed=closed,
        length=length,
        points_sigma=across[own],
        heading_sigma=turn[own],
        curvature_sigma=bend[own],
        arc_length_sigma=along[own],
        width_left_sigma=to_left[own],
        width_right_sigma=to_right[own],
        length_sigma=float(along[-1]),
    )


def _uncrossed(points: Array, normal: Array, widths: list[Array], closed: bool) -> list[Array]:
    """Shorten the widths to the left and right, so that normals of points up to ten apart do not meet.

    The normals p + a n and q + b m meet where a n - b m = q - p.
    """
    left, right = (width.copy() for width in widths)
    count = len(points)
    for apart in range(1, min(10, count - 1) + 1):
        i = np.arange(count if closed else count - apart)
        j = (i + apart) % count
        turn, way = cross(normal[i], normal[j]), points[j] - points[i]
        known = np.abs(turn) > np.finfo(float).eps
        a = np.divide(cross(way, normal[j]), turn, out=np.full(len(i), np.inf), where=known)
        b = np.divide(cross(way, normal[i]), turn, out=np.full(len(i), np.inf), where=known)
        for width, side in ((left, 1.0), (right, -1.0)):
            meet = (side * a > 0.0) & (side * b > 0.0) & (side * a <= width[i]) & (side * b <= width[j])
            np.minimum.at(width, i[meet], _WIDTH_SHARE * np.abs(a[meet]))
            np.minimum.at(width, j[meet], _WIDTH_SHARE * np.abs(b[meet]))
    return [left, right]


def _sigmas(
    line: lines.CentreCurve, u: Array, crossings: list[lines.NormalCrossing], covariance: Array | None
) -> list[Array]:
    """Standard deviations (n,) across the line, and of heading, curvature, arc length and both widths.

    Each is that of the point where the line crosses its old normal at u (n,). With dC = B dc, and the shift
    -t . dC along the line, the derivatives by the control points of the boundaries are

        e = n . dC,   dtheta = n . dC' / |C'| - k t . dC,   ds = t . dC - t . dC(0) - integral of k e,
        do = N . dS / (N . n) + o (N . t) / (N . n) dtheta - e.
    """
    if covariance is None:
        return [np.full(len(u), np.nan)] * 6
    centre, by_control = line.ribbon.centre, line.by_boundaries.reshape(line.ribbon.size, -1)
    basis = [sparse_rows(*centre.local_basis(u, order), centre.size) for order in range(3)]
    moved = [(B @ by_control).reshape(len(u), lines.RIBBON, -1)[:, :2] for B in basis]
    tangent = centre.tangent_unit(u)
    normal, curvature = left_of(tangent), centre.curvature(u)[:, None]
    _, first, second, third = centre.derivatives(u, 3)
    speed = np.linalg.norm(first, axis=1)
    across, along = _along(normal, moved[0]), _along(tangent, moved[0])
    heading = _along(normal, moved[1]) / speed[:, None] - curvature * along
    cube = (speed**3)[:, None]
    bent = _along(-left_of(second) / cube - 3.0 * curvature / speed[:, None] * tangent, moved[1])
    bent = bent + _along(left_of(first) / cube, moved[2])
    by_parameter = cross(first, third) / cube[:, 0]
    by_parameter -= 3.0 * curvature[:, 0] * dot(first, second) / speed**2
    bent = bent - (by_parameter / speed)[:, None] * along
    shorter = -curvature * across
    pieces = 0.5 * np.diff(centre.arc_length(u))[:, None] * (shorter[1:] + shorter[:-1])
    lengths = np.concatenate([np.zeros((1, pieces.shape[1])), np.cumsum(pieces, axis=0)])
    rows = [across, heading, bent, lengths]
    for one, begin in zip(crossings, (0, line.sides[0].size), strict=True):
        turn = one.offset * dot(one.own_normal, tangent)
        rows.append(one.along_normal(begin, line.size) + turn[:, None] * heading - across)
    return [np.sqrt(np.maximum(np.einsum("km,km->k", row @ covariance, row), 0.0)) for row in rows]


def _along(a: Array, moved: Array) -> Array:
    """Derivatives `a . dC` (n, M), of vectors a (n, 2) and derivatives (n, 2, M)."""
    return np.asarray(np.einsum("kd,kdm->km", a, moved))


# --- the next metres of a drive --------------------------------------------------------------------------

_SAMPLES_BEHIND: Final = 3.0  # distance of the first sample behind the vehicle (m), which may stand askew
_SETTLED: Final = 1e-3  # largest difference of the distances from both boundaries on the line (m)


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
class TrackAhead(Line):
    """The next stretch of the track in the vehicle's frame (x forward, y left, m and rad).

    The points of the centre line are equally far from both boundaries; the first one is beside the vehicle.
    There are none if only one boundary is known, and fewer than requested if the map ends before.
    """

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


def check_line(distance: float, step: float) -> None:
    """Raise a SettingsError unless distance and step (m) are in range."""
    check_length("step", step, LEAST_STEP)
    check_length("distance", distance)
    check_length("step", step, distance / MOST_POINTS)


def track_ahead(curves: Mapping[int, CurveAhead], pose: Array, distance: float, step: float) -> TrackAhead:
    """Return the next `distance` metres from a pose (x, y, theta), at points `step` (m) apart.

    `curves` are the known boundaries by label. The lengths have passed `check_line`. Newton steps move the
    midpoints of samples that face each other (`paired`) until both boundaries are equally far.
    """
    known = {label: _stretch(curve, distance) for label, curve in curves.items()}
    sides = {label: np.zeros((0, 2)) for label in BOUNDARIES}
    for label, stretch in known.items():
        first, last = stretch.u.searchsorted([-_SETTLED, distance + _SETTLED])
        sides[label] = to_vehicle(stretch.points[first:last], pose[None])
    no, none = np.zeros(0), np.zeros((0, 2))
    nothing = TrackAhead(none, no, no, no, no, no, no > 0.0, sides[LEFT], sides[RIGHT])
    if len(known) < len(BOUNDARIES):
        return nothing
    stretches = known[LEFT], known[RIGHT]
    i, j = lines.paired(*stretches, starts=16)
    if len(i) < 2:
        return nothing
    (left, first), (right, second) = stretches[0].at(i), stretches[1].at(j)
    pairs = np.column_stack([0.5 * (left + right), first, second])
    # the pairs advance on one side at a time: without the mean of two, their midpoints zigzag
    pairs = np.concatenate([pairs[:1], 0.5 * (pairs[1:] + pairs[:-1]), pairs[-1:]])
    # at even steps, from beside the vehicle on
    edges, offset = np.diff(pairs[:, :2], axis=0), pose[:2] - pairs[:-1, :2]
    share = np.clip(dot(offset, edges) / np.maximum(dot(edges, edges), np.finfo(float).tiny), 0.0, 1.0)
    away = offset - share[:, None] * edges
    nearest, lengths = int(dot(away, away).argmin()), path_lengths(pairs)
    begin = lengths[nearest] + share[nearest] * (lengths[nearest + 1] - lengths[nearest])
    at = begin + step * np.arange(int(min(distance, lengths[-1] - begin) / step + _SETTLED) + 1)
    x, y, *places = (np.interp(at, lengths, values) for values in pairs.T)
    points = np.column_stack([x, y])
    for _ in range(8):  # Newton steps; two are mostly enough
        feet = [
            foot_points(
                one.spline.tables, one.spline.control_points, points, u - step, u + step, lines.SAMPLE_STEP
            )
            for one, u in zip(stretches, places, strict=True)
        ]
        places = [foot.u for foot in feet]
        off, both = feet[0].distance + feet[1].distance, feet[0].normal_unit + feet[1].normal_unit
        inside = feet[0].interior & feet[1].interior
        if not inside.all():  # a point may lie a little past the end of a boundary
            beyond = np.abs([dot(points - foot.position, foot.tangent_unit) for foot in feet])
            inside = np.asarray((beyond <= 0.5 * lines.SAMPLE_STEP).all(axis=0))
        if not (inside & (np.abs(off) > _SETTLED)).any():
            break
        points = points - (off / np.maximum(dot(both, both), np.finfo(float).tiny))[:, None] * both
    good = inside & (np.abs(off) <= _SETTLED) & (feet[0].distance < 0.0) & (feet[1].distance > 0.0)
    steps = np.append(0.0, np.hypot(*np.diff(points, axis=0).T))
    good &= steps <= 2.0 * step
    n = len(good) if good.all() else int(good.argmin())
    points, normal = points[:n], both[:n] / np.hypot(*both[:n].T)[:, None]
    heading = np.arctan2(-normal[:, 0], normal[:, 1]) - pose[2]
    half_turn = 0.5 * wrap_angle(np.diff(heading, prepend=heading[:1]))
    widths, bends, confirmed = [], [], np.ones(n, bool)
    for stretch, foot in zip(stretches, feet, strict=True):
        u, d = foot.u[:n], foot.distance[:n]
        k = np.interp(u, stretch.u, stretch.curvature)
        bends.append(k / (1.0 - k * d))  # of the parallel curve through each point
        # the normal of the line crosses the osculating circle where k w^2 + 2 w half = rest
        half, rest = dot(normal, foot.normal_unit[:n]) * (1.0 - k * d), (2.0 - k * d) * d
        widths.append(np.abs(rest) / (np.abs(half) + np.sqrt(np.maximum(half**2 + k * rest, 0.0))))
        confirmed &= u <= stretch.confirmed_end
    return TrackAhead(
        points=to_vehicle(points, pose[None]),
        heading=wrap_angle(heading),
        curvature=0.5 * dot(normal, feet[0].normal_unit[:n]) * (bends[0] + bends[1]),
        arc_length=np.cumsum(steps[:n] / np.sinc(half_turn / np.pi)),  # along circular arcs
        width_left=widths[0],
        width_right=widths[1],
        confirmed=confirmed,
        left=sides[LEFT],
        right=sides[RIGHT],
    )


@dataclass(frozen=True, eq=False)
class _Stretch(lines.SampledBoundary):
    """Samples of a boundary whose parameter is 0 beside the vehicle."""

    curvature: Array  # (n,) in 1/m
    confirmed_end: float  # parameter up to which it is confirmed


def _stretch(curve: CurveAhead, distance: float) -> _Stretch:
    """Sample a boundary from behind the vehicle on.

    The cubic through the samples, and through tentative points with the slopes of a Catmull-Rom spline,
    differs from the curve by far less than a mm.
    """
    tables, beside = curve.tables, curve.beside
    # the outer boundary of a turn is up to 1.8 times as long as the centre line
    begin, end = beside - _SAMPLES_BEHIND, beside + 1.8 * distance + _SAMPLES_BEHIND
    if tables.periodic:
        end = min(end, begin + tables.length)  # at most one period
    else:
        end = min(end, tables.high, curve.until)
        begin = min(max(begin, tables.low), end - lines.SAMPLE_STEP)
    # put a sample beside the vehicle, unless the curve begins or ends there
    low, high = (begin - beside) / lines.SAMPLE_STEP + _SETTLED, (end - beside) / lines.SAMPLE_STEP - _SETTLED
    u = lines.SAMPLE_STEP * np.arange(floor(low), ceil(high) + 1, dtype=np.float64)
    u[[0, -1]] = begin - beside, end - beside
    values, span = tables.evaluate(beside + u, 2)
    columns = span[:, None] + np.arange(-tables.degree, 1)
    places = np.einsum("rkj,kjd->rkd", values, curve.control_points[columns])
    nodes, (points, slopes, _), end = u, places, float(u[-1])
    tentative = curve.tentative if curve.tentative is not None else points[:0]
    if len(tentative):
        edges = np.diff(np.concatenate([points[-1:], tentative]), axis=0)
        lengths = np.hypot(*edges.T)
        unit, share = edges / lengths[:, None], (lengths[:-1] / (lengths[:-1] + lengths[1:]))[:, None]
        slopes = np.concatenate([slopes, unit[:-1] * (1.0 - share) + unit[1:] * share, unit[-1:]])
        points, nodes = np.concatenate([points, tentative]), np.append(u, end + np.cumsum(lengths))
    spline = BSpline.hermite(nodes, points, slopes)
    if len(tentative):
        beyond = np.linspace(end, nodes[-1], ceil((nodes[-1] - end) / lines.SAMPLE_STEP) + 1)[1:]
        u, places = np.append(u, beyond), np.concatenate([places, spline.derivatives(beyond, 2)], axis=1)
    some = np.append(np.arange(0, len(u) - 1, 2), len(u) - 1)  # every other sample is paired
    u, (points, first, second) = u[some], places[:, some]
    curvature = cross(first, second) / np.hypot(*first.T) ** 3
    return _Stretch(spline, u, u, points, first, curvature, end if curve.confirmed else -np.inf)


# --- speed -----------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class SpeedProfile:
    """Speed at the n points of a line."""

    speed: Array
    """Speed (n,) in m/s."""
    acceleration: Array
    """Acceleration (n,) from each point to the next, in m/s^2; 0 at the last point of an open line."""
    time: Array
    """Time (n,) since the first point, in s."""
    duration: float
    """Time for the whole line (s): the lap time of a closed one."""


def speed_profile(
    line: CentreLine | TrackAhead,
    settings: SpeedSettings | None = None,
    begin: float | None = None,
    end: float | None = None,
) -> SpeedProfile:
    """Compute the largest speeds with v <= v_top on the friction ellipse

        (v^2 k / a_lateral)^2 + (a / a_long)^2 <= 1,

    with the curvature k, and the acceleration a, constant from each point to the next one. Each such step
    obeys it at its slower end. a_long is `forward` or `braking`. The pass of the curvature sets
    v^2 = a_lateral / |k|; a forward and a backward pass bound v_next^2 by v^2 + 2 a ds (Kapania et al., J.
    Dyn. Syst. Meas. Control 138, 2016). A closed line begins and ends at the same speed, an open one at the
    given speeds (m/s), by default as fast as its curvature allows. SettingsError for fewer than two points,
    or an impossible speed.
    """
    settings, limits = settings or SpeedSettings(), [one for one in (begin, end) if one is not None]
    if len(line.curvature) < 2:
        found = len(line.curvature)
        raise SettingsError(f"a speed profile: expected a line of at least 2 points, found {found}")
    if line.closed and limits:
        raise SettingsError("a speed profile: expected an open line for a begin or end speed, found a loop")
    for limit in limits:
        if not 0.0 <= limit < np.inf:
            raise SettingsError(f"a speed profile: expected a speed (m/s) of at least 0, found {limit:g}")
    count, steps = len(line.curvature), np.diff(line.arc_length)
    bend = np.abs(line.curvature) / settings.lateral
    squares = np.minimum(1.0 / np.maximum(bend, np.finfo(float).tiny), settings.top**2)
    if line.closed:  # begin and end at the slowest point
        first = int(squares.argmin())
        around = np.arange(first, first + count + 1) % count
        steps = np.append(steps, line.length - line.arc_length[-1])[around[:-1]]
        squares, bend = squares[around], bend[around]
    for at, most in ((0, begin), (-1, end)):
        squares[at] = squares[at] if most is None else min(squares[at], most**2)
    squares = _accelerated(squares, steps, bend, settings.forward)
    squares = _accelerated(squares[::-1], steps[::-1], bend[::-1], settings.braking)[::-1]
    acceleration, speed = 0.5 * np.diff(squares) / steps, np.sqrt(squares)
    sums = speed[:-1] + speed[1:]
    seconds = np.divide(2.0 * steps, sums, out=np.full(len(steps), np.inf), where=sums > 0.0)
    if line.closed:
        columns = speed[:-1], acceleration, seconds
        speed, acceleration, seconds = (np.roll(column, first) for column in columns)
    else:
        acceleration = np.append(acceleration, 0.0)
    time = np.append(0.0, np.cumsum(seconds))
    return SpeedProfile(speed, acceleration, time[:count], float(time[-1]))


def _accelerated(squares: Array, steps: Array, bend: Array, most: float) -> Array:
    """Limit squared speeds (n,) to what an acceleration of at most `most` (m/s^2) reaches along the line."""
    reached, now = squares.tolist(), float(squares[0])
    for i, (step, turn) in enumerate(zip(steps.tolist(), bend[:-1].tolist(), strict=True), 1):
        share = sqrt(max(1.0 - (now * turn) ** 2, 0.0))
        now = reached[i] = min(reached[i], now + 2.0 * most * share * step)
    return np.array(reached)
