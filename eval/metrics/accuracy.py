"""How far a map is from the truth: the paper's Table 1, true boundaries as curves, crossings, ghosts."""

from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations
from typing import Final

import numpy as np
import scipy  # which imports its modules when they are used
from scipy.spatial import KDTree

from pathspace_graph.errors import SettingsError
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.footpoint import FootPoints, foot_points
from pathspace_graph.io.log import Truth
from pathspace_graph.io.map import Map, MapBoundary, SplineBoundary
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.laps import lap_end_indices
from pathspace_graph.sim.track import along_polyline, arc_lengths
from pathspace_graph.spline.boundary import crossing_segments
from pathspace_graph.spline.bspline import BSpline

MISSED_DISTANCE: Final = 3.0  # distance from its boundary beyond which a cone is missed (m; Table 1)
GHOST_DISTANCE: Final = 2.0  # distance from its boundary beyond which a mapped point is a ghost (m)
MAPPED_STEP: Final = 0.1  # largest step on a mapped curve (m)
_OVERLAP: Final = 3  # cones beyond the seam that Akima's tangents of a closed curve need


@dataclass(frozen=True, slots=True)
class LapMetrics:
    """One row of the paper's Table 1."""

    lap: int  # number of the lap, from 1; the map is taken as it stood at its end
    rmse: float  # rmse (m) over the cones that aren't missed; NaN where all are
    missed: float  # share (0 to 1) of all true cones that is missed; NaN without true cones
    size: int  # number of control points or landmarks of both boundaries


def lap_metrics(track: Map, truth: Truth, lap: int) -> LapMetrics:
    """Return rmse = sqrt(mean d^2) over true cones with d <= 3 m, and the share of those with d > 3 m."""
    found = cone_errors(track, truth)
    return LapMetrics(lap, found["rmse"], found["missed"], track.size)


def cone_errors(track: Map, truth: Truth) -> dict[str, float]:
    """Return the metrics of the distances d of the true cones, NaN without any.

    In `rmse_capped`, sqrt(mean min(d, 3 m)^2), a missed cone counts as 3 m, so that missing it never pays.
    """
    distances = cone_distances(track, truth)
    count = len(distances)
    return {
        "rmse": root_mean_square(distances[distances <= MISSED_DISTANCE]),
        "missed": mean_of(distances > MISSED_DISTANCE),
        "size_share": track.size / count if count else float("nan"),
        "missed_2m": mean_of(distances > 2.0),
        "missed_1m": mean_of(distances > 1.0),
        "rmse_capped": root_mean_square(np.minimum(distances, MISSED_DISTANCE)),
    }


def cone_distances(track: Map, truth: Truth) -> Array:
    """Return the distance (K,) in m of each true cone from its own mapped boundary, in the truth's order.

    Infinite where that boundary isn't mapped. Cones labelled `unknown` are left out.
    """
    distances = np.full(len(truth.cones), np.inf)
    for label in BOUNDARIES:
        if label in track.boundaries:
            own = truth.cone_labels == label
            distances[own] = boundary_distances(track.boundaries[label], truth.cones[own])
    return distances[np.isin(truth.cone_labels, BOUNDARIES)]


def boundary_distances(boundary: MapBoundary, points_map: Array) -> Array:
    """Return the distance (k,) in m of each point (k, 2) from the spline, or from the nearest landmark."""
    if isinstance(boundary, SplineBoundary):
        feet = closest_points(boundary.spline, points_map)
        return np.asarray(np.linalg.norm(points_map - feet.position, axis=1))
    if boundary.size == 0:
        return np.full(len(points_map), np.inf)
    return np.asarray(KDTree(boundary.points).query(points_map)[0])


def closest_points(spline: BSpline, points_map: Array) -> FootPoints:
    """Return the closest point of the whole curve to each point (k, 2).

    Exact, except where two stretches are equally near to about the sagitta of the grid.
    """
    low, high = spline.domain
    step = (high - low) / (64 * (len(spline.breaks) - 1))  # about 0.1 m
    lows, highs = np.full(len(points_map), low), np.full(len(points_map), high)
    return foot_points(spline.tables, spline.control_points, points_map, lows, highs, step)


