"""Plane B-spline curves: evaluation, arc length, extension, covariance, least-squares fits, and knots."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Final, Self

import numpy as np
from scipy.sparse import csc_array, csr_array, issparse, vstack
from scipy.sparse.linalg import SuperLU, splu

from pathspace_graph.errors import SettingsError
from pathspace_graph.factors import bspline
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.footpoint import FootPoints, foot_points
from pathspace_graph.factors.se2 import left_of, path_lengths

_FOOT_GRID: Final = 8  # grid points on each span of a foot-point search over the whole curve
_GAUSS_NODES, _GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(12)


@dataclass(frozen=True, eq=False, repr=False)
class BSpline:
    """Curve S(u) = sum_j N_j^p(u) c_j in the map frame, u in [knots[p], knots[n]].

    Knots and control points are laid out as in scipy's `BSpline`.
    """

    LENGTHS: ClassVar = {"knots": 1, "control_points": 1}
    DIMENSION: ClassVar = 2

    knots: Array
    """(n + p + 1,) Knots, non-decreasing."""
    control_points: Array
    """(n, 2) Control points in m, map frame; a periodic curve's last p repeat the first p."""
    degree: int = 3
    periodic: bool = False
    """Whether the curve is closed: parameters are wrapped into the domain."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "knots", np.array(self.knots, dtype=np.float64))
        object.__setattr__(self, "control_points", np.array(self.control_points, dtype=np.float64))
        points, knots = self.control_points, self.knots
        if self.degree < 1:
            raise SettingsError(f"a spline's degree must be at least 1, not {self.degree}")
        if points.ndim != 2 or points.shape[1] != self.DIMENSION or len(points) <= self.degree:
            shape = f"(n > {self.degree}, {self.DIMENSION})"
            raise SettingsError(
                f"a spline of degree {self.degree} needs control points of shape {shape}, not {points.shape}"
            )
        count = len(points) + self.degree + 1
        if knots.shape != (count,):
            raise SettingsError(
                f"{len(points)} control points of degree {self.degree} need {count} knots, "
                f"not shape {knots.shape}"
            )
        if not (np.isfinite(points).all() and np.isfinite(knots).all()):
            raise SettingsError("a spline's knots and control points must be finite")
        steps = np.diff(knots)
        if (steps < 0.0).any():
            raise SettingsError(f"knots must not decrease, but knot {int(steps.argmin()) + 1} does")
        if steps[self.degree] <= 0.0 or steps[-self.degree - 1] <= 0.0:
            raise SettingsError("the first and the last knot interval of a domain must not be empty")
        if not self.periodic:
            return
        p, m = self.degree, len(points) - self.degree
        if m <= p:
            raise SettingsError(
                f"a periodic spline of degree {p} needs more than {p} distinct points, not {m}"
            )
        low, high = self.domain
        knot_error = np.abs(knots[m:] - knots[: 2 * p + 1] - (high - low)).max()
        point_error = np.abs(points[m:] - points[:p]).max()
        if knot_error > 1e-9 * (1.0 + np.abs(knots).max()):
            raise SettingsError(f"knots of a periodic spline must repeat, but differ by {knot_error:.3g}")
        if point_error > 1e-9 * (1.0 + np.abs(points).max()):
            raise SettingsError(
                f"the last {p} control points must repeat the first, not be {point_error:.3g} off"
            )

    def __repr__(self) -> str:
        ends = "periodic" if self.periodic else "open"
        return f"{type(self).__name__}({ends}, degree {self.degree}, {self.size} control points)"

    @classmethod
    def open_uniform(
        cls, control_points: Array, degree: int = 3, interval: float = 1.0, start: float = 0.0
    ) -> Self:
        """Build a curve on equally spaced knots with floating (unclamped) ends, from `start` on."""
        return cls(
            bspline.uniform_knots(len(control_points), degree, interval, start), control_points, degree
        )

    @classmethod
    def clamped_from(cls, breaks: Array, control_points: Array, degree: int = 3) -> "BSpline":
        """Build a clamped curve on breaks (k + 1,) with k + p control points."""
        return cls(bspline.clamped_knots(breaks, degree), control_points, degree)

    @classmethod
    def periodic_from(cls, breaks: Array, control_points: Array, degree: int = 3) -> Self:
        """Build a closed curve on one period of breaks (m + 1,) with m distinct control points."""
        if len(breaks) != len(control_points) + 1 or len(control_points) <= degree:
            raise SettingsError(
                f"a periodic spline of m > {degree} distinct control points needs m + 1 breaks, "
                f"not {len(control_points)} points and {len(breaks)} breaks"
            )
        unwrapped = np.concatenate([control_points, control_points[:degree]])
        return cls(bspline.periodic_knots(breaks, degree), unwrapped, degree, periodic=True)

    @classmethod
    def hermite(cls, u: Array, points: Array, slopes: Array) -> Self:
        """Build the cubic curve through points (k, 2) at parameters u (k,), with slopes dS/du (k, 2) there.

        It has a Bernstein basis on each span: all knots are triple.
        """
        third, count = np.diff(u)[:, None] / 3.0, len(u) - 1
        before, after = points[:-1] + third * slopes[:-1], points[1:] - third * slopes[1:]
        pieces = np.stack([points[:-1], before, after], axis=1)
        knots = np.concatenate([u[:1], np.repeat(u, 3), u[-1:]])
        cubic = np.array([[1.0, 0, 0, 0], [-3.0, 3.0, 0, 0], [3.0, -6.0, 3.0, 0], [-1.0, 3.0, -3.0, 1.0]])
        basis = np.broadcast_to(cubic[:, None], (4, 3 * count - 2, 4))  # by power, span and function
        control_points = np.concatenate([pieces.reshape(-1, cls.DIMENSION), points[-1:]])
        return cls.on(bspline.SpanPolynomials(knots, 3, False, basis), control_points)

    @classmethod
    def on(cls, tables: bspline.SpanPolynomials, control_points: Array) -> Self:
        """Build a curve that shares a basis; control points (n, 2) are unwrapped."""
        spline = cls(tables.knots, control_points, tables.degree, tables.periodic)
        spline.__dict__["tables"] = tables
        return spline

    @classmethod
    def even(cls, low: float, high: float, intervals: int, periodic: bool, degree: int = 3) -> Self:
        """Build a curve of zeros on equally spaced knots; an open one has floating ends."""
        if periodic:
            breaks = np.linspace(low, high, intervals + 1)
            return cls.periodic_from(breaks, np.zeros((intervals, cls.DIMENSION)), degree)
        zeros = np.zeros((intervals + degree, cls.DIMENSION))
        return cls.open_uniform(zeros, degree, (high - low) / intervals, low)

    @property
    def domain(self) -> tuple[float, float]:
        """First and last parameter, knots[p] and knots[n]."""
        return float(self.knots[self.degree]), float(self.knots[len(self.control_points)])

    @property
    def size(self) -> int:
        """Number m of distinct control points."""
        return len(self.control_points) - (self.degree if self.periodic else 0)

    @property
    def distinct_control_points(self) -> Array:
        """Control points (m, 2) without the repeated ones of a periodic curve."""
        return self.control_points[: self.size]

    @property
    def breaks(self) -> Array:
        """Distinct knots of the domain, both ends included."""
        return np.unique(self.knots[self.degree : len(self.control_points) + 1])

    @cached_property
    def tables(self) -> bspline.SpanPolynomials:
        """Basis as polynomials on each span."""
        return bspline.SpanPolynomials(self.knots, self.degree, self.periodic)

    @cached_property
    def energy(self) -> csr_array:
        """Matrix E (m, m) with `c' E c` the bending energy of distinct control points c (`energy_rows`)."""
        R = energy_rows(self)
        return csr_array(R.T @ R)

    def with_points(self, distinct: Array) -> Self:
        """Return the curve of the same basis with other distinct control points (m, 2)."""
        points = np.concatenate([distinct, distinct[: self.degree]]) if self.periodic else distinct
        return type(self).on(self.tables, points)

    def local_basis(self, u: Array, derivative: int = 0) -> tuple[Array, IntArray]:
        """Return basis values (k, p + 1) at u (k,), and the indices (k, p + 1) of their control points."""
        values, columns = self._local(u, derivative)
        return values[derivative], columns

    def _local(self, u: Array, derivatives: int) -> tuple[Array, IntArray]:
        values, span = self.tables.evaluate(u, derivatives)
        columns = span[:, None] + np.arange(-self.degree, 1)
        return values, columns % self.size if self.periodic else columns

    def basis_matrix(self, u: Array, derivative: int = 0) -> Array:
        """Matrix B (k, m) of the basis on the distinct control points c: `S(u) = B c`."""
        values, span = self.tables.evaluate(u, derivative)
        return bspline.scatter(values[derivative], span - self.degree, self.size, self.periodic)

    def evaluate(self, u: Array, derivative: int = 0) -> Array:
        """Evaluate d^r S / du^r (k, 2) at u (k,); u is clipped to the domain, or wrapped if periodic."""
        values, columns = self.local_basis(u, derivative)
        position: Array = np.einsum("kj,kjd->kd", values, self.control_points[columns])
        return position

    def derivatives(self, u: Array, most: int) -> Array:
        """Evaluate S and its derivatives up to order `most`, (most + 1, k, 2), at u (k,)."""
        values, columns = self._local(u, most)
        return np.asarray(np.einsum("rkj,kjd->rkd", values, self.control_points[columns]))

    def tangent_unit(self, u: Array) -> Array:
        """Unit tangents S' / |S'| (k, 2), zero where S' vanishes."""
        first = self.evaluate(u, 1)
        norm = np.linalg.norm(first, axis=1, keepdims=True)
        return np.asarray(np.divide(first, norm, out=np.zeros_like(first), where=norm > 0.0))

    def normal_unit(self, u: Array) -> Array:
        """Unit normals (k, 2) to the left, zero where S' vanishes."""
        return left_of(self.tangent_unit(u))

    def curvature(self, u: Array) -> Array:
        """Curvature `(x' y'' - y' x'') / |S'|^3` (k,) in 1/m, positive to the left; 0 where S' vanishes."""
        _, first, second = self.derivatives(u, 2)
        bent = cross(first, second)
        cube = np.linalg.norm(first, axis=1) ** 3
        return np.asarray(np.divide(bent, cube, out=np.zeros_like(bent), where=cube > 0.0))

    def foot_points(self, points: Array) -> FootPoints:
        """Find the foot points of points (k, 2), map frame, on the whole curve."""
        low, high = self.domain
        step = (high - low) / (_FOOT_GRID * (len(self.control_points) - self.degree))
        lows, highs = np.full(len(points), low), np.full(len(points), high)
        return foot_points(self.tables, self.control_points, points, lows, highs, step)

    def length(self) -> float:
        """Length of the curve (m)."""
        return float(self._break_lengths[-1])

    def arc_length(self, u: Array) -> Array:
        """Arc length (k,) from the first parameter to u (k,), in m, by Gauss-Legendre on each span."""
        breaks = self.breaks
        u = np.clip(u, breaks[0], breaks[-1])
        index = np.clip(np.searchsorted(breaks, u, side="right") - 1, 0, len(breaks) - 2)
        return self._break_lengths[index] + self._gauss_lengths(breaks[index], u)

    def parameters_at(self, lengths: Array) -> Array:
        """Parameters u (k,) at arc lengths (k,), clipped to the curve: the inverse of `arc_length`."""
        low, high = self.domain
        lengths = np.clip(lengths, 0.0, self.length())
        grid = np.linspace(low, high, _FOOT_GRID * (len(self.breaks) - 1) + 1)
        u = np.interp(lengths, self.arc_length(grid), grid)
        for _ in range(4):  # Newton steps
            speed = np.linalg.norm(self.evaluate(u, 1), axis=1)
            error = lengths - self.arc_length(u)
            u = np.clip(u + np.divide(error, speed, out=np.zeros_like(u), where=speed > 0.0), low, high)
        return u

    @cached_property
    def _break_lengths(self) -> Array:
        breaks = self.breaks
        return np.concatenate([[0.0], np.cumsum(self._gauss_lengths(breaks[:-1], breaks[1:]))])

    def _gauss_lengths(self, starts: Array, ends: Array) -> Array:
        """Integrals (k,) of |S'| over intervals without a knot inside."""
        half = 0.5 * (ends - starts)
        nodes = (0.5 * (starts + ends))[:, None] + half[:, None] * _GAUSS_NODES
        speed = np.linalg.norm(self.evaluate(nodes.ravel(), 1), axis=1).reshape(nodes.shape)
        return np.asarray(half * (speed @ _GAUSS_WEIGHTS))

    def with_end_knots(self, knots: Array) -> "BSpline":
        """Return the same curve, exactly, on knots that differ only outside the domain."""
        if self.periodic:
            raise SettingsError("cannot change the ends of a periodic spline: it has no ends")
        matrix = end_change_matrix(self.knots, self.degree, knots)
        return BSpline(knots, matrix @ self.control_points, self.degree)

    def clamp(self) -> "BSpline":
        """Return the same curve with (p + 1)-fold knots at its ends, which become control points."""
        knots, p = self.knots.copy(), self.degree
        knots[:p] = knots[p]
        knots[-p:] = knots[-p - 1]
        return self.with_end_knots(knots)

    def unclamp(self) -> "BSpline":
        """Return the same curve with floating ends: p knots repeat the interval at each end outward."""
        knots, p, outward = self.knots.copy(), self.degree, np.arange(1, self.degree + 1)
        knots[:p] = knots[p] - (knots[p + 1] - knots[p]) * outward[::-1]
        knots[-p:] = knots[-p - 1] + (knots[-p - 1] - knots[-p - 2]) * outward
        return self.with_end_knots(knots)

    def extension_knots(self, point: Array) -> Array:
        """Knots (n + p + 2,) of `extend_to`; the new interval is proportional to the chord."""
        low, high = self.domain
        chord = float(np.linalg.norm(point - self.evaluate(np.array([high]))[0]))
        mean = (high - low) / (len(self.breaks) - 1)
        length = self.length()
        interval = chord * (high - low) / length if length > 0.0 else mean
        new_end = high + max(interval, 1e-3 * mean)
        kept = self.knots[: len(self.control_points) + 1]
        return np.concatenate([kept, np.full(self.degree + 1, new_end)])

    def extend_to(self, point: Array) -> "BSpline":
        """Extend the curve to a point (2,), its new last control point (Hu et al. 2002)."""
        if self.periodic:
            raise SettingsError("cannot extend a periodic spline: it has no ends")
        knots = self.extension_knots(point)
        kept = end_change_matrix(self.knots, self.degree, knots) @ self.control_points
        return BSpline(knots, np.concatenate([kept, np.reshape(point, (1, 2))]), self.degree)

    def covariance_at(self, u: Array, joint_covariance: Array) -> Array:
        """Covariance `cov S(u) = B Sigma B^T` (k, 2, 2), with the cross terms between control points.

        The joint covariance Sigma (2 m, 2 m) is ordered by control point: x0, y0, x1, y1 and so on.
        """
        values, columns = self.local_basis(u)
        blocks = joint_covariance.reshape(self.size, 2, self.size, 2).transpose(0, 2, 1, 3)
        local = blocks[columns[:, :, None], columns[:, None, :]]
        covariance: Array = np.einsum("ki,kijab,kj->kab", values, local, values)
        return covariance

    def normal_sigma(self, u: Array, joint_covariance: Array) -> Array:
        """Standard deviation `sqrt(n^T cov S(u) n)` (k,) across the curve, in m."""
        normal = self.normal_unit(u)
        variance = np.einsum("ka,kab,kb->k", normal, self.covariance_at(u, joint_covariance), normal)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def end_change_matrix(knots: Array, degree: int, new_knots: Array) -> Array:
    """Matrix M (n, n) with `C_new = M C`, which preserves the curve if only knots outside the domain change.

    The control point c_j is the blossom, at the knots t_{j+1} to t_{j+p}, of the polynomial of any span that
    it acts on (Ramshaw 1989). So one formula clamps, unclamps, and extends as Hu et al. (2002). The first and
    the last span of the domain must not be empty. Knots beyond index n + p - 1 are not read.
    """
    count = len(knots) - degree - 1
    matrix = np.eye(count)
    for j in range(count):
        arguments = new_knots[j + 1 : j + degree + 1]
        if not np.array_equal(arguments, knots[j + 1 : j + degree + 1]):
            span = degree if j < degree else count - 1
            matrix[j] = 0.0
            matrix[j, span - degree : span + 1] = _blossom(knots, degree, span, arguments)
    return matrix


