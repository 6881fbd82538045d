"""How the curves begin and grow, through what was seen often enough and comes next (paper: Expansion)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.projection import to_map

from .boundary import open_boundary
from .labels import BOUNDARIES, LEFT, RIGHT, UNKNOWN
from .path import Way
from .settings import GrowthSettings
from .sightings import Sightings
from .smoother import Smoother

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]

SIDES = {LEFT: 1.0, RIGHT: -1.0}
"""Sign of the signed distance from the path on which each boundary lies."""


@dataclass(frozen=True, eq=False)
class Candidates:
    """Sightings that a boundary may be led through, in the order of the way."""

    points: Array
    """(n, 2) map frame, m."""
    indices: IntArray
    """(n,) their indices among the sightings."""
    stations: Array
    """(n,) path length to each, m."""
    sides: Array
    """(n,) distance from the path to the boundary's own side, m."""

    def where(self, chosen: IntArray | NDArray[np.bool_]) -> Candidates:
        """Some of them."""
        return Candidates(
            self.points[chosen], self.indices[chosen], self.stations[chosen], self.sides[chosen]
        )


@dataclass(frozen=True, eq=False)
class End:
    """The end of a curve, as far as sightings hold it."""

    position: Array
    """(2,) map frame, m."""
    station: float
    """Path length to it, m."""
    side: float
    """Its distance from the path to the boundary's own side, m."""


class Growth:
    """Sightings of either boundary, and what is made of them."""

    def __init__(self, settings: GrowthSettings) -> None:
        self.settings = settings
        self.sightings = {label: Sightings(settings) for label in BOUNDARIES}

    def sight(self, smoother: Smoother, new: slice, t: float) -> None:
        """New readings that no curve takes are sightings."""
        readings = smoother.readings
        rows = np.arange(new.start, new.stop)
        rows = rows[~readings.used[rows]]
        points = to_map(readings.point[rows], smoother.state.poses[readings.slot[rows]])
        variances = np.trace(readings.covariance[rows], axis1=1, axis2=2)
        for label in BOUNDARIES:
            of = readings.label[rows] == label
            self.sightings[label].add(points[of], variances[of], t)

    def expand(self, smoother: Smoother, way: Way) -> frozenset[int]:
        """Begin each boundary, or lead its end on through what comes next; gives those that were led on."""
        grown = set()
        for label in BOUNDARIES:
            if label not in smoother.state.boundaries:
                self._begin(smoother, label, way)
            elif self._extend(smoother, label, way):
                grown.add(label)
        return frozenset(grown)

    def clear(self) -> None:
        """Forget all sightings."""
        for sightings in self.sightings.values():
            sightings.clear()

    def _candidates(self, smoother: Smoother, label: int, way: Way, end: End | None) -> Candidates:
        """Trusted sightings within reach that follow one another, from an end on where there is one."""
        settings, indices = self.settings, self.sightings[label].confirmed()
        points = self.sightings[label].points[indices]
        if len(points) == 0:
            return Candidates(points, indices, np.zeros(0), np.zeros(0))
        stations, lateral = way.locate(points)
        found = Candidates(points, indices, stations, SIDES[label] * lateral)
        found = found.where((stations <= way.stations[-1]) & (found.sides > 0.0))
        if end is None:
            found = found.where(found.sides < settings.max_lateral)
        else:
            far = np.hypot(*(found.points - end.position).T) > settings.threshold
            found = found.where(far & (found.stations > end.station + settings.station_margin))
        if len(found.points):
            found = found.where(undisputed(smoother, label, found.points, settings.merge_radius))
        found = found.where(np.argsort(found.stations))
        return found.where(chain(found, settings, end))

    def _begin(self, smoother: Smoother, label: int, way: Way) -> None:
        """A new curve through the first sightings."""
        found = self._candidates(smoother, label, way, None)
        if len(found.points) < 2:
            return
        state, settings = smoother.state, smoother.settings
        u = np.append(0.0, np.cumsum(_lengths(found.points)))
        boundary = open_boundary(settings.spline, settings.gauge)
        control_points = boundary.grow(np.zeros((0, 2)), u, found.points)
        state.add_boundary(label, boundary)
        smoother.insert_control_points(label, 0, control_points)
        self._consume(smoother, label, found, 0.0)
        poses = state.poses[:, :2]
        low, high = np.zeros(len(poses)), np.full(len(poses), boundary.confirmed)
        state.stations[label] = boundary.find(state.control_points(label), poses, low, high).u

    def _extend(self, smoother: Smoother, label: int, way: Way) -> bool:
        """Extend by every sighting that comes next, or carry a stranded end on; True where it grew."""
        settings = self.settings
        end = _end(smoother, label, way)
        found = self._candidates(smoother, label, way, end)
        if len(found.points):
            known = smoother.state.boundaries[label].confirmed
            lead(smoother, label, end.position, found.points)
            self._consume(smoother, label, found, known)
            return True
        if end.station < way.driven - settings.stranded:
            return _carry_on(smoother, label, way, end)
        return False

    def _consume(self, smoother: Smoother, label: int, found: Candidates, from_u: float) -> None:
        """Sightings that are on the curve from `from_u` on now: their readings update it."""
        boundary, state, readings = smoother.state.boundaries[label], smoother.state, smoother.readings
        boundary.sighted.extend(found.points)
        self.sightings[label].remove(found.indices)
        rows = readings.pending(label)
        rows = rows[readings.label[rows] == label]
        points = to_map(readings.point[rows], state.poses[readings.slot[rows]])
        offset = points[:, None, :] - found.points[None]
        radius = self.settings.merge_radius
        near = np.hypot(offset[:, :, 0], offset[:, :, 1]).min(axis=1) < radius
        rows, points = rows[near], points[near]
        low = np.full(len(rows), from_u - radius)
        high = boundary.believed(np.full(len(rows), np.inf))
        readings.used[rows] = True
        readings.u[rows] = boundary.find(state.control_points(label), points, low, high).u


