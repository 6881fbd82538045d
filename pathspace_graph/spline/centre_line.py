"""The centre line between two boundaries: the curve whose normals cross both at equal distances.

It is represented as a ribbon, one B-spline of the centre line and half the width.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from math import dist
from typing import Final, Literal

import numpy as np
from scipy.sparse import csr_array, diags_array

from pathspace_graph.errors import SettingsError
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.se2 import left_of, path_lengths
from pathspace_graph.labels import LEFT, RIGHT

from .bspline import SAMPLED_WEIGHT, BSpline, LeastSquares, dot, segments_cross, sparse_rows

RIBBON: Final = 3  # entries of a ribbon's control point: x, y (m, map frame) and half the width h (m)
SIDE: Final = {LEFT: 1.0, RIGHT: -1.0}  # side of the centre line of each label's edge
SAMPLE_STEP: Final = 0.5  # distance of the samples of boundaries, lines and fitted edges (m)


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

    def edge(self, label: int) -> tuple[BSpline, Array]:
        """Fit an edge by a B-spline of m' control points; return it and their derivatives (2m', 3m).

        With dn = -t (n . dC') / |C'|, the derivatives of `C + s h n` by c_j and h_j are
        `beta_j I - s h / |C'| beta'_j t n'` and `s beta_j n`.
        """
        (low, high), side = self.domain, SIDE[label]
        steps = int(np.ceil((high - low) / SAMPLE_STEP))
        u = np.linspace(low, high, steps + 1)[: steps if self.periodic else None]
        B, slope = self.basis_matrix(u), self.basis_matrix(u, 1)
        at, first = B @ self.distinct_control_points, slope @ self.distinct_control_points[:, :2]
        speed, half = np.hypot(*first.T)[:, None], side * at[:, 2:]
        t = first / speed
        n = left_of(t)
        by_control = np.zeros((len(u), 2, self.size, RIBBON))
        by_control[:, 0, :, 0] = by_control[:, 1, :, 1] = B
        turned = (half / speed * slope)[:, None, :, None]
        by_control[:, :, :, :2] -= t[:, :, None, None] * turned * n[:, None, None, :]
        by_control[:, :, :, 2] = side * n[:, :, None] * B[:, None, :]
        # twice the knots of the ribbon, since an edge is no B-spline
        blank = BSpline.even(low, high, 2 * len(self.tables.starts), self.periodic, self.degree)
        fit = LeastSquares(blank, u, SAMPLED_WEIGHT)
        by_ribbon = fit.solve(by_control.reshape(len(u), -1)).reshape(2 * blank.size, -1)
        return blank.with_points(fit.solve(at[:, :2] + half * n)), by_ribbon


# --- the line between two boundaries ---------------------------------------------------------------------

MOST_SAMPLES: Final = 200_000  # largest number of samples of a boundary; bounds the memory
_FEWEST_SPANS: Final = 4  # smallest number of samples of a boundary and of knot intervals of a line
_CROSSED: Final = 1e-6  # tolerance of a point where a normal crosses a boundary (m)
_LEAST_COSINE: Final = 0.1  # least cosine of the angle between boundary and line at a crossing


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

    def crossings(self, at: Array) -> "list[NormalCrossing]":
        """Find where the normals at parameters `at` (k,) of the ribbon cross each boundary.

        Where a normal crosses none, or far from the paired sample, the crossing is half the width away.
        """
        points, tangent = self.ribbon.centre.evaluate(at), self.ribbon.centre.tangent_unit(at)
        half, normal, found = self.ribbon.half_width(at), left_of(tangent), []
        for side, spline in enumerate(self.sides):
            u = begin = np.interp(at, *self.table(side).T[::-1])
            far = 1.5 * np.linalg.norm(spline.evaluate(begin) - points, axis=1)
            for _ in range(8):  # Newton steps
                point, first = spline.derivatives(u, 1)
                ahead, slope = dot(point - points, tangent), dot(first, tangent)
                if (np.abs(ahead) <= _CROSSED).all():
                    break
                u = u - np.divide(ahead, slope, out=np.zeros_like(u), where=slope != 0.0)
                u = u if spline.periodic else np.clip(u, *spline.domain)
            offset = dot(point - points, normal)
            good = (np.abs(ahead) <= _CROSSED) & (slope >= _LEAST_COSINE * np.hypot(*first.T))
            good &= (SIDE[side] * offset > 0.0) & (np.abs(offset) <= far)
            offset = np.where(good, offset, SIDE[side] * half)
            found.append(NormalCrossing(spline, np.where(good, u, begin), normal, offset, good))
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
        fit = LeastSquares(self.ribbon, self.u, SAMPLED_WEIGHT)
        solved = np.stack([fit.solve(csr_array(part)) for part in parts], axis=1)
        return np.asarray(solved.reshape(RIBBON * self.ribbon.size, -1))


@dataclass(frozen=True, eq=False)
class NormalCrossing:
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


def find_line(left: BSpline, right: BSpline, spacing: float = 3.0) -> CentreCurve:
    """Find the line between two boundaries, on knots about `spacing` (m) apart, which smooths shorter kinks.

    Samples of both are paired along the strip between them, always over the shorter diagonal. A ribbon is
    fitted to the midpoints, then to the midpoints between the crossings of its normals with the boundaries.
    An open line ends where both end. SettingsError if a boundary is too long, or if they cross or swap sides.
    """
    longest = max(left.length(), right.length())
    if not longest <= MOST_SAMPLES * SAMPLE_STEP:
        raise SettingsError(
            f"expected boundaries of at most {MOST_SAMPLES * SAMPLE_STEP:g} m, found {longest:.6g} m"
        )
    sides, closed = (_sampled(left), _sampled(right)), left.periodic
    i, j = paired(*sides)
    if not len(i):
        raise SettingsError("expected the left boundary to the left of the right one, found no such place")
    _check_apart(sides[0].points, sides[1].points, i, j, closed)
    (a, first), (b, second) = sides[0].at(i), sides[1].at(j)
    values = np.column_stack([0.5 * (a + b), 0.5 * np.hypot(*(a - b).T)])
    lengths = path_lengths(values)
    blank = Ribbon.even(0.0, lengths[-1], max(round(lengths[-1] / spacing), _FEWEST_SPANS), closed)
    count = max(int(np.ceil(lengths[-1] / SAMPLE_STEP)), RIBBON * (len(blank.breaks) - 1))
    u = np.linspace(0.0, lengths[-1], count + 1)[: count if closed else None]
    middles = np.column_stack([np.interp(u, lengths, column) for column in values.T])
    beside = np.interp(u, lengths, first), np.interp(u, lengths, second)
    fit = LeastSquares(blank, u, SAMPLED_WEIGHT)
    line = CentreCurve(blank.with_points(fit.solve(middles)), u, (left, right), beside)
    for _ in range(3):  # to the middle between the crossings of its normals
        one, other = line.crossings(u)
        good = one.good & other.good
        middle = 0.5 * (one.offset + other.offset)[:, None] * one.normal + line.ribbon.centre.evaluate(u)
        half = 0.5 * (one.offset - other.offset)
        values = np.where(good[:, None], np.column_stack([middle, half]), middles)
        beside = np.where(good, one.u, line.beside[0]), np.where(good, other.u, line.beside[1])
        line = replace(line, ribbon=blank.with_points(fit.solve(values)), beside=beside)
    return line


# --- pairs along the strip -------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class SampledBoundary:
    """Samples (n,) of a boundary, about `SAMPLE_STEP` apart; on a loop without the repeated first one."""

    spline: BSpline
    u: Array  # parameters
    lengths: Array  # lengths along the boundary (m)
    points: Array  # (n, 2) in m
    tangents: Array  # (n, 2), of any length

    def at(self, indices: IntArray) -> tuple[Array, Array]:
        """Return points (k, 2) and parameters (k,) of samples; indices continue past the end of a loop."""
        low, high = self.spline.domain
        around, own = np.divmod(indices, len(self.u))
        return self.points[own], self.u[own] + (high - low) * around


def _sampled(spline: BSpline) -> SampledBoundary:
    length = spline.length()
    count = max(int(np.ceil(length / SAMPLE_STEP)), _FEWEST_SPANS)
    lengths = np.linspace(0.0, length, count + 1)[: count if spline.periodic else None]
    u = spline.parameters_at(lengths)
    return SampledBoundary(spline, u, lengths, *spline.derivatives(u, 1))


def paired(one: SampledBoundary, other: SampledBoundary, starts: int = 200) -> tuple[IntArray, IntArray]:
    """Pair the samples of a left and a right boundary that face each other, in driving order.

    The march begins at the nearest pair that faces each other, the left sample on the left, of about `starts`
    samples of the left boundary. There are no pairs without one.
    """
    some = np.unique(np.linspace(0, len(one.u) - 1, starts).astype(int))
    a, along, closed = one.points[some], one.tangents[some], one.spline.periodic
    b, beside = other.points, other.tangents
    normal, facing = left_of(along), left_of(beside)
    apart = (a[:, :1] - b[:, 0]) ** 2 + (a[:, 1:] - b[:, 1]) ** 2
    good = (normal @ b.T < dot(a, normal)[:, None]) & (a @ facing.T > dot(b, facing))
    good &= along @ beside.T > 0.0
    if not closed:  # an open map may overlap itself before its loop is closed
        most = 0.5 * min(one.lengths[-1], other.lengths[-1])
        good &= np.abs(one.lengths[some][:, None] - other.lengths) <= most
    if not good.any():
        return np.zeros(0, int), np.zeros(0, int)
    i, j = map(int, np.unravel_index(np.where(good, apart, np.inf).argmin(), good.shape))
    i = int(some[i])
    lefts, rights = (list(map(tuple, side.points.tolist())) for side in (one, other))
    if closed:
        lefts, rights = lefts[i:] + lefts[: i + 1], rights[j:] + rights[: j + 1]
        ahead = np.array(_march(lefts, rights, True))
        left, right = ahead[:, 0] + i, ahead[:, 1] + j
        # begin the line at the first sample of the left boundary, not at the nearest pair
        begin, sizes = int(np.argmax(left >= len(one.u))), (len(one.u), len(other.u))
        left = np.append(left[begin:-1] - sizes[0], left[: begin + 1])
        right = np.append(right[begin:-1], right[: begin + 1] + sizes[1])
        return left, right - sizes[1] * (right[0] // sizes[1])
    back = -np.array(_march(lefts[i::-1], rights[j::-1], False))[:0:-1]
    ahead = np.array(_march(lefts[i:], rights[j:], False))
    pairs = np.concatenate([back.reshape(-1, 2), ahead])
    return pairs[:, 0] + i, pairs[:, 1] + j


def _march(
    lefts: list[tuple[float, ...]], rights: list[tuple[float, ...]], to_the_end: bool
) -> list[tuple[int, int]]:
    """March along two rows, always over the shorter diagonal; return the pairs passed."""
    i = j = 0
    pairs = [(0, 0)]
    last = len(lefts) - 1, len(rights) - 1
    while i < last[0] or j < last[1]:
        by_left = dist(lefts[i + 1], rights[j]) if i < last[0] else np.inf
        by_right = dist(lefts[i], rights[j + 1]) if j < last[1] else np.inf
        at_end = i == last[0] or j == last[1]
        if at_end and not to_the_end and min(by_left, by_right) >= dist(lefts[i], rights[j]):
            break
        if by_left <= by_right:
            i += 1
        else:
            j += 1
        pairs.append((i, j))
    return pairs


def _check_apart(lefts: Array, rights: Array, i: IntArray, j: IntArray, closed: bool) -> None:
    """Raise a SettingsError if the boundaries cross near a pair of samples that face each other."""
    mode: Literal["wrap", "clip"] = "wrap" if closed else "clip"
    near = j[:, None] + np.arange(-12, 13)
    p, q = (lefts.take(i[:, None] + k, axis=0, mode=mode) for k in range(2))
    r, s = (rights.take(near + k, axis=0, mode=mode) for k in range(2))
    crossed = segments_cross(p, q, r, s).any(axis=1)
    if crossed.any():
        x, y = p[crossed.argmax(), 0]
        raise SettingsError(
            f"expected boundaries that do not cross, found them crossing near x = {x:.1f} m, y = {y:.1f} m"
        )
