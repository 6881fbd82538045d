"""Estimators that get every cycle of a drive in turn: time and size of each update, points and power laws.

All run in one process, so that what slows the machine down slows all alike.
"""

import tracemalloc
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Literal

import numpy as np
import pandas as pd
from scipy.stats import linregress
from threadpoolctl import threadpool_limits

from pathspace_graph.estimators import make_online
from pathspace_graph.factors.arrays import Array
from pathspace_graph.io.log import Log
from pathspace_graph.run import split_odometry, timed_update, timed_wait
from pathspace_graph.settings.evaluation import ScalingSettings
from pathspace_graph.settings.mapper import MapperSettings

from .roads import LINE_POINTS, Drives

Sweep = Literal["cones", "readings", "laps", "line"]
"""Varied: cones seen, detections of an update, or lap. On a line, 300 points in each update."""
CONES: Final[Sweep] = "cones"
READINGS: Final[Sweep] = "readings"
LAPS: Final[Sweep] = "laps"
DENSE_LINE: Final[Sweep] = "line"
POINT: Final = ["sweep", "estimator", "at", "seconds", "cycles", "size"]  # columns of a point of a sweep
SLOPE: Final = [*POINT[:2], "slope", "error", "points", "low", "high", "stopped"]  # and of its slope
JUDGED: Final = 10  # number of updates whose mean is compared with the budget


@dataclass(eq=False)
class Lane:
    """An estimator that is to map a log, and what was measured, until the log ended or it was stopped."""

    estimator: str
    log: Log
    at: Array = field(default_factory=lambda: np.zeros(0))  # (n,) abscissa of each cycle; NaN doesn't count
    readings: int = 0  # number of detections in each cycle of the log, where they are varied
    seconds: list[float] = field(default_factory=list)  # processor time of each update (s)
    sizes: list[int] = field(default_factory=list)  # size of the map after each update
    stopped: str = ""  # why it did not reach the log's end; empty where it did

    def updates(self, settings: MapperSettings, budget: float) -> Iterator[None]:
        """Do an update at each step, until the log ends or the lane is stopped."""
        estimator = make_online(self.estimator, settings, self.log)
        for odometry, detections in split_odometry(self.log):
            try:
                timed_wait(estimator)
                estimate, _, seconds = timed_update(estimator, odometry, detections)
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

    So none always follows the same other. A lane stops if its last updates took over `budget` s on average.
    """
    runners = [lane.updates(settings, budget) for lane in lanes]
    with threadpool_limits(limits=1):
        for number in range(max(len(lane.log.cycles) for lane in lanes)):
            first = number % len(runners)
            for runner in (*runners[first:], *runners[:first]):
                next(runner, None)
            on_cycle()


def peak_memory(lane: Lane, settings: MapperSettings) -> float:
    """Return the peak (MB) of Python and numpy, not GTSAM, as the lane ran, by (slow) tracemalloc."""
    tracemalloc.start()
    try:
        before, _ = tracemalloc.get_traced_memory()
        tracemalloc.reset_peak()
        run_lanes([lane], settings, float("inf"))
        return (tracemalloc.get_traced_memory()[1] - before) / 1e6
    finally:
        tracemalloc.stop()


def binned(sweep: Sweep, lane: Lane, edges: Array) -> pd.DataFrame:
    """Return a point for each interval between two `edges` that holds cycles of a lane.

    It has the means of `at`, of `seconds` of an update and of the map's `size`, and the number of `cycles`.
    """
    at = lane.at[: len(lane.seconds)]
    frame = pd.DataFrame({"at": at, "seconds": lane.seconds, "size": lane.sizes})
    bins = np.searchsorted(edges, frame["at"], side="right") - 1
    inside = (bins >= 0) & (bins < len(edges) - 1)
    points = frame[inside].groupby(bins[inside])
    means = points.mean().assign(sweep=sweep, estimator=lane.estimator, cycles=points.size())
    return means[POINT].reset_index(drop=True)


def fit_slope(
    sweep: Sweep, estimator: str, points: pd.DataFrame, fit_from: float = 0.0, stopped: str = ""
) -> dict[str, Any]:
    """Return the power law `seconds ~ at^slope`, a line fitted to the logarithms from `fit_from` on.

    `error` is the standard error of the exponent; both are NaN with too few `points`, from `low` to `high`.
    """
    kept = points[points["at"] >= fit_from].astype({"at": float, "seconds": float})
    slope = error = float("nan")
    if len(kept) > 2:  # two would leave nothing to estimate the error from
        line = linregress(np.log(kept["at"]), np.log(kept["seconds"]))
        slope, error = float(line.slope), float(line.stderr)
    fitted = {"slope": slope, "error": error, "points": len(kept)}
    ends = {"low": float(kept["at"].min()), "high": float(kept["at"].max())}
    return {"sweep": sweep, "estimator": estimator, **fitted, **ends, "stopped": stopped}


def lanes_of(
    sweep: Sweep, drives: Drives, estimators: Sequence[str], settings: ScalingSettings
) -> tuple[list[Lane], Array, float]:
    """Return the lanes of a sweep, the edges of its points' intervals, and where its slope begins."""
    if sweep == CONES:
        low, high = np.log(settings.cones_min), np.log(settings.cones_max + 1.0)
        edges = np.exp(np.linspace(low, high, settings.bins + 1))
        return [Lane(name, drives.cones, drives.seen) for name in estimators], edges, settings.fit_from
    if sweep == LAPS:
        lap = 1.0 + np.searchsorted(drives.lap_ends, [seen.t for seen in drives.laps.cycles])
        edges = np.arange(1.0, len(drives.lap_ends) + 2.0)
        return [Lane(name, drives.laps, lap.astype(float)) for name in estimators], edges, 2.0
    if sweep == DENSE_LINE:
        at = np.full(len(drives.line.cycles), float(LINE_POINTS))
        return [Lane(name, drives.line, at) for name in estimators], np.array([LINE_POINTS, np.inf]), 0.0
    lanes = []
    for wanted, log in drives.readings.items():
        counts = np.array([len(seen.labels) for seen in log.cycles])
        counts[: settings.warm_up] = -1
        at = np.where(counts == wanted, float(wanted), np.nan)
        lanes += [Lane(name, log, at, wanted) for name in estimators]
    return lanes, np.append(np.sort(settings.readings), np.inf), 0.0


