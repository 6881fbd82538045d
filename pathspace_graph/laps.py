"""Online lap counter by poses, for estimate and truth."""

from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

# the start line is the y axis of the map frame
MIN_LAP_PATH: Final = 25.0  # least length of a lap (m along the path): jitter may cross the line before
MIN_LAP_REACH: Final = 7.0  # least distance from the start that a lap must reach (m)
LINE_HALF_WIDTH: Final = 5.0  # half width of the start line (m), with room for racing line and drift
LINE_DEPTH: Final = 10.0  # distance past the line at which a jump over it still counts as a crossing (m)
LINE_HEADING: Final = np.pi / 3  # largest difference of the heading from the start's at the line (rad)
LAP_END_TOLERANCE: Final = 5.0  # largest distance before the line at which a last lap is complete (m)


class LapCounter:
    """Counter of laps, which end with a forward crossing of the start line after a minimum path.

    The map frame has its origin and its x axis at the start. An online estimate may jump when a loop closes,
    so a pose just past the line with a forward heading ends a lap as well.
    """

    def __init__(self) -> None:
        self.lap = 1  # current lap, counted from 1
        self._path = 0.0
        self._farthest = 0.0
        self._last: tuple[float, float, float] | None = None

    def update(self, pose: ArrayLike) -> int:
        """Return the lap, counted from 1, of the next `pose` (x, y, theta) (3,), map frame."""
        x, y, theta = (float(value) for value in np.asarray(pose, dtype=float))
        if self._last is not None:
            self._path += float(np.hypot(x - self._last[0], y - self._last[1]))
            self._farthest = max(self._farthest, float(np.hypot(x, y)))
            if x >= 0.0 and self._has_driven_a_lap() and self._heads_forward(theta):
                last_x, last_y, _ = self._last
                crossing_y = last_y + (y - last_y) * last_x / (last_x - x) if last_x < 0.0 else np.inf
                behind = x <= LINE_DEPTH and abs(y) <= LINE_HALF_WIDTH
                if behind or abs(crossing_y) <= LINE_HALF_WIDTH:
                    self.lap += 1
                    self._path = self._farthest = 0.0
        self._last = (x, y, theta)
        return self.lap

    @property
    def last_lap_is_complete(self) -> bool:
        """Whether the current lap has returned to within `LAP_END_TOLERANCE` of the start."""
        if self._last is None or not self._has_driven_a_lap():
            return False
        x, y, theta = self._last
        return self._heads_forward(theta) and float(np.hypot(x, y)) <= LAP_END_TOLERANCE

    @property
    def completed(self) -> int:
        """Return the number of complete laps, including one that ends just before the line."""
        return self.lap - 1 + int(self.last_lap_is_complete)

    def _has_driven_a_lap(self) -> bool:
        return self._path >= MIN_LAP_PATH and self._farthest >= MIN_LAP_REACH

    def _heads_forward(self, theta: float) -> bool:
        return bool(np.cos(theta) > np.cos(LINE_HEADING))


def lap_end_indices(poses: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return the indices (k,) of the poses (N, 3), map frame, at which complete laps end."""
    counter = LapCounter()
    laps = np.array([counter.update(pose) for pose in poses], dtype=int)
    ends = np.flatnonzero(np.diff(laps)) + 1
    if counter.last_lap_is_complete:
        ends = np.append(ends, len(poses) - 1)
    return ends
