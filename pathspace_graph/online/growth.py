"""Growth of the open curves through confirmed tentative tracks ahead of their ends (paper: Expansion)."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.se2 import rotated, to_map
from pathspace_graph.labels import BOUNDARIES, NAMES, UNKNOWN
from pathspace_graph.mapping.candidates import SIDES, Candidates, End, chain
from pathspace_graph.mapping.curve_map import CurveSmoother
from pathspace_graph.mapping.path import PathAhead
from pathspace_graph.mapping.tentative import TentativeTracks
from pathspace_graph.settings.growth import GrowthSettings
from pathspace_graph.spline.boundary import Boundary, open_boundary

from .corridor import crosses

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


AROUND: Final = 2.0
"""The path around a hairpin is at most this number of times as long as the curve inside."""
NEWEST: Final = 3
"""This number of newest cones and the end of a curve say how far it runs beside the path."""


class Growth:
    """Holds the tentative tracks of both boundaries, and begins and extends the curves through them."""

    def __init__(self, settings: GrowthSettings) -> None:
        self.settings = settings
        self.tentative = {label: TentativeTracks(settings) for label in BOUNDARIES}
        """Detections that no curve explains are collected here, by label."""
        self.notice = ""
        """This says in the cycle in which a boundary stops growing that it does."""
        self._full: set[int] = set()

    def observe(self, smoother: CurveSmoother, new: slice, t: float) -> None:
        """Adds the new detections that no curve uses to the tentative tracks, seen at t (s)."""
        detections = smoother.map.detections
        rows = np.arange(new.start, new.stop)
        rows = rows[~detections.used[rows]]
        poses = smoother.variables.poses_at(detections.cycle[rows])
        points = to_map(detections.point[rows], poses)
        covariances = rotated(detections.covariance[rows], poses[:, 2])
        for label in BOUNDARIES:
            own = detections.label[rows] == label
            self.tentative[label].add(points[own], covariances[own], t)

    def expand(self, smoother: CurveSmoother, path_ahead: PathAhead) -> frozenset[int]:
        """Begins or extends each boundary; returns the labels of the curves that were extended."""
        self.notice, grown = "", set()
        for label in BOUNDARIES:
            if label not in smoother.map.state.boundaries:
                self._begin(smoother, label, path_ahead)
            elif not self._is_full(smoother, label, path_ahead) and self._grow(smoother, label, path_ahead):
                grown.add(label)
        return frozenset(grown)

    def _is_full(self, smoother: CurveSmoother, label: int, path_ahead: PathAhead) -> bool:
        """Returns whether an open curve grows no further, since it is longer than it can be."""
        boundary, settings = smoother.map.state.boundaries[label], self.settings
        longest = settings.length_free + settings.length_driven * path_ahead.driven
        if boundary.size < settings.max_size and boundary.confirmed_end < longest:
            return False
        self._say_full(boundary, label)
        return True

    def _say_full(self, boundary: Boundary, label: int) -> None:
        """Notes once that an open curve grows no further."""
        if label not in self._full:
            self._full.add(label)
            size = f"{boundary.size} control points on {boundary.confirmed_end:.0f} m"
            notice = f"the open {NAMES[label]} boundary grows no further, with {size}"
            self.notice = f"{self.notice}; {notice}" if self.notice else notice

    def move(self, motion: Array) -> None:
        """Moves all tentative tracks by a rigid motion (3,) of the map frame."""
        for tentative in self.tentative.values():
            tentative.move(motion)

    def clear(self) -> None:
        """Removes all tentative tracks."""
        self.notice = ""
        for tentative in self.tentative.values():
            tentative.clear()

    def _candidates(
        self, smoother: CurveSmoother, label: int, path_ahead: PathAhead, end: End | None
    ) -> Candidates:
        """Returns the chain of confirmed tracks within reach, from the end of the curve if there is one."""
        settings, tracks = self.settings, self.tentative[label]
        indices = tracks.confirmed()
        points = tracks.points[indices]
        if len(points) == 0:
            return Candidates(points, indices, np.zeros(0), np.zeros(0))
        stations, lateral = path_ahead.locate(points)
        found = Candidates(points, indices, stations, SIDES[label] * lateral)
        found = found.where((stations <= path_ahead.stations[-1]) & (found.sides > 0.0))
        if end is None:
            found = found.where(found.sides < settings.max_lateral)
        else:
            beyond = np.hypot(*(found.points - end.position).T) > settings.threshold
            found = found.where(beyond & (found.stations > end.station + settings.station_margin))
        if len(found.points):
            found = found.where(undisputed(smoother, label, found.points, settings.merge_radius))
        found = found.where(np.argsort(found.stations))
        found = found.where(chain(found, settings, end))
        found = found.where(self._certain(label, path_ahead, found))
        return found if end is None else found.where(self._uncrossed(smoother, label, path_ahead, end, found))

    def _certain(self, label: int, path_ahead: PathAhead, found: Candidates) -> IntArray:
        """Returns the candidates, by index, up to the first one ahead that is not known well enough.

        It waits until it was seen near, and so do all behind it: in a hairpin, the row of the way back may be
        known before the next cone of the way there. One that was passed is left out.
        """
        known = self.tentative[label].sigmas(found.indices) < self.settings.sigma
        waiting = np.flatnonzero(~known & (found.stations > path_ahead.driven))
        last = int(waiting[0]) if len(waiting) else len(known)
        return np.flatnonzero(known[:last])

    def _uncrossed(
        self, smoother: CurveSmoother, label: int, path_ahead: PathAhead, end: End, found: Candidates
    ) -> IntArray:
        """Returns the candidates, by index, up to the first that is reached only across a line.

        No boundary crosses the path driven, the other boundary or itself, on their newest stretches: in a
        second lap of an open loop it runs along its own first one.
        """
        driven = path_ahead.stations <= path_ahead.driven
        lines = [path_ahead.points[driven]]
        for own, boundary in smoother.map.state.boundaries.items():
            begin = boundary.confirmed_end - self.settings.recall
            first = int(np.searchsorted(boundary.cone_parameters, begin))
            lines.append(np.array(boundary.observed[first : -1 if own == label else None]))
        before = end.position
        for k, point in enumerate(found.points):
            if any(len(line) > 1 and crosses(before, point[None], line)[0] for line in lines):
                return np.arange(k)
            before = point
        return np.arange(len(found.points))

    def _begin(self, smoother: CurveSmoother, label: int, path_ahead: PathAhead) -> None:
        """Begins a curve through the first candidates, if there are at least two."""
        found = self._candidates(smoother, label, path_ahead, None)
        if len(found.points) < 2:
            return
        state, settings = smoother.map.state, smoother.map.settings
        u = np.append(0.0, np.cumsum(_distances(found.points)))
        boundary = open_boundary(settings.spline, settings.gauge)
        control_points = boundary.grow(np.zeros((0, 2)), u, found.points)
        state.add_boundary(label, boundary, control_points)
        self._consume(smoother, label, found, u)
        state.pose_u[label] = np.zeros(len(state.poses))
        _relocate_poses(smoother, label, 0.0)

    def _grow(self, smoother: CurveSmoother, label: int, path_ahead: PathAhead) -> bool:
        """Extends a curve, after it is taken back if its cones are out of order; True if it has changed."""
        boundary, settings = smoother.map.state.boundaries[label], self.settings
        kept = count_in_order(boundary, path_ahead, settings)
        if kept == len(boundary.observed):
            return self._extend(smoother, label, path_ahead, settings.end_behind)
        self._take_back(smoother, label, kept)
        from_u = boundary.confirmed_end
        self._extend(smoother, label, path_ahead, settings.recall)
        _relocate_poses(smoother, label, from_u)
        return True

    def _extend(self, smoother: CurveSmoother, label: int, path_ahead: PathAhead, behind: float) -> bool:
        """Extends a curve through all candidates, or extrapolates a stranded end; True if it has grown.

        The end's station is searched on the path from `behind` (m) behind the vehicle on.
        """
        settings = self.settings
        end = _end(smoother, label, path_ahead, behind)
        found = self._candidates(smoother, label, path_ahead, end)
        room = settings.max_unseen - smoother.map.state.boundaries[label].unseen
        if len(found.points) and np.hypot(*(found.points[0] - end.position)) < room:
            u = _extend_through(smoother, label, end.position, found.points)
            self._consume(smoother, label, found, u)
            return True
        if end.station < path_ahead.driven - settings.stranded:
            return self._follow_path(smoother, label, path_ahead, end, room)
        return False

    def _follow_path(
        self, smoother: CurveSmoother, label: int, path_ahead: PathAhead, end: End, room: float
    ) -> bool:
        """Extrapolates an end that the vehicle has passed: the curve follows the path at the end's distance.

        It does not where that is farther than `room` (m). Returns whether the curve has grown.
        """
        settings = self.settings
        side = max(end.side, settings.min_lateral)
        station = path_ahead.driven - settings.stranded_left * settings.stranded
        point = path_ahead.beside(station, SIDES[label] * side)
        distance = float(np.hypot(*(point - end.position)))
        if distance > room:
            self._say_full(smoother.map.state.boundaries[label], label)
        if not settings.min_carry <= distance <= room:
            return False
        _extend_through(smoother, label, end.position, point[None])
        return True

    def _take_back(self, smoother: CurveSmoother, label: int, kept: int) -> None:
        """Shortens a curve to its first `kept` cones; the other cones are tentative tracks again."""
        boundary, detections = smoother.map.state.boundaries[label], smoother.map.detections
        self.tentative[label].restore(np.array(boundary.observed[kept:]), smoother.times[-1])
        boundary.take_back(kept)
        smoother.remove_information(smoother.map.state.keys(label)[boundary.settled(boundary.size) :])
        rows = detections.used_on(label)
        detections.release(rows[detections.u[rows] > boundary.trusted])

    def _consume(self, smoother: CurveSmoother, label: int, found: Candidates, u: Array) -> None:
        """Makes candidates part of the curve at u (k,), and puts the window's detections of them into use."""
        state, detections = smoother.map.state, smoother.map.detections
        boundary = state.boundaries[label]
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


