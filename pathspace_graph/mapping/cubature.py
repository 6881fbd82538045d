"""The third-degree spherical-radial cubature rule (Arasaratnam and Haykin 2009)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

Array = NDArray[np.float64]

_LEAST_VARIANCE: Final = 1e-12
"""Variances below this share of the largest are lifted to it, where a covariance has no Cholesky factor."""


@dataclass(frozen=True, eq=False)
class Transformed:
    """A Gaussian after a function, as the cubature rule sees it."""

    mean: Array
    """(q,) mean of the function."""
    covariance: Array
    """(q, q) covariance of the function."""
    slope: Array
    """(q, d) statistical linearization `C_yx C_xx^-1`: so the covariance of the function with anything that
    it doesn't depend on directly is `slope @ C_x.`, which is exact for Gaussians."""


def square_root(covariance: Array) -> Array:
    """Lower L with `L L' = covariance` (d, d); one that is only semidefinite is lifted by round-off."""
    factor, info = lapack.dpotrf(covariance, lower=1, clean=1)
    if info == 0:
        return np.asarray(factor)
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    lifted = np.maximum(values, _LEAST_VARIANCE * max(float(values[-1]), _LEAST_VARIANCE))
    return np.asarray(np.linalg.qr((vectors * np.sqrt(lifted)).T)[1].T)


def cubature_points(mean: Array, root: Array) -> Array:
    """`mean +- sqrt(d) L e_i` (2 d, d), the positive ones first; each weighs 1 / (2 d)."""
    offsets = np.sqrt(len(mean)) * root.T
    return np.concatenate([mean + offsets, mean - offsets])


def transform(function: Callable[[Array], Array], mean: Array, covariance: Array) -> Transformed:
    """Mean, covariance and slope of `function`, which takes points (k, d) row by row to (k, q).

    Exact where the function is linear, and its mean where it is a polynomial of the third degree.
    """
    root = square_root(covariance)
    d = len(mean)
    values = function(cubature_points(mean, root))
    centre = values.mean(axis=0)
    spread = (values - centre) / np.sqrt(2.0 * d)
    half = (values[:d] - values[d:]) / (2.0 * np.sqrt(d))
    slope, _ = lapack.dtrtrs(root, half, lower=1, trans=1)
    return Transformed(centre, spread.T @ spread, np.asarray(slope).T)
