"""The centre line between two boundaries: the curve whose normals cross both at equal distances.

It is represented as a ribbon, one B-spline of the centre line and half the width.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, Literal

import numpy as np
from scipy.sparse import csc_array, csr_array, diags_array
from scipy.sparse.linalg import SuperLU, splu

from pathspace_graph.errors import SettingsError
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.residuals import greville, smoothness_coefficients
from pathspace_graph.factors.se2 import left_of, path_lengths
from pathspace_graph.labels import LEFT, RIGHT

from .bspline import BSpline, dot, segments_cross

RIBBON: Final = 3  # entries of a ribbon's control point: x, y (m, map frame) and half the width h (m)
SIDE: Final = {LEFT: 1.0, RIGHT: -1.0}  # side of the centre line of each label's edge
SAMPLE_STEP: Final = 0.5  # distance of the samples of boundaries, lines and fitted edges (m)
_EDGE_BREAKS: Final = 2  # knot intervals of a fitted edge for each of the ribbon; an edge is no B-spline


@dataclass(frozen=True, eq=False, repr=False)
class Ribbon(BSpline):
    """A spline (x, y, h)(u) = sum_j N_j(u) c_j with the centre C = (x, y) and the edges C + h n and C - h n.

    The parameter is about the length (m) along the line; h is half the width (m).
    """

    DIMENSION = RIBBON

    @cached_property
    def centre(self) -> BSpline:
        return BSpline.on(self.tables, self.control_points[:, :2])

    def half_width(self, u: Array) -> Array:
        """Half the width (k,) of the track, in m."""
        return np.asarray(self.evaluate(u)[:, 2])

    @cached_property
    def bending(self) -> Array:
        """Coefficients (r, 3) of the second differences of the control points j, j + 1 and j + 2."""
        period = self.tables.length if self.periodic else None
        return smoothness_coefficients(greville(self.knots, self.degree)[: self.size], period)

    @property
    def spacing(self) -> float:
        """Mean distance of neighbouring knots (m)."""
        return self.tables.length / len(self.tables.starts)

    def edge(self, u: Array, side: float) -> tuple[Array, Array]:
        """Return points (k, 2) of an edge, and their derivatives (k, 2, 3 m) by the control points.

        With dn = -t (n . dC') / |C'|, the derivatives of `C + s h n` by c_j and h_j are
        `beta_j I - s h / |C'| beta'_j t n'` and `s beta_j n`.
        """
        B, slope = self.basis_matrix(u), self.basis_matrix(u, 1)
        at, first = B @ self.distinct_control_points, slope @ self.distinct_control_points[:, :2]
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
        """Fit an edge by a B-spline of m' control points; return it and their derivatives (2m', 3m)."""
        low, high = self.domain
        blank = BSpline.even(low, high, _EDGE_BREAKS * len(self.tables.starts), self.periodic, self.degree)
        steps = int(np.ceil((high - low) / SAMPLE_STEP))
        u = np.linspace(low, high, steps + 1)[: steps if self.periodic else None]
        points, jacobian = self.edge(u, SIDE[label])
        fit = np.linalg.pinv(blank.basis_matrix(u))
        by_ribbon = np.einsum("ik,kdc->idc", fit, jacobian).reshape(2 * blank.size, -1)
        return blank.with_points(fit @ points), by_ribbon


# --- the line between two boundaries ---------------------------------------------------------------------

RIBBON_SPACING: Final = 3.0  # distance of the knots of a planner's line (m); shorter kinks are smoothed
MOST_SAMPLES: Final = 200_000  # largest number of samples of a boundary; bounds the memory
_FEWEST_SPANS: Final = 4  # smallest number of samples of a boundary and of knot intervals of a line
_PAIR_STARTS: Final = 200  # number of samples of the left boundary tried as the start of the march
_PAIRS_NEAR: Final = 12  # samples on either side of a pair in which segments are tested for a crossing
_RIBBON_ROUNDS: Final = 3  # number of moves of the line to the middle between the crossings of its normals
_RIBBON_SMOOTHNESS: Final = 1e-3  # weight of second differences, where samples do not determine the fit
_CROSSING_STEPS: Final = 8  # number of Newton steps to the crossing of a normal and a boundary
_CROSSED: Final = 1e-6  # tolerance of a point where a normal crosses a boundary (m)
_LEAST_COSINE: Final = 0.1  # least cosine of the angle between boundary and line at a crossing
_FARTHEST_ACROSS: Final = 1.5  # largest distance of a crossing, relative to the paired sample's


@dataclass(frozen=True, eq=False)
class CentreCurve:
    """A ribbon between two boundaries, with samples that map its parameter to theirs."""

    ribbon: Ribbon
    u: Array  # (k,) parameters of the ribbon, about evenly spaced; on a loop without the repeated first one
    sides: tuple[BSpline, BSpline]  # left and right boundary
    beside: tuple[Array, Array]  # (k,) parameters of the boundaries beside each sample, not wrapped

    @property
    def size(self) -> int:
        return self.sides[0].size + self.sides[1].size

    def table(self, side: int) -> Array:
        """Pairs (n, 2) of parameters of a boundary, ascending, and of the ribbon; over a whole loop."""
        u, own = self.u, self.beside[side]
        if self.ribbon.periodic:
            (low, high), (begin, end) = self.sides[side].domain, self.ribbon.domain
            u, own = np.append(u, u[0] + end - begin), np.append(own, own[0] + high - low)
        return np.column_stack([np.maximum.accumulate(own), u])

    def ribbon_parameters(self, side: int, u: Array) -> Array:
        """Parameters (k,) of the ribbon beside the parameters u (k,) of a boundary."""
        table = self.table(side)
        if self.ribbon.periodic:
            low, high = self.sides[side].domain
            u = table[0, 0] + np.mod(u - table[0, 0], high - low)
        return np.interp(u, table[:, 0], table[:, 1])

    def crossings(self, at: Array) -> "list[Crossing]":
        """Find where the normals at parameters `at` (k,) of the ribbon cross each boundary."""
        points, tangent = self.ribbon.centre.evaluate(at), self.ribbon.centre.tangent_unit(at)
        normal, half = left_of(tangent), self.ribbon.half_width(at)
        found = []
        for side, spline in enumerate(self.sides):
            outward, (low, high) = SIDE[side], spline.domain
            begin = u = np.interp(at, *self.table(side).T[::-1])
            far = _FARTHEST_ACROSS * np.linalg.norm(spline.evaluate(u) - points, axis=1)
            for _ in range(_CROSSING_STEPS):
                point, first = spline.derivatives(u, 1)
                ahead, slope = dot(point - points, tangent), dot(first, tangent)
                u = u - np.divide(ahead, slope, out=np.zeros_like(u), where=slope != 0.0)
                u = u if spline.periodic else np.minimum(np.maximum(u, low), high)
            offset = spline.evaluate(u) - points
            across = dot(offset, normal)
            good = np.abs(dot(offset, tangent)) <= _CROSSED
            good &= (outward * across > 0.0) & (np.abs(across) <= far)
            good &= dot(spline.tangent_unit(u), tangent) >= _LEAST_COSINE
            u, across = np.where(good, u, begin), np.where(good, across, outward * half)
            found.append(Crossing(spline, u, normal, across, good))
        return found

    @cached_property
    def by_boundaries(self) -> Array:
        """Derivatives (3m, 2M) of the ribbon's control points by the M of both boundaries, left first.

        At fixed normals a crossing moves by `N . dS / (N . n)` along the normal n, where N is the normal of
        the boundary. The line moves by the mean of both, half the width changes by half the difference.
        """
        left, right = self.crossings(self.u)
        moves = left.along_normal(0, self.size), right.along_normal(left.spline.size, self.size)
        normal = self.ribbon.centre.normal_unit(self.u)
        across, half = 0.5 * (moves[0] + moves[1]), 0.5 * (moves[0] - moves[1])
        parts = (diags_array(normal[:, 0]) @ across, diags_array(normal[:, 1]) @ across, half)
        fit = _Fit(self.ribbon, self.u)
        solved = np.stack([fit.solve(part.toarray()) for part in parts], axis=1)
        return np.asarray(solved.reshape(RIBBON * self.ribbon.size, -1))


@dataclass(frozen=True, eq=False)
class Crossing:
    """The points where normals of a line cross a boundary."""

    spline: BSpline
    u: Array  # (k,) parameters of the boundary, not wrapped; those of the paired samples if not `good`
    normal: Array  # (k, 2) unit normals of the line, to the left
    offset: Array  # (k,) signed distance along the normal, positive to the left (m)
    good: BoolArray  # (k,) whether the normal crosses the boundary

    @cached_property
    def own_normal(self) -> Array:
        """Normals N (k, 2) of the boundary over N . n, the cosine of its angle to the line."""
        own = self.spline.normal_unit(self.u)
        return np.asarray(own / np.maximum(dot(own, self.normal), _LEAST_COSINE)[:, None])

    def along_normal(self, first: int, size: int) -> csr_array:
        """Derivatives (k, 2s) of the offset by all s control points; the boundary's begin at `first`."""
        values, columns = self.spline.local_basis(self.u)
        entries = values[:, :, None] * self.own_normal[:, None, :]
        return sparse_rows(entries, 2 * (columns + first)[:, :, None] + np.arange(2), 2 * size)