def undisputed(smoother: CurveSmoother, label: int, points: Array, radius: float) -> NDArray[np.bool_]:
    """Returns whether places (n, 2) have at least as many detections of `label` around them as of the other.

    A sensor that now and then takes a cone for one of the other boundary sees its true colour more often. All
    coloured detections of the window within `radius` (m) count, in use or not.
    """
    detections = smoother.map.detections
    rows = np.flatnonzero(detections.label != UNKNOWN)
    seen = to_map(detections.point[rows], smoother.variables.poses_at(detections.cycle[rows]))
    offset = points[:, None] - seen
    near = offset[:, :, 0] ** 2 + offset[:, :, 1] ** 2 < radius**2
    votes = near @ np.where(detections.label[rows] == label, 1, -1)
    return np.asarray(votes >= 0)


def count_in_order(boundary: Boundary, path_ahead: PathAhead, settings: GrowthSettings) -> int:
    """Returns how many of a curve's cones, from its first on, are in the order in which they were passed.

    The order of cones ahead is predicted with an arc. In a hairpin, the row of the way back may be nearer
    than the row of the way there, and only after the vehicle has passed the cones is their order certain.
    Only the last `recall` metres of the curve are checked, and the first cone there counts as in order.
    """
    first = int(np.searchsorted(boundary.cone_parameters, boundary.confirmed_end - settings.recall))
    recent = np.array(boundary.observed[first:]).reshape(-1, 2)
    if len(recent) < 3:
        return len(boundary.observed)
    path = path_ahead.since(path_ahead.driven - AROUND * settings.recall)
    station, _ = path.locate(recent)
    passed = np.where(station <= path_ahead.driven, station, np.inf)
    later = np.minimum.accumulate(passed[::-1])[::-1]
    wrong = np.flatnonzero(passed[1:-1] > later[2:] + settings.station_margin)
    return first + 1 + int(wrong[0]) if len(wrong) else len(boundary.observed)


