"""Growth of open curves through confirmed tentative tracks ahead of their ends (paper: Expansion)."""

from collections.abc import Mapping
from statistics import median
from typing import Final

import numpy as np

from pathspace_graph.copies import Copyable
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.se2 import path_lengths
from pathspace_graph.labels import BOUNDARIES, LEFT, NAMES, RIGHT, UNKNOWN
from pathspace_graph.mapping import path
from pathspace_graph.mapping.curve_map import CurveMap
from pathspace_graph.mapping.path import SIDES, Candidates, End, PathAhead, chain, crosses
from pathspace_graph.mapping.smoother import CurveSmoother
from pathspace_graph.mapping.state import State
from pathspace_graph.mapping.tracks import FORGET_AFTER, KNOWN_SIGMA, Tracks, nearest_within
from pathspace_graph.settings.mapper import GrowthSettings
from pathspace_graph.spline.boundary import Boundary, open_boundary

GROWTH_REACH: Final = 7.0  # farthest ahead of the vehicle that a boundary is extended (m along the path)
MAX_SIZE: Final = 5000  # number of control points from which on an open curve grows no further
NEWEST: Final = 3  # number of newest cones that determine, with its end, a curve's distance from the path
RECALL: Final = 25.0  # newest stretch of path and curves that counts (m): in a second round, not the first
NEARER: Final = 0.5  # least decrease of the distance at which the path passes a cone again (m)
LENGTH_FREE: Final = 50.0  # length of an open curve that is always allowed (m)
LENGTH_DRIVEN: Final = 2.0  # further length for each metre driven; zigzags between false cones exceed it


