"""The metrics of the paper's Table 1, and the error of a trajectory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from pathspace_graph.factors.footpoint import FootPoints, foot_points
from pathspace_graph.factors.se2 import wrap_angle
from pathspace_graph.io.log import Truth
from pathspace_graph.io.map import Map, MapBoundary, SplineBoundary
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.laps import LapSettings, lap_end_indices
from pathspace_graph.spline.bspline import BSpline

Array = NDArray[np.float64]

MISSED_DISTANCE = 3.0
"""A true cone farther (m) than this from its boundary is missed (paper, Table 1)."""

GRID_PER_SPAN = 64
"""Grid points on each span that a closest point is searched from: about every 0.1 m of a track."""


@dataclass(frozen=True, slots=True)
class LapMetrics:
    """One row of the paper's Table 1."""

    lap: int
    """Counted from 1; the map is taken as it stood at this lap's end."""

    rmse: float
    """m, over the cones not missed; NaN where all are."""

    missed: float
    """Missed share of all true cones, 0 to 1; NaN where there are none."""

    size: int
    """Control points or landmarks on both boundaries together."""


def lap_metrics(track: Map, truth: Truth, lap: int) -> LapMetrics:
    """rmse = sqrt(mean d^2) over the true cones with d <= 3 m, and the share of those with d > 3 m."""
    distances = cone_distances(track, truth)
    return LapMetrics(
        lap=lap,
        rmse=root_mean_square(distances[distances <= MISSED_DISTANCE]),
        missed=missed_share(distances),
        size=track.size,
    )


def missed_share(distances: Array, threshold: float = MISSED_DISTANCE) -> float:
    """The share of the true cones (K,) with d > threshold (m); NaN where there are none."""
    return float(np.mean(distances > threshold)) if len(distances) else float("nan")


def capped_rmse(distances: Array, cap: float = MISSED_DISTANCE) -> float:
    """sqrt(mean min(d, cap)^2), m: every missed cone counts as `cap`, so that missing one never pays."""
    return root_mean_square(np.minimum(distances, cap))


def laps_metrics(lap_maps: Sequence[tuple[int, Map]], truth: Truth) -> list[LapMetrics]:
    """The whole table: `lap_metrics` of the map as it stood at the end of each lap."""
    return [lap_metrics(track, truth, lap) for lap, track in lap_maps]


def cone_distances(track: Map, truth: Truth) -> Array:
    """(K,) m: from each true cone of a boundary to the nearest mapped point of its own, in the truth's order.

    Infinite where that boundary isn't mapped. Cones labelled `unknown` belong to none and aren't counted.
    """
    distances = np.full(len(truth.cones), np.inf)
    for label in BOUNDARIES:
        if label in track.boundaries:
            own = truth.cone_labels == label
            distances[own] = boundary_distances(track.boundaries[label], truth.cones[own])
    return distances[np.isin(truth.cone_labels, BOUNDARIES)]


def boundary_distances(boundary: MapBoundary, points_map: Array) -> Array:
    """(k,) m: from each point (k, 2) to the closest point of the spline, or to the nearest landmark."""
    if isinstance(boundary, SplineBoundary):
        feet = closest_points(boundary.spline, points_map)
        return np.asarray(np.linalg.norm(points_map - feet.position, axis=1))
    if boundary.size == 0:
        return np.full(len(points_map), np.inf)
    return np.asarray(KDTree(boundary.points).query(points_map)[0])


def closest_points(spline: BSpline, points_map: Array) -> FootPoints:
    """The closest point of the whole curve to each point (k, 2), searched so finely that it counts as exact.

    Only where two stretches are equally near, to about the grid's sagitta, may the other one be taken.
    """
    low, high = spline.domain
    step = (high - low) / (GRID_PER_SPAN * (len(spline.breaks) - 1))
    lows, highs = np.full(len(points_map), low), np.full(len(points_map), high)
    return foot_points(spline.tables, spline.control_points, points_map, lows, highs, step)


def root_mean_square(values: Array) -> float:
    """sqrt(mean v^2); NaN of nothing."""
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else float("nan")


# --- trajectory ------------------------------------------------------------------------------------------


def interpolate_poses(pose_t: Array, poses: Array, t: Array) -> Array:
    """(n, 3) [x, y, theta] at t (n,), linear between poses (N, 3) at pose_t (N,), turning the shorter way."""
    columns = (poses[:, 0], poses[:, 1], np.unwrap(poses[:, 2]))
    x, y, theta = (np.interp(t, pose_t, column) for column in columns)
    return np.stack([x, y, wrap_angle(theta)], axis=1)


def trajectory_errors(t: Array, poses: Array, truth: Truth) -> Array:
    """(k, 3): [along, across, heading] error of each pose in the true vehicle frame (m, m, rad), unaligned.

    t (n,), poses (n, 3); stamps outside the truth's own are left out, so k <= n.
    """
    inside = (t >= truth.pose_t[0]) & (t <= truth.pose_t[-1])
    true = interpolate_poses(truth.pose_t, truth.poses, t[inside])
    dx, dy, turn = (poses[inside] - true).T
    c, s = np.cos(true[:, 2]), np.sin(true[:, 2])
    return np.stack([c * dx + s * dy, c * dy - s * dx, wrap_angle(turn)], axis=1)


def ate(t: Array, poses: Array, truth: Truth) -> float:
    """Absolute trajectory error: sqrt(mean |p - p_true|^2) in m, no alignment."""
    errors = trajectory_errors(t, poses, truth)
    return root_mean_square(np.linalg.norm(errors[:, :2], axis=1))


def lap_end_times(truth: Truth, settings: LapSettings | None = None) -> Array:
    """(laps,) s: when each complete lap of the true path ends."""
    return truth.pose_t[lap_end_indices(truth.poses, settings)]


# --- curves ----------------------------------------------------------------------------------------------


def two_way_distance(points_a: Array, points_b: Array) -> float:
    """Mean of the mean distances a -> b and b -> a (m) of two curves given as dense points (., 2)."""
    forth = KDTree(points_b).query(points_a)[0]
    back = KDTree(points_a).query(points_b)[0]
    return float(0.5 * (np.mean(forth) + np.mean(back)))
