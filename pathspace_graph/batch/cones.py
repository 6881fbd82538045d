"""The cones of each boundary: clusters of its detections, in the order of travel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.se2 import to_map, to_vehicle
from pathspace_graph.mapping.detections import DetectionTable
from pathspace_graph.mapping.path import BESIDE, LATERAL_GAP, SIDES, in_front_row
from pathspace_graph.mapping.state import State
from pathspace_graph.settings.batch import ConeSettings
from pathspace_graph.settings.mapper import MapperSettings

from .association import find_anywhere
from .recurrence import path_lengths

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Cones:
    """Holds the cones of a boundary in the order of travel."""

    points: Array
    """Each row (k, 2) is the weighted mean of a cone's detections in m, map frame."""
    u: Array
    """Each entry (k,) is a cone's parameter along the curve or path (m)."""
    count: IntArray
    """Each entry (k,) is the number of a cone's detections."""

    def where(self, chosen: BoolArray | IntArray) -> Cones:
        """Returns the chosen cones, in the order in which they are chosen."""
        return Cones(self.points[chosen], self.u[chosen], self.count[chosen])

    def merged(self, other: Cones) -> Cones:
        """Returns the cones of both, ordered by parameter."""
        pairs = zip((self.points, self.u, self.count), (other.points, other.u, other.count), strict=True)
        both = Cones(*(np.concatenate(pair) for pair in pairs))
        return both.where(np.argsort(both.u, kind="stable"))


# --- cones of a curve ------------------------------------------------------------------------------------


def cones_of_curve(state: State, detections: DetectionTable, label: int, settings: MapperSettings) -> Cones:
    """Returns the cones of a boundary whose curve the state has.

    A cone that is often detected beside the curve, but too far from it to be used, belongs to it as well: the
    curve cuts a corner there. On a closed curve parameters are counted from the beginning of the drive, so
    that the beginning of the curve's own parameter doesn't matter. There the cones are ordered as the vehicle
    passed them, since in a hairpin the curve may have taken two of them in the wrong order.
    """
    boundary, begin = state.boundaries[label], first_parameter(state, label)
    rows = sharp(np.flatnonzero(detections.label == label), detections, settings)
    points = to_map(detections.point[rows], state.variables.poses_at(detections.cycle[rows]))
    used = detections.used[rows] & (detections.boundary[rows] == label)
    beside, on_curve, u = used.copy(), used.copy(), detections.u[rows].copy()
    beside[~used], on_curve[~used], u[~used] = _beside(
        state, points[~used], detections.cycle[rows[~used]], label, settings
    )
    u = np.mod(u - begin, boundary.length) if boundary.periodic else u - begin
    weight = 1.0 / np.trace(detections.covariance[rows], axis1=1, axis2=2)

    def clustered(chosen: BoolArray) -> Cones:
        return cluster(
            points[chosen], u[chosen], weight[chosen], boundary.length, boundary.periodic, settings
        )

    cones = clustered(on_curve)
    if len(cones.u) == 0:
        return cones
    radius, min_share = settings.growth.merge_radius, settings.batch.cones.min_share_beside
    others = clustered(beside & ~on_curve & _far_from(points, cones.points, radius))
    cones = cones.merged(others.where(others.count >= min_share * np.median(cones.count)))
    if boundary.periodic:
        cones = along_drive(cones, last_lap(state, label), label)
    return without_folds(cones, boundary.periodic, settings.batch.cones)


def sharp(rows: IntArray, detections: DetectionTable, settings: MapperSettings) -> IntArray:
    """Returns the rows whose detections are certain enough to say where a cone stands.

    Those of far ones are smeared over several cones. All count where hardly any is certain.
    """
    sigma = np.sqrt(0.5 * np.trace(detections.covariance[rows], axis1=1, axis2=2))
    certain = rows[sigma < settings.batch.cones.sigma]
    return certain if len(certain) >= settings.batch.cones.sharp_share * len(rows) else rows


def cone_counts(state: State, detections: DetectionTable, settings: MapperSettings) -> list[int]:
    """Returns the number of cones of each boundary."""
    return [len(cones_of_curve(state, detections, label, settings).u) for label in state.boundaries]


def first_parameter(state: State, label: int) -> float:
    """Returns the parameter of a curve from which those of its cones are counted."""
    boundary = state.boundaries[label]
    return float(state.pose_u[label][0]) if boundary.periodic else boundary.tables.low


def last_lap(state: State, label: int) -> Array:
    """Returns the poses (l, 3) of the last lap around a closed curve, map frame."""
    pose_u = state.pose_u[label]
    return np.asarray(state.poses[pose_u > pose_u[-1] - state.boundaries[label].length])


def along_drive(cones: Cones, lap: Array, label: int) -> Cones:
    """Return the cones of the row nearest to the poses (l, 3) of a lap, in the order in which these pass it.

    A cone is passed at the path length of its nearest pose, plus its distance ahead of that pose. What stands
    behind the row belongs to another stretch, or is smeared between two rows by far detections.
    """
    driven = path_lengths(lap)
    offset = cones.points[:, None] - lap[:, :2]
    nearest = (offset**2).sum(axis=2).argmin(axis=1)
    ahead, left = to_vehicle(cones.points, lap[nearest]).T
    station, side = driven[nearest] + ahead, SIDES[label] * left
    front = in_front_row(station, side, BESIDE, LATERAL_GAP)
    order = np.argsort(station, kind="stable")
    return cones.where(order[front[order]])