class Growth(Copyable):
    """The tentative tracks of both boundaries, and the curves that begin and grow through them."""

    def __init__(self, settings: GrowthSettings) -> None:
        self.settings = settings
        self.tentative = Tracks(settings.merge_radius, FORGET_AFTER)  # unexplained cones
        self._known: Mapping[int, float] = {}  # ends of curves that were known before the drive (m)
        self.taken_back = 0  # how often a curve was shortened
        self._full: frozenset[int] = frozenset()  # boundaries that have stopped growing
        self._turn = BOUNDARIES  # order of the boundaries: the one that was extended last is the last one
        self._beside = dict.fromkeys(BOUNDARIES, np.zeros((0, 2)))

    def observe(self, track: CurveMap, new: slice, t: float) -> None:
        """Add the new detections that no curve uses to the tentative tracks, seen at t (s)."""
        detections, variables = track.detections, track.variables
        rows = np.arange(new.start, new.stop)
        rows = rows[~detections.used[rows]]
        points = detections.points_map(rows, variables)
        covariances = detections.covariances_map(rows, variables)
        self.tentative.add(points, covariances, detections.label[rows], t)

    def expand(self, smoother: CurveSmoother, path_ahead: PathAhead) -> tuple[frozenset[int], str]:
        """Begin boundaries or extend one of them; return the labels of those extended, and a notice.

        Boundaries are extended in turn, one in a cycle, so that no cycle is slow.
        """
        full, grown, track = self._full, frozenset[int](), smoother.map
        for label in self._turn:
            begins = self._known.get(label, -np.inf) - GROWTH_REACH
            if label not in track.state.boundaries:
                self._begin(track, label, path_ahead)
            elif track.state.pose_u[label][-1] < begins or self._is_full(track, label, path_ahead):
                continue
            elif self._grow(smoother, label, path_ahead, may_extend=not grown):
                grown |= {label}
                self._turn = LEFT + RIGHT - label, label
        notices = list[str]()
        for label in sorted(self._full - full):
            boundary = track.state.boundaries[label]
            size, length = f"{boundary.size} control points", f"{boundary.confirmed_end:.3g} m"
            notices.append(f"the open {NAMES[label]} boundary grows no further, with {size} on {length}")
        return grown, "; ".join(notices)

    def wait_for(self, ends: Mapping[int, float]) -> None:
        """Let known curves grow only when the vehicle is near their ends (m), by label."""
        self._known = ends

    def _begin(self, track: CurveMap, label: int, path_ahead: PathAhead) -> None:
        """Begin a curve through the first candidates, if there are at least two."""
        found = self._candidates(track, label, path_ahead, None)
        if len(found.points) < 2:
            return
        u = path_lengths(found.points)
        boundary, state = open_boundary(track.settings.spline), track.state
        state.add_boundary(label, boundary, boundary.grow(np.zeros((0, 2)), u, found.points))
        track.place(label, 0)
        self._consume(track, label, found, u)
        state.locate(label, np.zeros(len(state.poses)))
        _relocate_poses(state, label, 0.0)

    def _grow(self, smoother: CurveSmoother, label: int, path_ahead: PathAhead, *, may_extend: bool) -> bool:
        """Extend a curve if it may; first take it back if its cones are out of order, and then extend it.

        Return whether it has changed.
        """
        track, boundary = smoother.map, smoother.map.state.boundaries[label]
        kept, self._beside[label] = check_order(boundary, path_ahead, self._beside[label])
        if kept == len(boundary.observed):
            return may_extend and self._extend(track, label, path_ahead, path.END_BEHIND)
        self._take_back(smoother, label, kept)
        from_u = boundary.confirmed_end
        self._extend(track, label, path_ahead, RECALL)
        _relocate_poses(track.state, label, from_u)
        return True

    def _extend(self, track: CurveMap, label: int, path_ahead: PathAhead, behind: float) -> bool:
        """Extend a curve through all candidates, or extrapolate a stranded end; return whether it has grown.

        The end is located on the path from `behind` (m) behind the vehicle on.
        """
        end = end_of(track.state, label, path_ahead, behind)
        found = self._candidates(track, label, path_ahead, end)
        room = self.settings.max_unseen - track.state.boundaries[label].unseen
        if len(found.points) and np.hypot(*(found.points[0] - end.position)) < room:
            u = _extend_through(track, label, end.position, found.points)
            self._consume(track, label, found, u)
            return True
        if end.station < path_ahead.driven - path.STRANDED:
            return self._follow_path(track, label, path_ahead, end, room)
        return False

    def _follow_path(self, track: CurveMap, label: int, path_ahead: PathAhead, end: End, room: float) -> bool:
        """Extrapolate a passed end, at its distance from the path; return whether the curve has grown."""
        side = max(end.side, path.MIN_LATERAL)
        point = path_ahead.beside(path_ahead.driven - path.CARRIED_TO, SIDES[label] * side)
        distance = float(np.hypot(*(point - end.position)))
        if distance > room:
            self._full |= {label}
        if not path.MIN_CARRY <= distance <= room:
            return False
        _extend_through(track, label, end.position, point[None])
        return True

    def _take_back(self, smoother: CurveSmoother, label: int, kept: int) -> None:
        """Shorten a curve to its first `kept` cones; the others become tentative tracks again."""
        state, detections = smoother.map.state, smoother.map.detections
        boundary = state.boundaries[label]
        self.tentative.restore(boundary.observed[kept:], label, self.settings.sightings, smoother.times[-1])
        boundary.take_back(kept)
        self.taken_back += 1
        first = boundary.settled(boundary.size)
        smoother.remove_information(state.control_keys(label)[first:])
        smoother.map.place(label, first)
        rows = detections.used_on(label)
        detections.release(rows[detections.u[rows] > boundary.trusted])

    def _consume(self, track: CurveMap, label: int, found: Candidates, u: Array) -> None:
        """Make candidates part of the curve at u (k,), and use the window's detections of them."""
        detections, boundary = track.detections, track.state.boundaries[label]
        boundary.add_cones(found.points, u)
        self.tentative.remove(found.indices)
        rows = detections.pending(label)
        points, radius = detections.points_map(rows, track.variables), self.settings.merge_radius
        _, near = nearest_within(points, found.points, radius)
        rows, points = rows[near], points[near]
        low = np.full(len(rows), u[0] - radius)
        high = boundary.within_trusted(np.full(len(rows), np.inf))
        detections.take(rows, label, boundary.find(track.state.control_points(label), points, low, high).u)

    # --- what it grows through ---------------------------------------------------------------------------

    def _candidates(self, track: CurveMap, label: int, path_ahead: PathAhead, end: End | None) -> Candidates:
        """Return the chain of confirmed tracks within reach, from the end of the curve if there is one."""
        settings, tracks = self.settings, self.tentative
        indices = tracks.confirmed(label, settings.sightings)
        points = tracks.points[indices]
        if len(points) == 0:
            return Candidates(points, indices, np.zeros(0), np.zeros(0))
        way = path_ahead if end is None else newest(path_ahead, end.station)
        stations, lateral = way.locate(points)
        sides = SIDES[label] * lateral
        possible = (stations <= path_ahead.stations[-1]) & (sides > 0.0)
        if end is None:
            possible &= sides < settings.max_lateral
        else:
            beyond = np.hypot(*(points - end.position).T) > settings.threshold
            possible &= beyond & (stations > end.station + path.STATION_MARGIN)
        found = Candidates(points, indices, stations, sides).where(possible)
        if len(found.points) == 0:
            return found
        found = found.where(undisputed(track, label, found.points, settings.merge_radius))
        found = found.where(np.argsort(found.stations))
        found = found.where(chain(found, end))
        # In a hairpin, the row of the way back may be known before the next cone of the way there: candidates
        # up to the first uncertain one ahead count. Uncertain ones that were passed are skipped.
        known = tracks.sigmas(found.indices) < KNOWN_SIGMA
        waiting = np.flatnonzero(~known & (found.stations > path_ahead.driven))
        found = found.where(np.flatnonzero(known[: waiting[0]] if len(waiting) else known))
        return found if end is None else found.where(_uncrossed(track.state, label, path_ahead, end, found))

    def _is_full(self, track: CurveMap, label: int, path_ahead: PathAhead) -> bool:
        boundary = track.state.boundaries[label]
        longest = self._known.get(label, 0.0) + LENGTH_FREE + LENGTH_DRIVEN * path_ahead.driven
        is_full = boundary.size >= MAX_SIZE or boundary.confirmed_end >= longest
        if is_full:
            self._full |= {label}
        return is_full


