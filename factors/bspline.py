"""B-spline bases on plain arrays: the Cox-de Boor recurrence, as polynomials on each span.

A spline of degree p over n control points has n + p + 1 non-decreasing knots and the domain
[knots[p], knots[n]]. On the span knots[i] <= u < knots[i + 1] only the control points i - p to i matter.
A periodic spline of m distinct control points is stored unwrapped: n = m + p control points, of which the
last p repeat the first, over one period of knots and p more on either side.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from math import factorial, floor

import numpy as np

from .arrays import Array, IntArray


def domain(knots: Array, degree: int) -> tuple[float, float]:
    """Limits knots[p] and knots[n] of the domain, where all p + 1 basis functions exist."""
    return float(knots[degree]), float(knots[len(knots) - degree - 1])


def divisors(width: Array) -> Array:
    """Replace zero widths by infinity, so that 0 / 0 counts as 0."""
    return np.where(width > 0.0, width, np.inf)


def scatter(values: Array, first: IntArray, size: int, periodic: bool = False) -> Array:
    """Scatter local values (m, p + 1) into dense rows (m, size), from the columns `first` (m,) on.

    Columns of a periodic spline are taken modulo `size`; values in the same column are summed.
    """
    matrix = np.zeros((len(values), size))
    columns = first[:, None] + np.arange(values.shape[1])
    if periodic:
        columns %= size
    np.add.at(matrix, (np.arange(len(values))[:, None], columns), values)
    return matrix


def uniform_knots(count: int, degree: int, interval: float = 1.0, start: float = 0.0) -> Array:
    """Floating (unclamped), equally spaced knots of `count` control points; the domain begins at `start`."""
    return start + interval * np.arange(-degree, count + 1, dtype=np.float64)


def clamped_knots(breaks: Array, degree: int) -> Array:
    """Clamped knots of k + p control points: breaks (k + 1,) with both ends repeated p more times."""
    return np.concatenate([np.full(degree, breaks[0]), breaks, np.full(degree, breaks[-1])])


def periodic_knots(breaks: Array, degree: int) -> Array:
    """Knots of m + p control points: one period of m + 1 > p breaks, with p more on either side."""
    period = breaks[-1] - breaks[0]
    before = breaks[-1 - degree : -1] - period
    after = breaks[1 : degree + 1] + period
    return np.concatenate([before, breaks, after])


@dataclass(frozen=True, eq=False)
class SpanPolynomials:
    """Basis functions as polynomials of s = (u - t_i) / (t_{i+1} - t_i) on each span i."""

    knots: Array  # (n + p + 1,) non-decreasing; unwrapped if the curve is periodic
    degree: int
    periodic: bool = False  # wrap parameters into the domain instead of clipping them
    known: Array | None = field(default=None, repr=False)  # coefficients of the first spans, if computed

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
    def coefficients(self) -> Array:
        """`N_{i-p+j}(u) = sum_k coefficients[k, i - p, j] s^k`; shape (p + 1, n - p spans, p + 1)."""
        if self.known is None:
            return _span_coefficients(self.knots, self.degree)
        count = self.known.shape[1]
        if count == len(self.starts):
            return self.known
        return np.concatenate([self.known, _span_coefficients(self.knots[count:], self.degree)], axis=1)

    @cached_property
    def _breaks(self) -> Array:
        last = int(np.searchsorted(self.starts, self.high, side="left")) - 1
        return self.knots[self.degree + 1 : self.degree + 1 + max(last, 0)]

    @cached_property
    def _stacks(self) -> dict[int, Array]:
        return {0: self.coefficients}

    def extended(self, knots: Array) -> SpanPolynomials:
        """Extend an open curve to knots that begin with its own; only new spans are computed."""
        return SpanPolynomials(knots, self.degree, False, self.coefficients)

    def tail(self, first: int) -> SpanPolynomials:
        """Drop the first control points of an open curve; the remaining spans do not change."""
        return SpanPolynomials(self.knots[first:], self.degree, False, self.coefficients[:, first:])

    @property
    def length(self) -> float:
        return self.high - self.low

    @property
    def size(self) -> int:
        """Number of distinct control points."""
        return len(self.starts) if self.periodic else len(self.starts) + self.degree

    @property
    def occupied(self) -> int:
        """Number of spans up to the last one that is not empty."""
        return len(self._breaks) + 1

    def inside(self, u: Array) -> Array:
        """Wrap u into the domain of a periodic curve, or clip it to the domain of an open one."""
        if self.periodic:
            u = u - self.length * np.floor((u - self.low) / self.length)
        return np.minimum(np.maximum(u, self.low), self.high)

    def locate(self, u: Array) -> tuple[IntArray, Array]:
        """Return span numbers (m,) in [0, n - p) and s (m,) in [0, 1] of u (m,), moved `inside` first."""
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

        u is moved `inside` first. Column j belongs to the control point span - p + j. Derivatives at a knot
        are right-sided, and left-sided at the right end of the domain.
        """
        number, s = self.locate(u)
        values = horner(self._stack(derivatives).take(number, axis=1), s[:, None])
        by_order = values.reshape(len(s), derivatives + 1, self.degree + 1).transpose(1, 0, 2)
        return by_order, number + self.degree

    def _stack(self, derivatives: int) -> Array:
        """Stack the polynomials of all orders: (p + 1, n - p, (derivatives + 1) (p + 1))."""
        if derivatives not in self._stacks:
            orders = [_derivative(self.coefficients, r, self.inverse_widths) for r in range(derivatives + 1)]
            self._stacks[derivatives] = np.ascontiguousarray(np.concatenate(orders, axis=2))
        return self._stacks[derivatives]


def horner(terms: Array, s: Array) -> Array:
    """Evaluate `sum_k terms[k] s^k` for terms (p + 1, m, ...) and s, which broadcasts to a term's shape."""
    total: Array = terms[-1] * s
    total += terms[-2]
    for term in terms[-3::-1]:
        total *= s
        total += term
    return total


def _span_coefficients(knots: Array, degree: int) -> Array:
    """Compute the coefficients (p + 1 powers, n - p spans, p + 1) in s by the recurrence of de Boor (1972).

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
    """Differentiate polynomials of s = (u - start) / width r times by u; the shape does not change."""
    derived = np.zeros_like(coefficients)
    for power in range(order, len(coefficients)):
        derived[power - order] = coefficients[power] * (factorial(power) // factorial(power - order))
    derived *= (inverse_widths**order)[:, None]
    return derived
