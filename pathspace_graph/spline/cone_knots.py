"""Knots placed by the cones: each cone begins with a knot, and the knots that matter least are removed."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from pathspace_graph.factors.arrays import Array
from pathspace_graph.settings.knots import FitSettings

from .bspline import BSpline
from .knots import energy_rows

EVEN: Final = 1e-9
"""Weight of the square of the interval (m^2) that a removal leaves against the cost of the removal (m^2):
among knots that cost nothing, the one that leaves the shortest interval is removed."""
MARGIN: Final = 0.1
"""Least share by which the sum of squares of a smaller curve must be smaller for it to be chosen."""
COINCIDENT: Final = 1e-9
"""Largest difference of parameters of cones that share one knot (m). Two knots so close to each other impose
the same constraint up to rounding, and the cost of the second one would be 0 / 0."""


@dataclass(frozen=True, eq=False)
class Thinned:
    """Least-squares spline through ordered points, after the removal of some knots."""

    breaks: Array
    """(b + 1,) Knots that remain, in the parameter of the points (m)."""
    size: int
    residual: Array
    """(k, 2) Offset from the spline to each point, at the point's parameter (m)."""
    leverage: Array
    """(k,) Share of each point in the curve there: the diagonal of the hat matrix."""

    @property
    def rss(self) -> float:
        """Return the residual sum of squares (m^2)."""
        return float((self.residual**2).sum())

    @property
    def crossed(self) -> float:
        """Return the sum of squares (m^2) where each point in turn is left out of the fit."""
        return float(((self.residual / (1.0 - self.leverage)[:, None]) ** 2).sum())


def chosen_breaks(points: Array, periodic: bool, fit: FitSettings, least: int, most: int) -> Thinned:
    """Choose, among the curves of `thin` with `least` to `most` control points, by cross-validation.

    The largest curve is chosen, unless a smaller one predicts a point left out better by `MARGIN`: which of
    nearly equal curves is best is chance. The other criterion, `n log(rss / n) + p log(n)` (BIC), took a knot
    for every cone on all 22 boundaries of eleven tracks: with so many knots rss vanishes, and with it BIC's
    estimate of the noise. At a given size the curve is nearer to the cones than one whose knots follow the
    curvature: 0.066 m in place of 0.107 m on cones with 3 cm of noise.
    """
    along = np.append(0.0, np.cumsum(np.hypot(*np.diff(points, axis=0).T)))
    high = float(along[-1] + (np.hypot(*(points[0] - points[-1])) if periodic else 0.0))
    path = list(thin(points, along, high, periodic, fit, least))
    within = [curve for curve in path if curve.size <= most] or path[-1:]
    return min(within, key=lambda curve: (1.0 if curve is within[0] else 1.0 + MARGIN) * curve.crossed)


def thin(
    points: Array, u: Array, high: float, periodic: bool, fit: FitSettings, least: int
) -> Iterator[Thinned]:
    """Yield least-squares curves with one knot less each, from a knot at each point down to `least` points.

    The points (k, 2) have the parameters u (k,) in [0, high]; `least` counts control points, and where there
    are too few points for so many, the first curve is the only one. Each step removes the knot whose removal
    costs least; ties go to the shortest interval.

    A knot disappears where the p-th derivative does not jump: a linear constraint a'c = 0. The removal costs
    `|a'c|^2 / (a' G^-1 a)`, where G is the matrix of the normal equations, and every linear function `w'c`
    decreases by `w' G^-1 a / (a' G^-1 a) a'c`. So it suffices to update `W c` and `W G^-1 A'` by a rank of
    one, where the rows of W are the jumps A at all knots and the basis at the points.
    """
    breaks = _breaks(u, high)
    while periodic and len(breaks) <= fit.degree + 1:
        breaks = np.sort(np.append(breaks, 0.5 * (breaks[1:] + breaks[:-1])))
    frame = _frame(breaks, periodic, fit.degree)
    B, bending, jumps = frame.basis_matrix(u), energy_rows(frame), _jumps(frame)
    factor = cho_factor(B.T @ B + fit.smoothness * bending.T @ bending)
    watched, n, remaining = np.concatenate([jumps, B]), len(jumps), np.arange(len(jumps))
    spread, values = watched @ cho_solve(factor, jumps.T), watched @ cho_solve(factor, B.T @ points)
    leverage = np.einsum("kn,nk->k", B, cho_solve(factor, B.T))
    for size in range(B.shape[1], max(min(least, B.shape[1]), B.shape[1] - n) - 1, -1):
        kept = breaks[np.concatenate([[0], 1 + remaining, [-1]])]
        yield Thinned(kept, size, points - values[n:], leverage)
        if len(remaining):
            cost = (values[remaining] ** 2).sum(axis=1) / spread.diagonal()[remaining]
            removed = int((cost + EVEN * (kept[2:] - kept[:-2]) ** 2).argmin())
            k, column = remaining[removed], spread[:, remaining[removed]].copy()
            leverage = leverage - column[n:] ** 2 / column[k]
            values = values - np.outer(column / column[k], values[k])
            spread -= np.outer(column / column[k], spread[k])
            remaining = np.delete(remaining, removed)


def _breaks(u: Array, high: float) -> Array:
    """Return the distinct parameters among 0, u (k,) and `high`."""
    inner = np.unique(u[(u > COINCIDENT) & (u < high - COINCIDENT)])
    inner = inner[np.diff(inner, prepend=0.0) > COINCIDENT]
    return np.concatenate([[0.0], inner, [high]])


def _frame(breaks: Array, periodic: bool, degree: int) -> BSpline:
    count = len(breaks) - 1
    build = BSpline.periodic_from if periodic else BSpline.clamped_from
    return build(breaks, np.zeros((count if periodic else count + degree, 2)), degree)


def _jumps(frame: BSpline) -> Array:
    """Return (b - 1, m) the jump of the highest derivative at each inner break, by control point."""
    breaks = frame.breaks
    highest = frame.basis_matrix(0.5 * (breaks[1:] + breaks[:-1]), frame.degree)
    return np.asarray(np.diff(highest, axis=0))
