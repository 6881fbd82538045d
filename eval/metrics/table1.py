"""The metrics of the paper's Table 1."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from pathspace_graph.factors.footpoint import FootPoints, foot_points
from pathspace_graph.io.log import Truth
from pathspace_graph.io.map import Map, MapBoundary, SplineBoundary
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.spline.bspline import BSpline

Array = NDArray[np.float64]

MISSED_DISTANCE = 3.0
"""A true cone farther than this (m) from its mapped boundary is missed (paper, Table 1)."""

GRID_PER_SPAN = 64
"""Closest points are searched from this many grid points on each span, about every 0.1 m of a track."""


@dataclass(frozen=True, slots=True)
class LapMetrics:
    """Holds one row of the paper's Table 1."""

    lap: int
    """Laps count from 1; the map is taken as it stood at the end of this lap."""

    rmse: float
    """This is the rmse (m) over the cones that aren't missed; it is NaN where all are missed."""

    missed: float
    """This share (0 to 1) of all true cones is missed; it is NaN without true cones."""

    size: int
    """Both boundaries together have this many control points or landmarks."""


def lap_metrics(track: Map, truth: Truth, lap: int) -> LapMetrics:
    """Returns rmse = sqrt(mean d^2) over true cones with d <= 3 m, and the share of those with d > 3 m."""
    distances = cone_distances(track, truth)
    return LapMetrics(
        lap=lap,
        rmse=root_mean_square(distances[distances <= MISSED_DISTANCE]),
        missed=missed_share(distances),
        size=track.size,
    )


def missed_share(distances: Array, threshold: float = MISSED_DISTANCE) -> float:
    """Returns the share of the distances (K,) with d > threshold (m); NaN without any."""
    return float(np.mean(distances > threshold)) if len(distances) else float("nan")


def capped_rmse(distances: Array, cap: float = MISSED_DISTANCE) -> float:
    """Returns sqrt(mean min(d, cap)^2) in m: a missed cone counts as `cap`, so that missing it never pays."""
    return root_mean_square(np.minimum(distances, cap))


def cone_distances(track: Map, truth: Truth) -> Array:
    """Returns the distance (K,) in m of each true cone from its own mapped boundary, in the truth's order.

    It is infinite where that boundary isn't mapped. Cones labelled `unknown` belong to no boundary and are
    left out.
    """
    distances = np.full(len(truth.cones), np.inf)
    for label in BOUNDARIES:
        if label in track.boundaries:
            own = truth.cone_labels == label
            distances[own] = boundary_distances(track.boundaries[label], truth.cones[own])
    return distances[np.isin(truth.cone_labels, BOUNDARIES)]


def boundary_distances(boundary: MapBoundary, points_map: Array) -> Array:
    """Returns the distance (k,) in m of each point (k, 2) from the spline, or from the nearest landmark."""
    if isinstance(boundary, SplineBoundary):
        feet = closest_points(boundary.spline, points_map)
        return np.asarray(np.linalg.norm(points_map - feet.position, axis=1))
    if boundary.size == 0:
        return np.full(len(points_map), np.inf)
    return np.asarray(KDTree(boundary.points).query(points_map)[0])


def closest_points(spline: BSpline, points_map: Array) -> FootPoints:
    """Returns the closest point of the whole curve to each point (k, 2).

    The search is so fine that the result is exact, except where two stretches are equally near to about the
    sagitta of the grid: then either may be found.
    """
    low, high = spline.domain
    step = (high - low) / (GRID_PER_SPAN * (len(spline.breaks) - 1))
    lows, highs = np.full(len(points_map), low), np.full(len(points_map), high)
    return foot_points(spline.tables, spline.control_points, points_map, lows, highs, step)


def root_mean_square(values: Array) -> float:
    """Returns sqrt(mean v^2); NaN without values."""
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else float("nan")