def find_line(left: BSpline, right: BSpline, spacing: float = RIBBON_SPACING) -> CentreCurve:
    """Find the line between two boundaries, on knots about `spacing` (m) apart.

    Samples of both are paired along the strip between them, always over the shorter diagonal. A ribbon is
    fitted to the midpoints, then to the midpoints between the crossings of its normals with the boundaries.
    An open line ends where both end. SettingsError if a boundary is too long, or if they cross or swap sides.
    """
    longest = max(left.length(), right.length())
    if not longest <= MOST_SAMPLES * SAMPLE_STEP:
        raise SettingsError(
            f"expected boundaries of at most {MOST_SAMPLES * SAMPLE_STEP:g} m, found {longest:.6g} m"
        )
    sides, closed = (_Sampled(left), _Sampled(right)), left.periodic
    i, j = _paired(*sides)
    _check_apart(sides[0].points, sides[1].points, i, j, closed)
    (a, first), (b, second) = sides[0].at(i), sides[1].at(j)
    values = np.column_stack([0.5 * (a + b), 0.5 * np.hypot(*(a - b).T)])
    lengths = path_lengths(values)
    blank = Ribbon.even(0.0, lengths[-1], max(round(lengths[-1] / spacing), _FEWEST_SPANS), closed)
    count = max(int(np.ceil(lengths[-1] / SAMPLE_STEP)), RIBBON * (len(blank.breaks) - 1))
    u = np.linspace(0.0, lengths[-1], count + 1)[: count if closed else None]
    middles = np.column_stack([np.interp(u, lengths, column) for column in values.T])
    beside = np.interp(u, lengths, first), np.interp(u, lengths, second)
    fit = _Fit(blank, u)
    line = CentreCurve(blank.with_points(fit.solve(middles)), u, (left, right), beside)
    for _ in range(_RIBBON_ROUNDS):
        one, other = line.crossings(u)
        good = one.good & other.good
        middle = 0.5 * (one.offset + other.offset)[:, None] * one.normal + line.ribbon.centre.evaluate(u)
        half = 0.5 * (one.offset - other.offset)
        values = np.where(good[:, None], np.column_stack([middle, half]), middles)
        beside = np.where(good, one.u, line.beside[0]), np.where(good, other.u, line.beside[1])
        line = replace(line, ribbon=blank.with_points(fit.solve(values)), beside=beside)
    return line


