"""Boundaries through points that are put in by hand, and maps that are known exactly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.io.map import Map, PointBoundary, SplineBoundary
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.settings.mapper import SplineSettings
from pathspace_graph.spline.boundary import Boundary, open_boundary
from pathspace_graph.spline.bspline import BSpline

Array = NDArray[np.float64]

SIGMA = 0.1
"""Each coordinate of a control point has this standard deviation (m)."""


def boundary_through(points: Array, settings: SplineSettings | None = None) -> tuple[Boundary, Array]:
    """Returns an open boundary through cones (k, 2), parametrized by their distances; control points."""
    boundary = open_boundary(settings or SplineSettings())
    u = np.append(0.0, np.cumsum(np.hypot(*np.diff(points, axis=0).T)))
    control_points = boundary.grow(np.zeros((0, 2)), u, points)
    boundary.add_cones(points, u)
    return boundary, control_points


def circle(radius: float, size: int = 200, turn: float = 1.0) -> BSpline:
    """Interpolates a circle about the origin, anticlockwise where `turn` is 1, clockwise where it is -1."""
    breaks = np.linspace(0.0, 2 * np.pi, size + 1)
    points = radius * np.column_stack([np.cos(breaks[:-1]), turn * np.sin(breaks[:-1])])
    blank = BSpline.periodic_from(breaks, np.arange(2.0 * size).reshape(-1, 2))
    return BSpline.periodic_from(breaks, np.linalg.solve(blank.basis_matrix(breaks[:-1]), points))


def boundary(spline: BSpline) -> SplineBoundary:
    return SplineBoundary(spline, SIGMA**2 * np.eye(2 * spline.size))


def ring_map() -> Map:
    """A closed map: circles of 18 m and 22 m, the inner one on the left."""
    return Map(True, {LEFT: boundary(circle(18.0, 60)), RIGHT: boundary(circle(22.0, 50))})


def open_map() -> Map:
    """An open map: two straights along x, 4 m apart."""
    x = np.arange(12.0) * 3.0
    sides = {LEFT: 2.0, RIGHT: -2.0}
    splines = {y: BSpline.open_uniform(np.column_stack([x, np.full(12, at)])) for y, at in sides.items()}
    return Map(False, {label: boundary(spline) for label, spline in splines.items()})


def point_map() -> Map:
    """A map of landmarks."""
    points = {LEFT: np.array([[0.0, 2.0], [4.0, 2.5]]), RIGHT: np.array([[0.5, -2.0]])}
    return Map(False, {label: PointBoundary(at, np.eye(2 * len(at))) for label, at in points.items()})