def mean_of(values: Array | BoolArray) -> float:
    return float(np.mean(values)) if len(values) else float("nan")


def root_mean_square(values: Array) -> float:
    """Return sqrt(mean v^2); NaN without values."""
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else float("nan")


def cones_of(truth: Truth, label: int) -> Array:
    """Return the true cones (k, 2) of one boundary, m."""
    return np.asarray(truth.cones[truth.cone_labels == label])


@lru_cache(maxsize=16)  # asked for by every map and every curve of a log, as are the functions below
def true_lap_ends(truth: Truth) -> IntArray:
    """Return the index of the true pose (k,) at which each lap ends; cached, and not to be written to."""
    return lap_end_indices(truth.poses)


@lru_cache(maxsize=16)
def true_curve(truth: Truth, label: int, step: float = 0.02) -> Array:
    """Return points (k, 2) in m, at most `step` apart, on the curve through the true cones of a boundary.

    Akima's cubic over chord lengths, in driving order: it passes through every cone and, unlike a natural
    spline, doesn't overshoot where their spacing changes. It is closed where the true path completes a lap.
    The array is cached and must not be written to.
    """
    cones = cones_in_order(truth, label)
    if len(cones) < 2:
        return cones
    closed = len(cones) > _OVERLAP and len(true_lap_ends(truth)) > 0
    nodes = np.concatenate([cones[-_OVERLAP:], cones, cones[: _OVERLAP + 1]]) if closed else cones
    nodes = nodes[np.append(True, np.linalg.norm(np.diff(nodes, axis=0), axis=1) > 0.0)]
    length = arc_lengths(nodes)
    low, high = (length[_OVERLAP], length[-_OVERLAP - 1]) if closed else (length[0], length[-1])
    samples = np.linspace(low, high, int(np.ceil((high - low) / step)) + 1)
    return np.asarray(scipy.interpolate.Akima1DInterpolator(length, nodes)(samples), dtype=float)


@lru_cache(maxsize=16)
def cones_in_order(truth: Truth, label: int) -> Array:
    """Return the true cones (k, 2) of one boundary in driving order; cached like `true_curve`.

    Sorted by the nearest point of the true path's first lap, or as in the file where that gives the shorter
    polygon (inside a hairpin several cones share a nearest point) or there is no true path.
    """
    cones = cones_of(truth, label)
    if len(truth.poses) < 2 or len(cones) == 0:
        return cones
    ends = true_lap_ends(truth)
    path = truth.poses[: ends[0] + 1 if len(ends) else None, :2]
    length = arc_lengths(path)
    samples = np.linspace(0.0, length[-1], int(np.ceil(length[-1] / 0.1)) + 1)  # every 0.1 m
    nearest = np.asarray(KDTree(along_polyline(samples, length, path)).query(cones)[1])
    by_path: Array = cones[np.argsort(nearest, kind="stable")]
    return min(cones, by_path, key=lambda of: np.linalg.norm(of - np.roll(of, 1, axis=0), axis=1).sum())


def mapped_points(boundary: MapBoundary, step: float = MAPPED_STEP) -> Array:
    """Return points (k, 2) in m on a curve, equal lengths of at most `step` apart, or the landmarks.

    The array may be shared and must not be written to.
    """
    return _along(boundary.spline, step) if isinstance(boundary, SplineBoundary) else boundary.points


@lru_cache(maxsize=4)  # several metrics ask for the same points
def _along(spline: BSpline, step: float) -> Array:
    length = spline.length()
    count = max(int(np.ceil(length / step - 1e-9)), 1)  # round-off makes no further one
    return spline.evaluate(spline.parameters_at((np.arange(count) + 0.5) * length / count))


