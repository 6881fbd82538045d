"""Cones that were sighted: what a boundary's readings are heaped around, in the order of travel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.se2 import to_map
from pathspace_graph.mapping.detections import DetectionTable
from pathspace_graph.mapping.state import State
from pathspace_graph.settings.mapper import MapperSettings

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]

DENSITY_STEP = 0.1
"""Step (m) along a curve of the readings' density."""
SELDOM = 0.1
"""What is seen less often than this share of the median cone is no cone."""
SELDOM_APART = 0.3
"""The same share where the curve doesn't pass it."""
APART = 0.6
"""Least distance of two cones along a curve as a share of the radius within which sightings are merged: in a
bend the inner curve is shorter than the way from cone to cone."""
BLUR = 0.4
"""Standard deviation of the smoothing as a share of that."""
FEWEST = 4
"""Cones that are always kept."""
BACK = -0.5
"""A row of cones turns back on itself where the cosine of its turn at a cone is less than this."""
FOLD = 1.5
"""Distance (m) to the nearer neighbour below which such a turn means that one cone was put down twice."""


@dataclass(frozen=True, eq=False)
class ConeClusters:
    """What the readings of a boundary are heaped around, in the order of travel."""

    points: Array
    """(k, 2) weighted means, map frame, m."""
    u: Array
    """(k,) their places along the way, m."""
    count: IntArray
    """(k,) readings of each."""

    def kept(self, which: BoolArray) -> ConeClusters:
        """Those alone that `which` (k,) is true of."""
        return ConeClusters(self.points[which], self.u[which], self.count[which])

    def joined(self, other: ConeClusters) -> ConeClusters:
        """Both, in order."""
        order = np.argsort(np.concatenate([self.u, other.u]), kind="stable")
        pairs = zip((self.points, self.u, self.count), (other.points, other.u, other.count), strict=True)
        return ConeClusters(*(np.concatenate(pair)[order] for pair in pairs))


def cone_clusters(
    state: State, detections: DetectionTable, label: int, settings: MapperSettings
) -> ConeClusters:
    """What the readings on a curve are heaped around.

    What is seen again and again beside a curve, but too far from it to be used, is a cone of it as well: the
    curve cuts a corner there. On a closed curve they are counted from where the drive began, so that it
    doesn't matter where the curve's own parameter begins; and they are passed in the order in which the
    vehicle passed them, as a curve may have taken two of them in the wrong one in a hairpin.
    """
    boundary = state.boundaries[label]
    rows = np.flatnonzero(detections.label == label)
    points = to_map(detections.point[rows], state.variables.poses_at(detections.cycle[rows]))
    used = detections.used[rows] & (detections.boundary[rows] == label)
    beside, ending, u = used.copy(), used.copy(), detections.u[rows].copy()
    beside[~used], ending[~used], u[~used] = _beside(state, points[~used], label, settings)
    if boundary.periodic:
        u = np.mod(u - path_begin(state, label), boundary.length)
    else:
        u = u - path_begin(state, label)
    weight = 1.0 / np.trace(detections.covariance[rows], axis1=1, axis2=2)

    def heaped(which: BoolArray) -> ConeClusters:
        return cluster(points[which], u[which], weight[which], boundary.length, boundary.periodic, settings)

    cones = heaped(ending)
    if len(cones.points) == 0:
        return cones
    alone = beside & ~ending & _far_from(points, cones.points, settings.growth.merge_radius)
    apart = heaped(alone)
    apart = apart.kept(apart.count >= SELDOM_APART * np.median(cones.count))
    cones = cones.joined(apart)
    if boundary.periodic:
        cones = as_passed(cones, last_lap(state, label))
    return unfolded(cones, boundary.periodic)


def last_lap(state: State, label: int) -> Array:
    """(l, 3) the poses of the last way around a closed curve, map frame."""
    stations = state.pose_u[label]
    return np.asarray(state.poses[stations > stations[-1] - state.boundaries[label].length])


def as_passed(cones: ConeClusters, lap: Array) -> ConeClusters:
    """In the order of the way driven, poses (l, 3), abeam of each: from the nearest pose, ahead or behind."""
    driven = np.append(0.0, np.cumsum(np.hypot(*np.diff(lap[:, :2], axis=0).T)))
    offset = cones.points[:, None] - lap[:, :2]
    nearest = (offset**2).sum(axis=2).argmin(axis=1)
    dx, dy = offset[np.arange(len(nearest)), nearest].T
    ahead = dx * np.cos(lap[nearest, 2]) + dy * np.sin(lap[nearest, 2])
    order = np.argsort(driven[nearest] + ahead, kind="stable")
    return ConeClusters(cones.points[order], cones.u[order], cones.count[order])


