"""Noise models on arrays: the whitening of a point's covariance, and Huber's robust loss."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def whiteners(covariances: Array) -> Array:
    """Returns lower triangular W (m, 2, 2) with `W' W = K^-1` for covariances K (m, 2, 2).

    `W r` has two independent entries of unit variance where r has covariance K.
    """
    xx, xy, yy = covariances[:, 0, 0], covariances[:, 0, 1], covariances[:, 1, 1]
    out = np.zeros(covariances.shape)
    out[:, 0, 0] = 1.0 / np.sqrt(xx)
    out[:, 1, 1] = 1.0 / np.sqrt(yy - xy * xy / xx)
    out[:, 1, 0] = -xy / xx * out[:, 1, 1]
    return out


def huber_weights(whitened: Array, threshold: float) -> Array:
    """Returns `w = min(1, threshold / |z|)`, the weight of each whitened residual z in a Gauss-Newton step.

    An infinite threshold gives least squares: every weight is 1.
    """
    return 1.0 / np.maximum(np.abs(whitened) / threshold, 1.0)


def huber_loss(whitened: Array, threshold: float) -> Array:
    """Returns Huber's loss of each whitened residual z with threshold k.

    `rho(z) = z^2 / 2` where `|z| <= k`, and `k (|z| - k / 2)` beyond.
    """
    inner = np.minimum(np.abs(whitened), threshold)
    return np.asarray(inner * (np.abs(whitened) - 0.5 * inner))


def huber_roots(whitened: Array, threshold: float) -> Array:
    """Returns `sign(z) sqrt(2 rho(z))`, whose half square is the loss rho of `huber_loss`."""
    size = np.abs(whitened)
    inner = np.minimum(size, threshold)
    return np.sign(whitened) * np.sqrt(inner * (2.0 * size - inner))