def boundary_errors(track: Map, truth: Truth) -> dict[str, float]:
    """Return how far the mapped boundaries and the true curves are apart, and what of the map is false.

    `mapped_to_truth` is mean_p min_q |p - q| over mapped points p, large where something false is mapped;
    `truth_to_mapped` is mean_q min_p |q - p| over true points q, large where something true isn't (m). Both
    are over both boundaries together, at points equal lengths apart. Landmarks have nothing in between, so
    the second one charges them for the gaps. It is infinite where a boundary isn't mapped; both are NaN where
    there is nothing to measure from. `ghost_landmarks` and `ghost_metres` of curve have min_q |p - q| > 2 m,
    as has a boundary without any true cone as a whole.
    """
    forth, back, landmarks, metres = [np.zeros(0)], [np.zeros(0)], 0, 0.0
    for label in BOUNDARIES:
        curve, boundary = true_curve(truth, label), track.boundaries.get(label)
        if boundary is None:
            back += [np.full(1, np.inf)] if len(curve) else []
            continue
        points = mapped_points(boundary)
        away = np.asarray(KDTree(curve).query(points)[0]) if len(curve) else np.full(len(points), np.inf)
        if len(curve):
            forth.append(away)
            back.append(boundary_distances(boundary, true_curve(truth, label, MAPPED_STEP)))
        if isinstance(boundary, SplineBoundary):
            metres += float(np.mean(away > GHOST_DISTANCE)) * boundary.spline.length()
        else:
            landmarks += int(np.sum(away > GHOST_DISTANCE))
    distances = {
        "mapped_to_truth": mean_of(np.concatenate(forth)),
        "truth_to_mapped": mean_of(np.concatenate(back)),
    }
    return {**distances, "ghost_landmarks": landmarks, "ghost_metres": metres}


def crossings(track: Map) -> tuple[int, int]:
    """Return how often the curves of a map cross each other, and how often they cross themselves."""
    lines = []
    for boundary in track.boundaries.values():
        if isinstance(boundary, SplineBoundary):
            points = mapped_points(boundary, 0.25)
            lines.append(np.concatenate([points, points[:1]]) if boundary.spline.periodic else points)
    other = sum(len(crossing_segments(*pair)[0]) for pair in combinations(lines, 2))
    return other, sum(len(crossing_segments(line, line)[0]) // 2 for line in lines)


def centre_line_errors(track: Map, truth: Truth) -> dict[str, tuple[Array, Array]]:
    """Return errors of the mapped `centre` line and its `half_width` (n,), and their claimed sigmas (n,), m.

    The normal of each point, 1 m apart, crosses the true boundaries at offsets o_l and o_r: the true centre
    is at their mean, half the width is half their difference. An error is NaN where a true boundary does not
    cross the normal near the mapped one. Empty where the map has no centre line.
    """
    try:
        line = track.centre_line(1.0)
    except SettingsError:
        return {}
    normals = np.column_stack([-np.sin(line.heading), np.cos(line.heading)])
    left, right = (
        _crossings(line.points, normals, offsets, true_curve(truth, label, MAPPED_STEP))
        for label, offsets in zip(BOUNDARIES, (line.width_left, -line.width_right), strict=True)
    )
    width = 0.5 * (left - right - line.width_left - line.width_right)
    width_sigma = 0.5 * (line.width_left_sigma + line.width_right_sigma)
    return {"centre": (0.5 * (left + right), line.points_sigma), "half_width": (width, width_sigma)}


def _crossings(points: Array, normals: Array, expected: Array, curve: Array) -> Array:
    """Return the offsets (n,) at which normals through points (n, 2) cross a curve (k, 2), by its chords.

    Of several crossings it is the one nearest to the expected offset, if not as far off as a missed cone.
    """
    tangents = np.column_stack([normals[:, 1], -normals[:, 0]])
    offsets = np.full(len(points), np.nan)
    for i, (point, tangent, normal) in enumerate(zip(points, tangents, normals, strict=True)):
        relative = curve - point
        ahead = relative @ tangent
        at = np.flatnonzero(ahead[:-1] * ahead[1:] <= 0.0)
        if len(at):
            run = ahead[at] - ahead[at + 1]
            share = np.divide(ahead[at], run, out=np.zeros(len(at)), where=run != 0.0)
            across = (relative[at] + share[:, None] * (relative[at + 1] - relative[at])) @ normal
            nearest = across[np.abs(across - expected[i]).argmin()]
            if abs(nearest - expected[i]) < MISSED_DISTANCE:
                offsets[i] = nearest
    return offsets
