"""Arriving ROS messages as perception cycles, each with its twists."""

from bisect import insort
from collections import Counter, deque
from collections.abc import Iterator
from typing import Any

import numpy as np

from pathspace_graph.convert.lines import along_lines, default_spacing
from pathspace_graph.convert.messages import BROKEN, DENSE, points_of, stamp_of, twist_of
from pathspace_graph.convert.recording import distinct, in_vehicle_frame, usable
from pathspace_graph.convert.settings import Frames, LabelRule, NoiseSettings
from pathspace_graph.convert.twists import beyond_limits
from pathspace_graph.factors.arrays import Array
from pathspace_graph.io.log import Detections, Odometry


class MessageStream:
    """Buffer of messages, which gives cycles in order, each with its twists; refused ones are counted.

    A cycle waits for older ones until a message is newer by `wait` (s), since estimators refuse late ones.
    """

    def __init__(self, frames: Frames | None = None, wait: float = 0.0) -> None:
        self.frames, self.noise, self.rule = frames or Frames(), NoiseSettings(), LabelRule()
        self.refused: Counter[str] = Counter()  # number of messages for each reason
        self._twists: deque[tuple[float, list[float]]] = deque(maxlen=10_000)
        self._first = np.inf  # the stamp (s) of the first twist
        self._wait = wait
        self._waiting = list[Detections]()  # in order of their stamps
        self._newest = -np.inf  # the stamp (s) of the newest message with detections

    @property
    def newest_twist(self) -> Array:
        """The newest twist (3,) in m/s, m/s and rad/s."""
        return np.array(self._twists[-1][1])

    def take_odometry(self, message: Any, received: float) -> bool:
        """Buffer the twist of a message that was received at this time (s); return whether it is usable."""
        try:
            t, twist = stamp_of(message) or received, twist_of(message)
            if twist is None:
                raise ValueError("odometry: expected a message with a twist, found a pose alone")
            twist = twist * self.frames.flip
            if not np.isfinite([t, *twist]).all() or (self._twists and t <= self._twists[-1][0]):
                raise ValueError("odometry: expected finite numbers and a stamp later than the one before")
            if beyond_limits(twist).any():  # an estimator would refuse each cycle that holds it
                raise ValueError("odometry: expected a speed and a yaw rate that a vehicle can have")
            self._twists.append((t, twist.tolist()))
            self._first = min(self._first, t)
        except BROKEN as error:
            self.refused[str(error)] += 1
            return False
        return True

    def take_detections(self, message: Any, received: float) -> Iterator[tuple[Odometry, Detections]]:
        """Yield the cycles that have waited for long enough, with the twists since the last in `use`."""
        try:
            points = points_of(message, self.rule)
            points = points.where(points.lines < 0)  # polylines beside cones are decoration
            if (points.lines == DENSE).any():
                points = usable(points, self.refused)
                points = along_lines(points, default_spacing(points))
            else:
                points = distinct(points, self.refused)
            t = stamp_of(message) or received
            if not self._first <= t < np.inf:
                raise ValueError("detections: expected a stamp not before that of the first odometry")
            cycle = in_vehicle_frame(t, points, self.frames, self.noise, self.refused)
        except BROKEN as error:
            self.refused[str(error)] += 1
            return
        self._newest = max(self._newest, t)
        insort(self._waiting, cycle, key=lambda one: one.t)
        while self._waiting and self._waiting[0].t <= self._newest - self._wait:
            cycle = self._waiting.pop(0)
            rows = [row for row in self._twists if row[0] <= cycle.t]
            twists = np.array([twist for _, twist in rows]).reshape(-1, 3)
            yield Odometry(np.array([stamp for stamp, _ in rows]), twists), cycle

    def use(self, t: float) -> None:
        """Drop the twists that a cycle at t (s) has used, except the last one, which is held."""
        while len(self._twists) > 1 and self._twists[1][0] <= t:
            self._twists.popleft()
