"""B-splines as polynomials on each span, of one curve or several: faster than the recurrence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from math import factorial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from .bspline import Floats, Ints, divisors, domain, wrap

Bools = NDArray[np.bool_]

_PERIODS_LAID_OUT: Final = (-1.0, 0.0, 1.0)
"""A periodic curve lies on the axis of `Spans` once for each of these shifts, in periods."""
_GAP_OF_CURVES: Final = 1.0
"""Curves on the axis of `Spans` are at least this far apart, in units of the parameter."""


@dataclass(frozen=True, eq=False)
class SpanPolynomials:
    """Holds the basis functions on each span as polynomials of s = (u - t_i) / (t_{i+1} - t_i).

    It gives the same values as `basis`, but faster.
    """

    knots: Floats
    """The knots (n + p + 1,) do not decrease; they are unwrapped where the curve is periodic."""
    degree: int
    """The degree p is at least 1."""
    periodic: bool = False
    """If true, parameters are taken modulo the length of the domain instead of being clipped to it."""
    low: float = field(init=False)
    """This is the left end of the domain."""
    high: float = field(init=False)
    """This is the right end of the domain."""
    coefficients: Floats = field(init=False, repr=False)
    """N_{i-p+j}(u) is sum_k coefficients[k, i - p, j] s^k; the shape is (p + 1, n - p spans, p + 1)."""
    starts: Floats = field(init=False, repr=False)
    """These are the left knots of the spans (n - p,)."""
    inverse_widths: Floats = field(init=False, repr=False)
    """Each entry (n - p,) is 1 / (t_{i+1} - t_i) of a span, and zero for an empty span."""
    known: Floats | None = field(default=None, repr=False)
    """These coefficients of the first spans are taken over instead of being computed again."""
    _breaks: Floats = field(init=False, repr=False)
    _by_span: dict[int, Floats] = field(init=False, repr=False, default_factory=dict)
    windows: Ints = field(init=False, repr=False)
    """Each row (n - p, p + 1) holds the control points that matter on a span."""
    _stacks: dict[int, Floats] = field(init=False, repr=False, default_factory=dict)
    _laid: dict[str, Spans] = field(init=False, repr=False, default_factory=dict)

    def __post_init__(self) -> None:
        knots = np.ascontiguousarray(self.knots, dtype=np.float64)
        low, high = domain(knots, self.degree)
        end = len(knots) - self.degree - 1
        last = int(np.searchsorted(knots[self.degree : end], high, side="left")) - 1
        set_field = object.__setattr__
        set_field(self, "knots", knots)
        set_field(self, "low", low)
        set_field(self, "high", high)
        set_field(self, "starts", knots[self.degree : end])
        widths = np.diff(knots[self.degree : end + 1])
        set_field(self, "inverse_widths", np.where(widths > 0.0, 1.0 / divisors(widths), 0.0))
        set_field(self, "coefficients", self._all_coefficients())
        set_field(self, "windows", np.arange(len(widths))[:, None] + np.arange(self.degree + 1))
        set_field(self, "_breaks", knots[self.degree + 1 : self.degree + 1 + max(last, 0)])

    def _all_coefficients(self) -> Floats:
        if self.known is None:
            return _span_coefficients(self.knots, self.degree)
        count = self.known.shape[1]
        if count == len(self.knots) - 2 * self.degree - 1:
            return self.known
        return np.concatenate([self.known, _span_coefficients(self.knots[count:], self.degree)], axis=1)

    def extended(self, knots: Floats) -> SpanPolynomials:
        """Returns an open curve's polynomials on knots that begin with these; only new spans are computed."""
        return SpanPolynomials(knots, self.degree, False, self.coefficients)

    def tail(self, first: int) -> SpanPolynomials:
        """Returns an open curve's polynomials without its first control points; other spans stay the same."""
        return SpanPolynomials(self.knots[first:], self.degree, False, self.coefficients[:, first:])

    @property
    def alone(self) -> Spans:
        """Returns the spans of this curve alone, on its unwrapped control points; they are computed once."""
        if "alone" not in self._laid:
            self._laid["alone"] = lay_out([self], [0])
        return self._laid["alone"]

    @property
    def length(self) -> float:
        """Returns the length of the domain."""
        return self.high - self.low

    @property
    def occupied(self) -> int:
        """Returns the number of spans up to the last one that is not empty."""
        return len(self._breaks) + 1

    def inside(self, u: Floats) -> Floats:
        """Returns u wrapped into the domain of a periodic curve, or clipped to the domain of an open one."""
        if self.periodic:
            return wrap(self.knots, self.degree, u)
        return np.minimum(np.maximum(u, self.low), self.high)

    def locate(self, u: Floats) -> tuple[Ints, Floats]:
        """Returns the span number span - p (m,), in [0, n - p), and s (m,), in [0, 1], of each u (m,).

        u is wrapped or clipped first.
        """
        inside = self.inside(u)
        number = self._breaks.searchsorted(inside, side="right")
        return number, (inside - self.starts.take(number)) * self.inverse_widths.take(number)

    def evaluate(self, u: Floats, derivatives: int = 0) -> tuple[Floats, Ints]:
        """Returns values (derivatives + 1, m, p + 1) and spans (m,) as `basis` does, by Horner's rule.

        u is wrapped or clipped first.
        """
        number, s = self.locate(u)
        values = horner(self._stack(derivatives).take(number, axis=1), s[:, None])
        by_order = values.reshape(len(s), derivatives + 1, self.degree + 1).transpose(1, 0, 2)
        return by_order, number + self.degree

    def polynomials(self, derivatives: int) -> Floats:
        """Returns the polynomials of all orders by span: (n - p, (p + 1) (derivatives + 1), p + 1)."""
        if derivatives not in self._by_span:
            by_span = self._stack(derivatives).transpose(1, 0, 2)
            self._by_span[derivatives] = by_span.reshape(by_span.shape[0], -1, self.degree + 1)
        return self._by_span[derivatives]

    def _stack(self, derivatives: int) -> Floats:
        """Returns the polynomials of all orders side by side: (p + 1, n - p, (derivatives + 1) (p + 1))."""
        if derivatives == 0:
            return self.coefficients
        if derivatives not in self._stacks:
            orders = [_derivative(self.coefficients, r, self.inverse_widths) for r in range(derivatives + 1)]
            self._stacks[derivatives] = np.ascontiguousarray(np.concatenate(orders, axis=2))
        return self._stacks[derivatives]


