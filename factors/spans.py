"""B-splines as polynomials on each span: faster than the recurrence, of one curve or of several at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import factorial

import numpy as np

from .bspline import Floats, Ints, domain, positive, wrap


@dataclass(frozen=True, eq=False)
class SpanPolynomials:
    """Basis functions as polynomials of s = (u - t_i) / (t_{i+1} - t_i) on each span: `basis`, but faster."""

    knots: Floats
    """Non-decreasing knots (n + p + 1,), unwrapped if periodic."""
    degree: int
    """Degree p >= 1."""
    periodic: bool = False
    """Parameters are taken modulo the domain's length instead of clipped to it."""
    low: float = field(init=False)
    """Left end of the domain."""
    high: float = field(init=False)
    """Right end of the domain."""
    coefficients: Floats = field(init=False, repr=False)
    """(p + 1 powers, n - p spans, p + 1 columns): N_{i-p+j}(u) = sum_k coefficients[k, i - p, j] s^k."""
    starts: Floats = field(init=False, repr=False)
    """Left knot of each span (n - p,)."""
    inverse_widths: Floats = field(init=False, repr=False)
    """1 / (t_{i+1} - t_i) of each span (n - p,), zero for an empty span."""
    known: Floats | None = field(default=None, repr=False)
    """The coefficients of the first spans, where they have been worked out already."""
    _breaks: Floats = field(init=False, repr=False)
    _by_span: dict[int, Floats] = field(init=False, repr=False, default_factory=dict)
    windows: Ints = field(init=False, repr=False)
    """(n - p, p + 1) control points that matter on each span."""
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
        set_field(self, "inverse_widths", np.where(widths > 0.0, 1.0 / positive(widths), 0.0))
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
        """An open curve's on knots that begin with the own ones: only what is new is worked out."""
        return SpanPolynomials(knots, self.degree, False, self.coefficients)

    def tail(self, first: int) -> SpanPolynomials:
        """An open curve's without its first control points, which changes nothing on the spans that stay."""
        return SpanPolynomials(self.knots[first:], self.degree, False, self.coefficients[:, first:])

    @property
    def alone(self) -> Spans:
        """The spans of this curve only, on its unwrapped control points; kept for next time."""
        if "alone" not in self._laid:
            self._laid["alone"] = lay_out([self], [0])
        return self._laid["alone"]

    @property
    def length(self) -> float:
        """Length of the domain."""
        return self.high - self.low

    @property
    def occupied(self) -> int:
        """Spans up to the last that is not empty."""
        return len(self._breaks) + 1

    def inside(self, u: Floats) -> Floats:
        """u wrapped into the domain where periodic, else clipped to it."""
        if self.periodic:
            return wrap(self.knots, self.degree, u)
        return np.minimum(np.maximum(u, self.low), self.high)

    def locate(self, u: Floats) -> tuple[Ints, Floats]:
        """Span number span - p in [0, n - p) and s in [0, 1] of each u (m,), wrapped or clipped."""
        inside = self.inside(u)
        number = self._breaks.searchsorted(inside, side="right")
        return number, (inside - self.starts.take(number)) * self.inverse_widths.take(number)

    def evaluate(self, u: Floats, derivatives: int = 0) -> tuple[Floats, Ints]:
        """As `basis`: values (derivatives + 1, m, p + 1) and spans (m,), with u wrapped or clipped."""
        number, s = self.locate(u)
        return self.evaluate_located(number, s, derivatives), number + self.degree

    def evaluate_located(self, number: Ints, s: Floats, derivatives: int = 0) -> Floats:
        """Basis values (derivatives + 1, m, p + 1) at what `locate` gave, by Horner's rule."""
        stack = self._stack(derivatives)
        column = s[:, None]
        values: Floats = stack[-1].take(number, axis=0)
        for power in range(self.degree - 1, -1, -1):
            values *= column
            values += stack[power].take(number, axis=0)
        return values.reshape(len(s), derivatives + 1, self.degree + 1).transpose(1, 0, 2)

    def curve_coefficients(self, control_points: Floats, derivatives: int = 0) -> Floats:
        """(p + 1, derivatives + 1, 2, n - p): d^r S / du^r = sum_k coefficients[k, r, :, i - p] s^k.

        control_points (n, 2), unwrapped where periodic.
        """
        by_span = np.matmul(self.polynomials(derivatives), control_points[self.windows])
        shape = (len(by_span), self.degree + 1, derivatives + 1, 2)
        return np.ascontiguousarray(by_span.reshape(shape).transpose(1, 2, 3, 0))

    def polynomials(self, derivatives: int) -> Floats:
        """(n - p spans, (p + 1) (derivatives + 1), p + 1 columns): the polynomials of `_stack` by span."""
        if derivatives not in self._by_span:
            by_span = self._stack(derivatives).transpose(1, 0, 2)
            self._by_span[derivatives] = by_span.reshape(by_span.shape[0], -1, self.degree + 1)
        return self._by_span[derivatives]

    def _stack(self, derivatives: int) -> Floats:
        """(p + 1 powers, n - p spans, (derivatives + 1) (p + 1)): polynomials of all orders side by side."""
        if derivatives == 0:
            return self.coefficients
        if derivatives not in self._stacks:
            orders = [_derivative(self.coefficients, r, self.inverse_widths) for r in range(derivatives + 1)]
            self._stacks[derivatives] = np.ascontiguousarray(np.concatenate(orders, axis=2))
        return self._stacks[derivatives]


