"""Input of a planner: a centre line with widths, curvature and sigmas, and a speed profile."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from math import sqrt
from typing import TYPE_CHECKING, Final

import numpy as np

from pathspace_graph.errors import SettingsError
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.se2 import left_of
from pathspace_graph.settings.output import SpeedSettings

from .ahead import LEAST_STEP, MOST_POINTS, TrackAhead, check_length
from .bspline import BSpline, cross, dot
from .centre_line import RIBBON, CentreCurve, Crossing, find_line, sparse_rows

if TYPE_CHECKING:
    import pandas as pd


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
    settings = settings or SpeedSettings()
    _check_ends(line, begin, end)
    count, steps = len(line.curvature), np.diff(line.arc_length)
    bend = np.abs(line.curvature) / settings.lateral
    squares = np.minimum(1.0 / np.maximum(bend, np.finfo(float).tiny), settings.top**2)
    if line.closed:  # begin and end at the slowest point
        first = int(squares.argmin())
        around = np.arange(first, first + count + 1) % count
        steps = np.append(steps, line.length - line.arc_length[-1])[around[:-1]]
        squares, bend = squares[around], bend[around]
    for at, limit in ((0, begin), (-1, end)):
        squares[at] = squares[at] if limit is None else min(squares[at], limit**2)
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


def _check_ends(line: CentreLine | TrackAhead, begin: float | None, end: float | None) -> None:
    limits, where = [limit for limit in (begin, end) if limit is not None], "a speed profile: expected"
    if len(line.curvature) < 2:
        raise SettingsError(f"{where} a line of at least 2 points, found {len(line.curvature)}")
    if line.closed and limits:
        raise SettingsError(f"{where} an open line for a begin or end speed, found a loop")
    for limit in limits:
        if not 0.0 <= limit < np.inf:
            raise SettingsError(f"{where} a speed (m/s) of at least 0, found {limit:g}")


def _accelerated(squares: Array, steps: Array, bend: Array, most: float) -> Array:
    """Limit squared speeds (n,) to what an acceleration of at most `most` (m/s^2) reaches along the line."""
    reached, now = squares.tolist(), float(squares[0])
    for i, (step, turn) in enumerate(zip(steps.tolist(), bend[:-1].tolist(), strict=True), 1):
        share = sqrt(max(1.0 - (now * turn) ** 2, 0.0))
        now = reached[i] = min(reached[i], now + 2.0 * most * share * step)
    return np.array(reached)


_FEWEST_POINTS: Final = 4  # smallest number of points of a line
_NORMALS_APART: Final = 10  # largest number of points between normals that must not cross
_WIDTH_SHARE: Final = 0.95  # largest width, as a share of the distance to where two normals cross


@dataclass(frozen=True, eq=False, repr=False)
class CentreLine:
    """Smooth centre line of a track (`find_line`) at n evenly spaced points, map frame.

    Standard deviations are those of the point where the line crosses its normal; NaN without covariance.
    """

    points: Array
    """Points (n, 2) in m; a closed line does not repeat the first one."""
    heading: Array
    """Direction of travel (n,) in rad, in (-pi, pi]."""
    curvature: Array
    """Curvature (n,) in 1/m, positive in a left turn."""
    arc_length: Array
    """Length (n,) of the line from its first point, in m."""
    width_left: Array
    """Distance (n,) along the normal to the left boundary (m); shortened if normals would cross."""
    width_right: Array
    """Distance (n,) along the normal to the right boundary (m), shortened likewise."""
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
    line, closed = find_line(left, right), left.periodic
    centre = line.ribbon.centre
    length = centre.length()
    count = max(round(length / step), _FEWEST_POINTS)
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
    """Shorten the widths to the left and right, so that normals of neighbouring points do not meet.

    The normals p + a n and q + b m meet where a n - b m = q - p.
    """
    left, right = (width.copy() for width in widths)
    count = len(points)
    for apart in range(1, min(_NORMALS_APART, count - 1) + 1):
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


def _sigmas(line: CentreCurve, u: Array, crossings: list[Crossing], covariance: Array | None) -> list[Array]:
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
    moved = [(B @ by_control).reshape(len(u), RIBBON, -1)[:, :2] for B in basis]
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
