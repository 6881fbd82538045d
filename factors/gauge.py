"""Weak priors on what detections leave free: control points slide along the curve, and some are unseen."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def spacing_residuals(control_points: Array, nominal: Array, periodic: bool) -> tuple[Array, Array]:
    """Returns `r_j = |c_{j+1} - c_j| - nominal_j` (k,), in m, and unit directions (k, 2) of neighbours.

    The residual is that of GTSAM's RangeFactor2, with dr/dc_{j+1} = -dr/dc_j the direction, which is zero
    for coinciding points. control_points (m, 2) have k = m - 1 pairs of neighbours, or m where periodic, and
    nominal (k,) is in m.
    """
    following = np.roll(control_points, -1, axis=0) if periodic else control_points[1:]
    return pair_residuals(control_points[: len(following)], following, nominal)


def pair_residuals(first: Array, second: Array, nominal: Array) -> tuple[Array, Array]:
    """Returns `|b_j - a_j| - nominal_j` (k,) of pairs of points a, b (k, 2), and unit directions (k, 2)."""
    offset = second - first
    length = np.hypot(offset[:, 0], offset[:, 1])
    return length - nominal, offset / np.maximum(length, np.finfo(float).tiny)[:, None]


def smoothness_coefficients(abscissae: Array, period: float | None, spacing: float | None = None) -> Array:
    """Returns second divided differences over abscissae (m,), times the squared spacing: (m - 2, 3).

    Row j holds the coefficients of the points j, j + 1 and j + 2. They are the second difference where points
    are evenly spaced, and give zero for points on a straight line whatever their spacing. A curve that is
    closed after `period` has m rows, whose points are counted around. The spacing is the mean gap of these
    abscissae where `spacing` is not given.
    """
    m = len(abscissae)
    extended = abscissae if period is None else np.concatenate([abscissae, abscissae[:2] + period])
    gaps = np.diff(extended)
    mean = gaps[:m].mean() if spacing is None else spacing  # the period repeats one gap, which counts once
    before, after = gaps[:-1], gaps[1:]
    scale = 2.0 * mean**2 / (before + after)
    return np.column_stack([scale / before, -scale / before - scale / after, scale / after])


def smoothness_matrix(abscissae: Array, period: float | None, spacing: float | None = None) -> Array:
    """Returns the matrix D (m - 2, m), or (m, m) for a closed curve, of `smoothness_coefficients`.

    `D c` is in m. The prior `D c ~ N(0, sigma^2)` is linear, so it is a Jacobian factor.
    """
    coefficients, m = smoothness_coefficients(abscissae, period, spacing), len(abscissae)
    matrix = np.zeros((len(coefficients), m))
    rows = np.arange(len(coefficients))
    for k in range(3):
        matrix[rows, (rows + k) % m] += coefficients[:, k]
    return matrix


def greville(knots: Array, degree: int) -> Array:
    """Returns the Greville abscissae `(t_{j+1} + ... + t_{j+p}) / p` (n,), where control points act most."""
    n = len(knots) - degree - 1
    windows = np.lib.stride_tricks.sliding_window_view(knots[1:-1], degree)
    return np.asarray(windows[:n].mean(axis=1))
