"""Knots by curvature (paper: Simplification) or by cones, and fits and refits on them."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.linalg.blas import dger

from pathspace_graph.errors import SettingsError
from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.footpoint import foot_points
from pathspace_graph.factors.se2 import path_lengths
from pathspace_graph.spline.bspline import BSpline

CUBIC: Final = 3  # default degree
LINEAR_BASELINE: Final = 0.5  # share in [0, 1] of evenly spread knots, for straights
CURVATURE_MAX: Final = 0.7  # limit of the curvature (1/m), so that a kink does not attract all knots
ENERGY_WEIGHT: Final = (
    1e-3  # weight (m^3) of the integral of |S''|^2, relative to the squared distances (m^2)
)
KNOT_ROUNDS: Final = 4  # placements of a fit's knots by curvature, after evenly spaced ones
REFITS: Final = 4  # least-squares fits on each set of knots, with refreshed foot points
_SAMPLES_PER_BREAK: Final = 40  # equally spaced samples of the curvature for each break
_SAMPLES_PER_SPAN: Final = 8  # least-squares samples of a refit on each span; enough up to degree 7
_BRIDGE: Final = 1e-3  # weight of second derivatives on spans with too few samples of a refit
_BENDING_PER_SPAN: Final = 3  # points of the second derivative on each such span


def quantile_breaks(u: Array, curvature: Array, count: int, baseline: float = LINEAR_BASELINE) -> Array:
    """Place breaks (count + 1,) at equal quantiles of `(1 - b) |kappa| / sum |kappa| + b / N`.

    The N equally long intervals between parameters u (N + 1,) have curvature kappa (N,) in 1/m; b is the
    linear baseline. SettingsError if `count` is less than 1.
    """
    if count < 1:
        raise SettingsError(f"at least one knot interval is needed, not {count}")
    bent = np.minimum(np.abs(curvature), CURVATURE_MAX)
    total, equal = float(bent.sum()), np.full(len(bent), 1.0 / len(bent))
    share = (1.0 - baseline) * bent / total + baseline * equal if total > 0.0 else equal
    cumulative = np.append(0.0, np.cumsum(share))
    breaks = np.interp(np.linspace(0.0, 1.0, count + 1), cumulative / cumulative[-1], u)
    breaks[[0, -1]] = u[[0, -1]]
    return breaks


def curvature_weighted_breaks(
    spline: BSpline,
    count: int,
    baseline: float = LINEAR_BASELINE,
    low: float | None = None,
    high: float | None = None,
) -> Array:
    """Place breaks (count + 1,) in the spline's parameter between low and high (default: its domain).

    They are the quantiles of a density: the curvature at equal distances, plus the linear baseline (paper:
    Simplification). An open curve is straight beyond its ends. SettingsError on an empty stretch.
    """
    first, last = spline.domain
    low, high = first if low is None else low, last if high is None else high
    if not low < high:
        raise SettingsError(f"knots need a stretch that is not empty, not [{low}, {high}]")
    u = _equal_lengths(spline, low, high, count * _SAMPLES_PER_BREAK)
    middle = 0.5 * (u[1:] + u[:-1])
    curvature = spline.curvature(middle)
    if not spline.periodic:
        curvature[(middle < first) | (middle > last)] = 0.0
    return quantile_breaks(u, curvature, count, baseline)


def _equal_lengths(spline: BSpline, low: float, high: float, count: int) -> Array:
    """Parameters (count + 1,) from low to high at equal distances, extrapolated beyond an end."""
    first, last = spline.domain
    grid = np.linspace(low, high, 4 * count + 1)
    chords = np.linalg.norm(np.diff(spline.evaluate(grid), axis=0), axis=1)
    if not spline.periodic:
        beyond = (grid[:-1] < first) | (grid[1:] > last)
        chords[beyond] = spline.length() / (last - first) * (grid[1] - grid[0])
    shortest = 1e-9 * max(float(chords.sum()), 1.0) / len(chords)
    along = np.concatenate([[0.0], np.cumsum(np.maximum(chords, shortest))])
    return np.interp(np.linspace(0.0, along[-1], count + 1), along, grid)


@dataclass(frozen=True, eq=False)
class Refit:
    """Change of basis between an old and a new spline, the same for both coordinates."""

    new_from_old: Array  # (m_new, m_old) F of the least-squares fit C_new = F C_old
    old_from_new: Array  # (m_old, m_new) E of the least-squares fit C_old ~ E C_new


def refit(
    old: BSpline,
    new: BSpline,
    u_map: Callable[[Array], Array] | None = None,
    within: tuple[float, float] = (-np.inf, np.inf),
) -> Refit:
    """Fit the bases of two splines to each other; the control points of `new` are not used.

    `u_map` maps increasing parameters of the old to the new spline (default: the same). F is smooth over gaps
    without samples in the new domain. Old parameters that are not `within` the limits count for E only.
    """
    finer = int(np.ceil(np.diff(old.breaks).max() / np.diff(new.breaks).min()))
    u = _on_spans(old, _SAMPLES_PER_SPAN * min(max(1, finer), _SAMPLES_PER_SPAN))
    inside = (u >= within[0]) & (u <= within[1])
    w = u if u_map is None else u_map(u)
    local_old, local_new = old.local_basis(u), new.local_basis(w)
    within_new = w[inside]
    if new.periodic:
        begin, end = new.domain
        within_new = begin + np.mod(within_new - begin, end - begin)
    sparse = np.histogram(within_new, new.breaks)[0] <= new.degree  # fewer samples than control points
    bridge = _BRIDGE * _bending_rows(new)[np.repeat(sparse, _BENDING_PER_SPAN)]
    (values, columns), (size, old_size) = local_new, (new.size, old.size)
    counted = values * inside[:, None], columns
    new_from_old = _normal_solution(
        _product(counted, local_new, (size, size)) + bridge.T @ bridge,
        _product(counted, local_old, (size, old_size)),
    )
    old_from_new = _normal_solution(
        _product(local_old, local_old, (old_size, old_size)),
        _product(local_old, local_new, (old_size, size)),
    )
    return Refit(new_from_old, old_from_new)


def _product(a: tuple[Array, IntArray], b: tuple[Array, IntArray], shape: tuple[int, int]) -> Array:
    """Compute A' B of basis matrices (k, m) and (k, n), each given by local values and their columns."""
    at = a[1][:, :, None] * shape[1] + b[1][:, None, :]
    weights = a[0][:, :, None] * b[0][:, None, :]
    return np.asarray(np.bincount(at.ravel(), weights.ravel(), shape[0] * shape[1]).reshape(shape), float)