@dataclass(frozen=True, eq=False)
class Spans:
    """Holds the spans of several curves of one degree, laid out one curve after the other on an axis v.

    Rows on any of the curves are then located and evaluated in one call. Parameter u of curve k lies at
    `v = u + shift[k]`. A periodic curve is laid out for three periods, so that a stretch across the seam need
    not be wrapped.
    """

    degree: int
    """All curves have this degree p."""
    periodic: bool
    """If true, all curves are closed; otherwise none is."""
    low: Floats
    """These are the left ends (k,) of the curves' domains on the axis."""
    high: Floats
    """These are the right ends (k,) of the curves' domains on the axis."""
    shift: Floats
    """Each shift (k,) leads from a curve's own parameter to the axis; it is zero for the first curve."""
    interval: Floats
    """These are the mean knot intervals (k,) of the curves."""
    first: int
    """The control points of the first curve begin at this place of the common array."""
    columns: Ints
    """Each row (n, p + 1) holds the control points that matter on a span."""
    starts: Floats
    """These are the left ends (l,) of the spans, in order: l is n, or 3 n for periodic curves."""
    inverse_widths: Floats
    """Each entry (l,) is one over the width of a span."""
    number: Ints
    """Each entry (l,) is the number of the span, in [0, n)."""
    by_span: Floats
    """The array (n, 3 (p + 1), p + 1) holds the polynomials of the basis and of two derivatives."""
    values: Floats
    """The array (p + 1, n, p + 1) holds the polynomials of the basis, power after power."""

    def locate(self, v: Floats) -> tuple[Ints, Floats]:
        """Returns the span number in [0, n), and s in [0, 1], of each place v (m,) on the axis."""
        laid = self.starts[1:].searchsorted(v, side="right")
        s = (v - self.starts.take(laid)) * self.inverse_widths.take(laid)
        return self.number.take(laid) if self.periodic else laid, s

    def basis(self, number: Ints, s: Floats) -> Floats:
        """Returns basis values (m, p + 1) at the result of `locate`, by Horner's rule."""
        return horner(self.values.take(number, axis=1), s[:, None])

    def curve_coefficients(self, control_points: Floats) -> Floats:
        """Returns C (p + 1, 3, 2, n): on span i, d^r S / du^r = sum_k C[k, r, :, i] s^k, r <= 2."""
        by_span = np.matmul(self.by_span, control_points.take(self.columns, axis=0))
        shape = (len(by_span), self.degree + 1, 3, 2)
        return np.ascontiguousarray(by_span.reshape(shape).transpose(1, 2, 3, 0))


