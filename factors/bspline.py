"""B-spline bases on plain arrays: the Cox-de Boor recurrence, as polynomials on each span.

A spline of degree p over n control points has n + p + 1 non-decreasing knots and the domain
[knots[p], knots[n]]. On the span knots[i] <= u < knots[i + 1] only the control points i - p to i matter.
A periodic spline of m distinct control points is stored unwrapped: n = m + p control points, of which the
last p repeat the first, over one period of knots and p more on either side.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from math import factorial, floor
from typing import Final

import numpy as np

from .arrays import Array, IntArray


def domain(knots: Array, degree: int) -> tuple[float, float]:
    """Return the limits knots[p] and knots[n] of the domain, where all p + 1 basis functions exist."""
    return float(knots[degree]), float(knots[len(knots) - degree - 1])


def divisors(width: Array) -> Array:
    """Return each width, or infinity where it is zero, so that 0 / 0 is taken as 0."""
    return np.where(width > 0.0, width, np.inf)


def scatter(values: Array, first: IntArray, size: int, periodic: bool = False) -> Array:
    """Return dense rows (m, size) of local values (m, p + 1), which begin in the columns `first` (m,).

    Columns of a periodic spline are taken modulo `size`, and values in the same column are added.
    """
    matrix = np.zeros((len(values), size))
    columns = first[:, None] + np.arange(values.shape[1])
    if periodic:
        columns %= size
    np.add.at(matrix, (np.arange(len(values))[:, None], columns), values)
    return matrix


def uniform_knots(count: int, degree: int, interval: float = 1.0, start: float = 0.0) -> Array:
    """Return unclamped, equally spaced knots of `count` control points; the domain begins at `start`."""
    return start + interval * np.arange(-degree, count + 1, dtype=np.float64)


def clamped_knots(breaks: Array, degree: int) -> Array:
    """Return the breaks (k + 1,) with both ends repeated p times more, as knots of k + p control points."""
    return np.concatenate([np.full(degree, breaks[0]), breaks, np.full(degree, breaks[-1])])


def periodic_knots(breaks: Array, degree: int) -> Array:
    """Return one period of m + 1 > p breaks with p more on either side: knots of m + p control points."""
    period = breaks[-1] - breaks[0]
    before = breaks[-1 - degree : -1] - period
    after = breaks[1 : degree + 1] + period
    return np.concatenate([before, breaks, after])


_PERIODS_LAID_OUT: Final = (-1.0, 0.0, 1.0)  # shifts at which a periodic curve lies on the axis of `Spans`
_GAP_OF_CURVES: Final = 1.0  # least distance of curves on the axis of `Spans`, in units of the parameter


@dataclass(frozen=True, eq=False)
class SpanPolynomials:
    """Basis functions as polynomials of s = (u - t_i) / (t_{i+1} - t_i) on each span i."""

    knots: Array  # (n + p + 1,) not decreasing, and unwrapped where the curve is periodic
    degree: int
    periodic: bool = False  # parameters are taken modulo the length of the domain instead of being clipped
    known: Array | None = field(default=None, repr=False)  # coefficients of the first spans

    def __post_init__(self) -> None:
        object.__setattr__(self, "knots", np.ascontiguousarray(self.knots, dtype=np.float64))

    @cached_property
    def low(self) -> float:
        return domain(self.knots, self.degree)[0]

    @cached_property
    def high(self) -> float:
        return domain(self.knots, self.degree)[1]

    @cached_property
    def starts(self) -> Array:
        """Left knots of the spans (n - p,)."""
        return self.knots[self.degree : -self.degree - 1]

    @cached_property
    def inverse_widths(self) -> Array:
        """`1 / (t_{i+1} - t_i)` of each span (n - p,), zero for an empty span."""
        widths = np.diff(self.knots[self.degree : len(self.knots) - self.degree])
        return np.where(widths > 0.0, 1.0 / divisors(widths), 0.0)

    @cached_property
    def windows(self) -> IntArray:
        """Indices (n - p, p + 1) of the control points that matter on each span."""
        return np.arange(len(self.starts))[:, None] + np.arange(self.degree + 1)

    @cached_property
    def coefficients(self) -> Array:
        """N_{i-p+j}(u) is sum_k coefficients[k, i - p, j] s^k; the shape is (p + 1, n - p spans, p + 1)."""
        if self.known is None:
            return _span_coefficients(self.knots, self.degree)
        count = self.known.shape[1]
        if count == len(self.starts):
            return self.known
        return np.concatenate([self.known, _span_coefficients(self.knots[count:], self.degree)], axis=1)

    @cached_property
    def alone(self) -> Spans:
        """Spans of this curve alone, on its unwrapped control points."""
        return lay_out([self], [0])

    @cached_property
    def _breaks(self) -> Array:
        last = int(np.searchsorted(self.starts, self.high, side="left")) - 1
        return self.knots[self.degree + 1 : self.degree + 1 + max(last, 0)]

    @cached_property
    def _stacks(self) -> dict[int, Array]:
        return {0: self.coefficients}

    def extended(self, knots: Array) -> SpanPolynomials:
        """Return an open curve's polynomials on knots that begin with these; only new spans are computed."""
        return SpanPolynomials(knots, self.degree, False, self.coefficients)

    def tail(self, first: int) -> SpanPolynomials:
        """Return an open curve's polynomials without its first control points; other spans stay the same."""
        return SpanPolynomials(self.knots[first:], self.degree, False, self.coefficients[:, first:])

    @property
    def length(self) -> float:
        return self.high - self.low

    @property
    def size(self) -> int:
        """Return the number of distinct control points."""
        return len(self.starts) if self.periodic else len(self.starts) + self.degree

    @property
    def occupied(self) -> int:
        """Return the number of spans up to the last one that is not empty."""
        return len(self._breaks) + 1

    def inside(self, u: Array) -> Array:
        """Return u wrapped into the domain of a periodic curve, or clipped to the domain of an open one."""
        if self.periodic:
            u = u - self.length * np.floor((u - self.low) / self.length)
        return np.minimum(np.maximum(u, self.low), self.high)

    def locate(self, u: Array) -> tuple[IntArray, Array]:
        """Return the span number (m,), in [0, n - p), and s (m,), in [0, 1], of each u (m,), put `inside`."""
        inside = self.inside(u)
        number = self._breaks.searchsorted(inside, side="right")
        return number, (inside - self.starts.take(number)) * self.inverse_widths.take(number)

    def span_of(self, u: float) -> int:
        """Return the span number of one parameter, as `locate` does."""
        if self.periodic:
            u -= self.length * floor((u - self.low) / self.length)
        return int(self._breaks.searchsorted(min(max(u, self.low), self.high), side="right"))

    def evaluate(self, u: Array, derivatives: int = 0) -> tuple[Array, IntArray]:
        """Return basis values and derivatives (derivatives + 1, m, p + 1) at u (m,), and the spans (m,) of u.

        u is put `inside`. Column j belongs to the control point span - p + j. A derivative at a knot is the
        one from the right, and at the right end of the domain the one from the left.
        """
        number, s = self.locate(u)
        values = horner(self._stack(derivatives).take(number, axis=1), s[:, None])
        by_order = values.reshape(len(s), derivatives + 1, self.degree + 1).transpose(1, 0, 2)
        return by_order, number + self.degree

    @cached_property
    def polynomials(self) -> Array:
        """Polynomials of the basis and of two derivatives by span: (n - p, 3 (p + 1), p + 1)."""
        return self._stack(2).transpose(1, 0, 2).reshape(len(self.starts), -1, self.degree + 1)

    def _stack(self, derivatives: int) -> Array:
        """Return the polynomials of all orders side by side: (p + 1, n - p, (derivatives + 1) (p + 1))."""
        if derivatives not in self._stacks:
            orders = [_derivative(self.coefficients, r, self.inverse_widths) for r in range(derivatives + 1)]
            self._stacks[derivatives] = np.ascontiguousarray(np.concatenate(orders, axis=2))
        return self._stacks[derivatives]