def _blossom(knots: Array, degree: int, span: int, arguments: Array) -> Array:
    """Weights (p + 1,) of a span's control points in its blossom, by de Boor's recurrence."""
    weights = np.eye(degree + 1)
    for r, x in enumerate(arguments, start=1):
        lower = knots[span - degree + r : span + 1]
        upper = knots[span + 1 : span + degree - r + 2]
        share = ((x - lower) / (upper - lower))[:, None]
        weights = (1.0 - share) * weights[:-1] + share * weights[1:]
    return np.asarray(weights[0])


def sparse_rows(values: Array, columns: IntArray, size: int) -> csr_array:
    """Build a sparse matrix (k, size) from the values (k, ...) and columns of each row."""
    ends = np.arange(len(values) + 1) * (values.size // len(values))
    return csr_array((values.ravel(), columns.ravel(), ends), shape=(len(values), size))


def dot(a: Array, b: Array) -> Array:
    """Scalar products (k,) of plane vectors (k, 2)."""
    return np.asarray(np.einsum("kd,kd->k", a, b))


def cross(a: Array, b: Array) -> Array:
    """Cross products (...) of plane vectors (..., 2)."""
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def side_of(p: Array, q: Array, point: Array) -> Array:
    """Side of points relative to the lines from p to q (..., 2): positive on the left."""
    return cross(q - p, point - p)


def segments_cross(p: Array, q: Array, r: Array, s: Array) -> BoolArray:
    """Whether the segments from p to q cross those from r to s (..., 2)."""
    r_apart_s, p_apart_q = side_of(p, q, r) * side_of(p, q, s), side_of(r, s, p) * side_of(r, s, q)
    return np.asarray((r_apart_s < 0.0) & (p_apart_q < 0.0))


# --- least-squares fits of splines, with bending energy, and the choice of their knots ------------------

ENERGY_WEIGHT: Final = 1e-3  # weight (m^3) of the integral of |S''|^2, relative to squared distances (m^2)
SAMPLED_WEIGHT: Final = 1e-8  # the same for dense samples of a curve: only gaps between them are bent by it


class LeastSquares:
    """Least-squares fit `argmin |B c - v|^2 + w |R c|^2` of a spline's control points c to values v.

    B is the basis at parameters u (k,), `|R c|^2` the bending energy (`energy_rows`), and w its weight (m^3).
    The control points of the spline itself are not used. `normal` solves with the normal matrix B'B + w R'R.
    """

    def __init__(self, spline: BSpline, u: Array, weight: float) -> None:
        self.basis = sparse_rows(*spline.local_basis(u), spline.size)
        self.normal: SuperLU = splu(csc_array(self.basis.T @ self.basis + weight * spline.energy))

    def solve(self, values: Array | csr_array) -> Array:
        """Return the control points (m, d) of values (k, d) at the parameters."""
        right = self.basis.T @ values
        return np.asarray(self.normal.solve(right.toarray() if issparse(right) else np.asarray(right)))


def energy_rows(spline: BSpline) -> csr_array:
    """Rows R with `|R c|^2` the integral of |S''|^2 (exact up to degree 4), or of |S'|^2 for degree 1."""
    nodes, weights = np.polynomial.legendre.leggauss(3)
    breaks = spline.breaks
    half = 0.5 * np.diff(breaks)
    u = ((breaks[:-1] + half)[:, None] + half[:, None] * nodes).ravel()
    values, columns = spline.local_basis(u, min(2, spline.degree))
    return sparse_rows(values * np.sqrt(half[:, None] * weights).reshape(-1, 1), columns, spline.size)


def fit_spline(points: Array, breaks: Array | int, periodic: bool, degree: int = 3) -> tuple[BSpline, Array]:
    """Fit a spline to ordered points (k, 2) in m, by least squares; return it and their parameters (k,).

    Parameters begin at chord lengths and move to the foot points. The knots are `breaks`, in chord lengths,
    or so many control points on evenly spaced ones. With bending energy two points are enough, or three on a
    loop. SettingsError for fewer points, or too few control points for the degree.
    """
    following = np.roll(points, -1, axis=0) if periodic else points[1:]
    lengths = np.append(0.0, np.cumsum(np.hypot(*(following - points[: len(following)]).T)))
    if len(points) < (3 if periodic else 2) or not lengths[-1] > 0.0:
        raise SettingsError("a spline is fitted to at least two distinct points, a closed one to three")
    if isinstance(breaks, int):
        count = breaks if periodic else breaks - degree
        if count < 1 or (periodic and count <= degree):
            raise SettingsError(f"{breaks} control points are too few for a spline of degree {degree}")
        breaks = np.linspace(0.0, lengths[-1], count + 1)
    frame, feet = _frame(breaks, periodic, degree), lengths[: len(points)]
    reach = (breaks[-1] - breaks[0]) / max(len(breaks) - 1, len(points))
    for _ in range(4):  # with refreshed foot points
        u = feet
        spline = frame.with_points(LeastSquares(frame, u, ENERGY_WEIGHT).solve(points))
        search = u - reach, u + reach, 0.1 * reach
        feet = foot_points(spline.tables, spline.control_points, points, *search).u
    return spline, u


# --- knots by the cones ----------------------------------------------------------------------------------


COINCIDENT_CONES: Final = 1e-9  # largest difference of parameters of cones that share a knot (m)


@dataclass(frozen=True, eq=False)
class Thinned:
    """Least-squares spline through ordered points, after the removal of some knots."""

    breaks: Array  # (b + 1,) remaining knots, in the parameter of the points (m)
    size: int  # number of control points
    residual: Array  # (k, 2) offset from the spline to each point, at the point's parameter (m)
    leverage: Array  # (k,) diagonal of the hat matrix

    @property
    def crossed(self) -> float:
        """Leave-one-out sum of squares (m^2)."""
        return float(((self.residual / (1.0 - self.leverage)[:, None]) ** 2).sum())


def chosen_breaks(points: Array, periodic: bool, degree: int, least: int, most: int) -> Thinned:
    """Choose a curve of `thin` with `least` to `most` control points by cross-validation.

    It is the largest, unless a smaller one predicts left-out points better by a tenth. BIC would take a
    knot for every cone, since the residuals vanish. Cones are 0.066 m from the curve, 0.107 m with knots by
    curvature.
    """
    path = list(thin(points, periodic, degree, least))
    within = [curve for curve in path if curve.size <= most] or path[-1:]
    return min(within, key=lambda curve: (1.0 if curve is within[0] else 1.1) * curve.crossed)


def fewest_breaks(points: Array, periodic: bool, degree: int, least: int, tolerance: float) -> Thinned:
    """Choose the smallest curve of `thin` whose leave-one-out rms is within a tolerance (m).

    It has at least `least` control points. If none is so near, the largest is chosen.
    """
    path = list(thin(points, periodic, degree, least))
    near = [curve for curve in path if curve.crossed <= tolerance**2 * len(points)]
    return near[-1] if near else path[0]


def thin(points: Array, periodic: bool, degree: int, least: int) -> Iterator[Thinned]:
    """Yield least-squares curves from a knot at each point down to `least` control points, knot by knot.

    The parameters of the ordered points (k, 2) are path lengths. If they are too few for `least` control
    points, the first curve is the only one. Each step removes the knot whose removal costs least; ties go to
    the shortest interval.

    A knot vanishes if the p-th derivative does not jump there: a linear constraint a'c = 0. The removal costs
    `|a'c|^2 / (a' G^-1 a)`, where G is the matrix of the normal equations, and every linear function `w'c`
    decreases by `w' G^-1 a / (a' G^-1 a) a'c`. So rank-one updates of `W c` and `W G^-1 A'` suffice, where
    the rows of W are the jumps A at all knots and the basis at the points.
    """
    u = path_lengths(points)
    high = float(u[-1] + (np.hypot(*(points[0] - points[-1])) if periodic else 0.0))
    inner = np.unique(u[(u > COINCIDENT_CONES) & (u < high - COINCIDENT_CONES)])
    breaks = np.concatenate([[0.0], inner[np.diff(inner, prepend=0.0) > COINCIDENT_CONES], [high]])
    while periodic and len(breaks) <= degree + 1:
        breaks = np.sort(np.append(breaks, 0.5 * (breaks[1:] + breaks[:-1])))
    frame = _frame(breaks, periodic, degree)
    fit = LeastSquares(frame, u, ENERGY_WEIGHT)
    middle = 0.5 * (frame.breaks[1:] + frame.breaks[:-1])
    highest = sparse_rows(*frame.local_basis(middle, degree), frame.size)
    jumps = highest[1:] - highest[:-1]  # of the highest derivative at each inner break, by control point
    B, n = fit.basis, jumps.shape[0]
    watched, remaining, stays = vstack([jumps, B], "csr"), np.arange(n), np.ones(n + len(points), bool)
    spread = np.asfortranarray(watched @ fit.normal.solve(jumps.T.toarray()))
    values = watched @ fit.solve(points)
    leverage = np.asarray(B.multiply(fit.normal.solve(B.T.toarray()).T).sum(axis=1), np.float64)
    for size in range(B.shape[1], max(min(least, B.shape[1]), B.shape[1] - n) - 1, -1):
        kept = breaks[np.concatenate([[0], 1 + remaining, [-1]])]
        yield Thinned(kept, size, points - values[n:], leverage)
        if len(remaining):
            jump = values[remaining]
            cost = (jump[:, 0] ** 2 + jump[:, 1] ** 2) / spread[remaining, remaining]
            removed = int((cost + 1e-9 * (kept[2:] - kept[:-2]) ** 2).argmin())
            k, column = remaining[removed], spread[:, remaining[removed]].copy()
            share = column / column[k]
            near = np.flatnonzero(stays & (np.abs(share) > 1e-12))  # knots and points that feel it
            stays[k] = False
            inner, outer = near[near < n], near[near >= n]
            leverage = leverage.copy()
            leverage[outer - n] -= column[outer] * share[outer]
            values[near] -= share[near, None] * values[k]
            spread[np.ix_(near, inner)] -= np.outer(share[near], column[inner])
            remaining = np.concatenate([remaining[:removed], remaining[removed + 1 :]])


def _frame(breaks: Array, periodic: bool, degree: int) -> BSpline:
    count = len(breaks) - 1
    build = BSpline.periodic_from if periodic else BSpline.clamped_from
    return build(breaks, np.zeros((count if periodic else count + degree, 2)), degree)