def cone_counts(state: State, detections: DetectionTable, settings: MapperSettings) -> list[int]:
    """How many cones were sighted of each boundary."""
    return [len(cone_clusters(state, detections, label, settings).u) for label in state.boundaries]


def path_begin(state: State, label: int) -> float:
    """Parameter of a curve at which the places of its cones are counted from."""
    boundary = state.boundaries[label]
    return float(state.pose_u[label][0]) if boundary.periodic else boundary.tables.low


def _beside(
    state: State, points: Array, label: int, settings: MapperSettings
) -> tuple[BoolArray, BoolArray, Array]:
    """Whether a cone of a curve may stand at each point (m, 2), or its very last one; foot points (m,).

    What is read of the cone at which an open curve ends lies half beyond it.
    """
    boundary = state.boundaries[label]
    low, high = np.full(len(points), boundary.tables.low), np.full(len(points), boundary.tables.high)
    foot = boundary.find(state.control_points(label), points, low, high)
    away = np.hypot(*(points - foot.position).T)
    beside = foot.interior & (away < settings.gate.rough)
    return beside, ~foot.interior & (away < settings.growth.merge_radius), foot.u


def _far_from(points: Array, cones: Array, radius: float) -> BoolArray:
    """(m,) whether a point (m, 2) is farther than that from every cone (k, 2)."""
    away = (points[:, :1] - cones[:, 0]) ** 2 + (points[:, 1:] - cones[:, 1]) ** 2
    return np.asarray(away.min(axis=1) > radius**2)


def cluster(
    points: Array, u: Array, weight: Array, length: float, periodic: bool, settings: MapperSettings
) -> ConeClusters:
    """Peaks of the density of readings (m, 2) along a way, at least `growth.sightings` readings each.

    u (m,) in [0, length]: places along the way (m); weight (m,): information, 1/m^2.
    """
    peaks = _peaks(u, weight, length, periodic, settings)
    member = _nearest(u, peaks, length if periodic else np.inf, settings)
    count = np.bincount(member[member >= 0], minlength=len(peaks))
    typical = float(np.median(count)) if len(count) else 0.0
    cones = ConeClusters(_means(points, weight, member, len(peaks)), peaks, count)
    return unfolded(cones.kept(count >= max(settings.growth.sightings, SELDOM * typical)), periodic)


def unfolded(cones: ConeClusters, periodic: bool) -> ConeClusters:
    """Without cones at which the way would turn back on itself at once: one cone, put down twice."""
    points = cones.points
    if len(points) < FEWEST:
        return cones
    into, out = points - np.roll(points, 1, axis=0), np.roll(points, -1, axis=0) - points
    lengths = np.hypot(*into.T), np.hypot(*out.T)
    cosine = (into * out).sum(axis=1) / np.maximum(lengths[0] * lengths[1], np.finfo(float).tiny)
    folded = (cosine < BACK) & (np.minimum(*lengths) < FOLD)
    if not periodic:
        folded[[0, -1]] = False
    return unfolded(cones.kept(~folded), periodic) if folded.any() else cones


def _peaks(u: Array, weight: Array, length: float, periodic: bool, settings: MapperSettings) -> Array:
    """(k,) maxima of the density, smoothed: a share of `growth.merge_radius` apart, at least."""
    bins = max(int(np.ceil(length / DENSITY_STEP)), 1)
    step = length / bins
    density = np.bincount(np.minimum((u / step).astype(np.intp), bins - 1).clip(0), weight, bins)
    radius = APART * settings.growth.merge_radius
    reach = round(radius / step)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) * step / (BLUR * radius)) ** 2)
    padded = (
        np.concatenate([density[-reach:], density, density[:reach]]) if periodic else np.pad(density, reach)
    )
    smooth = np.convolve(padded, kernel, "same")
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(smooth, reach), 2 * reach + 1)
    highest = (smooth > 0.0) & (smooth >= windows.max(axis=1))
    return np.asarray((np.flatnonzero(highest[reach : reach + bins]) + 0.5) * step, np.float64)


def _nearest(u: Array, peaks: Array, period: float, settings: MapperSettings) -> IntArray:
    """(m,) the peak within `growth.merge_radius` of each parameter, -1 where there is none."""
    if len(peaks) == 0:
        return np.full(len(u), -1)
    away = np.abs(u[:, None] - peaks)
    if np.isfinite(period):
        away = np.minimum(away, period - away)
    nearest = away.argmin(axis=1)
    return np.where(away[np.arange(len(u)), nearest] < settings.growth.merge_radius, nearest, -1)


def _means(points: Array, weight: Array, member: IntArray, count: int) -> Array:
    inside = member >= 0
    total = np.bincount(member[inside], weight[inside], count)
    sums = [np.bincount(member[inside], weight[inside] * points[inside, k], count) for k in range(2)]
    return np.column_stack(sums) / np.maximum(total, np.finfo(float).tiny)[:, None]