@dataclass(frozen=True, eq=False)
class Spans:
    """Spans of several curves of one degree on one axis v: rows on any of them are evaluated in one call.

    Parameter u of curve k lies at `v = u + shift[k]`. A periodic curve is laid out for three periods, so that
    a stretch across the seam need not be wrapped.
    """

    degree: int
    periodic: bool  # all curves are closed, or none is
    low: Array
    high: Array  # limits (k,) of the curves' domains on the axis
    shift: Array  # (k,) from a curve's own parameter to the axis; zero for the first curve
    interval: Array  # (k,) mean knot intervals
    first: int  # where the control points of the first curve begin in the common array
    columns: IntArray  # (n, p + 1) control points that matter on each span
    starts: Array  # (l,) left ends of the spans, in order: l is n, or 3 n for periodic curves
    inverse_widths: Array  # (l,) one over the width of each span
    number: IntArray  # (l,) number of each span, in [0, n)
    by_span: Array  # (n, 3 (p + 1), p + 1) polynomials of the basis and of two derivatives
    values: Array  # (p + 1, n, p + 1) polynomials of the basis, power after power


def horner(terms: Array, s: Array) -> Array:
    """Return sum_k terms[k] s^k for terms (p + 1, m, ...) and s, which broadcasts to the shape of a term."""
    total: Array = terms[-1] * s
    total += terms[-2]
    for term in terms[-3::-1]:
        total *= s
        total += term
    return total