def _beside(
    state: State, points: Array, cycles: IntArray, label: int, settings: MapperSettings
) -> tuple[BoolArray, BoolArray, Array]:
    """Returns which points (m, 2) lie beside a curve, which lie about its end, and their foot points u (m,).

    Half of the detections of the cone at which an open curve ends lie beyond its end. On an open curve, a
    point lies on the stretch that the pose of its cycle (m,) sees.
    """
    boundary, control_points = state.boundaries[label], state.control_points(label)
    if boundary.periodic:
        foot = find_anywhere(boundary, control_points, points)
    else:
        u = state.pose_u[label][cycles]
        low, high = u - settings.gate.view_behind, u + settings.gate.view_ahead
        ends = boundary.tables.low, boundary.tables.high
        foot = boundary.find(control_points, points, np.clip(low, *ends), np.clip(high, *ends))
    distance = np.hypot(*(points - foot.position).T)
    beside = foot.interior & (distance < settings.gate.rough)
    return beside, ~foot.interior & (distance < settings.growth.merge_radius), foot.u


def _far_from(points: Array, cones: Array, radius: float) -> BoolArray:
    """Returns (m,) whether each point (m, 2) is farther than the radius from every cone (k, 2)."""
    square = (points[:, :1] - cones[:, 0]) ** 2 + (points[:, 1:] - cones[:, 1]) ** 2
    return np.asarray(square.min(axis=1) > radius**2)


# --- clustering ------------------------------------------------------------------------------------------


def cluster(
    points: Array, u: Array, weight: Array, length: float, periodic: bool, settings: MapperSettings
) -> Cones:
    """Returns a cone at each peak of the density of detections (m, 2) along a curve or a path.

    u (m,) in [0, length] are the parameters of the detections (m), and weight (m,) is their information
    (1/m^2). A cone has at least `growth.sightings` detections.
    """
    peaks, member = _clusters(u, weight, length, periodic, settings)
    count = np.bincount(member[member >= 0], minlength=len(peaks))
    cones = Cones(_means(points, weight, member, len(peaks)), peaks, count)
    enough = _often_seen(count, settings)
    return without_folds(cones.where(enough), periodic, settings.batch.cones)


def _clusters(
    u: Array, weight: Array, length: float, periodic: bool, settings: MapperSettings
) -> tuple[Array, IntArray]:
    """Returns the peaks (k,) of the density of detections along a curve, and the peak (m,) next to each."""
    peaks = _peaks(u, weight, length, periodic, settings)
    return peaks, _nearest_peak(u, peaks, length if periodic else np.inf, settings.growth.merge_radius)


def _often_seen(count: IntArray, settings: MapperSettings) -> BoolArray:
    """Returns (k,) whether clusters with this number of detections (k,) are cones."""
    typical = float(np.median(count)) if len(count) else 0.0
    return np.asarray(count >= max(settings.growth.sightings, settings.batch.cones.min_share * typical))


def without_folds(cones: Cones, periodic: bool, settings: ConeSettings) -> Cones:
    """Returns the cones without those at which their row folds back on itself over a short distance.

    Such a cone is a duplicate of its neighbour.
    """
    points = cones.points
    if len(points) < settings.min_count:
        return cones
    into, out = points - np.roll(points, 1, axis=0), np.roll(points, -1, axis=0) - points
    lengths = np.hypot(*into.T), np.hypot(*out.T)
    cosine = (into * out).sum(axis=1) / np.maximum(lengths[0] * lengths[1], np.finfo(float).tiny)
    folded = (cosine < -settings.fold_cosine) & (np.minimum(*lengths) < settings.fold_distance)
    if not periodic:
        folded[[0, -1]] = False
    return without_folds(cones.where(~folded), periodic, settings) if folded.any() else cones


def _peaks(u: Array, weight: Array, length: float, periodic: bool, settings: MapperSettings) -> Array:
    """Returns the parameters (k,) of the smoothed density's maxima, which are `separation` apart at least."""
    own = settings.batch.cones
    bins = max(int(np.ceil(length / own.density_step)), 1)
    step = length / bins
    density = np.bincount(np.minimum((u / step).astype(np.intp), bins - 1).clip(0), weight, bins)
    radius = own.separation * settings.growth.merge_radius
    reach = round(radius / step)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) * step / (own.bandwidth * radius)) ** 2)
    padded = np.pad(density, reach, "wrap" if periodic else "constant")
    smooth = np.convolve(padded, kernel, "same")
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(smooth, reach), 2 * reach + 1)
    highest = (smooth > 0.0) & (smooth >= windows.max(axis=1))
    return np.asarray((np.flatnonzero(highest[reach : reach + bins]) + 0.5) * step, np.float64)


def _nearest_peak(u: Array, peaks: Array, period: float, radius: float) -> IntArray:
    """Returns the index (m,) of the peak nearest to each parameter, -1 where none is within the radius."""
    if len(peaks) == 0:
        return np.full(len(u), -1)
    distance = np.abs(u[:, None] - peaks)
    if np.isfinite(period):
        distance = np.minimum(distance, period - distance)
    nearest = distance.argmin(axis=1)
    return np.where(distance[np.arange(len(u)), nearest] < radius, nearest, -1)


def _means(points: Array, weight: Array, member: IntArray, count: int) -> Array:
    """Returns the weighted mean (count, 2) of the points (m, 2) of each cluster."""
    inside = member >= 0
    total = np.bincount(member[inside], weight[inside], count)
    sums = [np.bincount(member[inside], weight[inside] * points[inside, k], count) for k in range(2)]
    return np.column_stack(sums) / np.maximum(total, np.finfo(float).tiny)[:, None]
