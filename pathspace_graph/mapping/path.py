"""The way driven, and the way ahead as the current turn predicts it: growth goes along it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.settings.mapper import PathSettings

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PathAhead:
    """The path driven and an arc ahead of the vehicle, as one polyline."""

    points: Array
    """(n, 2) positions, map frame, m."""
    stations: Array
    """(n,) path length to each, m."""
    driven: float
    """Station of the vehicle, m."""

    def locate(self, points: Array) -> tuple[Array, Array]:
        """Stations (m,) and signed distances (m,), left positive, of points (m, 2)."""
        return along_and_across(points, self.points, self.stations)

    def since(self, station: float) -> PathAhead:
        """What of it comes after a station (m), from the last position before that on."""
        first = max(int(self.stations.searchsorted(station)) - 1, 0)
        return PathAhead(self.points[first:], self.stations[first:], self.driven)

    def beside(self, station: float, lateral: float) -> Array:
        """(2,) the point at about a station, so far to the left of the way."""
        i = int(np.clip(np.searchsorted(self.stations, station), 1, len(self.stations) - 1))
        direction = self.points[i] - self.points[i - 1]
        direction /= max(np.hypot(*direction), np.finfo(float).tiny)
        return np.asarray(self.points[i] + lateral * np.array([-direction[1], direction[0]]))


class DrivenPath:
    """Positions driven, a least step apart, with their stations (path length, m); and the present turn."""

    def __init__(self, settings: PathSettings | None = None) -> None:
        self.settings = settings or PathSettings()
        self.points: Array = np.zeros((0, 2))
        """(n, 2) positions kept, map frame, m."""
        self.stations: Array = np.zeros(0)
        """(n,) theirs, m."""
        self.beginning: Array = np.zeros((0, 3))
        """Poses on the first stretch, as long as the memory."""
        self.length = 0.0
        """Path driven so far, the station of the last position, m."""
        self.curvature = 0.0
        """Smoothed curvature of the path now, left positive, 1/m."""
        self._last: Array = np.zeros(2)

    def update(self, pose: Array) -> None:
        """Drive on to `pose` (3,), map frame."""
        self._keep_beginning(pose)
        position = pose[:2]
        if len(self.points) == 0:
            self.points, self.stations = position[None].copy(), np.zeros(1)
            self._last = position.copy()
            return
        self._take_back(pose)
        distance = float(np.hypot(*(position - self.points[-1])))
        self.length = float(self.stations[-1]) + distance
        if distance >= self.settings.step:
            self.points = np.concatenate([self.points, position[None]])
            self.stations = np.append(self.stations, self.length)
            keep = self.stations >= self.length - self.settings.memory
            self.points, self.stations = self.points[keep], self.stations[keep]

    def _take_back(self, pose: Array) -> None:
        """Driving backwards to `pose` (3,) undoes the path that was driven since the vehicle was there."""
        heading = np.array([np.cos(pose[2]), np.sin(pose[2])])
        moved = pose[:2] - self._last
        self._last = pose[:2].copy()
        reach = float(np.hypot(*moved)) + self.settings.step
        while moved @ heading < 0.0 and len(self.points) > 1:
            ahead = self.points[-1] - pose[:2]
            if ahead @ heading <= 0.0 or np.hypot(*ahead) > reach:
                return
            self.points, self.stations = self.points[:-1], self.stations[:-1]

    def _keep_beginning(self, pose: Array) -> None:
        if self.length > self.settings.memory:
            return
        first = len(self.beginning) == 0
        if first or np.hypot(*(pose[:2] - self.beginning[-1, :2])) >= self.settings.beginning_step:
            self.beginning = np.concatenate([self.beginning, pose[None]])

    def steer(self, twists: Array) -> None:
        """Follow the curvature `w / v` of body twists (k, 3), where they are fast enough to tell."""
        if len(twists) == 0:
            return
        speed, _, rate = twists.mean(axis=0)
        if speed > self.settings.min_speed:
            limit = self.settings.max_curvature
            now = float(np.clip(rate / speed, -limit, limit))
            self.curvature += self.settings.curvature_gain * (now - self.curvature)

    def ahead(self, pose: Array, reach: float) -> PathAhead:
        """The path driven, and an arc of the current curvature for `reach` metres ahead of `pose` (3,)."""
        step = self.settings.step
        s = np.arange(0.0, reach + step, step)
        angle = 0.5 * self.curvature * s
        chord = s * np.sinc(angle / np.pi)
        direction = np.column_stack([np.cos(pose[2] + angle), np.sin(pose[2] + angle)])
        behind = self.stations < self.length - 0.5 * step
        points = np.concatenate([self.points[behind], pose[:2] + chord[:, None] * direction])
        return PathAhead(points, np.concatenate([self.stations[behind], self.length + s]), self.length)


def along_and_across(points: Array, path: Array, stations: Array) -> tuple[Array, Array]:
    """Station (m,) and signed distance (m,), left positive, of points (m, 2) from a polyline (n, 2), n >= 2.

    Past the last position the station runs on along the last segment.
    """
    (x, y), (ex, ey) = path[:-1].T, np.diff(path, axis=0).T
    length2 = np.maximum(ex**2 + ey**2, np.finfo(float).tiny)
    dx, dy = points[:, :1] - x, points[:, 1:] - y
    share = np.clip((dx * ex + dy * ey) / length2, 0.0, 1.0)
    distance2 = (dx - share * ex) ** 2 + (dy - share * ey) ** 2
    best = distance2.argmin(axis=1)
    rows = np.arange(len(points))
    ex, ey, dx, dy = ex[best], ey[best], dx[rows, best], dy[rows, best]
    overshoot = np.where(best == len(length2) - 1, (dx * ex + dy * ey) / length2[best] - 1.0, 0.0)
    at = np.where(overshoot > 0.0, 1.0 + overshoot, share[rows, best])
    side = ex * dy - ey * dx
    across = np.sign(side) * np.sqrt(distance2[rows, best])
    lateral = np.where(overshoot > 0.0, side / np.sqrt(length2[best]), across)
    return stations[best] + at * (stations[best + 1] - stations[best]), lateral