def _normal_solution(normal: Array, right: Array) -> Array:
    """Solve normal equations for `N^+ R`; a well-sampled B-spline basis is well conditioned."""
    try:
        factor = cho_factor(normal, check_finite=False)
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.lstsq(normal, right, rcond=None)[0])
    return np.asarray(cho_solve(factor, right, check_finite=False))


def _bending_rows(spline: BSpline) -> Array:
    """Rows whose product with the control points is h^2 S'' at points on every span of width h."""
    width, order = np.diff(spline.breaks), min(2, spline.degree)
    scale = np.repeat(width, _BENDING_PER_SPAN) ** order
    return np.asarray(spline.basis_matrix(_on_spans(spline, _BENDING_PER_SPAN), order) * scale[:, None])


def _on_spans(spline: BSpline, count: int) -> Array:
    """Evenly spaced parameters, `count` in each span of a spline."""
    offsets = (np.arange(count) + 0.5) / count
    return (spline.breaks[:-1, None] + np.diff(spline.breaks)[:, None] * offsets).ravel()


def fit_spline(
    points: Array, size: int, periodic: bool, degree: int = CUBIC, breaks: Array | None = None
) -> BSpline:
    """Fit a spline of `size` distinct control points to ordered points (k, 2) in m, by least squares.

    Parameters begin at chord lengths and move to the foot points. Unless `breaks` are given, knots follow the
    curvature, and the fit with the smallest rmse is returned. With bending energy two points are enough, or
    three on a loop. SettingsError for fewer points, or too few control points for the degree.
    """
    u, high = _chord_lengths(points, periodic)
    count = size if periodic else size - degree
    if count < 1 or (periodic and count <= degree):
        raise SettingsError(f"{size} control points are too few for a spline of degree {degree}")
    if breaks is not None:
        return _fit_on(points, u, breaks, periodic, degree)[0]
    knots, fits = np.linspace(0.0, high, count + 1), []
    for _ in range(KNOT_ROUNDS + 1):
        spline, u, rmse = _fit_on(points, u, knots, periodic, degree)
        fits.append((rmse, spline))
        knots = curvature_weighted_breaks(spline, count)
    return min(fits, key=lambda fit: fit[0])[1]


