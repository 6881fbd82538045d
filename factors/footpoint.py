"""Foot points: the nearest point of a stretch of a spline, by a coarse grid and safeguarded Newton steps."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Final

import numpy as np
from numpy.typing import NDArray

from .bspline import Floats, Ints, SpanPolynomials

Bools = NDArray[np.bool_]

_STEP_TOLERANCE: Final = 1e-9
"""A row takes its last step where |step| <= tolerance * length of the domain: the error is its square."""
_FLAT: Final = 1e-12
"""f' is positive where f' > tolerance * |S'|^2."""
_EQUAL_SQUARE: Final = 1e-12
"""Squared distances d, e (m^2) are told apart where e > d + tolerance * (1 + d): below lies round-off."""
_END_TOLERANCE: Final = 1e-9
"""A foot point is at an end where it lies within tolerance * length of the domain of it."""
_NO_TANGENT: Final = 1e-12
"""The tangent vanishes where |S'| <= tolerance * largest coordinate / length of the domain."""
_SAFEGUARDED_STEPS: Final = 4
"""Bracketed steps in place of a Newton step that led farther away."""
_TINY: Final = 1e-300
"""Smallest divisor of a step; the numerator vanishes before it does."""
_CHUNK: Final = 1 << 20
"""Most point-to-grid distances held at once (entries)."""


@dataclass(frozen=True, eq=False)
class FootPoints:
    """The nearest curve point to each of m points, within each one's own stretch."""

    u: Floats
    """Parameter (m,), inside the domain (wrapped where periodic)."""
    position: Floats
    """S(u) (m, 2), metres."""
    tangent_unit: Floats
    """Unit tangent in the direction of travel (m, 2)."""
    normal_unit: Floats
    """Unit normal (m, 2), left of the direction of travel."""
    distance: Floats
    """normal_unit . (point - S(u)) (m,), metres: positive left of the curve."""
    interior: Bools
    """False (m,) at an end of an open curve, and at a limit of the stretch beyond which it comes nearer."""
    basis: Floats
    """Basis values (m, p + 1) at u; column j is of control point span - p + j (modulo m where periodic)."""
    span: Ints
    """Knot span (m,) of u."""


@dataclass(frozen=True, eq=False)
class _Curve:
    """A curve as polynomials on each span, evaluated component-first."""

    tables: SpanPolynomials
    """The basis."""
    coefficients: Floats
    """(p + 1, 3, 2, n - p) of `SpanPolynomials.curve_coefficients`: S, S', S''."""

    def position(self, u: Floats) -> Floats:
        """S(u) (2, m)."""
        number, s = self.tables.locate(u)
        return _horner(self.coefficients[:, 0].take(number, axis=-1), s)

    def derivatives(self, number: Ints, s: Floats) -> Floats:
        """S, S', S'' (3, 2, m) at the local coordinate s on span `number`."""
        return _horner(self.coefficients.take(number, axis=-1), s)


def _horner(terms: Floats, s: Floats) -> Floats:
    """sum_k terms[k] s^k (..., m) of terms (p + 1, ..., m)."""
    total: Floats = terms[-1] * s
    total += terms[-2]
    for term in terms[-3::-1]:
        total *= s
        total += term
    return total


@dataclass(frozen=True, eq=False)
class _Probe:
    """The curve and the distances to it at one parameter for each row."""

    u: Floats
    """Parameters (m,)."""
    number: Ints
    """Span numbers (m,) of `SpanPolynomials.locate`."""
    s: Floats
    """Local coordinates (m,)."""
    offset: Floats
    """S(u) - p (2, m), metres."""
    first: Floats
    """S'(u) (2, m)."""
    square: Floats
    """Squared distance (m,)."""
    slope: Floats
    """f = (S - p) . S' (m,): half the derivative of the squared distance."""
    step: Floats
    """Newton's -f / f' (m,), or Gauss-Newton's -f / |S'|^2 where f' is not positive: downhill."""


def foot_points(
    tables: SpanPolynomials,
    control_points: Floats,
    points: Floats,
    u_low: Floats,
    u_high: Floats,
    coarse_step: float,
    iterations: int = 50,
) -> FootPoints:
    """u_i = argmin |S(u) - p_i| over u in [u_low_i, u_high_i], globally as far as the coarse grid resolves.

    control_points (n, 2) unwrapped where periodic, points (m, 2), stretch limits (m,) in parameter units:
    clipped to the domain of an open curve; of a periodic one they may run past the seam, and a stretch as
    long as the period has no limits. `coarse_step` is the grid's step in u. It stops once all rows converged.
    Finite input gives finite output, also where the tangent vanishes, at centres of curvature and at kinks.
    """
    curve = _Curve(tables, tables.curve_coefficients(control_points, 2))
    points_t = np.ascontiguousarray(points.T)
    low, high = _stretches(tables, u_low, u_high)
    limits = _limits(tables, low, high)
    start = _nearest_on_grid(curve, points, low, high, coarse_step)
    probe = _descend(curve, points_t, start, limits, coarse_step, iterations)
    return _finish(tables, control_points, points_t, probe, limits)


