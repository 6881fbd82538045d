"""Online estimators in one process, cycle for cycle in turn, each timed; one that is too slow is stopped."""

from __future__ import annotations

import time
import tracemalloc
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pathspace_graph.estimators import make_online
from pathspace_graph.io.log import Detections, Log, Odometry
from pathspace_graph.run import split_odometry
from pathspace_graph.settings.mapper import MapperSettings

Array = NDArray[np.float64]

JUDGED: Final = 10
"""The mean of so many last updates is held against the budget."""


@dataclass(frozen=True, eq=False)
class Lane:
    """An estimator on a log."""

    estimator: str
    """Its name."""
    log: Log
    """What it is fed with."""
    variant: int = 0
    """What tells it from the other lanes of the estimator."""


@dataclass(frozen=True, eq=False)
class LaneTimes:
    """How a lane went, a row per cycle until it ended or was stopped."""

    lane: Lane
    """Which it was."""
    seconds: Array
    """Wall time of each update (n,), s."""
    sizes: Array
    """Control points or landmarks after each (n,)."""
    stopped: str = ""
    """Why it did not come to the log's end; empty where it did."""


class _Runner:
    """A lane under way."""

    def __init__(self, lane: Lane, settings: MapperSettings, budget: float) -> None:
        self.lane, self._budget = lane, budget
        self._estimator = make_online(lane.estimator, settings, lane.log)
        self._cycles: Iterator[tuple[Odometry, Detections]] = split_odometry(lane.log)
        self._seconds: list[float] = []
        self._sizes: list[int] = []
        self.stopped = ""
        self.over = False

    def cycle(self) -> None:
        """The next update; nothing once the lane is over."""
        fed = None if self.over else next(self._cycles, None)
        if fed is None:
            self.over = True
            return
        begin = time.perf_counter()
        try:
            estimate = self._estimator.update(*fed)
        except Exception as error:  # whatever ends it belongs into the table
            self._stop(" ".join(f"{type(error).__name__}: {error}".split()))
            return
        self._seconds.append(time.perf_counter() - begin)
        self._sizes.append(sum(estimate.sizes))
        if len(self._seconds) >= JUDGED and np.mean(self._seconds[-JUDGED:]) > self._budget:
            self._stop(f"over {self._budget:g} s an update")

    def _stop(self, why: str) -> None:
        self.stopped, self.over = why, True

    def times(self) -> LaneTimes:
        """What was measured."""
        return LaneTimes(self.lane, np.array(self._seconds), np.array(self._sizes, dtype=float), self.stopped)


def run_lanes(
    lanes: Sequence[Lane],
    settings: MapperSettings,
    budget: float,
    on_cycle: Callable[[], None] = lambda: None,
) -> tuple[LaneTimes, ...]:
    """Cycle k goes to every lane in turn, the first one of which moves on by one with k.

    So whatever slows the machine down slows all alike, and none always follows the same other. A lane is
    stopped where its last updates took more than `budget` (s) each on average. BLAS has one thread.
    """
    runners = [_Runner(lane, settings, budget) for lane in lanes]
    with threadpool_limits(limits=1):
        for cycle in range(max(len(lane.log.cycles) for lane in lanes)):
            first = cycle % len(runners)
            for runner in (*runners[first:], *runners[:first]):
                runner.cycle()
            on_cycle()
    return tuple(runner.times() for runner in runners)


def peak_memory(lane: Lane, settings: MapperSettings) -> float:
    """Most memory (MB) held at a time while the lane runs, of what tracemalloc sees: Python and numpy.

    What GTSAM and LAPACK take for themselves isn't in it. Not to be timed: tracing slows everything down.
    """
    tracemalloc.start()
    try:
        before, _ = tracemalloc.get_traced_memory()
        tracemalloc.reset_peak()
        run_lanes([lane], settings, float("inf"))
        return (tracemalloc.get_traced_memory()[1] - before) / 1e6
    finally:
        tracemalloc.stop()