def _chord_lengths(points: Array, periodic: bool) -> tuple[Array, float]:
    following = np.roll(points, -1, axis=0) if periodic else points[1:]
    chords = np.linalg.norm(following - points[: len(following)], axis=1)
    along = np.concatenate([[0.0], np.cumsum(chords)])
    if len(points) < (3 if periodic else 2) or not along[-1] > 0.0:
        raise SettingsError("a spline is fitted to at least two distinct points, a closed one to three")
    return along[: len(points)], float(along[-1])


def _fit_on(
    points: Array, u: Array, breaks: Array, periodic: bool, degree: int
) -> tuple[BSpline, Array, float]:
    frame = _frame(breaks, periodic, degree)
    bending = np.sqrt(ENERGY_WEIGHT) * energy_rows(frame)
    values = np.concatenate([points, np.zeros((len(bending), 2))])
    reach = (breaks[-1] - breaks[0]) / max(len(breaks) - 1, len(points))
    for _ in range(REFITS):
        stacked = np.concatenate([frame.basis_matrix(u), bending])
        frame = frame.with_points(np.linalg.lstsq(stacked, values, rcond=None)[0])
        feet = foot_points(frame.tables, frame.control_points, points, u - reach, u + reach, 0.1 * reach)
        u = feet.u
    return frame, u, float(np.sqrt(np.mean(np.sum((feet.position - points) ** 2, axis=1))))


def energy_rows(spline: BSpline) -> Array:
    """Rows R with `|R c|^2` the integral of |S''|^2 (exact up to degree 4), or of |S'|^2 for degree 1."""
    nodes, weights = np.polynomial.legendre.leggauss(3)
    breaks = spline.breaks
    half = 0.5 * np.diff(breaks)
    u = ((breaks[:-1] + half)[:, None] + half[:, None] * nodes).ravel()
    root = np.sqrt((half[:, None] * weights).ravel())
    return np.asarray(spline.basis_matrix(u, min(2, spline.degree)) * root[:, None])


# --- knots by the cones ----------------------------------------------------------------------------------


EVEN_WEIGHT: Final = 1e-9  # weight of the squared interval left by a removal; decides between equal costs
SIZE_MARGIN: Final = 0.1  # least relative gain in the sum of squares for which a smaller curve is chosen
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
    """Choose a curve of `thin_along` with `least` to `most` control points by cross-validation.

    It is the largest, unless a smaller one predicts left-out points better by `SIZE_MARGIN`. BIC would take a
    knot for every cone, since the residuals vanish. Cones are 0.066 m from the curve, 0.107 m with knots by
    curvature.
    """
    path = thin_along(points, periodic, degree, least)
    within = [curve for curve in path if curve.size <= most] or path[-1:]
    return min(within, key=lambda curve: (1.0 if curve is within[0] else 1.0 + SIZE_MARGIN) * curve.crossed)


