"""Time per update against the size of the map, the readings of an update and the laps, of every estimator."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from pathspace_graph.eval.metrics.summary import lap_times
from pathspace_graph.io.log import Log
from pathspace_graph.settings.mapper import MapperSettings

from .lanes import Lane, LaneTimes, peak_memory, run_lanes
from .points import CONES, LAPS, READINGS, Point, Slope, Sweep, binned, fit_slope, point
from .roads import closed_road, cones_seen, drive_log, first_cycles, open_road, thinned
from .settings import ScalingSettings

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Scaling:
    """Everything measured."""

    settings: ScalingSettings
    """What was asked for."""
    mapper: dict[str, Any]
    """The settings of the estimators, in full."""
    points: tuple[Point, ...]
    """All sweeps, estimator by estimator."""
    slopes: tuple[Slope, ...]
    """Of each sweep and estimator."""
    memory: dict[str, float]
    """Most memory (MB) of Python and numpy while each estimator mapped the first lap."""

    def of(self, sweep: Sweep, estimator: str) -> list[Point]:
        """The points of a sweep of an estimator."""
        return [p for p in self.points if (p.sweep, p.estimator) == (sweep, estimator)]

    def slope(self, sweep: Sweep, estimator: str) -> Slope:
        """The slope of a sweep of an estimator."""
        return next(s for s in self.slopes if (s.sweep, s.estimator) == (sweep, estimator))

    @property
    def estimators(self) -> tuple[str, ...]:
        """Their names, in order."""
        return tuple(self.memory)

    def seconds_at(self, cones: float, estimator: str) -> float:
        """Mean update (s) at so many cones, between the points; NaN beyond them."""
        points = self.of(CONES, estimator)
        if not points:
            return float("nan")
        at, seconds = np.log([p.at for p in points]), np.log([p.seconds for p in points])
        return float(np.exp(np.interp(np.log(cones), at, seconds, left=np.nan, right=np.nan)))

    def frame(self) -> pd.DataFrame:
        """A row per point."""
        return pd.DataFrame([asdict(point) for point in self.points])


@dataclass(frozen=True, eq=False)
class Drives:
    """The logs that are driven, by what is varied on them."""

    cones: Log
    """A long road, up to the cycle that the last cone asked for is seen in."""
    seen: Array
    """Cones seen by the end of each cycle (n,)."""
    readings: dict[int, Log]
    """A short dense road, by the number of readings of a cycle."""
    laps: Log
    """Laps of a closed road."""
    lap_ends: Array
    """When each of them ends (m,), s."""

    @property
    def cycles(self) -> int:
        """Of all three together."""
        dense = max(len(log.cycles) for log in self.readings.values())
        return len(self.cones.cycles) + dense + len(self.laps.cycles)


def make_drives(settings: ScalingSettings) -> Drives:
    """Simulate what the estimators are to be timed on."""
    road, seed = settings.road, settings.seed
    long = drive_log(open_road(int(settings.cones_max), road.gap, road), road, seed)
    seen = cones_seen(long)
    count = int(np.searchsorted(seen, settings.cones_max)) + 1
    dense = drive_log(open_road(settings.readings_cones, road.dense_gap, road), road, seed, dense=True)
    rng = np.random.default_rng(seed)
    laps = drive_log(closed_road(settings.laps_cones, road), road, seed, settings.laps)
    return Drives(
        cones=first_cycles(long, count),
        seen=seen[:count].astype(float),
        readings={k: thinned(dense, k, rng) for k in settings.readings},
        laps=laps,
        lap_ends=lap_times(laps),
    )


def measure_scaling(
    estimators: Sequence[str],
    drives: Drives,
    settings: ScalingSettings,
    mapper: MapperSettings | None = None,
    on_cycle: Callable[[], None] = lambda: None,
) -> Scaling:
    """All three sweeps, and the memory; `on_cycle` is called after each cycle of a sweep."""
    measure = _Measure(tuple(estimators), drives, settings, mapper or MapperSettings(), on_cycle)
    sweeps = (measure.cones(), measure.readings(), measure.laps())
    return Scaling(
        settings=settings,
        mapper=asdict(measure.mapper),
        points=tuple(p for points, _ in sweeps for p in points),
        slopes=tuple(s for _, slopes in sweeps for s in slopes),
        memory=measure.memory(),
    )


@dataclass(frozen=True, eq=False)
class _Measure:
    """The sweeps; each gives its points and its slopes."""

    estimators: tuple[str, ...]
    drives: Drives
    settings: ScalingSettings
    mapper: MapperSettings
    on_cycle: Callable[[], None]

    def cones(self) -> tuple[list[Point], list[Slope]]:
        low, high = self.settings.cones_min, self.settings.cones_max
        edges: Array = np.exp(np.linspace(np.log(low), np.log(high + 1.0), self.settings.bins + 1))
        lanes = [Lane(name, self.drives.cones) for name in self.estimators]
        found = [(t, binned(CONES, t, self.drives.seen, edges)) for t in self._run(lanes)]
        return _collect(CONES, found, self.settings.fit_from)

    def readings(self) -> tuple[list[Point], list[Slope]]:
        logs = self.drives.readings
        times = self._run([Lane(name, logs[k], k) for name in self.estimators for k in logs])
        points: list[Point] = []
        slopes: list[Slope] = []
        for name in self.estimators:
            own = [t for t in times if t.lane.estimator == name]
            found = [p for t in own for p in self._reading_points(t)]
            stopped = "; ".join(f"{t.lane.variant} readings: {t.stopped}" for t in own if t.stopped)
            points += found
            slopes.append(fit_slope(READINGS, name, found, stopped=stopped))
        return points, slopes

    def _reading_points(self, times: LaneTimes) -> list[Point]:
        """The mean of the cycles that had as many readings as were asked for, once warm."""
        cycles = times.lane.log.cycles[: len(times.seconds)]
        used = np.array([len(cycle.labels) for cycle in cycles], dtype=float)
        counted = (np.arange(len(cycles)) >= self.settings.warm_up) & (used == times.lane.variant)
        return [point(READINGS, times, used, counted)] if counted.any() else []

    def laps(self) -> tuple[list[Point], list[Slope]]:
        drives = self.drives
        lap = (
            np.searchsorted(drives.lap_ends, [cycle.t for cycle in drives.laps.cycles]).astype(np.float64)
            + 1.0
        )
        edges = np.arange(1.0, len(drives.lap_ends) + 2.0)
        lanes = [Lane(name, drives.laps) for name in self.estimators]
        found = [(t, binned(LAPS, t, lap, edges)) for t in self._run(lanes)]
        return _collect(LAPS, found, fit_from=2.0)

    def memory(self) -> dict[str, float]:
        """Of the first lap."""
        count = int(np.searchsorted([cycle.t for cycle in self.drives.laps.cycles], self.drives.lap_ends[0]))
        lap = first_cycles(self.drives.laps, count)
        return {name: peak_memory(Lane(name, lap), self.mapper) for name in self.estimators}

    def _run(self, lanes: Sequence[Lane]) -> tuple[LaneTimes, ...]:
        return run_lanes(lanes, self.mapper, self.settings.budget, self.on_cycle)


def _collect(
    sweep: Sweep, found: Sequence[tuple[LaneTimes, list[Point]]], fit_from: float
) -> tuple[list[Point], list[Slope]]:
    """All points, and the slope of each lane."""
    slopes = [fit_slope(sweep, t.lane.estimator, points, fit_from, t.stopped) for t, points in found]
    return [p for _, points in found for p in points], slopes
