"""Least-squares fits of splines, with bending energy, and the choice of their knots."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.sparse import csc_array, csr_array, issparse, vstack
from scipy.sparse.linalg import SuperLU, splu

from pathspace_graph.errors import SettingsError
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.footpoint import foot_points
from pathspace_graph.factors.se2 import path_lengths
from pathspace_graph.spline.bspline import BSpline, sparse_rows

ENERGY_WEIGHT: Final = 1e-3  # weight (m^3) of the integral of |S''|^2, relative to squared distances (m^2)
SAMPLED_WEIGHT: Final = 1e-8  # the same for dense samples of a curve: only gaps between them are bent by it


class LeastSquares:
    """Least-squares fit `argmin |B c - v|^2 + w |R c|^2` of a spline's control points c to values v.

    B is the basis at parameters u (k,), `|R c|^2` the bending energy (`energy_rows`), and w its weight (m^3).
    The control points of the spline itself are not used. `normal` solves with the normal matrix B'B + w R'R.
    """

    def __init__(self, spline: BSpline, u: Array, weight: float) -> None:
        self.basis, R = sparse_rows(*spline.local_basis(u), spline.size), energy_rows(spline)
        self.normal: SuperLU = splu(csc_array(self.basis.T @ self.basis + weight * (R.T @ R)))

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
    spline, feet = _frame(breaks, periodic, degree), lengths[: len(points)]
    reach = (breaks[-1] - breaks[0]) / max(len(breaks) - 1, len(points))
    for _ in range(4):  # with refreshed foot points
        u = feet
        spline = spline.with_points(LeastSquares(spline, u, ENERGY_WEIGHT).solve(points))
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