def fewest_breaks(points: Array, periodic: bool, degree: int, least: int, tolerance: float) -> Thinned:
    """Choose the smallest curve of `thin_along` whose leave-one-out rms is within a tolerance (m).

    It has at least `least` control points. If none is so near, the largest is chosen.
    """
    path = thin_along(points, periodic, degree, least)
    near = [curve for curve in path if curve.crossed <= tolerance**2 * len(points)]
    return near[-1] if near else path[0]


def thin_along(points: Array, periodic: bool, degree: int, least: int) -> list[Thinned]:
    """Return the curves of `thin` through ordered points (k, 2), with path lengths as parameters."""
    along = path_lengths(points)
    high = float(along[-1] + (np.hypot(*(points[0] - points[-1])) if periodic else 0.0))
    return list(thin(points, along, high, periodic, degree, least))


def thin(points: Array, u: Array, high: float, periodic: bool, degree: int, least: int) -> Iterator[Thinned]:
    """Yield least-squares curves from a knot at each point down to `least` control points, knot by knot.

    The points (k, 2) have the parameters u (k,) in [0, high]. If they are too few for `least` control points,
    the first curve is the only one. Each step removes the knot whose removal costs least; ties go to the
    shortest interval.

    A knot vanishes if the p-th derivative does not jump there: a linear constraint a'c = 0. The removal costs
    `|a'c|^2 / (a' G^-1 a)`, where G is the matrix of the normal equations, and every linear function `w'c`
    decreases by `w' G^-1 a / (a' G^-1 a) a'c`. So rank-one updates of `W c` and `W G^-1 A'` suffice, where
    the rows of W are the jumps A at all knots and the basis at the points.
    """
    inner = np.unique(u[(u > COINCIDENT_CONES) & (u < high - COINCIDENT_CONES)])
    breaks = np.concatenate([[0.0], inner[np.diff(inner, prepend=0.0) > COINCIDENT_CONES], [high]])
    while periodic and len(breaks) <= degree + 1:
        breaks = np.sort(np.append(breaks, 0.5 * (breaks[1:] + breaks[:-1])))
    frame = _frame(breaks, periodic, degree)
    B, bending = frame.basis_matrix(u), energy_rows(frame)
    highest = frame.basis_matrix(0.5 * (frame.breaks[1:] + frame.breaks[:-1]), degree)
    jumps = np.diff(highest, axis=0)  # of the highest derivative at each inner break, by control point
    factor = cho_factor(B.T @ B + ENERGY_WEIGHT * bending.T @ bending)
    watched, n, remaining = np.concatenate([jumps, B]), len(jumps), np.arange(len(jumps))
    spread = np.asfortranarray(watched @ cho_solve(factor, jumps.T))
    values = watched @ cho_solve(factor, B.T @ points)
    leverage = np.einsum("kn,nk->k", B, cho_solve(factor, B.T))
    for size in range(B.shape[1], max(min(least, B.shape[1]), B.shape[1] - n) - 1, -1):
        kept = breaks[np.concatenate([[0], 1 + remaining, [-1]])]
        yield Thinned(kept, size, points - values[n:], leverage)
        if len(remaining):
            jump = values[remaining]
            cost = (jump[:, 0] ** 2 + jump[:, 1] ** 2) / spread[remaining, remaining]
            removed = int((cost + EVEN_WEIGHT * (kept[2:] - kept[:-2]) ** 2).argmin())
            k, column = remaining[removed], spread[:, remaining[removed]].copy()
            leverage, share = leverage - column[n:] ** 2 / column[k], column / column[k]
            values = values - share[:, None] * values[k]
            spread = dger(-1.0, share, spread[k], a=spread, overwrite_a=1)
            remaining = np.concatenate([remaining[:removed], remaining[removed + 1 :]])


def _frame(breaks: Array, periodic: bool, degree: int) -> BSpline:
    count = len(breaks) - 1
    build = BSpline.periodic_from if periodic else BSpline.clamped_from
    return build(breaks, np.zeros((count if periodic else count + degree, 2)), degree)
