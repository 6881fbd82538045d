"""The third-degree spherical-radial cubature rule (Arasaratnam and Haykin 2009), the paper's transform."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

Array = NDArray[np.float64]

_LEAST_VARIANCE: Final = 1e-12
"""Eigenvalues are raised to this share of the largest one where a covariance has no Cholesky factor."""


@dataclass(frozen=True, eq=False)
class Transformed:
    """Holds the moments of a function of a Gaussian, by the cubature rule."""

    mean: Array
    """(q,) This is the mean of the function."""
    covariance: Array
    """(q, q) This is the covariance of the function."""
    slope: Array
    """(q, d) This is the statistical linearization `C_yx C_xx^-1`. The covariance of the function with a
    variable z that it does not depend on is `slope @ C_xz`, which is exact for Gaussians."""


def square_root(covariance: Array) -> Array:
    """Returns the lower L with `L L' = covariance` (d, d). Small eigenvalues are raised if it is singular."""
    factor, info = lapack.dpotrf(covariance, lower=1, clean=1)
    if info == 0:
        return np.asarray(factor)
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    lifted = np.maximum(values, _LEAST_VARIANCE * max(float(values[-1]), _LEAST_VARIANCE))
    return np.asarray(np.linalg.qr((vectors * np.sqrt(lifted)).T)[1].T)


def cubature_points(mean: Array, root: Array) -> Array:
    """Returns `mean +- sqrt(d) L e_i` (2 d, d), the positive ones first; each has the weight 1 / (2 d)."""
    offsets = np.sqrt(len(mean)) * root.T
    return np.concatenate([mean + offsets, mean - offsets])


def transform(function: Callable[[Array], Array], mean: Array, covariance: Array) -> Transformed:
    """Returns mean, covariance and slope of `function`, which maps points (k, d) row by row to (k, q).

    All are exact for a linear function, and the mean is exact for a polynomial of the third degree.
    """
    root = square_root(covariance)
    d = len(mean)
    values = function(cubature_points(mean, root))
    centre = values.mean(axis=0)
    spread = (values - centre) / np.sqrt(2.0 * d)
    half = (values[:d] - values[d:]) / (2.0 * np.sqrt(d))
    slope, _ = lapack.dtrtrs(root, half, lower=1, trans=1)
    return Transformed(centre, spread.T @ spread, np.asarray(slope).T)