def _extend_through(track: CurveMap, label: int, end: Array, points: Array) -> Array:
    """Extend a curve from its end (2,) through points (k, 2); return their parameters (k,)."""
    state = track.state
    boundary, known = state.boundaries[label], state.control_points(label)
    u = boundary.confirmed_end + path_lengths(np.concatenate([end[None], points]))[1:]
    placement = boundary.extend(len(known), u, boundary.last_cone(boundary.confirmed_end))
    control_points = placement.place(known, points)
    known[:] = control_points[: len(known)]
    if len(control_points) > len(known):
        state.extend(label, control_points[len(known) :])
    track.place(label, placement.kept)
    return np.asarray(u)


def _relocate_poses(state: State, label: int, from_u: float) -> None:
    """Find the poses' parameters again on a curve that has changed from `from_u` on."""
    boundary, pose_u = state.boundaries[label], state.pose_u[label].copy()
    late = pose_u >= from_u
    poses = state.poses[late, :2]
    low, high = np.full(len(poses), from_u), np.full(len(poses), boundary.confirmed_end)
    pose_u[late] = boundary.find(state.control_points(label), poses, low, high).u
    state.locate(label, pose_u)


def _uncrossed(state: State, label: int, path_ahead: PathAhead, end: End, found: Candidates) -> IntArray:
    """Select candidates, by index, up to the first one that lies across a line.

    Lines are the newest stretches of the driven path and of both boundaries. Older stretches do not count,
    since a second lap of an open loop runs along the first one.
    """
    way = newest(path_ahead, end.station)
    lines = [way.points[way.stations <= way.driven]]
    for other, boundary in state.boundaries.items():
        begin = boundary.confirmed_end - RECALL
        first = int(boundary.cone_parameters.searchsorted(begin))
        lines.append(boundary.observed[first : -1 if other == label else None])
    begins = np.concatenate([end.position[None], found.points[:-1]])
    crossed = np.zeros(len(found.points), bool)
    for line in lines:
        if len(line) > 1:
            crossed |= crosses(begins, found.points, line)
    return np.flatnonzero(~np.logical_or.accumulate(crossed))