def horner(terms: Floats, s: Floats) -> Floats:
    """Returns sum_k terms[k] s^k for terms (p + 1, m, ...) and s, which broadcasts to the shape of a term."""
    total: Floats = terms[-1] * s
    total += terms[-2]
    for term in terms[-3::-1]:
        total *= s
        total += term
    return total


def lay_out(
    curves: Sequence[SpanPolynomials], offsets: Sequence[int], sizes: Sequence[int] | None = None
) -> Spans:
    """Returns the spans of curves, all periodic or none, laid out on one axis.

    The control points of each curve begin at its entry of `offsets` in a common array. Where `sizes` is
    given, the array holds this many distinct control points of each periodic curve; otherwise it holds
    unwrapped ones.
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
        by_span=np.concatenate([c.polynomials(2)[:n] for c, n in zip(curves, counts, strict=True)]),
        values=np.concatenate([c.coefficients[:, :n] for c, n in zip(curves, counts, strict=True)], axis=1),
    )


def _shifts(curves: Sequence[SpanPolynomials], periods: Floats) -> list[float]:
    """Returns the shift of each curve at which no two overlap; the first curve is not shifted.

    Shifts are whole numbers, which add the least round-off.
    """
    shifts, end = [0.0], curves[0].high + curves[0].length * periods[-1]
    for curve in curves[1:]:
        shifts.append(float(np.ceil(end - (curve.low + curve.length * periods[0]) + _GAP_OF_CURVES)))
        end = curve.high + curve.length * periods[-1] + shifts[-1]
    return shifts


def _span_coefficients(knots: Floats, degree: int) -> Floats:
    """Returns the coefficients (p + 1 powers, n - p spans, p + 1) by Cox-de Boor on polynomials of s."""
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


def _derivative(coefficients: Floats, order: int, inverse_widths: Floats) -> Floats:
    """Returns d^r/du^r of polynomials of s = (u - start) / width, in the same shape."""
    derived = np.zeros_like(coefficients)
    for power in range(order, len(coefficients)):
        derived[power - order] = coefficients[power] * (factorial(power) // factorial(power - order))
    derived *= (inverse_widths**order)[:, None]
    return derived


# --- stretches of the curves -----------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Stretch:
    """Holds the part of its own curve where each row's foot point is searched for, on the axis of `Spans`."""

    periodic: bool
    """If true, the curves are closed."""
    begin: Floats
    """The domain of each row's curve begins here (m,)."""
    end: Floats
    """The domain of each row's curve ends here (m,)."""
    low: Floats
    """Each stretch begins here (m,)."""
    high: Floats
    """Each stretch ends here (m,)."""
    floor: Floats
    """The iteration does not go below this limit (m,), which is -inf where a stretch is a whole period."""
    ceiling: Floats
    """The iteration does not go above this limit (m,), which is inf where a stretch is a whole period."""
    interval: Floats
    """This is the mean knot interval (m,) of each row's curve."""

    @property
    def length(self) -> Floats:
        """Returns the length (m,) of the domain of each row's curve."""
        return self.end - self.begin

    def within(self, v: Floats) -> Floats:
        """Returns v (m,) clipped to the limits of the iteration."""
        return np.minimum(np.maximum(v, self.floor), self.ceiling)

    def moved_into(self, v: Floats) -> Floats:
        """Returns v (m,) moved into its stretch by whole periods, or to the nearest limit."""
        low, high = self.low, self.high
        if not self.periodic:
            return np.minimum(np.maximum(v, low), high)
        period = self.length
        inside = low + np.mod(v - low, period)
        nearest = np.where(inside - high < low + period - inside, high, low)
        return np.where(inside <= high, inside, nearest)

    def in_domain(self, v: Floats) -> Floats:
        """Returns v (m,) wrapped into the domain of a periodic curve, or clipped to that of an open one."""
        if self.periodic:
            v = v - self.length * np.floor((v - self.begin) / self.length)
        return np.minimum(np.maximum(v, self.begin), self.end)

    def where(self, rows: Bools) -> Stretch:
        """Returns the stretches of some rows."""
        names = ("begin", "end", "low", "high", "floor", "ceiling", "interval")
        return replace(self, **{name: getattr(self, name)[rows] for name in names})


def stretch_of(spans: Spans, curve: Ints, u_low: Floats, u_high: Floats) -> Stretch:
    """Returns the stretches of rows on curves `curve` (m,) between the parameters u_low and u_high (m,).

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
