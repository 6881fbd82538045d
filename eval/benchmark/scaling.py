"""Time of an update against the size of the map, its detections and the laps: points, power laws, memory.

All estimators run in one process: every cycle goes to each in turn, so that whatever slows the machine down
slows all alike.
"""

import tracemalloc
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Final, Literal

import numpy as np
import pandas as pd
from scipy.stats import linregress
from threadpoolctl import threadpool_limits

from pathspace_graph.estimators import make_online
from pathspace_graph.factors.arrays import Array
from pathspace_graph.io.log import Log
from pathspace_graph.run import split_odometry, timed_update, timed_wait
from pathspace_graph.settings.mapper import MapperSettings

from .roads import Drives, ScalingSettings, first_cycles

Sweep = Literal["cones", "readings", "laps"]
"""What is varied: the cones seen, the detections of an update (readings), or the lap."""
CONES: Final[Sweep] = "cones"
READINGS: Final[Sweep] = "readings"
LAPS: Final[Sweep] = "laps"
Logs = Sequence[tuple[Log, int, Array]]
"""Log, number of detections where that is varied, and the abscissa of each cycle; NaN doesn't count."""
JUDGED: Final = 10
"""Number of updates whose mean is compared with the budget."""


# --- lanes -----------------------------------------------------------------------------------------------


@dataclass(eq=False)
class Lane:
    """An estimator that is to map a log, and what was measured, until the log ended or it was stopped."""

    estimator: str
    log: Log
    at: Array = field(default_factory=lambda: np.zeros(0))
    """Abscissa (n,) of each cycle of the log; NaN doesn't count."""
    readings: int = 0
    """Number of detections in each cycle of the log, where they are varied."""
    seconds: list[float] = field(default_factory=list)
    """Processor time of each update, s."""
    sizes: list[int] = field(default_factory=list)
    """Number of control points or landmarks after each update."""
    stopped: str = ""
    """Why it did not reach the log's end; empty where it did."""

    def updates(self, settings: MapperSettings, budget: float) -> Iterator[None]:
        """Do an update at each step, until the log ends or the lane is stopped."""
        estimator = make_online(self.estimator, settings, self.log)
        for cycle in split_odometry(self.log):
            try:
                timed_wait(estimator)
                estimate, _, seconds = timed_update(estimator, *cycle)
            except Exception as error:  # the table reports any failure
                self.stopped = " ".join(f"{type(error).__name__}: {error}".split())
                return
            self.seconds.append(seconds)
            self.sizes.append(sum(estimate.sizes))
            if len(self.seconds) >= JUDGED and np.mean(self.seconds[-JUDGED:]) > budget:
                self.stopped = f"over {budget:g} s an update"
                return
            yield


def run_lanes(
    lanes: Sequence[Lane],
    settings: MapperSettings,
    budget: float,
    on_cycle: Callable[[], None] = lambda: None,
) -> None:
    """Give cycle k to every lane in turn; the lane that is first moves on by one with k.

    So none always follows the same other. A lane is stopped where its last updates took more than `budget`
    (s) on average. BLAS has one thread.
    """
    runners = [lane.updates(settings, budget) for lane in lanes]
    with threadpool_limits(limits=1):
        for cycle in range(max(len(lane.log.cycles) for lane in lanes)):
            first = cycle % len(runners)
            for runner in (*runners[first:], *runners[:first]):
                next(runner, None)
            on_cycle()


def peak_memory(lane: Lane, settings: MapperSettings) -> float:
    """Return the most memory (MB) that Python and numpy held at a time while the lane ran.

    By tracemalloc, which sees nothing of what GTSAM and LAPACK allocate, and slows everything down.
    """
    tracemalloc.start()
    try:
        before, _ = tracemalloc.get_traced_memory()
        tracemalloc.reset_peak()
        run_lanes([lane], settings, float("inf"))
        return (tracemalloc.get_traced_memory()[1] - before) / 1e6
    finally:
        tracemalloc.stop()


# --- points and slopes -----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Scaling:
    """All results of the measurement."""

    settings: ScalingSettings
    mapper: dict[str, Any]
    """Settings of the estimators, in full."""
    points: pd.DataFrame
    """Row for each mean of some updates, as `binned` returns them."""
    slopes: pd.DataFrame
    """Row for each sweep and estimator, as `fit_slope` returns it."""
    memory: dict[str, float]
    """Most memory (MB) that Python and numpy held while each estimator mapped the first lap."""

    def of(self, sweep: Sweep, estimator: str) -> pd.DataFrame:
        return self.points[(self.points["sweep"] == sweep) & (self.points["estimator"] == estimator)]

    def slope(self, sweep: Sweep, estimator: str) -> pd.Series:
        return self.slopes.set_index(["sweep", "estimator"]).loc[(sweep, estimator)]

    @property
    def estimators(self) -> tuple[str, ...]:
        return tuple(self.memory)

    def seconds_at(self, cones: float, estimator: str) -> float:
        """Return the mean update (s) at a number of cones, between the points; NaN beyond them."""
        points = self.of(CONES, estimator)
        if not len(points):
            return float("nan")
        at, seconds = np.log(points["at"]), np.log(points["seconds"])
        return float(np.exp(np.interp(np.log(cones), at, seconds, left=np.nan, right=np.nan)))


