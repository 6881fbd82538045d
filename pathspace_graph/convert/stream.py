"""ROS messages as they arrive, as perception cycles for an online estimator."""

from collections import Counter, deque
from typing import Any, Final

import numpy as np

from pathspace_graph.errors import PathspaceError
from pathspace_graph.io.log import Detections, Odometry

from .messages import points_of, stamp_of, twist_of
from .recording import in_vehicle_frame, usable
from .settings import Frames, LabelRule, NoiseSettings

MAX_BUFFERED: Final = 10_000
"""At most this number of twists waits for a perception cycle, the newest ones."""
BROKEN: Final = (PathspaceError, AttributeError, TypeError, ValueError, IndexError, OverflowError)
"""A message that cannot be read raises one of these."""


class MessageStream:
    """Buffers twists, and gives each message with detections the twists up to it.

    No message raises an error: one that cannot be used is counted in `refused`, and left out. A message
    without a stamp has the time at which it was received.
    """

    def __init__(
        self,
        frames: Frames | None = None,
        noise: NoiseSettings | None = None,
        rule: LabelRule | None = None,
        label_field: str | None = None,
    ) -> None:
        self.frames, self.noise = frames or Frames(), noise or NoiseSettings()
        self.rule, self.label_field = rule or LabelRule(), label_field
        self.refused: Counter[str] = Counter()
        """Each of these reasons came up this number of times."""
        self._twists: deque[tuple[float, list[float]]] = deque(maxlen=MAX_BUFFERED)
        self._first = np.inf  # the stamp (s) of the first twist
        self._newest = -np.inf  # the stamp (s) of the newest cycle in order

    def take_odometry(self, message: Any, received: float) -> None:
        """Buffers the twist of a message that was received at this time (s)."""
        try:
            t, twist = _stamp(message, received), twist_of(message)
            if twist is None:
                raise ValueError("odometry: expected a message with a twist, found a pose alone")
            twist = twist * self.frames.flip
            if not np.isfinite([t, *twist]).all() or (self._twists and t <= self._twists[-1][0]):
                raise ValueError("odometry: expected finite numbers and a stamp later than the one before")
            self._twists.append((t, twist.tolist()))
            self._first = min(self._first, t)
        except BROKEN as error:
            self.refused[str(error)] += 1

    def take_detections(self, message: Any, received: float) -> tuple[Odometry, Detections] | None:
        """Return a perception cycle with the twists since the last one that was used, or None.

        A late cycle comes without twists, which the cycles in order have had already. The caller says by
        `use` that the estimator took the cycle; until then its twists are kept.
        """
        try:
            points = usable(points_of(message, self.rule, self.label_field), self.refused)
            t = _stamp(message, received)
            if not self._first <= t < np.inf:
                raise ValueError("detections: expected a stamp not before that of the first odometry")
            cycle = in_vehicle_frame(t, points, self.frames, self.noise, self.refused)
        except BROKEN as error:
            self.refused[str(error)] += 1
            return None
        return self._odometry_until(t), cycle

    def use(self, t: float) -> None:
        """Drops the twists that a cycle at t (s) has used, but for the last one, which is held."""
        self._newest = max(self._newest, t)
        while len(self._twists) > 1 and self._twists[1][0] <= self._newest:
            self._twists.popleft()

    def _odometry_until(self, t: float) -> Odometry:
        """Return the buffered twists up to t (s); there are none for a late cycle."""
        rows = [] if t <= self._newest else [row for row in self._twists if row[0] <= t]
        twists = np.array([twist for _, twist in rows]).reshape(-1, 3)
        return Odometry(np.array([stamp for stamp, _ in rows]), twists)


def _stamp(message: Any, received: float) -> float:
    stamp = stamp_of(message)
    return received if stamp is None else stamp