@dataclass(frozen=True, eq=False)
class Spans:
    """The spans of some curves of one degree, laid one curve after the other on an axis v.

    So rows on any of the curves are looked up and evaluated at once. Parameter u of curve k is at
    `v = u + shift[k]`. Periodic curves lie there for three periods: what runs past the seam is not wrapped.
    """

    degree: int
    """Degree p of all."""
    periodic: bool
    """Whether all are closed; else none is."""
    low: Floats
    """Left end (k,) of each curve's domain on the axis."""
    high: Floats
    """Right end (k,)."""
    shift: Floats
    """(k,) from each curve's own parameter to the axis; none for the first."""
    interval: Floats
    """Mean knot interval (k,) of each."""
    first: int
    """Spans of the first curve that are left out before it."""
    columns: Ints
    """(n, p + 1) control points that matter on each span."""
    starts: Floats
    """Left end of each span (l,) on the axis, in order: n, or three times as many."""
    inverse_widths: Floats
    """1 / width (l,) of each."""
    number: Ints
    """Which of the n spans (l,) each is."""
    by_span: Floats
    """(n, 3 (p + 1), p + 1): the polynomials of the basis and two derivatives, power after power."""
    values: Floats
    """(p + 1, n, p + 1): those of the basis."""

    def locate(self, v: Floats) -> tuple[Ints, Floats]:
        """Span number in [0, n) and s in [0, 1] of each v (m,) on the axis."""
        laid = self.starts[1:].searchsorted(v, side="right")
        s = (v - self.starts.take(laid)) * self.inverse_widths.take(laid)
        return self.number.take(laid) if self.periodic else laid, s

    def basis(self, number: Ints, s: Floats) -> Floats:
        """Basis values (m, p + 1) at what `locate` gave, by Horner's rule."""
        terms, column = self.values.take(number, axis=1), s[:, None]
        total: Floats = terms[-1] * column
        total += terms[-2]
        for term in terms[-3::-1]:
            total *= column
            total += term
        return total

    def curve_coefficients(self, control_points: Floats) -> Floats:
        """(p + 1, 3, 2, n): S, S', S'' of span i are sum_k coefficients[k, r, :, i] s^k."""
        by_span = np.matmul(self.by_span, control_points.take(self.columns, axis=0))
        shape = (len(by_span), self.degree + 1, 3, 2)
        return np.ascontiguousarray(by_span.reshape(shape).transpose(1, 2, 3, 0))


def lay_out(
    curves: Sequence[SpanPolynomials], offsets: Sequence[int], sizes: Sequence[int] | None = None
) -> Spans:
    """Curves, all periodic or none, whose control points begin at these places of a common array.

    `sizes`: so many control points of periodic curves are distinct, the others not there; else unwrapped.
    """
    periodic, counts = curves[0].periodic, [curve.occupied for curve in curves]
    periods = np.arange(-1.0, 2.0) if periodic else np.zeros(1)
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
    """How far each curve is moved, the first not at all, so that none overlaps; whole, which rounds least."""
    shifts, end = [0.0], curves[0].high + curves[0].length * periods[-1]
    for curve in curves[1:]:
        shifts.append(float(np.ceil(end - (curve.low + curve.length * periods[0]) + 1.0)))
        end = curve.high + curve.length * periods[-1] + shifts[-1]
    return shifts


def _span_coefficients(knots: Floats, degree: int) -> Floats:
    """The Cox-de Boor recurrence on polynomials of s: (p + 1 powers, n - p spans, p + 1 columns)."""
    spans = np.arange(degree, len(knots) - degree - 1)
    start = knots[spans]
    width = knots[spans + 1] - start
    window = knots[spans + np.arange(1 - degree, degree + 1)[:, None]]
    level = np.zeros((degree + 1, 1, len(spans)))
    level[0] = 1.0
    for q in range(1, degree + 1):
        lower, upper = window[degree - q : degree], window[degree : degree + q]
        ratio = level / positive(upper - lower)
        raised = np.zeros((degree + 1, q + 1, len(spans)))
        raised[:, :-1] = (upper - start) * ratio
        raised[:, 1:] += (start - lower) * ratio
        raised[1:, :-1] -= width * ratio[:-1]
        raised[1:, 1:] += width * ratio[:-1]
        level = raised
    return np.ascontiguousarray(level.transpose(0, 2, 1))


def _derivative(coefficients: Floats, order: int, inverse_widths: Floats) -> Floats:
    """d^r/du^r of the polynomials of s = (u - start) / width: same shape, high powers zero."""
    derived = np.zeros_like(coefficients)
    for power in range(order, len(coefficients)):
        derived[power - order] = coefficients[power] * (factorial(power) // factorial(power - order))
    derived *= (inverse_widths**order)[:, None]
    return derived
