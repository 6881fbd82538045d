"""Laps: counted online from poses, the same way for an estimate and for the truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class LapSettings:
    """What counts as passing the start line, which is the y axis of the map frame at the first pose."""

    min_path: float = 40.0
    """Shortest lap (m, path driven); a line crossed sooner is crossed by jitter or by an overlap."""

    min_distance: float = 15.0
    """How far from the start (m) a lap must have led at some time."""

    gate_half_width: float = 5.0
    """Half the length of the start line (m): room for the racing line and for the drift of one lap."""

    gate_depth: float = 10.0
    """How far behind the line (m) a crossing is still noticed where an estimate jumped over it."""

    max_heading: float = np.pi / 3
    """Largest angle (rad) between the heading and the start's own for it to be the same stretch of road."""

    end_tolerance: float = 5.0
    """A last lap that ends at most this far (m) before the line is as good as complete."""


class LapCounter:
    """Counts laps pose by pose: it ends where the start line is crossed forward after a lap's worth of path.

    Poses are [x, y, theta] in the map frame, whose origin and x axis are the start. An online estimate may
    jump (a closing loop), so a pose just behind the line and heading forward ends the lap as well.
    """

    def __init__(self, settings: LapSettings | None = None) -> None:
        self.settings = settings or LapSettings()
        self.lap = 1
        """The lap being driven, counted from 1."""
        self._path = 0.0
        self._farthest = 0.0
        self._last: tuple[float, float, float] | None = None

    def update(self, pose: ArrayLike) -> int:
        """The lap (counted from 1) that `pose` (3,) [x, y, theta] belongs to."""
        x, y, theta = (float(value) for value in np.asarray(pose, dtype=float))
        if self._last is not None:
            self._path += float(np.hypot(x - self._last[0], y - self._last[1]))
            self._farthest = max(self._farthest, float(np.hypot(x, y)))
            if self._has_driven_a_lap() and self._passes_the_line(x, y, theta):
                self.lap += 1
                self._path = self._farthest = 0.0
        self._last = (x, y, theta)
        return self.lap

    @property
    def last_lap_is_complete(self) -> bool:
        """Whether the lap being driven has come back to within `end_tolerance` of the start line."""
        if self._last is None or not self._has_driven_a_lap():
            return False
        x, y, theta = self._last
        return self._heads_forward(theta) and float(np.hypot(x, y)) <= self.settings.end_tolerance

    @property
    def completed(self) -> int:
        """How many laps are complete, the one just short of the line included."""
        return self.lap - 1 + int(self.last_lap_is_complete)

    def _has_driven_a_lap(self) -> bool:
        return self._path >= self.settings.min_path and self._farthest >= self.settings.min_distance

    def _heads_forward(self, theta: float) -> bool:
        return bool(np.cos(theta) > np.cos(self.settings.max_heading))

    def _passes_the_line(self, x: float, y: float, theta: float) -> bool:
        assert self._last is not None
        if x < 0.0 or not self._heads_forward(theta):
            return False
        last_x, last_y, _ = self._last
        crossing_y = last_y + (y - last_y) * last_x / (last_x - x) if last_x < 0.0 else np.inf
        behind = x <= self.settings.gate_depth and abs(y) <= self.settings.gate_half_width
        return bool(behind or abs(crossing_y) <= self.settings.gate_half_width)


def lap_end_indices(poses: Array, settings: LapSettings | None = None) -> NDArray[np.intp]:
    """Index of the pose at which each complete lap ends, of poses (N, 3) in the map frame.

    A last lap that ends within a few metres of the line is complete and ends with the last pose; a lap that
    the log breaks off in the middle isn't listed.
    """
    counter = LapCounter(settings)
    laps = np.array([counter.update(pose) for pose in poses], dtype=int)
    ends = np.flatnonzero(np.diff(laps)) + 1
    if counter.last_lap_is_complete:
        ends = np.append(ends, len(poses) - 1)
    return ends