class _Fit:
    """Least-squares fit of a ribbon's control points to values at parameters u (k,)."""

    def __init__(self, ribbon: Ribbon, u: Array) -> None:
        self._basis = sparse_rows(*ribbon.local_basis(u), ribbon.size)
        triples = (np.arange(len(ribbon.bending))[:, None] + np.arange(RIBBON)) % ribbon.size
        D = sparse_rows(ribbon.bending, triples, ribbon.size)
        information = self._basis.T @ self._basis + _RIBBON_SMOOTHNESS**2 * (D.T @ D)
        self._factor: SuperLU = splu(csc_array(information))

    def solve(self, values: Array) -> Array:
        return np.asarray(self._factor.solve(np.asarray(self._basis.T @ values)))


def sparse_rows(values: Array, columns: IntArray, size: int) -> csr_array:
    """Build a sparse matrix (k, size) from the values (k, ...) and columns of each row."""
    ends = np.arange(len(values) + 1) * (values.size // len(values))
    return csr_array((values.ravel(), columns.ravel(), ends), shape=(len(values), size))


# --- pairs along the strip -------------------------------------------------------------------------------


class _Sampled:
    """Samples of a boundary about `SAMPLE_STEP` apart; on a loop without the repeated first one."""

    def __init__(self, spline: BSpline) -> None:
        self.spline, self.length = spline, spline.length()
        count = max(int(np.ceil(self.length / SAMPLE_STEP)), _FEWEST_SPANS)
        ends = np.linspace(0.0, self.length, count + 1)[: count if spline.periodic else None]
        self.u = spline.parameters_at(ends)
        self.points = spline.evaluate(self.u)

    def __len__(self) -> int:
        return len(self.u)

    def at(self, indices: IntArray) -> tuple[Array, Array]:
        """Return points (k, 2) and parameters (k,) of samples; indices continue past the end of a loop."""
        low, high = self.spline.domain
        around, own = np.divmod(indices, len(self))
        return self.points[own], self.u[own] + (high - low) * around


def _paired(one: _Sampled, other: _Sampled) -> tuple[IntArray, IntArray]:
    """Pair the samples of both boundaries that face each other, in driving order."""
    i, j = _first_pair(one, other)
    lefts, rights = ([tuple(point) for point in side.points.tolist()] for side in (one, other))
    if one.spline.periodic:
        lefts, rights = lefts[i:] + lefts[: i + 1], rights[j:] + rights[: j + 1]
        ahead = np.array(_march(lefts, rights, True))
        left, right = ahead[:, 0] + i, ahead[:, 1] + j
        # begin the line at the first sample of the left boundary, not at the nearest pair
        begin = int(np.argmax(left >= len(one)))
        left = np.append(left[begin:-1] - len(one), left[: begin + 1])
        right = np.append(right[begin:-1], right[: begin + 1] + len(other))
        return left, right - len(other) * (right[0] // len(other))
    back = -np.array(_march(lefts[i::-1], rights[j::-1], False))[:0:-1]
    ahead = np.array(_march(lefts[i:], rights[j:], False))
    pairs = np.concatenate([back.reshape(-1, 2), ahead])
    return pairs[:, 0] + i, pairs[:, 1] + j


def _first_pair(one: _Sampled, other: _Sampled) -> tuple[int, int]:
    """Find the nearest pair of samples that face each other, the left one on the left."""
    some = np.unique(np.linspace(0, len(one) - 1, _PAIR_STARTS).astype(int))
    points = one.points[some], other.points
    tangents = one.spline.tangent_unit(one.u)[some], other.spline.tangent_unit(other.u)
    lengths = np.linspace(0.0, one.length, len(one))[some], np.linspace(0.0, other.length, len(other))
    # an open map may overlap itself before its loop is closed
    apart = np.inf if one.spline.periodic else 0.5 * min(one.length, other.length)
    i, j = points_across(points, tangents, lengths, apart)
    if not len(i):
        raise SettingsError("expected the left boundary to the left of the right one, found no such place")
    best = int(((points[0][i] - points[1][j]) ** 2).sum(axis=1).argmin())
    return int(some[i[best]]), int(j[best])


def points_across(
    points: tuple[Array, Array], tangents: tuple[Array, Array], lengths: tuple[Array, Array], apart: float
) -> tuple[IntArray, IntArray]:
    """Return the samples of the first curve that have a sample of the second across, and these samples.

    The sample across is the nearest one to the right of the first curve that has the first curve on its left
    and the same direction. Their arc lengths differ by at most `apart` (m).
    """
    normals = left_of(tangents[0]), left_of(tangents[1])
    square = ((points[0][:, None] - points[1]) ** 2).sum(axis=2)
    good = normals[0] @ points[1].T < dot(points[0], normals[0])[:, None]
    good &= points[0] @ normals[1].T > dot(points[1], normals[1])
    good &= tangents[0] @ tangents[1].T > 0.0
    good &= np.abs(lengths[0][:, None] - lengths[1]) <= apart
    found = np.flatnonzero(good.any(axis=1))
    return found, np.where(good, square, np.inf).argmin(axis=1)[found]


def _march(
    lefts: list[tuple[float, ...]], rights: list[tuple[float, ...]], to_the_end: bool
) -> list[tuple[int, int]]:
    """March along two rows, always over the shorter diagonal; return the pairs passed."""
    i = j = 0
    pairs = [(0, 0)]
    last = len(lefts) - 1, len(rights) - 1
    while i < last[0] or j < last[1]:
        by_left = _square(lefts[i + 1], rights[j]) if i < last[0] else np.inf
        by_right = _square(lefts[i], rights[j + 1]) if j < last[1] else np.inf
        at_end = i == last[0] or j == last[1]
        if at_end and not to_the_end and min(by_left, by_right) >= _square(lefts[i], rights[j]):
            break
        if by_left <= by_right:
            i += 1
        else:
            j += 1
        pairs.append((i, j))
    return pairs


def _square(a: tuple[float, ...], b: tuple[float, ...]) -> float:
    return (a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2


def _check_apart(lefts: Array, rights: Array, i: IntArray, j: IntArray, closed: bool) -> None:
    """Raise a SettingsError if the boundaries cross near a pair of samples that face each other."""
    mode: Literal["wrap", "clip"] = "wrap" if closed else "clip"
    near = j[:, None] + np.arange(-_PAIRS_NEAR, _PAIRS_NEAR + 1)
    p, q = (lefts.take(i[:, None] + k, axis=0, mode=mode) for k in range(2))
    r, s = (rights.take(near + k, axis=0, mode=mode) for k in range(2))
    crossed = segments_cross(p, q, r, s).any(axis=1)
    if crossed.any():
        x, y = p[crossed.argmax(), 0]
        raise SettingsError(
            f"expected boundaries that do not cross, found them crossing near x = {x:.1f} m, y = {y:.1f} m"
        )
