"""How long each stage of an update took."""

from __future__ import annotations

import time


class Stopwatch:
    """Laps by name, from the moment it is made."""

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        """Seconds of each."""
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        """What has passed since the last lap was `name`."""
        now = time.perf_counter()
        self.laps[name] = now - self._last
        self._last = now
