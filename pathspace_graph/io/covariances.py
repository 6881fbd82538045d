"""Covariances of detections: of range and bearing, and which entries are those of a covariance."""

from collections.abc import Iterable
from typing import Final

import numpy as np

from pathspace_graph.factors.arrays import Array, BoolArray

SIGMA_DETECTIONS: Final = (0.05, 0.012, np.pi / 200.0)  # (m, m/m, rad) where nothing is known


def covariances_of(xx: Array, xy: Array, yy: Array) -> Array:
    return np.stack([xx, xy, xy, yy], axis=-1).reshape(-1, 2, 2)


def polar_covariances(bearings: Array, along: Array, across: Array) -> Array:
    """`R(b) diag(along, across) R(b)^T` (m, 2, 2) of variances (m,) along rays and across them."""
    c, s = np.cos(bearings), np.sin(bearings)
    xx, yy = c * c * along + s * s * across, s * s * along + c * c * across
    return covariances_of(xx, c * s * (along - across), yy)


def ray_covariances(points: Array, sigmas: Iterable[float]) -> Array:
    """Covariances (m, 2, 2) by (s_range, s_growth, s_bearing) of points (m, 2) at ranges r.

    `(s_range + s_growth r)^2` along the ray, `(r s_bearing)^2` across it.
    """
    ranges, bearings = np.hypot(*points.T), np.arctan2(points[:, 1], points[:, 0])
    begin, growth, bearing = sigmas
    across = (np.maximum(ranges, 1.0) * bearing) ** 2  # K > 0 at the sensor, too
    return polar_covariances(bearings, (begin + growth * ranges) ** 2, across)


def is_positive_definite(xx: Array, xy: Array, yy: Array) -> BoolArray:
    """Which covariances (m,) are positive definite, by their entries."""
    with np.errstate(over="ignore", invalid="ignore"):
        good = (xx > 0) & (yy > 0) & (xx * yy - xy * xy > 1e-12 * xx * yy)  # singular to doubles below
    return np.asarray(good)
