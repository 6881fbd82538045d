"""How the curves begin and grow, through what was seen often enough and comes next (paper: Expansion)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.se2 import to_map
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.mapping.candidates import SIDES, Candidates, End, chain, undisputed
from pathspace_graph.mapping.curve_map import CurveSmoother
from pathspace_graph.mapping.path import PathAhead
from pathspace_graph.mapping.tentative import TentativeTracks
from pathspace_graph.settings.mapper import GrowthSettings
from pathspace_graph.spline.boundary import Boundary, open_boundary

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


class Growth:
    """Sightings of either boundary, and what is made of them."""

    def __init__(self, settings: GrowthSettings) -> None:
        self.settings = settings
        self.tentative = {label: TentativeTracks(settings) for label in BOUNDARIES}

    def observe(self, smoother: CurveSmoother, new: slice, t: float) -> None:
        """New readings that no curve takes are sightings."""
        detections = smoother.map.detections
        rows = np.arange(new.start, new.stop)
        rows = rows[~detections.used[rows]]
        points = to_map(detections.point[rows], smoother.variables.poses_at(detections.cycle[rows]))
        variances = np.trace(detections.covariance[rows], axis1=1, axis2=2)
        for label in BOUNDARIES:
            of = detections.label[rows] == label
            self.tentative[label].add(points[of], variances[of], t)

    def expand(self, smoother: CurveSmoother, path_ahead: PathAhead) -> frozenset[int]:
        """Begin each boundary, or lead its end on through what comes next; gives those that were led on."""
        grown = set()
        for label in BOUNDARIES:
            if label not in smoother.map.state.boundaries:
                self._begin(smoother, label, path_ahead)
            elif self._lead_on(smoother, label, path_ahead):
                grown.add(label)
        return frozenset(grown)

    def clear(self) -> None:
        """Forget all sightings."""
        for tentative in self.tentative.values():
            tentative.clear()

    def _candidates(
        self, smoother: CurveSmoother, label: int, path_ahead: PathAhead, end: End | None
    ) -> Candidates:
        """Trusted sightings within reach that follow one another, from an end on where there is one."""
        settings, indices = self.settings, self.tentative[label].confirmed()
        points = self.tentative[label].points[indices]
        if len(points) == 0:
            return Candidates(points, indices, np.zeros(0), np.zeros(0))
        stations, lateral = path_ahead.locate(points)
        found = Candidates(points, indices, stations, SIDES[label] * lateral)
        found = found.where((stations <= path_ahead.stations[-1]) & (found.sides > 0.0))
        if end is None:
            found = found.where(found.sides < settings.max_lateral)
        else:
            far = np.hypot(*(found.points - end.position).T) > settings.threshold
            found = found.where(far & (found.stations > end.station + settings.station_margin))
        if len(found.points):
            found = found.where(undisputed(smoother, label, found.points, settings.merge_radius))
        found = found.where(np.argsort(found.stations))
        return found.where(chain(found, settings, end))

    def _begin(self, smoother: CurveSmoother, label: int, path_ahead: PathAhead) -> None:
        """A new curve through the first sightings."""
        found = self._candidates(smoother, label, path_ahead, None)
        if len(found.points) < 2:
            return
        state, settings = smoother.map.state, smoother.map.settings
        u = np.append(0.0, np.cumsum(_lengths(found.points)))
        boundary = open_boundary(settings.spline, settings.gauge)
        control_points = boundary.grow(np.zeros((0, 2)), u, found.points)
        state.add_boundary(label, boundary, control_points)
        self._consume(smoother, label, found, u)
        state.pose_u[label] = np.zeros(len(state.poses))
        _stand_again(smoother, label, 0.0)

    def _lead_on(self, smoother: CurveSmoother, label: int, path_ahead: PathAhead) -> bool:
        """Extend a curve, from where its cones are in order; True where it has changed."""
        boundary, settings = smoother.map.state.boundaries[label], self.settings
        kept = in_order(boundary, path_ahead, settings)
        if kept == len(boundary.observed):
            return self._extend(smoother, label, path_ahead, settings.end_behind)
        self._take_back(smoother, label, kept)
        from_u = boundary.confirmed_end
        self._extend(smoother, label, path_ahead, settings.recall)
        _stand_again(smoother, label, from_u)
        return True

    def _extend(self, smoother: CurveSmoother, label: int, path_ahead: PathAhead, behind: float) -> bool:
        """Extend by every sighting that comes next, or carry a stranded end on; True where it grew.

        The end is beside the way since so far (m) behind the vehicle.
        """
        settings = self.settings
        end = _end(smoother, label, path_ahead.since(path_ahead.driven - behind))
        found = self._candidates(smoother, label, path_ahead, end)
        if len(found.points):
            u = lead(smoother, label, end.position, found.points)
            self._consume(smoother, label, found, u)
            return True
        if end.station < path_ahead.driven - settings.stranded:
            return _carry_on(smoother, label, path_ahead, end)
        return False

    def _take_back(self, smoother: CurveSmoother, label: int, kept: int) -> None:
        """Only the first `kept` cones hold a curve: the others are sightings that may lead it on again."""
        boundary, detections = smoother.map.state.boundaries[label], smoother.map.detections
        self.tentative[label].restore(np.array(boundary.observed[kept:]), smoother.times[-1])
        boundary.take_back(kept)
        smoother.remove_information(smoother.map.state.keys(label)[boundary.settled(boundary.size) :])
        rows = detections.used_on(label)
        detections.release(rows[detections.u[rows] > boundary.trusted])

    def _consume(self, smoother: CurveSmoother, label: int, found: Candidates, u: Array) -> None:
        """Sightings that are on the curve, at u (k,), now: their readings update it."""
        boundary, state, detections = (
            smoother.map.state.boundaries[label],
            smoother.map.state,
            smoother.map.detections,
        )
        boundary.observed.extend(found.points)
        boundary.cone_parameters.extend(u.tolist())
        self.tentative[label].remove(found.indices)
        rows = detections.pending(label)
        rows = rows[detections.label[rows] == label]
        points = to_map(detections.point[rows], state.variables.poses_at(detections.cycle[rows]))
        offset = points[:, None, :] - found.points[None]
        radius = self.settings.merge_radius
        near = np.hypot(offset[:, :, 0], offset[:, :, 1]).min(axis=1) < radius
        rows, points = rows[near], points[near]
        low = np.full(len(rows), u[0] - radius)
        high = boundary.believed(np.full(len(rows), np.inf))
        detections.take(rows, label, boundary.find(state.control_points(label), points, low, high).u)


def in_order(boundary: Boundary, path_ahead: PathAhead, settings: GrowthSettings) -> int:
    """How many of the cones that a curve was led through are in the order in which they were passed.

    What comes next is told from an arc ahead; in a hairpin a row of cones may come back nearer than it goes
    away, and only when the vehicle is past them all it is known which was which. Of the last `recall` metres
    of the curve; the first cone of them is left where it is.
    """
    first = int(np.searchsorted(boundary.cone_parameters, boundary.confirmed_end - settings.recall))
    recent = np.array(boundary.observed[first:]).reshape(-1, 2)
    if len(recent) < 3:
        return len(boundary.observed)
    station, _ = path_ahead.since(path_ahead.driven - settings.recall).locate(recent)
    passed = np.where(station <= path_ahead.driven, station, np.inf)
    later = np.minimum.accumulate(passed[::-1])[::-1]
    wrong = np.flatnonzero(passed[1:-1] > later[2:] + settings.station_margin)
    return first + 1 + int(wrong[0]) if len(wrong) else len(boundary.observed)


def lead(smoother: CurveSmoother, label: int, end: Array, points: Array) -> Array:
    """Lead a curve from its end (2,) through points (k, 2), parametrized by their distances: u (k,)."""
    boundary = smoother.map.state.boundaries[label]
    u = boundary.confirmed_end + np.cumsum(_lengths(np.concatenate([end[None], points])))
    known = smoother.map.state.control_points(label)
    control_points = boundary.grow(known.copy(), u, points)
    known[:] = control_points[: len(known)]
    if len(control_points) > len(known):
        smoother.map.state.extend(label, control_points[len(known) :])
    return np.asarray(u)


def _carry_on(smoother: CurveSmoother, label: int, path_ahead: PathAhead, end: End) -> bool:
    """The vehicle has passed a stranded end: lead it beside the way nearly as far as the vehicle is."""
    settings = smoother.map.settings.growth
    side = max(end.side, settings.min_lateral)
    station = path_ahead.driven - settings.stranded_left * settings.stranded
    point = path_ahead.beside(station, SIDES[label] * side)
    if np.hypot(*(point - end.position)) < settings.min_carry:
        return False
    lead(smoother, label, end.position, point[None])
    return True


def _stand_again(smoother: CurveSmoother, label: int, from_u: float) -> None:
    """Stations, on a curve that was led on anew from `from_u` on, of the poses that were past that."""
    state, boundary = smoother.map.state, smoother.map.state.boundaries[label]
    stations = state.pose_u[label]
    late = stations >= from_u
    poses = state.poses[late, :2]
    low, high = np.full(len(poses), from_u), np.full(len(poses), boundary.confirmed_end)
    stations[late] = boundary.find(state.control_points(label), poses, low, high).u


def _end(smoother: CurveSmoother, label: int, path_ahead: PathAhead) -> End:
    boundary = smoother.map.state.boundaries[label]
    u = np.array([boundary.confirmed_end])
    position = boundary.evaluate(smoother.map.state.control_points(label), u)
    station, lateral = path_ahead.locate(position)
    return End(position[0], float(station[0]), SIDES[label] * float(lateral[0]))


def _lengths(points: Array) -> Array:
    """Distances (k - 1,) between neighbouring points (k, 2), m."""
    return np.asarray(np.hypot(*np.diff(points, axis=0).T))
