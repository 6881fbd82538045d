"""The driven path, and the path ahead as the current turn predicts it: curves grow along both."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.se2 import move_points
from pathspace_graph.settings.mapper import PathSettings

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PathAhead:
    """Holds the driven path and an arc ahead of the vehicle as one polyline."""

    points: Array
    """(n, 2) Each row holds a position (x, y) in m, map frame."""
    stations: Array
    """(n,) Each position has this station: the path length up to it (m)."""
    driven: float
    """The vehicle is at this station (m)."""

    def locate(self, points: Array) -> tuple[Array, Array]:
        """Returns the stations (m,) and the signed distances (m,), left positive, of points (m, 2)."""
        return along_and_across(points, self.points, self.stations)

    def since(self, station: float) -> PathAhead:
        """Returns the path from the last position before a station (m) on."""
        first = max(int(self.stations.searchsorted(station)) - 1, 0)
        return PathAhead(self.points[first:], self.stations[first:], self.driven)

    def beside(self, station: float, lateral: float) -> Array:
        """Returns the point (2,) near a station (m), at a signed distance (m) to the left of the path."""
        i = int(np.clip(np.searchsorted(self.stations, station), 1, len(self.stations) - 1))
        direction = self.points[i] - self.points[i - 1]
        direction /= max(np.hypot(*direction), np.finfo(float).tiny)
        return np.asarray(self.points[i] + lateral * np.array([-direction[1], direction[0]]))


class DrivenPath:
    """The driven path is a polyline that grows with the vehicle; it also tracks the present curvature."""

    def __init__(self, settings: PathSettings | None = None) -> None:
        self.settings = settings or PathSettings()
        self.points: Array = np.zeros((0, 2))
        """(n, 2) Each row holds a kept position (x, y) in m, map frame; they are at least a step apart."""
        self.stations: Array = np.zeros(0)
        """(n,) Each kept position has this station: the path length up to it (m)."""
        self.beginning: Array = np.zeros((0, 3))
        """(k, 3) These are poses (x, y, theta) on the first stretch, which is as long as the memory."""
        self.length = 0.0
        """The vehicle is at this station: the length of the driven path (m)."""
        self.curvature = 0.0
        """This is the smoothed curvature of the present turn (1/m), left positive."""
        self._last: Array = np.zeros(2)

    def update(self, pose: Array) -> None:
        """Extends the path to `pose` (3,), map frame."""
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

    def move(self, motion: Array) -> None:
        """Moves the path behind the vehicle by a rigid motion (3,) of the map frame; its beginning stays."""
        self.points = move_points(motion, self.points)
        self._last = move_points(motion, self._last[None])[0]

    def _take_back(self, pose: Array) -> None:
        """Shortens the path if the vehicle drove backwards to `pose` (3,)."""
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
        """Adds a pose to the beginning while the path is shorter than the memory."""
        if self.length > self.settings.memory:
            return
        first = len(self.beginning) == 0
        if first or np.hypot(*(pose[:2] - self.beginning[-1, :2])) >= self.settings.beginning_step:
            self.beginning = np.concatenate([self.beginning, pose[None]])

    def steer(self, twists: Array) -> None:
        """Updates the curvature by `w / v` of body twists (k, 3), if the vehicle is fast enough."""
        if len(twists) == 0:
            return
        speed, _, rate = twists.mean(axis=0)
        if speed > self.settings.min_speed:
            limit = self.settings.max_curvature
            now = float(np.clip(rate / speed, -limit, limit))
            self.curvature += self.settings.curvature_gain * (now - self.curvature)

    def ahead(self, pose: Array, reach: float) -> PathAhead:
        """Returns the driven path, continued from `pose` (3,) by an arc of `reach` metres."""
        step = self.settings.step
        s = np.arange(0.0, reach + step, step)
        angle = 0.5 * self.curvature * s
        chord = s * np.sinc(angle / np.pi)
        direction = np.column_stack([np.cos(pose[2] + angle), np.sin(pose[2] + angle)])
        behind = self.stations < self.length - 0.5 * step
        points = np.concatenate([self.points[behind], pose[:2] + chord[:, None] * direction])
        return PathAhead(points, np.concatenate([self.stations[behind], self.length + s]), self.length)


def along_and_across(points: Array, path: Array, stations: Array) -> tuple[Array, Array]:
    """Returns the station (m,) and signed distance (m,), left positive, of points (m, 2) beside a polyline.

    The polyline has at least two positions (n, 2) with stations (n,). Beyond the last position the station
    continues along the last segment.
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
    along = np.where(overshoot > 0.0, 1.0 + overshoot, share[rows, best])
    cross = ex * dy - ey * dx
    nearest = np.sign(cross) * np.sqrt(distance2[rows, best])
    lateral = np.where(overshoot > 0.0, cross / np.sqrt(length2[best]), nearest)
    return stations[best] + along * (stations[best + 1] - stations[best]), lateral
