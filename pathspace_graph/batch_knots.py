"""Knots of the batch's curves: as many, and where, as the cones that were sighted ask for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.projection import to_map

from .boundary import Boundary
from .knots import BreakSettings, FitSettings, curvature_weighted_breaks, fit_spline
from .readings import Readings
from .settings import MapperSettings, SplineSettings
from .spline import BSpline
from .state import State

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]

DENSITY_STEP = 0.1
"""Step (m) along a curve of the readings' density."""


FINE_SHARE = 0.8
"""Control points by cones of the curve whose curvature says where knots go."""
SELDOM = 0.1
"""What is seen less often than this share of the median cone is none."""
APART = 0.6
"""Least distance of two cones along a curve as a share of the radius within which sightings are merged: in a
bend the inner curve is shorter than the way from cone to cone."""
BLUR = 0.4
"""Standard deviation of the smoothing as a share of that."""
FEWEST = 4
"""Cones that are always kept."""
BACK = -0.5
"""A row of cones turns back on itself where the cosine of its turn at a cone is less than this, ..."""
FOLD = 1.5
"""... the nearer neighbour being so near (m)."""


@dataclass(frozen=True, eq=False)
class SightedCones:
    """What the readings of a boundary are heaped around, in the order of travel."""

    points: Array
    """(k, 2) weighted means, map frame, m."""
    u: Array
    """(k,) their places along the way, m."""
    member: IntArray
    """(m,) which of them each reading belongs to, -1 for none."""


def sighted_cones(state: State, readings: Readings, label: int, settings: MapperSettings) -> SightedCones:
    """What the readings in use on a curve are heaped around.

    On a closed curve they are counted from where the drive began, so that it doesn't matter where the curve's
    own parameter begins.
    """
    boundary = state.boundaries[label]
    rows = readings.used_on(label)
    rows = rows[readings.label[rows] == label]
    points = to_map(readings.point[rows], state.poses[readings.slot[rows]])
    origin = float(state.stations[label][0]) if boundary.periodic else boundary.tables.low
    u = readings.u[rows] - origin
    if boundary.periodic:
        u = np.mod(u, boundary.length)
    weight = 1.0 / np.trace(readings.covariance[rows], axis1=1, axis2=2)
    return cluster(points, u, weight, boundary.length, boundary.periodic, settings)


def scatter_of_cones(state: State, readings: Readings, settings: MapperSettings) -> float:
    """Root mean square distance (m) of the sighted cones, each the mean of its readings, from the curves."""
    offsets = [np.zeros(0)]
    for label, boundary in state.boundaries.items():
        cones = sighted_cones(state, readings, label, settings)
        origin = float(state.stations[label][0]) if boundary.periodic else boundary.tables.low
        low, high = origin + cones.u - FOLD, origin + cones.u + FOLD
        offsets.append(boundary.find(state.control_points(label), cones.points, low, high).distance)
    distance = np.concatenate(offsets)
    return float(np.sqrt(np.mean(distance**2))) if len(distance) else 0.0


def cluster(
    points: Array, u: Array, weight: Array, length: float, periodic: bool, settings: MapperSettings
) -> SightedCones:
    """Peaks of the density of readings (m, 2) along a way, at least `growth.sightings` readings each.

    u (m,) in [0, length]: places along the way (m); weight (m,): information, 1/m^2.
    """
    peaks = _peaks(u, weight, length, periodic, settings)
    member = _nearest(u, peaks, length if periodic else np.inf, settings)
    count = np.bincount(member[member >= 0], minlength=len(peaks))
    typical = float(np.median(count)) if len(count) else 0.0
    kept = count >= max(settings.growth.sightings, SELDOM * typical)
    member = np.append(np.where(kept, np.cumsum(kept) - 1, -1), -1)[member]
    means = _means(points, weight, member, int(kept.sum()))
    return _unfolded(SightedCones(means, peaks[kept], member), periodic)


def _unfolded(cones: SightedCones, periodic: bool) -> SightedCones:
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
    if not folded.any():
        return cones
    kept = ~folded
    member = np.append(np.where(kept, np.cumsum(kept) - 1, -1), -1)[cones.member]
    return _unfolded(SightedCones(points[kept], cones.u[kept], member), periodic)


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


def knot_count(cones: int, share: float, least: int) -> int:
    """Control points of a boundary along which so many cones were sighted."""
    return max(least, int(share * cones))


def replace_curve(state: State, label: int, spline: BSpline, settings: MapperSettings) -> None:
    """Another curve along nearly the same way takes a boundary's place."""
    block = state.block(label)
    spline = spline if spline.periodic else spline.unclamp()
    new = Boundary(spline.knots, spline.periodic, exact_settings(settings.spline), settings.gauge)
    new.confirmed = new.tables.high
    values = spline.distinct_control_points.ravel()
    state.vector = np.concatenate([state.vector[: block.start], values, state.vector[block.stop :]])
    state.boundaries = {**state.boundaries, label: new}


def reknot(state: State, readings: Readings, settings: MapperSettings) -> State:
    """Every curve anew, through the cones sighted along it."""
    state = replace_state(state)
    cones = {label: sighted_cones(state, readings, label, settings) for label in state.boundaries}
    share = size_share({label: len(own.points) for label, own in cones.items()}, settings)
    for label, boundary in list(state.boundaries.items()):
        points = cones[label].points
        if len(points) >= FEWEST:
            replace_curve(state, label, fit_through(points, boundary.periodic, settings, share), settings)
    return state


def size_share(cones: Mapping[int, int], settings: MapperSettings) -> float:
    """Control points by cones: the settings' own, or what keeps the budget of both boundaries together."""
    size, total = settings.batch.size, sum(cones.values())
    return settings.batch.size_share if size is None or total == 0 else size / total


def replace_state(state: State) -> State:
    """A copy whose boundaries and stations may be replaced."""
    own = State()
    own.vector, own.boundaries, own.stations = (
        state.vector.copy(),
        dict(state.boundaries),
        dict(state.stations),
    )
    return own


def fit_through(points: Array, periodic: bool, settings: MapperSettings, share: float) -> BSpline:
    """A curve through cones (k, 2) in the order of travel, of so many control points by cones.

    Its knots follow the curvature of a finer one, and a closed one's are counted from the cone nearest to the
    start, so that nearly the same cones give nearly the same knots.
    """
    if periodic:
        points = np.roll(points, -int(np.hypot(*points.T).argmin()), axis=0)
    spline = settings.spline
    size = knot_count(len(points), share, spline.min_size)
    fit = FitSettings(degree=spline.degree, rounds=1)
    fine = fit_spline(points, max(size, int(FINE_SHARE * len(points))), periodic, fit)
    count = size if periodic else size - spline.degree
    breaks = curvature_weighted_breaks(fine, count, BreakSettings(spline.linear_baseline))
    return fit_spline(points, size, periodic, fit, breaks)


def exact_settings(spline: SplineSettings) -> SplineSettings:
    """Foot points are followed as far as it takes: an optimum needs exact ones."""
    return replace(spline, refine_iterations=6, refine_room=8.0, search_iterations=8)
