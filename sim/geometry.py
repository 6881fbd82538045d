"""Small plane geometry on sampled curves."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


def ring(points: FloatArray) -> FloatArray:
    """Returns the points (n, 2) of a closed curve with the first one repeated at the end (n + 1, 2)."""
    return np.vstack([points, points[:1]])


def arc_lengths(points: FloatArray) -> FloatArray:
    """Returns the path length (n,) in m along a polyline (n, 2) from its first point to each."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


def along_polyline(at: FloatArray, s: FloatArray, points: FloatArray) -> FloatArray:
    """Interpolates a polyline (n, 2) with increasing parameters `s` (n,) at the values `at` (k,): (k, 2)."""
    return np.column_stack([np.interp(at, s, points[:, 0]), np.interp(at, s, points[:, 1])])


def unit(vectors: FloatArray) -> FloatArray:
    """Returns the vectors (n, 2) scaled to length 1."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def left_normals(tangents: FloatArray) -> FloatArray:
    """Returns the vectors (n, 2) turned a quarter to the left."""
    return np.stack([-tangents[..., 1], tangents[..., 0]], axis=-1)


def direction(theta: float) -> FloatArray:
    """Returns the unit vector (2,) of a heading in rad."""
    return np.array([np.cos(theta), np.sin(theta)])


def curvature(first: FloatArray, second: FloatArray) -> FloatArray:
    """Returns the signed curvature (n,) in 1/m, positive to the left, from both derivatives (n, 2)."""
    cross = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    return np.asarray(cross / np.linalg.norm(first, axis=1) ** 3)