def end_of(state: State, label: int, path_ahead: PathAhead, behind: float) -> End:
    """Return the confirmed end of a curve, located on the path from `behind` (m) behind the vehicle on.

    Its distance from the path is the median over end and newest cones, which is robust to one wrong cone.
    """
    boundary = state.boundaries[label]
    u = np.array([boundary.confirmed_end])
    position = boundary.evaluate(state.control_points(label), u)
    station, lateral = path_ahead.since(path_ahead.driven - behind).locate(position)
    side = SIDES[label] * float(lateral[0])
    if len(boundary.observed) >= NEWEST:
        _, beside = path_ahead.locate(boundary.observed[-NEWEST:])
        side = median([*(SIDES[label] * beside).tolist(), side])
    return End(position[0], float(station[0]), side)


def undisputed(track: CurveMap, label: int, points: Array, radius: float) -> BoolArray:
    """Whether places (n, 2) have at least as many detections of `label` within `radius` (m) as others.

    A sensor that sometimes confuses colours detects the true one more often. All coloured detections of the
    window count, used or not.
    """
    detections = track.detections
    rows = np.flatnonzero(detections.label != UNKNOWN)
    offset = points[:, None] - detections.points_map(rows, track.variables)
    near = offset[:, :, 0] ** 2 + offset[:, :, 1] ** 2 < radius**2
    votes = near @ np.where(detections.label[rows] == label, 1, -1)
    return np.asarray(votes >= 0)


def check_order(boundary: Boundary, path_ahead: PathAhead, known: Array) -> tuple[int, Array]:
    """Count the cones of a curve, from its first on, that are in the order in which they were passed.

    The order of cones ahead is predicted with an arc. In a hairpin, the row of the way back may be nearer
    than the row of the way there, so the order is certain only after they were passed. The last `RECALL`
    metres of the curve are checked; their first cone counts as in order. `known` (n, 2) are station and
    distance beside the path of the first n cones in the last cycle, and the second result (m, 2) the new
    ones.
    """
    first = int(boundary.cone_parameters.searchsorted(boundary.confirmed_end - RECALL))
    beside = np.full((len(boundary.observed), 2), np.nan)  # nothing is known of others
    beside[: len(known)] = known[: len(beside)]
    now = np.stack(newest(path_ahead).locate(boundary.observed[first:]), axis=1)
    before, passed = beside[first:], beside[first:, 0] <= path_ahead.driven
    stays = passed & (np.abs(now[:, 1]) > np.abs(before[:, 1]) - NEARER)
    now[stays] = before[stays]
    beside[first:] = now
    at = np.where(now[:, 0] <= path_ahead.driven, now[:, 0], np.inf)
    later = np.minimum.accumulate(at[::-1])[::-1]
    wrong = np.flatnonzero(at[1:-1] > later[2:] + path.STATION_MARGIN)
    kept = first + 1 + int(wrong[0]) if len(wrong) else len(beside)
    return kept, beside[:kept]


def newest(path_ahead: PathAhead, station: float = np.inf) -> PathAhead:
    """Cut earlier rounds off the path: it begins `RECALL` before the vehicle, or before a station (m)."""
    return path_ahead.since(min(station, path_ahead.driven) - RECALL)