def _extend_through(smoother: CurveSmoother, label: int, end: Array, points: Array) -> Array:
    """Extends a curve from its end (2,) through points (k, 2); returns their parameters (k,).

    The parameters increase by the distances between the points.
    """
    boundary = smoother.map.state.boundaries[label]
    u = boundary.confirmed_end + np.cumsum(_distances(np.concatenate([end[None], points])))
    known = smoother.map.state.control_points(label)
    control_points = boundary.grow(known.copy(), u, points)
    known[:] = control_points[: len(known)]
    if len(control_points) > len(known):
        smoother.map.state.extend(label, control_points[len(known) :])
    return np.asarray(u)


def _relocate_poses(smoother: CurveSmoother, label: int, from_u: float) -> None:
    """Finds the poses' parameters again on a curve that was changed from `from_u` on."""
    state, boundary = smoother.map.state, smoother.map.state.boundaries[label]
    pose_u = state.pose_u[label]
    late = pose_u >= from_u
    poses = state.poses[late, :2]
    low, high = np.full(len(poses), from_u), np.full(len(poses), boundary.confirmed_end)
    pose_u[late] = boundary.find(state.control_points(label), poses, low, high).u


def _end(smoother: CurveSmoother, label: int, path_ahead: PathAhead, behind: float) -> End:
    """Returns the confirmed end of a curve, located on the path from `behind` (m) behind the vehicle on.

    Its distance from the path is the median of the newest cones', so that one wrong cone leads no further.
    """
    boundary = smoother.map.state.boundaries[label]
    u = np.array([boundary.confirmed_end])
    position = boundary.evaluate(smoother.map.state.control_points(label), u)
    station, lateral = path_ahead.since(path_ahead.driven - behind).locate(position)
    side = SIDES[label] * float(lateral[0])
    if len(boundary.observed) >= NEWEST:
        _, beside = path_ahead.locate(np.array(boundary.observed[-NEWEST:]))
        side = float(np.median(np.append(SIDES[label] * beside, side)))
    return End(position[0], float(station[0]), side)


def _distances(points: Array) -> Array:
    """Returns the distances (k - 1,) between neighbouring points (k, 2), in m."""
    return np.asarray(np.hypot(*np.diff(points, axis=0).T))