def sweep_rows(
    sweep: Sweep,
    estimators: Sequence[str],
    settings: ScalingSettings,
    mapper: MapperSettings,
    drives: Drives,
    on_cycle: Callable[[], None],
) -> list[dict[str, Any]]:
    """Return the points of a sweep, each with its `cycles`, and the slope of each estimator."""
    lanes, edges, fit_from = lanes_of(sweep, drives, estimators, settings)
    run_lanes(lanes, mapper, settings.budget, on_cycle)
    rows: list[dict[str, Any]] = []
    for name in estimators:
        own = [lane for lane in lanes if lane.estimator == name]
        points = _joined([binned(sweep, lane, edges) for lane in own])
        stops = [(lane.readings, lane.stopped) for lane in own if lane.stopped]
        stopped = "; ".join(f"{k} readings: {why}" if k else why for k, why in stops)
        rows += [*points.to_dict("records"), fit_slope(sweep, name, points, fit_from, stopped)]
    return rows


def memory_rows(estimator: str, mapper: MapperSettings, first_lap: Log) -> list[dict[str, Any]]:
    """Return the peak memory (MB) of an estimator on the first lap."""
    return [{"estimator": estimator, "megabytes": peak_memory(Lane(estimator, first_lap), mapper)}]


def _joined(points: Sequence[pd.DataFrame]) -> pd.DataFrame:
    return pd.concat([of for of in points if len(of)] or points[:1], ignore_index=True)