def refine_foot_points(
    tables: SpanPolynomials,
    control_points: Floats,
    points: Floats,
    u_start: Floats,
    u_low: Floats,
    u_high: Floats,
    iterations: int = 2,
) -> FootPoints:
    """The local minimum of |S(u) - p_i| downhill from u_start, by a few safeguarded Newton steps.

    As `foot_points`, but from a known parameter (m,), moved into the stretch where it lies outside; a step
    never goes farther than one mean knot interval, and no row ends farther from the curve than it began.
    """
    curve = _Curve(tables, tables.curve_coefficients(control_points, 2))
    points_t = np.ascontiguousarray(points.T)
    low, high = _stretches(tables, u_low, u_high)
    limits = _limits(tables, low, high)
    start = _into_stretch(tables, u_start, low, high)
    probe = _newton(curve, points_t, start, limits, iterations)
    return _finish(tables, control_points, points_t, probe, limits)


def _stretches(tables: SpanPolynomials, u_low: Floats, u_high: Floats) -> tuple[Floats, Floats]:
    """Stretch limits (m,): inside an open domain, or begun in a periodic one; never reversed."""
    if not tables.periodic:
        low = np.minimum(np.maximum(u_low, tables.low), tables.high)
        return low, np.maximum(low, np.minimum(u_high, tables.high))
    period = tables.high - tables.low
    whole = ~(u_high - u_low < period)
    turns = period * np.floor((np.where(whole, tables.low, u_low) - tables.low) / period)
    low = np.where(whole, tables.low, u_low - turns)
    return low, np.where(whole, tables.high, np.maximum(low, u_high - turns))


def _limits(tables: SpanPolynomials, low: Floats, high: Floats) -> tuple[Floats, Floats]:
    """The limits that the iteration must keep: none for a stretch that is a whole period."""
    if not tables.periodic:
        return low, high
    whole = high - low >= tables.high - tables.low
    return np.where(whole, -np.inf, low), np.where(whole, np.inf, high)


def _into_stretch(tables: SpanPolynomials, u: Floats, low: Floats, high: Floats) -> Floats:
    """u moved into the stretch: by whole periods where periodic, else to the nearest limit."""
    if not tables.periodic:
        return np.minimum(np.maximum(u, low), high)
    period = tables.high - tables.low
    inside = low + np.mod(u - low, period)
    nearest = np.where(inside - high < low + period - inside, high, low)
    return np.where(inside <= high, inside, nearest)


def _nearest_on_grid(curve: _Curve, points: Floats, low: Floats, high: Floats, step: float) -> Floats:
    """The nearest to each point (m,) among the parameters of a shared grid in its stretch, and its limits."""
    if len(points) == 0:
        return np.zeros(0)
    first = float(low.min())
    count = max(int(np.ceil((float(high.max()) - first) / step)), 1) + 1
    grid: Floats = first + step * np.arange(count, dtype=np.float64)
    on_curve = curve.position(np.concatenate([grid, low, high]))
    on_grid, ends = on_curve[:, :count], on_curve[:, count:].reshape(2, 2, -1)
    offsets = ends - points.T[:, None]
    at_ends = offsets[0] ** 2 + offsets[1] ** 2
    index, at_grid = _nearest_of(points, grid, on_grid, low, high)
    choice = np.concatenate([at_grid[None], at_ends]).argmin(axis=0)
    return np.asarray(np.choose(choice, [grid[index], low, high]))


