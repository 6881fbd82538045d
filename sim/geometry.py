"""Small plane geometry on sampled curves."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


def ring(points: FloatArray) -> FloatArray:
    """The points of a closed curve (n, 2), the first repeated at the end (n + 1, 2)."""
    return np.vstack([points, points[:1]])


def arc_lengths(points: FloatArray) -> FloatArray:
    """Way along a polyline (n, 2) from its first point to each (n,), m."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


def along_polyline(at: FloatArray, s: FloatArray, points: FloatArray) -> FloatArray:
    """Points (k, 2) at the values `at` (k,) of an increasing parameter `s` (n,) of a polyline (n, 2)."""
    return np.column_stack([np.interp(at, s, points[:, 0]), np.interp(at, s, points[:, 1])])


def unit(vectors: FloatArray) -> FloatArray:
    """The vectors (n, 2) at length 1."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def left_normals(tangents: FloatArray) -> FloatArray:
    """The vectors (n, 2) a quarter turn to the left."""
    return np.stack([-tangents[..., 1], tangents[..., 0]], axis=-1)


def direction(theta: float) -> FloatArray:
    """The unit vector (2,) of a heading, rad."""
    return np.array([np.cos(theta), np.sin(theta)])


def curvature(first: FloatArray, second: FloatArray) -> FloatArray:
    """Signed curvature (n,), 1/m, of a curve with these derivatives (n, 2), positive to the left."""
    cross = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    return np.asarray(cross / np.linalg.norm(first, axis=1) ** 3)
