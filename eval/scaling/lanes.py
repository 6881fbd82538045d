"""Several online estimators in one process: every cycle goes to each in turn, and each update is timed."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pathspace_graph.estimators import make_online
from pathspace_graph.io.log import Log
from pathspace_graph.run import split_odometry, timed_update, timed_wait
from pathspace_graph.settings.mapper import MapperSettings

Array = NDArray[np.float64]

JUDGED: Final = 10
"""The mean of this many updates is compared with the budget."""


@dataclass(frozen=True, eq=False)
class Lane:
    """An estimator is to map a log."""

    estimator: str
    """The estimator has this name."""
    log: Log
    """The estimator maps this log."""
    variant: int = 0
    """This number tells the lane from other lanes of the same estimator."""


@dataclass(frozen=True, eq=False)
class LaneTimes:
    """Holds what was measured in a lane, a row for each cycle until it ended or was stopped."""

    lane: Lane
    """The times are of this lane."""
    seconds: Array
    """Each update took this wall time (n,), s."""
    sizes: Array
    """The map had this many control points or landmarks after each update (n,)."""
    stopped: str = ""
    """This says why the lane did not reach the log's end; it is empty where it did."""


class _Runner:
    """Runs a lane cycle by cycle."""

    def __init__(self, lane: Lane, settings: MapperSettings, budget: float) -> None:
        self._lane, self._budget = lane, budget
        self._estimator = make_online(lane.estimator, settings, lane.log)
        self._cycles = split_odometry(lane.log)
        self._seconds: list[float] = []
        self._sizes: list[int] = []
        self._stopped = ""

    def cycle(self) -> None:
        """Does the next update; does nothing where the lane has ended or was stopped."""
        cycle = None if self._stopped else next(self._cycles, None)
        if cycle is None:
            return
        try:
            timed_wait(self._estimator)
            estimate, seconds = timed_update(self._estimator, *cycle)
        except Exception as error:  # the table reports any failure
            self._stopped = " ".join(f"{type(error).__name__}: {error}".split())
            return
        self._seconds.append(seconds)
        self._sizes.append(sum(estimate.sizes))
        if len(self._seconds) >= JUDGED and np.mean(self._seconds[-JUDGED:]) > self._budget:
            self._stopped = f"over {self._budget:g} s an update"

    def times(self) -> LaneTimes:
        """Returns what was measured."""
        sizes = np.array(self._sizes, dtype=float)
        return LaneTimes(self._lane, np.array(self._seconds), sizes, self._stopped)


def run_lanes(
    lanes: Sequence[Lane],
    settings: MapperSettings,
    budget: float,
    on_cycle: Callable[[], None] = lambda: None,
) -> tuple[LaneTimes, ...]:
    """Gives cycle k to every lane in turn; the lane that is first moves on by one with k.

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
    """Returns the most memory (MB) that Python and numpy held at a time while the lane ran.

    This is what tracemalloc sees; it sees nothing of what GTSAM and LAPACK allocate. Don't time a lane
    meanwhile: tracing slows everything down.
    """
    tracemalloc.start()
    try:
        before, _ = tracemalloc.get_traced_memory()
        tracemalloc.reset_peak()
        run_lanes([lane], settings, float("inf"))
        return (tracemalloc.get_traced_memory()[1] - before) / 1e6
    finally:
        tracemalloc.stop()
