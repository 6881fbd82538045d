"""What readings leave free: control points slide along the curve, and nothing holds unseen ones."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def spacing_residuals(control_points: Array, nominal: Array, periodic: bool) -> tuple[Array, Array]:
    """`r_j = |c_{j+1} - c_j| - nominal_j` (m), as GTSAM's RangeFactor2 has it, for all neighbours at once.

    control_points (m, 2), nominal (m - 1,) or (m,) where periodic. Gives r and the unit directions (k, 2),
    which are dr/dc_{j+1} = -dr/dc_j. Coinciding points have a zero direction.
    """
    following = np.roll(control_points, -1, axis=0) if periodic else control_points[1:]
    return pair_residuals(control_points[: len(following)], following, nominal)


def pair_residuals(first: Array, second: Array, nominal: Array) -> tuple[Array, Array]:
    """`|b_j - a_j| - nominal_j` (k,) of any pairs of points (k, 2), and the directions as above."""
    offset = second - first
    length = np.hypot(offset[:, 0], offset[:, 1])
    return length - nominal, offset / np.maximum(length, np.finfo(float).tiny)[:, None]


def smoothness_coefficients(abscissae: Array, period: float | None, spacing: float | None = None) -> Array:
    """Second divided differences over abscissae, times the spacing squared: (m - 2, 3), by three in a row.

    abscissae (m,) (Greville's); `period` closes the curve, (m, 3) then, and row j is of the points j, j + 1
    and j + 2, counted around. So they are the second differences of evenly spaced points; zero for a straight
    line, whatever the spacing. `spacing`: the curve's mean one, unless these points' own is meant.
    """
    m = len(abscissae)
    extended = abscissae if period is None else np.concatenate([abscissae, abscissae[:2] + period])
    gaps = np.diff(extended)
    mean = gaps[:m].mean() if spacing is None else spacing  # the gap that the period repeats counts once
    before, after = gaps[:-1], gaps[1:]
    scale = 2.0 * mean**2 / (before + after)
    return np.column_stack([scale / before, -scale / before - scale / after, scale / after])


def smoothness_matrix(abscissae: Array, period: float | None, spacing: float | None = None) -> Array:
    """The same as a matrix D (m - 2, m), or (m, m) where `period` closes the curve, so that `D c` (m).

    Linear: a prior `D c ~ N(0, sigma^2)` is a JacobianFactor.
    """
    coefficients, m = smoothness_coefficients(abscissae, period, spacing), len(abscissae)
    matrix = np.zeros((len(coefficients), m))
    rows = np.arange(len(coefficients))
    for k in range(3):
        matrix[rows, (rows + k) % m] += coefficients[:, k]
    return matrix


def greville(knots: Array, degree: int) -> Array:
    """Greville abscissae `(t_{j+1} + ... + t_{j+p}) / p` (n,): the parameter where each point acts."""
    n = len(knots) - degree - 1
    windows = np.lib.stride_tricks.sliding_window_view(knots[1:-1], degree)
    return np.asarray(windows[:n].mean(axis=1))
