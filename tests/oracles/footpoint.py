"""Foot points in numpy: a coarse grid, and safeguarded Newton steps of all rows at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.bspline import horner

from .spans import Spans

_STEP_TOLERANCE: Final = 1e-9  # a row's last step, by the length of the domain; the error is its square
_FLAT: Final = 1e-12  # f' counts as zero where |f'| <= this * |S'|^2
_EQUAL_SQUARE: Final = 1e-12  # squared distances d, e (m^2) differ where e > d + this * (1 + d)
_END_TOLERANCE: Final = 1e-9  # a foot point this near (by the length of the domain) to an end is at the end
_NO_TANGENT: Final = 1e-12  # S' vanishes where |S'| <= this * largest coordinate / length of the domain
_TINY: Final = 1e-300  # smallest divisor of a step; the numerator vanishes before it does
_SAFEGUARDED: Final = 50  # most steps of a row that a Newton step has led farther away


def searched(
    spans: Spans,
    control_points: Array,
    points: Array,
    curve: IntArray,
    u_low: Array,
    u_high: Array,
    coarse_step: float,
    iterations: int,
) -> tuple[Any, ...]:
    """Return the fields of `Curves.search`."""
    search = _Search.of(spans, control_points, points, curve, u_low, u_high)
    start = search.nearest_on_grid(coarse_step)
    probe = search.descend(start, np.full(len(points), coarse_step), iterations)
    return search.finish(control_points, probe)


def refined(
    spans: Spans,
    control_points: Array,
    points: Array,
    curve: IntArray,
    u_start: Array,
    u_low: Array,
    u_high: Array,
    iterations: int,
) -> tuple[Any, ...]:
    """Return the fields of `Curves.refine`."""
    search = _Search.of(spans, control_points, points, curve, u_low, u_high)
    start = search.stretch.moved_into(u_start + spans.shift.take(curve))
    return search.finish(control_points, search.newton(start, iterations, _SAFEGUARDED))


@dataclass(frozen=True, eq=False)
class Stretch:
    """Part of its own curve where each row's foot point is searched for, on the axis of `Spans`."""

    periodic: bool
    begin: Array
    end: Array  # limits (m,) of the domain of each row's curve
    low: Array
    high: Array
    floor: Array
    ceiling: Array  # limits (m,) of the iteration, infinite where a stretch is a whole period
    interval: Array  # (m,) mean knot interval of each row's curve

    @property
    def length(self) -> Array:
        return self.end - self.begin

    def within(self, v: Array) -> Array:
        """Return v (m,) clipped to the limits of the iteration."""
        return np.minimum(np.maximum(v, self.floor), self.ceiling)

    def moved_into(self, v: Array) -> Array:
        """Return v (m,) moved into its stretch by whole periods, or to the nearest limit."""
        low, high = self.low, self.high
        if not self.periodic:
            return np.minimum(np.maximum(v, low), high)
        period = self.length
        inside = low + np.mod(v - low, period)
        nearest = np.where(inside - high < low + period - inside, high, low)
        return np.where(inside <= high, inside, nearest)

    def in_domain(self, v: Array) -> Array:
        """Return v (m,) wrapped into the domain of a periodic curve, or clipped to that of an open one."""
        if self.periodic:
            v = v - self.length * np.floor((v - self.begin) / self.length)
        return np.minimum(np.maximum(v, self.begin), self.end)

    def where(self, rows: BoolArray) -> Stretch:
        _, *limits = vars(self).values()
        return Stretch(self.periodic, *(limit[rows] for limit in limits))


def stretch_of(spans: Spans, curve: IntArray, u_low: Array, u_high: Array) -> Stretch:
    """Return the stretches of rows on curves `curve` (m,) between the parameters u_low and u_high (m,).

    A stretch lies inside the domain of an open curve and begins inside that of a periodic one. Reversed
    limits give a stretch of length zero.
    """
    begin, end, shift = spans.low.take(curve), spans.high.take(curve), spans.shift.take(curve)
    interval = spans.interval.take(curve)
    low, high = u_low + shift, u_high + shift
    if not spans.periodic:
        low = np.minimum(np.maximum(low, begin), end)
        high = np.maximum(low, np.minimum(high, end))
        return Stretch(False, begin, end, low, high, low, high, interval)
    period = end - begin
    whole = ~(high - low < period)
    if whole.any():
        low, high = np.where(whole, begin, low), np.where(whole, end, high)
    turns = period * np.floor((low - begin) / period)
    low, high = low - turns, np.maximum(low, high) - turns
    if not whole.any():
        return Stretch(True, begin, end, low, high, low, high, interval)
    floor, ceiling = np.where(whole, -np.inf, low), np.where(whole, np.inf, high)
    return Stretch(True, begin, end, low, high, floor, ceiling, interval)


_CHUNK: Final = 1 << 20  # largest number of point-to-grid distances in memory at once