def _nearest_of(
    points: Floats, grid: Floats, on_grid: Floats, low: Floats, high: Floats
) -> tuple[Ints, Floats]:
    """Nearest grid point (m,) of each stretch, and its squared distance (m,); so many rows at once as fit."""
    index, least = np.empty(len(points), np.intp), np.empty(len(points))
    rows = max(_CHUNK // len(grid), 1)
    for begin in range(0, len(points), rows):
        part = slice(begin, begin + rows)
        squares = (points[part, :1] - on_grid[0]) ** 2
        squares += (points[part, 1:] - on_grid[1]) ** 2
        squares[(grid < low[part, None]) | (grid > high[part, None])] = np.inf
        index[part] = squares.argmin(axis=1)
        least[part] = squares.min(axis=1)
    return index, least


def _newton(
    curve: _Curve, points_t: Floats, start: Floats, limits: tuple[Floats, Floats], iterations: int
) -> _Probe:
    """Newton steps no longer than a knot interval; a row that would get farther away is safeguarded."""
    reach = (curve.tables.high - curve.tables.low) / len(curve.tables.starts)
    last = _probe(curve, points_t, start)
    for _ in range(iterations):
        step = np.minimum(np.maximum(last.step, -reach), reach)
        u = np.minimum(np.maximum(last.u + step, limits[0]), limits[1])
        probe = _probe(curve, points_t, u)
        farther = ~_no_farther(probe.square, last.square)
        if farther.any():
            own_limits = (limits[0][farther], limits[1][farther])
            u[farther] = _descend(
                curve, points_t[:, farther], last.u[farther], own_limits, reach, _SAFEGUARDED_STEPS
            ).u
            probe = _probe(curve, points_t, u)
        last = probe
    return last


def _descend(
    curve: _Curve,
    points_t: Floats,
    start: Floats,
    limits: tuple[Floats, Floats],
    reach: float,
    iterations: int,
) -> _Probe:
    """Newton where its step stays inside the bracket, else its middle; it begins as `reach` downhill.

    The bracket is from the nearest so far to where the distance surely rises again, so that no row ever gets
    farther away.
    """
    tolerance = _STEP_TOLERANCE * (curve.tables.high - curve.tables.low)
    best = _probe(curve, points_t, start)
    end, step = start - np.sign(best.slope) * reach, best.step
    for _ in range(iterations):
        inside = np.abs(step) < np.abs(end - best.u)
        candidate = np.where(inside, best.u + step, 0.5 * (best.u + end))
        candidate = np.minimum(np.maximum(candidate, limits[0]), limits[1])
        probe = _probe(curve, points_t, candidate)
        if not (np.abs(candidate - best.u) > tolerance).any():
            return probe
        better = _no_farther(probe.square, best.square)
        passed = probe.slope * best.slope <= 0.0
        end = np.where(better, np.where(passed, best.u, end), probe.u)
        step = np.where(better, probe.step, np.inf)
        best = probe if better.all() else _either(better, probe, best)
    return best


def _either(first: Bools, a: _Probe, b: _Probe) -> _Probe:
    """Row by row the one or the other."""
    return _Probe(*(np.where(first, getattr(a, f.name), getattr(b, f.name)) for f in fields(a)))


def _no_farther(square: Floats, than: Floats) -> Bools:
    """Squared distances (m,) compared, round-off aside."""
    return square <= than + _EQUAL_SQUARE * (1.0 + than)


def _probe(curve: _Curve, points_t: Floats, u: Floats) -> _Probe:
    """The curve and the distances of points (2, m) at u."""
    number, s = curve.tables.locate(u)
    orders = curve.derivatives(number, s)
    offset, first = orders[0], orders[1]
    offset -= points_t
    products = orders * offset
    square, slope, centripetal = products[:, 0] + products[:, 1]
    speed = _dot(first, first)
    bend = speed + centripetal
    divisor = np.where(bend > _FLAT * speed, bend, speed)
    step = -slope / np.maximum(divisor, _TINY)
    return _Probe(u, number, s, offset, first, square, slope, step)


def _dot(a: Floats, b: Floats) -> Floats:
    """Inner products (m,) of columns (2, m)."""
    products = a * b
    return np.asarray(products[0] + products[1])


def _finish(
    tables: SpanPolynomials,
    control_points: Floats,
    points_t: Floats,
    probe: _Probe,
    limits: tuple[Floats, Floats],
) -> FootPoints:
    """All outputs at the parameters found."""
    span = probe.number + tables.degree
    tangent = _unit_tangent(tables, control_points, probe.first, span)
    normal = np.empty_like(tangent)
    np.negative(tangent[1], out=normal[0])
    normal[1] = tangent[0]
    return FootPoints(
        u=tables.inside(probe.u),
        position=(points_t + probe.offset).T,
        tangent_unit=tangent.T,
        normal_unit=normal.T,
        distance=-_dot(normal, probe.offset),
        interior=_interior(tables, probe, limits),
        basis=tables.evaluate_located(probe.number, probe.s)[0],
        span=span,
    )


def _unit_tangent(tables: SpanPolynomials, control_points: Floats, first: Floats, span: Ints) -> Floats:
    """S' / |S'| (2, m); where S' vanishes the direction of the control polygon, or else of the x axis."""
    norm = np.sqrt(_dot(first, first))
    smallest = _NO_TANGENT * np.abs(control_points).max(initial=0.0) / (tables.high - tables.low)
    vanishing = ~(norm > smallest)
    if not vanishing.any():
        return first / norm
    spans = span[vanishing]
    chord = (control_points[spans] - control_points[spans - tables.degree]).T
    chord[0, ~chord.any(axis=0)] = 1.0
    direction = first.copy()
    direction[:, vanishing] = chord
    norm[vanishing] = np.hypot(chord[0], chord[1])
    return direction / norm


def _interior(tables: SpanPolynomials, probe: _Probe, limits: tuple[Floats, Floats]) -> Bools:
    """False at an end of an open domain, and at a limit of the stretch where the distance falls outward."""
    tolerance = _END_TOLERANCE * (tables.high - tables.low)
    at_low = probe.u - limits[0] <= tolerance
    at_high = limits[1] - probe.u <= tolerance
    outside = (at_low & (probe.slope > 0.0)) | (at_high & (probe.slope < 0.0))
    if not tables.periodic:
        outside |= probe.u <= tables.low + tolerance
        outside |= probe.u >= tables.high - tolerance
    return ~outside
