"""Foot points: the nearest point of a stretch of a spline, by a coarse grid and safeguarded Newton steps."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Final

import numpy as np
from numpy.typing import NDArray

from .bspline import Floats, Ints
from .spans import SpanPolynomials, Spans
from .stretch import Stretch, stretch_of

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
    """Knot span (m,) of u; those of several curves are counted through."""
    columns: Ints
    """Control points (m, p + 1) that the basis values belong to."""

    def where(self, rows: Ints | Bools | slice) -> FootPoints:
        """Of some rows."""
        return FootPoints(*(getattr(self, f.name)[rows] for f in fields(self)))


@dataclass(frozen=True, eq=False)
class _Curves:
    """Curves as polynomials on each span, evaluated component-first."""

    spans: Spans
    """The basis."""
    coefficients: Floats
    """(p + 1, 3, 2, n) of `Spans.curve_coefficients`: S, S', S''."""

    def position(self, v: Floats) -> Floats:
        """S (2, m) at places on the axis."""
        number, s = self.spans.locate(v)
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

    v: Floats
    """Places (m,) on the axis."""
    number: Ints
    """Span numbers (m,) of `Spans.locate`."""
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
    curve = np.zeros(len(points), np.intp)
    search = (coarse_step, iterations)
    return joint_foot_points(tables.alone, control_points, points, curve, u_low, u_high, *search)


def joint_foot_points(
    spans: Spans,
    control_points: Floats,
    points: Floats,
    curve: Ints,
    u_low: Floats,
    u_high: Floats,
    coarse_step: float,
    iterations: int = 50,
) -> FootPoints:
    """`foot_points` on several curves at once, `curve` (m,) each row's own, of those that are laid out."""
    curves = _Curves(spans, spans.curve_coefficients(control_points))
    points_t = np.ascontiguousarray(points.T)
    stretch = stretch_of(spans, curve, u_low, u_high)
    start = _nearest_on_grid(curves, points, curve, stretch, coarse_step)
    probe = _descend(curves, points_t, start, stretch, np.full(len(points), coarse_step), iterations)
    return _finish(spans, control_points, points_t, curve, probe, stretch)


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
    curve = np.zeros(len(points), np.intp)
    return refine_joint_foot_points(
        tables.alone, control_points, points, curve, u_start, u_low, u_high, iterations
    )


def refine_joint_foot_points(
    spans: Spans,
    control_points: Floats,
    points: Floats,
    curve: Ints,
    u_start: Floats,
    u_low: Floats,
    u_high: Floats,
    iterations: int = 2,
) -> FootPoints:
    """`refine_foot_points` on several curves at once, `curve` (m,) each row's own."""
    curves = _Curves(spans, spans.curve_coefficients(control_points))
    points_t = np.ascontiguousarray(points.T)
    stretch = stretch_of(spans, curve, u_low, u_high)
    start = stretch.moved_into(u_start + spans.shift.take(curve))
    probe = _newton(curves, points_t, start, stretch, iterations)
    return _finish(spans, control_points, points_t, curve, probe, stretch)


def _nearest_on_grid(curves: _Curves, points: Floats, curve: Ints, stretch: Stretch, step: float) -> Floats:
    """The nearest to each point (m,) among the places of a shared grid in its stretch, and its limits."""
    if len(points) == 0:
        return np.zeros(0)
    low, high = stretch.low, stretch.high
    grid = np.concatenate([_grid(low[of], high[of], step) for of in _by_curve(curve, len(curves.spans.low))])
    count = len(grid)
    on_curve = curves.position(np.concatenate([grid, low, high]))
    on_grid, ends = on_curve[:, :count], on_curve[:, count:].reshape(2, 2, -1)
    offsets = ends - points.T[:, None]
    at_ends = offsets[0] ** 2 + offsets[1] ** 2
    index, at_grid = _nearest_of(points, grid, on_grid, low, high)
    choice = np.concatenate([at_grid[None], at_ends]).argmin(axis=0)
    return np.asarray(np.choose(choice, [grid[index], low, high]))


def _by_curve(curve: Ints, count: int) -> list[Bools]:
    """The rows (m,) of each curve that has any."""
    of_each = (curve == k for k in range(count))
    return [rows for rows in of_each if rows.any()]


def _grid(low: Floats, high: Floats, step: float) -> Floats:
    """Evenly spaced places from the lowest to the highest of stretches (m,) on a curve."""
    first = float(low.min())
    count = max(int(np.ceil((float(high.max()) - first) / step)), 1) + 1
    return np.asarray(first + step * np.arange(count, dtype=np.float64))


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