def binned(sweep: Sweep, lane: Lane, edges: Array) -> pd.DataFrame:
    """Return a point for each interval between two `edges` that holds cycles of a lane.

    It has the mean abscissa `at`, the mean `seconds` of an update and `size` of the map, and the number of
    `cycles`.
    """
    at = lane.at[: len(lane.seconds)]
    frame = pd.DataFrame({"at": at, "seconds": lane.seconds, "size": lane.sizes})
    bins = np.searchsorted(edges, frame["at"], side="right") - 1
    inside = (bins >= 0) & (bins < len(edges) - 1)
    points = frame[inside].groupby(bins[inside])
    means = points.mean().assign(sweep=sweep, estimator=lane.estimator, cycles=points.size())
    return means[["sweep", "estimator", "at", "seconds", "cycles", "size"]].reset_index(drop=True)


def fit_slope(
    sweep: Sweep, estimator: str, points: pd.DataFrame, fit_from: float = 0.0, stopped: str = ""
) -> dict[str, Any]:
    """Return the power law `seconds ~ at^slope`, a line fitted to the logarithms from `fit_from` on.

    The standard `error` is that of the exponent; both are NaN where there are too few `points`, which lie
    from `low` to `high`.
    """
    kept = points[points["at"] >= fit_from].astype({"at": float, "seconds": float})
    slope = error = float("nan")
    if len(kept) > 2:  # two would leave nothing to estimate the error from
        line = linregress(np.log(kept["at"]), np.log(kept["seconds"]))
        slope, error = float(line.slope), float(line.stderr)
    fitted = {"slope": slope, "error": error, "points": len(kept)}
    ends = {"low": float(kept["at"].min()), "high": float(kept["at"].max())}
    return {"sweep": sweep, "estimator": estimator, **fitted, **ends, "stopped": stopped}


# --- the measurement -------------------------------------------------------------------------------------


def sweeps(drives: Drives, settings: ScalingSettings) -> dict[Sweep, tuple[Logs, Array, float]]:
    """Return the logs of each sweep, the edges of its points' intervals, and where its slope begins."""
    low, high = np.log(settings.cones_min), np.log(settings.cones_max + 1.0)
    cones = np.exp(np.linspace(low, high, settings.bins + 1))
    lap = 1.0 + np.searchsorted(drives.lap_ends, [cycle.t for cycle in drives.laps.cycles])
    dense = []
    for wanted, log in drives.readings.items():
        counts = np.array([len(cycle.labels) for cycle in log.cycles])
        counts[: settings.warm_up] = -1
        dense.append((log, wanted, np.where(counts == wanted, float(wanted), np.nan)))
    ends = np.arange(1.0, len(drives.lap_ends) + 2.0)
    return {
        CONES: ([(drives.cones, 0, drives.seen)], cones, settings.fit_from),
        READINGS: (dense, np.append(np.sort(settings.readings), np.inf), 0.0),
        LAPS: ([(drives.laps, 0, lap.astype(float))], ends, 2.0),
    }


def measure_scaling(
    estimators: Sequence[str],
    drives: Drives,
    settings: ScalingSettings,
    mapper: MapperSettings | None = None,
    on_cycle: Callable[[], None] = lambda: None,
) -> Scaling:
    """Measure all three sweeps, and the memory; `on_cycle` is called after each cycle of a sweep."""
    mapper = mapper or MapperSettings()
    points, slopes = [], []
    for sweep, (logs, edges, fit_from) in sweeps(drives, settings).items():
        lanes = [Lane(name, log, at, k) for name in estimators for log, k, at in logs]
        run_lanes(lanes, mapper, settings.budget, on_cycle)
        for name in estimators:
            own = [lane for lane in lanes if lane.estimator == name]
            points.append(_joined([binned(sweep, lane, edges) for lane in own]))
            stops = [(lane.readings, lane.stopped) for lane in own if lane.stopped]
            stopped = "; ".join(f"{k} readings: {why}" if k else why for k, why in stops)
            slopes.append(fit_slope(sweep, name, points[-1], fit_from, stopped))
    end = int(np.searchsorted([cycle.t for cycle in drives.laps.cycles], drives.lap_ends[0]))
    first_lap = first_cycles(drives.laps, end)
    memory = {name: peak_memory(Lane(name, first_lap), mapper) for name in estimators}
    return Scaling(settings, asdict(mapper), _joined(points), pd.DataFrame(slopes), memory)


def _joined(points: Sequence[pd.DataFrame]) -> pd.DataFrame:
    return pd.concat([of for of in points if len(of)] or points[:1], ignore_index=True)