def undisputed(smoother: Smoother, label: int, points: Array, radius: float) -> NDArray[np.bool_]:
    """Which places (n, 2) have no more readings of the other boundary's label around them than of their own.

    A sensor that takes a cone for one of the other boundary now and then sees it in its true colour oftener.
    Readings in the window count, in use or not, within `radius` (m).
    """
    readings = smoother.readings
    rows = np.flatnonzero(readings.label != UNKNOWN)
    seen = to_map(readings.point[rows], smoother.state.poses[readings.slot[rows]])
    offset = points[:, None] - seen
    near = offset[:, :, 0] ** 2 + offset[:, :, 1] ** 2 < radius**2
    votes = near @ np.where(readings.label[rows] == label, 1, -1)
    return np.asarray(votes >= 0)


def chain(found: Candidates, settings: GrowthSettings, end: End | None) -> IntArray:
    """Indices of those that follow one another: each not much farther from the path than the last.

    `side_i <= side_last + lateral_change + lateral_rate (s_i - s_last)`, from the end of the curve on where
    there is one; and of those at about the same station the one nearest to the path: what is behind another
    row belongs to another stretch of the track.
    """
    chosen: list[int] = []
    last = None if end is None else (end.station, end.side)
    for i, (station, side) in enumerate(zip(found.stations, found.sides, strict=True)):
        beside = np.abs(found.stations - station) < settings.beside
        if (found.sides[beside] < side - settings.lateral_gap).any():
            continue
        if last is not None:
            room = settings.lateral_change + settings.lateral_rate * (station - last[0])
            if side > last[1] + room:
                continue
        chosen.append(i)
        last = (station, side)
    return np.array(chosen, dtype=np.intp)


def lead(smoother: Smoother, label: int, end: Array, points: Array) -> None:
    """Lead a curve from its end (2,) through points (k, 2), parametrized by their distances."""
    boundary = smoother.state.boundaries[label]
    u = boundary.confirmed + np.cumsum(_lengths(np.concatenate([end[None], points])))
    known = smoother.state.control_points(label)
    control_points = boundary.grow(known.copy(), u, points)
    known[:] = control_points[: len(known)]
    if len(control_points) > len(known):
        smoother.insert_control_points(label, len(known), control_points[len(known) :])


def _carry_on(smoother: Smoother, label: int, way: Way, end: End) -> bool:
    """The vehicle has passed a stranded end: lead it beside the way nearly as far as the vehicle is."""
    settings = smoother.settings.growth
    side = max(end.side, settings.min_lateral)
    station = way.driven - settings.stranded_left * settings.stranded
    point = way.beside(station, SIDES[label] * side)
    if np.hypot(*(point - end.position)) < settings.min_carry:
        return False
    lead(smoother, label, end.position, point[None])
    return True


def _end(smoother: Smoother, label: int, way: Way) -> End:
    boundary = smoother.state.boundaries[label]
    u = np.array([boundary.confirmed])
    position = boundary.evaluate(smoother.state.control_points(label), u)
    station, lateral = way.since(way.driven - smoother.settings.growth.end_behind).locate(position)
    return End(position[0], float(station[0]), SIDES[label] * float(lateral[0]))


def _lengths(points: Array) -> Array:
    """Distances (k - 1,) between neighbouring points (k, 2), m."""
    return np.asarray(np.hypot(*np.diff(points, axis=0).T))
