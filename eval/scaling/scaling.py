"""Time per update of every estimator against the size of the map, the detections and the laps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.settings.mapper import MapperSettings

from .lanes import Lane, LaneTimes, peak_memory, run_lanes
from .points import CONES, LAPS, READINGS, Point, Scaling, Slope, Sweep, binned, fit_slope, mean_point
from .roads import Drives, first_cycles
from .settings import ScalingSettings

Array = NDArray[np.float64]
Measured = tuple[list[Point], list[Slope]]
"""A sweep gives the points of all estimators and their slopes."""


def measure_scaling(
    estimators: Sequence[str],
    drives: Drives,
    settings: ScalingSettings,
    mapper: MapperSettings | None = None,
    on_cycle: Callable[[], None] = lambda: None,
) -> Scaling:
    """Measures all three sweeps, and the memory; `on_cycle` is called after each cycle of a sweep."""
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
    """Runs the sweeps."""

    estimators: tuple[str, ...]
    drives: Drives
    settings: ScalingSettings
    mapper: MapperSettings
    on_cycle: Callable[[], None]

    def cones(self) -> Measured:
        """Drives the long road; a point is the mean of the cycles with about as many cones seen."""
        low, high = self.settings.cones_min, self.settings.cones_max
        edges: Array = np.exp(np.linspace(np.log(low), np.log(high + 1.0), self.settings.bins + 1))
        lanes = [Lane(name, self.drives.cones) for name in self.estimators]
        found = [(t, binned(CONES, t, self.drives.seen, edges)) for t in self._run(lanes)]
        return _collect(CONES, found, self.settings.fit_from)

    def readings(self) -> Measured:
        """Drives the dense road once for each number of detections."""
        logs = self.drives.readings
        times = self._run([Lane(name, logs[k], k) for name in self.estimators for k in logs])
        points: list[Point] = []
        slopes: list[Slope] = []
        for name in self.estimators:
            own = [t for t in times if t.lane.estimator == name]
            found = [p for t in own for p in self._readings_points(t)]
            stopped = "; ".join(f"{t.lane.variant} readings: {t.stopped}" for t in own if t.stopped)
            points += found
            slopes.append(fit_slope(READINGS, name, found, stopped=stopped))
        return points, slopes

    def _readings_points(self, times: LaneTimes) -> list[Point]:
        """Returns the mean of the cycles after the warm-up that had as many detections as were asked for."""
        cycles = times.lane.log.cycles[: len(times.seconds)]
        detections = np.array([len(cycle.labels) for cycle in cycles], dtype=float)
        counted = (np.arange(len(cycles)) >= self.settings.warm_up) & (detections == times.lane.variant)
        return [mean_point(READINGS, times, detections, counted)] if counted.any() else []

    def laps(self) -> Measured:
        """Drives the closed road; a point is the mean of a lap, and lap 1 is not in the slope."""
        ends, log = self.drives.lap_ends, self.drives.laps
        lap: Array = 1.0 + np.searchsorted(ends, [cycle.t for cycle in log.cycles]).astype(np.float64)
        edges = np.arange(1.0, len(ends) + 2.0)
        times = self._run([Lane(name, log) for name in self.estimators])
        return _collect(LAPS, [(t, binned(LAPS, t, lap, edges)) for t in times], fit_from=2.0)

    def memory(self) -> dict[str, float]:
        """Returns the most memory (MB) that each estimator held in the first lap of the closed road."""
        log = self.drives.laps
        count = int(np.searchsorted([cycle.t for cycle in log.cycles], self.drives.lap_ends[0]))
        first_lap = first_cycles(log, count)
        return {name: peak_memory(Lane(name, first_lap), self.mapper) for name in self.estimators}

    def _run(self, lanes: Sequence[Lane]) -> tuple[LaneTimes, ...]:
        return run_lanes(lanes, self.mapper, self.settings.budget, self.on_cycle)


def _collect(sweep: Sweep, found: Sequence[tuple[LaneTimes, list[Point]]], fit_from: float) -> Measured:
    """Returns the points of all lanes, and the slope of each lane."""
    slopes = [fit_slope(sweep, t.lane.estimator, points, fit_from, t.stopped) for t, points in found]
    return [p for _, points in found for p in points], slopes