def _newton(curves: _Curves, points_t: Floats, start: Floats, stretch: Stretch, iterations: int) -> _Probe:
    """Newton steps no longer than a knot interval; a row that would get farther away is safeguarded."""
    reach = stretch.interval
    last = _probe(curves, points_t, start)
    for _ in range(iterations):
        step = np.minimum(np.maximum(last.step, -reach), reach)
        v = stretch.within(last.v + step)
        probe = _probe(curves, points_t, v)
        farther = ~_no_farther(probe.square, last.square)
        if farther.any():
            own, start = stretch.where(farther), last.v[farther]
            v[farther] = _descend(
                curves, points_t[:, farther], start, own, own.interval, _SAFEGUARDED_STEPS
            ).v
            probe = _probe(curves, points_t, v)
        last = probe
    return last


def _descend(
    curves: _Curves,
    points_t: Floats,
    start: Floats,
    stretch: Stretch,
    reach: Floats,
    iterations: int,
) -> _Probe:
    """Newton where its step stays inside the bracket, else its middle; it begins as `reach` (m,) downhill.

    The bracket is from the nearest so far to where the distance surely rises again, so that no row ever gets
    farther away.
    """
    tolerance = _STEP_TOLERANCE * stretch.length
    best = _probe(curves, points_t, start)
    end, step = start - np.sign(best.slope) * reach, best.step
    for _ in range(iterations):
        inside = np.abs(step) < np.abs(end - best.v)
        candidate = stretch.within(np.where(inside, best.v + step, 0.5 * (best.v + end)))
        probe = _probe(curves, points_t, candidate)
        if not (np.abs(candidate - best.v) > tolerance).any():
            return probe
        better = _no_farther(probe.square, best.square)
        passed = probe.slope * best.slope <= 0.0
        end = np.where(better, np.where(passed, best.v, end), probe.v)
        step = np.where(better, probe.step, np.inf)
        best = probe if better.all() else _either(better, probe, best)
    return best


def _either(first: Bools, a: _Probe, b: _Probe) -> _Probe:
    """Row by row the one or the other."""
    return _Probe(*(np.where(first, getattr(a, f.name), getattr(b, f.name)) for f in fields(a)))


def _no_farther(square: Floats, than: Floats) -> Bools:
    """Squared distances (m,) compared, round-off aside."""
    return square <= than + _EQUAL_SQUARE * (1.0 + than)


def _probe(curves: _Curves, points_t: Floats, v: Floats) -> _Probe:
    """The curve and the distances of points (2, m) at v."""
    number, s = curves.spans.locate(v)
    orders = curves.derivatives(number, s)
    offset, first = orders[0], orders[1]
    offset -= points_t
    products = orders * offset
    square, slope, centripetal = products[:, 0] + products[:, 1]
    speed = _dot(first, first)
    bend = speed + centripetal
    divisor = np.where(bend > _FLAT * speed, bend, speed)
    step = -slope / np.maximum(divisor, _TINY)
    return _Probe(v, number, s, offset, first, square, slope, step)


def _dot(a: Floats, b: Floats) -> Floats:
    """Inner products (m,) of columns (2, m)."""
    products = a * b
    return np.asarray(products[0] + products[1])


def _finish(
    spans: Spans, control_points: Floats, points_t: Floats, curve: Ints, probe: _Probe, stretch: Stretch
) -> FootPoints:
    """All outputs at the places found."""
    columns = spans.columns.take(probe.number, axis=0)
    tangent = _unit_tangent(control_points, probe.first, columns, stretch.length)
    normal = np.empty_like(tangent)
    np.negative(tangent[1], out=normal[0])
    normal[1] = tangent[0]
    return FootPoints(
        u=stretch.in_domain(probe.v) - spans.shift.take(curve),
        position=(points_t + probe.offset).T,
        tangent_unit=tangent.T,
        normal_unit=normal.T,
        distance=-_dot(normal, probe.offset),
        interior=_interior(probe, stretch),
        basis=spans.basis(probe.number, probe.s),
        span=probe.number + (spans.first + spans.degree),
        columns=columns,
    )


def _unit_tangent(control_points: Floats, first: Floats, columns: Ints, length: Floats) -> Floats:
    """S' / |S'| (2, m); where S' vanishes the direction of the control polygon, or else of the x axis."""
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


def _interior(probe: _Probe, stretch: Stretch) -> Bools:
    """False at an end of an open domain, and at a limit of the stretch where the distance falls outward."""
    tolerance = _END_TOLERANCE * stretch.length
    at_low = probe.v - stretch.floor <= tolerance
    at_high = stretch.ceiling - probe.v <= tolerance
    outside = (at_low & (probe.slope > 0.0)) | (at_high & (probe.slope < 0.0))
    if not stretch.periodic:
        outside |= probe.v <= stretch.begin + tolerance
        outside |= probe.v >= stretch.end - tolerance
    return ~outside
