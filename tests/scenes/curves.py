"""Boundaries through points that are put in by hand."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.settings.mapper import GaugeSettings, SplineSettings
from pathspace_graph.spline.boundary import Boundary, open_boundary

Array = NDArray[np.float64]


def boundary_through(points: Array, settings: SplineSettings | None = None) -> tuple[Boundary, Array]:
    """Returns an open boundary through cones (k, 2), parametrized by their distances; control points."""
    boundary = open_boundary(settings or SplineSettings(), GaugeSettings())
    u = np.append(0.0, np.cumsum(np.hypot(*np.diff(points, axis=0).T)))
    control_points = boundary.grow(np.zeros((0, 2)), u, points)
    boundary.observed.extend(points)
    boundary.cone_parameters.extend(u.tolist())
    return boundary, control_points
