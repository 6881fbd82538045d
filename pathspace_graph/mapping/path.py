"""The driven path and the path ahead, along which curves grow, and the next cones beside it."""

from dataclasses import dataclass
from typing import Final, Self

import numpy as np

from pathspace_graph.copies import shallow
from pathspace_graph.factors import _kernels as kernels
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.se2 import move_points
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.settings.mapper import ClosingSettings

STEP: Final = 0.3  # least distance of neighbouring positions of the stored path (m)
PATH_MEMORY: Final = 60.0  # length of the stored path behind the vehicle, and of the stored first stretch (m)
BEGINNING_STEP: Final = 1.0  # least distance of neighbouring poses of the stored first stretch (m)
MAX_CURVATURE: Final = 0.3  # largest curvature of the predicted path (1/m), of a tight hairpin
CURVATURE_GAIN: Final = 0.4  # weight of a cycle's measured curvature in the smoothed one
MIN_SPEED: Final = 1.0  # least speed (m/s) for a curvature from yaw rate over speed
HEADING: Final = 0.8  # largest angle between the headings of two passes of one place (rad)
SIDES: Final = {LEFT: 1.0, RIGHT: -1.0}  # sign of the distance from the path of each boundary


@dataclass(frozen=True, eq=False)
class PathAhead:
    """The driven path and an arc ahead of the vehicle as one polyline."""

    points: Array  # (n, 2) positions (x, y) in m, map frame
    stations: Array  # (n,) path length up to each position (m)
    driven: float  # station of the vehicle (m)

    def locate(self, points: Array) -> tuple[Array, Array]:
        """Return stations (m,) and signed distances (m,), left positive, of points (m, 2)."""
        return along_and_across(points, self.points, self.stations)

    def since(self, station: float) -> Self:
        """Cut off the path before the last position ahead of a station (m)."""
        first = max(int(self.stations.searchsorted(station)) - 1, 0)
        return type(self)(self.points[first:], self.stations[first:], self.driven)

    def beside(self, station: float, lateral: float) -> Array:
        """Point (2,) near a station (m), at a signed distance (m) to the left of the path."""
        i = int(np.clip(np.searchsorted(self.stations, station), 1, len(self.stations) - 1))
        direction = self.points[i] - self.points[i - 1]
        direction /= max(np.hypot(*direction), np.finfo(float).tiny)
        return np.asarray(self.points[i] + lateral * np.array([-direction[1], direction[0]]))


class DrivenPath:
    """A polyline that grows with the vehicle, and the curvature of its present turn."""

    def __init__(self) -> None:
        self.points: Array = np.zeros((0, 2))  # (n, 2) positions in m, map frame, at least `STEP` apart
        self.stations: Array = np.zeros(0)  # (n,) path length up to each of them (m)
        self.beginning: Array = np.zeros((0, 3))  # (k, 3) poses (x, y, theta) on the first stretch
        self.length = 0.0  # length of the driven path, the station of the vehicle (m)
        self.curvature = 0.0  # smoothed curvature of the present turn (1/m), left positive
        self._last: Array = np.zeros(2)

    def copy(self) -> Self:
        """Return an independent copy; arrays are only replaced."""
        return shallow(self)

    def update(self, pose: Array) -> None:
        """Extend the path to `pose` (3,), map frame."""
        position, known = pose[:2], self.beginning[-1:, :2]
        if self.length <= PATH_MEMORY and (np.hypot(*(position - known).T) >= BEGINNING_STEP).all():
            self.beginning = np.concatenate([self.beginning, pose[None]])
        if len(self.points) == 0:
            self.points, self.stations = position[None].copy(), np.zeros(1)
            self._last = position.copy()
            return
        self._take_back(pose)
        distance = float(np.hypot(*(position - self.points[-1])))
        self.length = float(self.stations[-1]) + distance
        if distance >= STEP:
            self.points = np.concatenate([self.points, position[None]])
            self.stations = np.append(self.stations, self.length)
            keep = self.stations >= self.length - PATH_MEMORY
            self.points, self.stations = self.points[keep], self.stations[keep]

    def near_beginning(self, pose: Array, settings: ClosingSettings) -> bool:
        """Whether a pose (3,) may be on the beginning again: after a lap, near it, and in its direction."""
        if self.length < settings.min_path:
            return False
        away = np.hypot(*(self.beginning[:, :2] - pose[:2]).T)
        same_direction = np.cos(self.beginning[:, 2] - pose[2]) > np.cos(HEADING)
        return bool((same_direction & (away < settings.radius_after(self.length))).any())

    def move(self, motion: Array) -> None:
        """Move the path behind the vehicle by a rigid motion (3,) of the map frame, except its beginning."""
        self.points = move_points(motion, self.points)
        self._last = move_points(motion, self._last[None])[0]

    def _take_back(self, pose: Array) -> None:
        """Shorten the path if the vehicle has reversed to `pose` (3,)."""
        heading = np.array([np.cos(pose[2]), np.sin(pose[2])])
        moved = pose[:2] - self._last
        self._last = pose[:2].copy()
        reach = float(np.hypot(*moved)) + STEP
        while moved @ heading < 0.0 and len(self.points) > 1:
            ahead = self.points[-1] - pose[:2]
            if ahead @ heading <= 0.0 or np.hypot(*ahead) > reach:
                return
            self.points, self.stations = self.points[:-1], self.stations[:-1]

    def steer(self, twists: Array) -> None:
        """Update the curvature by `w / v` of body twists (k, 3), if the vehicle is fast enough."""
        if len(twists) == 0:
            return
        speed, _, rate = (twists.sum(axis=0) / len(twists)).tolist()
        if speed > MIN_SPEED:
            now = min(max(rate / speed, -MAX_CURVATURE), MAX_CURVATURE)
            self.curvature += CURVATURE_GAIN * (now - self.curvature)

    def ahead(self, pose: Array, reach: float) -> PathAhead:
        """Continue the driven path from `pose` (3,) by an arc of `reach` metres."""
        s = np.arange(0.0, reach + STEP, STEP)
        angle = 0.5 * self.curvature * s
        chord = s * np.sinc(angle / np.pi)
        direction = np.column_stack([np.cos(pose[2] + angle), np.sin(pose[2] + angle)])
        behind = self.stations < self.length - 0.5 * STEP
        points = np.concatenate([self.points[behind], pose[:2] + chord[:, None] * direction])
        return PathAhead(points, np.concatenate([self.stations[behind], self.length + s]), self.length)


