"""The way driven, and the way ahead as the current turn predicts it: what comes next is what comes next along it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class DrivenPath:
    """Positions driven, at least `step` apart, with their station (path length, m)."""

    def __init__(self, step: float = 0.3, memory: float = 60.0) -> None:
        self.step = step
        """Least distance of two kept positions (m)."""
        self.memory = memory
        """Stretch behind the vehicle (m) that is kept."""
        self.points: Array = np.zeros((0, 2))
        self.stations: Array = np.zeros(0)
        self.beginning: Array = np.zeros((0, 3))
        """Poses about a metre apart on the first stretch, as long as the memory."""
        self.length = 0.0
        """Path driven so far (m), the station of the last position."""

    def update(self, pose: Array) -> None:
        """Drive on to `pose` (3,), map frame."""
        position = pose[:2]
        if self.length <= self.memory and (len(self.beginning) == 0 or np.hypot(*(position - self.beginning[-1, :2])) >= 1.0):
            self.beginning = np.concatenate([self.beginning, pose[None]])
        if len(self.points) == 0:
            self.points, self.stations = position[None].copy(), np.zeros(1)
            return
        distance = float(np.hypot(*(position - self.points[-1])))
        self.length = float(self.stations[-1]) + distance
        if distance >= self.step:
            self.points = np.concatenate([self.points, position[None]])
            self.stations = np.append(self.stations, self.length)
            keep = self.stations >= self.length - self.memory
            self.points, self.stations = self.points[keep], self.stations[keep]

    def move(self, shift: Array) -> None:
        """Shift all positions by (2,), after the estimate jumped."""
        self.points = self.points + shift

    def with_prediction(self, pose: Array, curvature: float, reach: float) -> tuple[Array, Array]:
        """Positions (n, 2) and stations (n,) of the path driven and of an arc of `reach` metres ahead of `pose`."""
        s = np.arange(0.0, reach + self.step, self.step)
        angle = 0.5 * curvature * s
        chord = s * np.sinc(angle / np.pi)
        ahead = pose[:2] + chord[:, None] * np.column_stack(
            [np.cos(pose[2] + angle), np.sin(pose[2] + angle)]
        )
        behind = self.stations < self.length - 0.5 * self.step
        return (
            np.concatenate([self.points[behind], ahead]),
            np.concatenate([self.stations[behind], self.length + s]),
        )


def along_and_across(points: Array, path: Array, stations: Array) -> tuple[Array, Array]:
    """Station (m,) and signed distance (m,), left positive, of points (m, 2) from the polyline `path` (n, 2), n >= 2.

    Past the last position the station runs on along the last segment.
    """
    start, segment = path[:-1], np.diff(path, axis=0)
    length2 = np.maximum((segment**2).sum(axis=1), np.finfo(float).tiny)
    offset = points[:, None, :] - start[None]
    share = (offset * segment).sum(axis=2) / length2
    share = np.clip(share, 0.0, 1.0)
    to = offset - share[:, :, None] * segment
    distance2 = (to**2).sum(axis=2)
    best = distance2.argmin(axis=1)
    rows = np.arange(len(points))
    e, d = segment[best], offset[rows, best]
    overshoot = np.where(best == len(segment) - 1, (d * e).sum(axis=1) / length2[best] - 1.0, 0.0)
    at = np.where(overshoot > 0.0, 1.0 + overshoot, share[rows, best])
    side = e[:, 0] * d[:, 1] - e[:, 1] * d[:, 0]
    lateral = np.where(
        overshoot > 0.0, side / np.sqrt(length2[best]), np.sign(side) * np.sqrt(distance2[rows, best])
    )
    return stations[best] + at * (stations[best + 1] - stations[best]), lateral