@dataclass(frozen=True, eq=False)
class _Probe:
    """Curve and the distance to it at one parameter for each row."""

    v: Array  # (m,) places on the axis
    number: IntArray  # (m,) span numbers
    s: Array  # (m,) local coordinates on the spans
    offset: Array  # (2, m) S(u) - p, in m
    first: Array  # (2, m) derivatives S'(u)
    square: Array  # (m,) |S(u) - p|^2, in m^2
    slope: Array  # (m,) f = (S - p) . S', half the derivative of the squared distance
    step: Array  # (m,) downhill: Newton's -f / |f'|, or Gauss-Newton's -f / |S'|^2 where f' is zero


@dataclass(frozen=True, eq=False)
class _Search:
    """Points, and the stretches where their foot points are searched for."""

    spans: Spans
    coefficients: Array  # of the curves (`curve_coefficients`)
    points: Array  # (2, m) in m
    curve: IntArray  # (m,) number of each row's own curve
    stretch: Stretch

    @staticmethod
    def of(
        spans: Spans, control_points: Array, points: Array, curve: IntArray, u_low: Array, u_high: Array
    ) -> _Search:
        coefficients, columns = curve_coefficients(spans, control_points), np.ascontiguousarray(points.T)
        return _Search(spans, coefficients, columns, curve, stretch_of(spans, curve, u_low, u_high))

    def where(self, rows: BoolArray) -> _Search:
        points, curve, stretch = self.points[:, rows], self.curve[rows], self.stretch.where(rows)
        return _Search(self.spans, self.coefficients, points, curve, stretch)

    def nearest_on_grid(self, step: float) -> Array:
        """Return the nearest place (m,) to each point, of a grid in its stretch and the stretch's limits."""
        if len(self.curve) == 0:
            return np.zeros(0)
        low, high = self.stretch.low, self.stretch.high
        masks = [self.curve == k for k in range(len(self.spans.low))]
        grid = np.concatenate([_grid(low[rows], high[rows], step) for rows in masks if rows.any()])
        number, s = _located(self.spans, np.concatenate([grid, low, high]))
        on_curve = horner(self.coefficients[:, 0].take(number, axis=-1), s)
        on_grid, ends = on_curve[:, : len(grid)], on_curve[:, len(grid) :].reshape(2, 2, -1)
        offsets = ends - self.points[:, None]
        at_ends = offsets[0] ** 2 + offsets[1] ** 2
        index, at_grid = _nearest_of(self.points.T, grid, on_grid, low, high)
        choice = np.concatenate([at_grid[None], at_ends]).argmin(axis=0)
        return np.asarray(np.choose(choice, [grid[index], low, high]))

    def newton(self, start: Array, iterations: int, safeguarded: int) -> _Probe:
        """Take Newton steps; a row that one leads farther away is searched for to the end of its bracket."""
        reach, last = self.stretch.interval, self.probe(start)
        for _ in range(iterations):
            step = np.minimum(np.maximum(last.step, -reach), reach)
            v = self.stretch.within(last.v + step)
            probe = self.probe(v)
            farther = ~_no_farther(probe.square, last.square)
            if farther.any():
                v[farther] = self.where(farther).descend(last.v[farther], reach[farther], safeguarded).v
                probe = self.probe(v)
            last = probe
        return last

    def descend(self, start: Array, reach: Array, iterations: int) -> _Probe:
        """Take Newton steps that stay inside a bracket, or go to the middle of the bracket.

        The bracket reaches from the nearest place so far to one where the distance surely rises again, so
        that no row ever gets farther away. At first it is `reach` (m,) long, downhill.
        """
        tolerance, best = _STEP_TOLERANCE * self.stretch.length, self.probe(start)
        end, step = start - np.sign(best.slope) * reach, best.step
        for _ in range(iterations):
            inside = np.abs(step) < np.abs(end - best.v)
            candidate = self.stretch.within(np.where(inside, best.v + step, 0.5 * (best.v + end)))
            probe = self.probe(candidate)
            if not (np.abs(candidate - best.v) > tolerance).any():
                return probe
            better = _no_farther(probe.square, best.square)
            passed = probe.slope * best.slope <= 0.0
            end = np.where(better, np.where(passed, best.v, end), probe.v)
            step = np.where(better, probe.step, np.inf)
            pairs = zip(vars(probe).values(), vars(best).values(), strict=True)
            best = probe if better.all() else _Probe(*(np.where(better, new, old) for new, old in pairs))
        return best

    def probe(self, v: Array) -> _Probe:
        """Return the curve at the places v (m,), and its distance from the points."""
        number, s = _located(self.spans, v)
        orders = horner(self.coefficients.take(number, axis=-1), s)
        offset, first = orders[0], orders[1]
        offset -= self.points
        products = orders * offset
        square, slope, centripetal = products[:, 0] + products[:, 1]
        speed = _dot(first, first)
        curvature = np.abs(speed + centripetal)
        divisor = np.where(curvature > _FLAT * speed, curvature, speed)
        step = -slope / np.maximum(divisor, _TINY)
        return _Probe(v, number, s, offset, first, square, slope, step)

    def finish(self, control_points: Array, probe: _Probe) -> tuple[Any, ...]:
        """Return the fields of `FootPoints` at the places that were found."""
        columns = self.spans.columns.take(probe.number, axis=0)
        tangent = _unit_tangent(control_points, probe.first, columns, self.stretch.length)
        normal = np.empty_like(tangent)
        np.negative(tangent[1], out=normal[0])
        normal[1] = tangent[0]
        return (
            self.stretch.in_domain(probe.v) - self.spans.shift.take(self.curve),
            (self.points + probe.offset).T,
            tangent.T,
            normal.T,
            -_dot(normal, probe.offset),
            _interior(probe, self.stretch),
            horner(self.spans.values.take(probe.number, axis=1), probe.s[:, None]),
            probe.number + (self.spans.first + self.spans.degree),
            columns,
        )