along_and_across: Final = kernels.along_and_across
"""Stations (m,) and signed distances (m,), left positive, of points (m, 2) beside a polyline."""


def crosses(begin: Array, ends: Array, line: Array) -> BoolArray:
    """Whether segments from `begin`, (2,) or (k, 2), to `ends` (k, 2) cross a polyline (n, 2)."""
    step, relative, edge = ends - begin, line - begin[..., None, :], line[1:] - line[:-1]
    beside = step[:, :1] * relative[..., 1] - step[:, 1:] * relative[..., 0]
    at_begin = edge[:, 1] * relative[..., :-1, 0] - edge[:, 0] * relative[..., :-1, 1]
    at_end = at_begin + edge[:, 0] * step[:, 1:] - edge[:, 1] * step[:, :1]
    parts = (beside[:, :-1] * beside[:, 1:] < 0.0) & (at_begin * at_end < 0.0)
    return np.asarray(parts.any(axis=1))


# --- the next cones --------------------------------------------------------------------------------------

LATERAL_CHANGE: Final = 1.5  # largest increase of the distance from the path to the next cone (m)
LATERAL_RATE: Final = 0.2  # growth of `LATERAL_CHANGE` with the distance along the path (m/m)
ROW_BESIDE: Final = 2.0  # largest distance along the path of cones beside each other (m)
LATERAL_GAP: Final = 0.8  # least difference of distances by which a cone hides another one beside it (m)
STATION_MARGIN: Final = 0.3  # least distance of the next cone past the end of a curve (m along the path)
END_BEHIND: Final = 5.0
"""Largest distance of the end of a curve behind the vehicle (m along the path); a stranded end is
extrapolated. An older stretch of the path across the infield may be nearer to the end."""
STRANDED: Final = 2.0  # distance behind the vehicle from which an end without candidates is extrapolated (m)
CARRIED_TO: Final = 1.0  # distance behind the vehicle of an end after its extrapolation (m)
MIN_LATERAL: Final = 0.5  # least distance of a boundary from the path (m)
BEGIN_LATERAL: Final = 1.5  # distance beside the vehicle at which a row without cones begins (m)
MIN_CARRY: Final = 0.5  # least length of an extrapolation (m)


@dataclass(frozen=True, eq=False)
class Candidates:
    """Points through which a boundary may be extended."""

    points: Array  # (n, 2) positions (x, y) in m, map frame
    indices: IntArray  # (n,) index of each among the tentative tracks, or among a cycle's detections
    stations: Array  # (n,) station of each along the path (m)
    sides: Array  # (n,) distance of each from the path (m), positive on the boundary's own side

    def where(self, chosen: IntArray | BoolArray) -> Self:
        """Select candidates, in the given order if by index."""
        return type(self)(
            self.points[chosen], self.indices[chosen], self.stations[chosen], self.sides[chosen]
        )


@dataclass(frozen=True, eq=False)
class End:
    """End of the confirmed part of a curve."""

    position: Array  # (2,) position (x, y) in m, map frame
    station: float  # station along the path (m)
    side: float  # distance from the path (m), positive on the boundary's own side


def chain(candidates: Candidates, end: End | None) -> IntArray:
    """Select candidates, sorted by station, that may follow one another; return their indices.

    A candidate i may follow a cone j of the row if `side_i <= side_j + LATERAL_CHANGE + LATERAL_RATE (s_i -
    s_j)`. It is compared with the end of the curve and all candidates before it. By its neighbour alone, a
    row would drift to the next lane step by step; by the end alone, it would jump there. Without a curve the
    first candidate replaces the end. Of candidates at about the same station only the nearest to the path
    remain: a second row is of another stretch of the track.
    """
    stations, sides = candidates.stations, candidates.sides
    in_front = np.flatnonzero(in_front_row(stations, sides, ROW_BESIDE, LATERAL_GAP))
    if len(in_front) == 0:
        return in_front
    out = sides[in_front] - LATERAL_RATE * stations[in_front]
    known = np.append(out[0] if end is None else end.side - LATERAL_RATE * end.station, out[:-1])
    return np.asarray(in_front[out <= np.minimum.accumulate(known) + LATERAL_CHANGE])


def in_front_row(stations: Array, sides: Array, beside: float, gap: float) -> BoolArray:
    """Whether points are in the row nearest to the path, by their stations and sides (n,), in m.

    A point is behind that row if another one within `beside` (m) along the path is nearer by more than `gap`
    (m).
    """
    near = np.abs(stations - stations[:, None]) < beside
    return np.asarray(~(near & (sides < sides[:, None] - gap)).any(axis=1))
