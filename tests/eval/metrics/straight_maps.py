"""Straight rows of cones, and maps of them whose errors are known by hand."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.io.log import Truth
from pathspace_graph.io.map import PointBoundary, SplineBoundary
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.spline.bspline import BSpline

Array = NDArray[np.float64]


def truth(left: Array, right: Array | None = None) -> Truth:
    right = np.zeros((0, 2)) if right is None else right
    labels = np.repeat([LEFT, RIGHT], [len(left), len(right)])
    return Truth(np.zeros(0), np.zeros((0, 3)), np.concatenate([left, right]), labels)


def row(y: float, x: tuple[float, ...] = (0.0, 5.0, 10.0)) -> Array:
    return np.array([(value, y) for value in x])


def line(y: float, start: float = 0.0, end: float = 10.0, sigma: float = 0.1) -> SplineBoundary:
    """A straight clamped spline of four control points."""
    points = np.column_stack([np.linspace(start, end, 4), np.full(4, y)])
    return SplineBoundary(BSpline.clamped_from(np.array([0.0, end - start]), points), sigma**2 * np.eye(8))


def landmarks(*points: tuple[float, float], sigma: float = 0.1) -> PointBoundary:
    return PointBoundary(np.array(points).reshape(-1, 2), sigma**2 * np.eye(2 * len(points)))
