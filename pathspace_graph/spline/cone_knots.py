"""Knots where cones ask for them: one at each cone, and those taken out that are missed least."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from pathspace_graph.settings.knots import FitSettings

from .bspline import BSpline
from .knots import energy_rows

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Thinned:
    """A least-squares spline through ordered points, on fewer and fewer breaks."""

    breaks: Array
    """(b + 1,) of the parameter."""
    size: int
    """Distinct control points."""
    residual: Array
    """(k, 2) from where it passes the points to them, m."""
    leverage: Array
    """(k,) by how much each point draws it there, 0 to 1."""

    @property
    def rss(self) -> float:
        """Sum of squared distances of the points, m^2."""
        return float((self.residual**2).sum())

    @property
    def crossed(self) -> float:
        """The same of each point from the curve that is fitted without it, m^2: cross-validation."""
        return float(((self.residual / (1.0 - self.leverage)[:, None]) ** 2).sum())


def chosen_breaks(points: Array, periodic: bool, fit: FitSettings, least: int, most: int) -> Thinned:
    """Of `thin`'s curves of `least` to `most` control points the one that foretells a cone left out best.

    The largest, unless a smaller one is better by a margin: which of nearly equal ones is best is chance.
    Cross-validation, as the other criterion, `n log(rss / n) + p log(n)` (BIC), took a knot for every cone on
    all 22 boundaries of eleven tracks: with so many knots rss, and with it the noise that BIC reckons with,
    vanishes. At a given size the curve is nearer to the cones than one whose knots
    follow the curvature: 0.066 m in place of 0.107 m on cones with 3 cm of noise.
    """
    along = np.append(0.0, np.cumsum(np.hypot(*np.diff(points, axis=0).T)))
    high = float(along[-1] + (np.hypot(*(points[0] - points[-1])) if periodic else 0.0))
    path = list(thin(points, along, high, periodic, fit, least))
    within = [curve for curve in path if curve.size <= most] or path[-1:]
    return min(within, key=lambda curve: (1.0 if curve is within[0] else 1.0 + MARGIN) * curve.crossed)


EVEN = 1e-9
"""Of knots that aren't missed at all, the one goes that leaves the least interval (m^2 by m^2)."""
MARGIN = 0.1
"""So much better (of the sum of squares) a smaller curve must be."""


def thin(
    points: Array, u: Array, high: float, periodic: bool, fit: FitSettings, least: int
) -> Iterator[Thinned]:
    """From a break at each of the points (k, 2), at u (k,) in [0, high], down to `least` control points.

    Each curve has one knot less than the last, the one that is missed least.

    A knot t is no knot any more where the p-th derivative doesn't jump there: a linear constraint a'c = 0. It
    costs `|a'c|^2 / (a' G^-1 a)`, G the normal equations; and whatever is linear in the control points,
    `w'c`, is less by `w' G^-1 a / (a' G^-1 a) a'c` then. So of the jumps at all knots and of the curve at the
    points, W, what changes is `W c` and `W G^-1 A'` only, by a rank of one.
    """
    breaks = np.unique(np.concatenate([[0.0], u, [high]]))
    frame = _frame(breaks, periodic, fit.degree)
    B, bending, jumps = frame.basis_matrix(u), energy_rows(frame), _jumps(frame)
    factor = cho_factor(B.T @ B + fit.smoothness * bending.T @ bending)
    watched, n, left = np.concatenate([jumps, B]), len(jumps), np.arange(len(jumps))
    spread, values = watched @ cho_solve(factor, jumps.T), watched @ cho_solve(factor, B.T @ points)
    leverage = np.einsum("kn,nk->k", B, cho_solve(factor, B.T))
    for size in range(B.shape[1], max(least, B.shape[1] - n) - 1, -1):
        kept = breaks[np.concatenate([[0], 1 + left, [-1]])]
        yield Thinned(kept, size, points - values[n:], leverage)
        if len(left):
            price = (values[left] ** 2).sum(axis=1) / spread.diagonal()[left]
            gone = int((price + EVEN * (kept[2:] - kept[:-2]) ** 2).argmin())
            k, column = left[gone], spread[:, left[gone]].copy()
            leverage = leverage - column[n:] ** 2 / column[k]
            values = values - np.outer(column / column[k], values[k])
            spread -= np.outer(column / column[k], spread[k])
            left = np.delete(left, gone)


def _frame(breaks: Array, periodic: bool, degree: int) -> BSpline:
    count = len(breaks) - 1
    build = BSpline.periodic_from if periodic else BSpline.clamped_from
    return build(breaks, np.zeros((count if periodic else count + degree, 2)), degree)


def _jumps(frame: BSpline) -> Array:
    """(b - 1, m) jump of the highest derivative at each inner break, by the distinct control points."""
    breaks = frame.breaks
    highest = frame.basis_matrix(0.5 * (breaks[1:] + breaks[:-1]), frame.degree)
    return np.asarray(np.diff(highest, axis=0))