def lay_out(
    curves: Sequence[SpanPolynomials], offsets: Sequence[int], sizes: Sequence[int] | None = None
) -> Spans:
    """Return the spans of curves, all periodic or none, laid out on one axis.

    The control points of each curve begin at its entry of `offsets` in a common array, which holds unwrapped
    ones, or as many distinct ones of each periodic curve as `sizes` tells.
    """
    periodic, counts = curves[0].periodic, [curve.occupied for curve in curves]
    periods = np.array(_PERIODS_LAID_OUT) if periodic else np.zeros(1)
    shift = np.array(_shifts(curves, periods))
    columns = [curve.windows[:n] for curve, n in zip(curves, counts, strict=True)]
    if periodic and sizes is not None:
        columns = [window % size for window, size in zip(columns, sizes, strict=True)]
    starts = [
        (curve.starts[:n] + curve.length * periods[:, None]).ravel() + moved
        for curve, n, moved in zip(curves, counts, shift, strict=True)
    ]
    first = np.cumsum([0, *counts[:-1]])
    number = [np.tile(k + np.arange(n), len(periods)) for k, n in zip(first, counts, strict=True)]
    inverse_widths = np.concatenate([c.inverse_widths[:n] for c, n in zip(curves, counts, strict=True)])
    laid = np.concatenate(number)
    return Spans(
        degree=curves[0].degree,
        periodic=periodic,
        low=np.array([curve.low for curve in curves]) + shift,
        high=np.array([curve.high for curve in curves]) + shift,
        shift=shift,
        interval=np.array([curve.length / len(curve.starts) for curve in curves]),
        first=offsets[0],
        columns=np.concatenate([k + window for k, window in zip(offsets, columns, strict=True)]),
        starts=np.concatenate(starts),
        inverse_widths=inverse_widths[laid],
        number=laid,
        by_span=np.concatenate([c.polynomials[:n] for c, n in zip(curves, counts, strict=True)]),
        values=np.concatenate([c.coefficients[:, :n] for c, n in zip(curves, counts, strict=True)], axis=1),
    )


def _shifts(curves: Sequence[SpanPolynomials], periods: Array) -> list[float]:
    """Return the shift of each curve at which no two overlap: whole numbers, which add little round-off."""
    shifts, end = [0.0], curves[0].high + curves[0].length * periods[-1]
    for curve in curves[1:]:
        shifts.append(float(np.ceil(end - (curve.low + curve.length * periods[0]) + _GAP_OF_CURVES)))
        end = curve.high + curve.length * periods[-1] + shifts[-1]
    return shifts


def _span_coefficients(knots: Array, degree: int) -> Array:
    """Return the coefficients (p + 1 powers, n - p spans, p + 1) in s, by the recurrence of de Boor (1972).

        N_i^p = (u - t_i) / (t_{i+p} - t_i) N_i^{p-1} + (t_{i+p+1} - u) / (t_{i+p+1} - t_{i+1}) N_{i+1}^{p-1}

    A term over an empty width is zero.
    """
    spans = np.arange(degree, len(knots) - degree - 1)
    start = knots[spans]
    width = knots[spans + 1] - start
    window = knots[spans + np.arange(1 - degree, degree + 1)[:, None]]
    level = np.zeros((degree + 1, 1, len(spans)))
    level[0] = 1.0
    for q in range(1, degree + 1):
        lower, upper = window[degree - q : degree], window[degree : degree + q]
        ratio = level / divisors(upper - lower)
        raised = np.zeros((degree + 1, q + 1, len(spans)))
        raised[:, :-1] = (upper - start) * ratio
        raised[:, 1:] += (start - lower) * ratio
        raised[1:, :-1] -= width * ratio[:-1]
        raised[1:, 1:] += width * ratio[:-1]
        level = raised
    return np.ascontiguousarray(level.transpose(0, 2, 1))


def _derivative(coefficients: Array, order: int, inverse_widths: Array) -> Array:
    """Return d^r/du^r of polynomials of s = (u - start) / width, in the same shape."""
    derived = np.zeros_like(coefficients)
    for power in range(order, len(coefficients)):
        derived[power - order] = coefficients[power] * (factorial(power) // factorial(power - order))
    derived *= (inverse_widths**order)[:, None]
    return derived