def _located(spans: Spans, v: Array) -> tuple[IntArray, Array]:
    """Return the span number in [0, n), and s in [0, 1], of each place v (m,) on the axis."""
    laid = spans.starts[1:].searchsorted(v, side="right")
    s = (v - spans.starts.take(laid)) * spans.inverse_widths.take(laid)
    return spans.number.take(laid) if spans.periodic else laid, s


def curve_coefficients(spans: Spans, control_points: Array) -> Array:
    """Return C (p + 1, 3, 2, n): on span i, d^r S / du^r = sum_k C[k, r, :, i] s^k, r <= 2."""
    by_span = np.matmul(spans.by_span, control_points.take(spans.columns, axis=0))
    shape = (len(by_span), spans.degree + 1, 3, 2)
    return np.ascontiguousarray(by_span.reshape(shape).transpose(1, 2, 3, 0))


def _grid(low: Array, high: Array, step: float) -> Array:
    """Return evenly spaced places from the lowest to the highest limit of stretches (m,) on a curve."""
    first = float(low.min())
    count = max(int(np.ceil((float(high.max()) - first) / step)), 1) + 1
    return np.asarray(first + step * np.arange(count, dtype=np.float64))


def _nearest_of(
    points: Array, grid: Array, on_grid: Array, low: Array, high: Array
) -> tuple[IntArray, Array]:
    """Return the index (m,) of the nearest grid point in each stretch, and its squared distance (m,)."""
    index, least = np.empty(len(points), np.intp), np.empty(len(points))
    rows = max(_CHUNK // len(grid), 1)
    for begin in range(0, len(points), rows):
        chunk = slice(begin, begin + rows)
        squares = (points[chunk, :1] - on_grid[0]) ** 2
        squares += (points[chunk, 1:] - on_grid[1]) ** 2
        squares[(grid < low[chunk, None]) | (grid > high[chunk, None])] = np.inf
        index[chunk] = squares.argmin(axis=1)
        least[chunk] = squares.min(axis=1)
    return index, least


def _no_farther(square: Array, than: Array) -> BoolArray:
    """Return where a squared distance (m,) is no larger than another one, apart from round-off."""
    return square <= than + _EQUAL_SQUARE * (1.0 + than)


def _dot(a: Array, b: Array) -> Array:
    """Return the inner products (m,) of columns (2, m)."""
    products = a * b
    return np.asarray(products[0] + products[1])


def _unit_tangent(control_points: Array, first: Array, columns: IntArray, length: Array) -> Array:
    """Return S' / |S'| (2, m); where S' vanishes, the direction of the control polygon or of the x axis."""
    norm = np.sqrt(_dot(first, first))
    vanishing = ~(norm * length > _NO_TANGENT * np.abs(control_points).max(initial=0.0))
    if not vanishing.any():
        return first / norm
    ends = columns[vanishing]
    chord = (control_points[ends[:, -1]] - control_points[ends[:, 0]]).T
    chord[0, ~chord.any(axis=0)] = 1.0
    direction = first.copy()
    direction[:, vanishing] = chord
    norm[vanishing] = np.hypot(chord[0], chord[1])
    return direction / norm


def _interior(probe: _Probe, stretch: Stretch) -> BoolArray:
    """Return false (m,) at an end of an open domain, and at a limit beyond which the distance falls."""
    tolerance = _END_TOLERANCE * stretch.length
    at_low = probe.v - stretch.floor <= tolerance
    at_high = stretch.ceiling - probe.v <= tolerance
    outside = (at_low & (probe.slope > 0.0)) | (at_high & (probe.slope < 0.0))
    if not stretch.periodic:
        outside |= probe.v <= stretch.begin + tolerance
        outside |= probe.v >= stretch.end - tolerance
    return ~outside
