"""One run of the mapper, timed beside GTSAM's elimination and the landmark graph, and the figures of it.

GTSAM's figure is of the ordering that was fastest on average in the run. Ratios are of means over all cycles
from the first sample on, the closing one included. The landmark graph gets every cycle right after the
mapper. BLAS has one thread.

From closing until the map is replaced by one that was solved as a batch, the cycles come as they do in a car,
since another process solves meanwhile.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.estimators import make_online
from pathspace_graph.io.log import Log
from pathspace_graph.io.results import CycleRecord
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.progress import progress
from pathspace_graph.run import ObservedCycle, run_online, split_odometry, timed_update
from pathspace_graph.settings.mapper import MapperSettings

from .gtsam_window import linear_window, time_gtsam
from .metric import Metric

Array = NDArray[np.float64]

AHEAD: Final = 20.0
"""The track is looked at this far ahead (m) after every cycle, as a controller does."""
RIVAL: Final = "landmark-fixed-lag"
"""This estimator gets the same cycles in turn."""
SAMPLE_EVERY: Final = 10
"""GTSAM is timed after every tenth cycle."""
WARM_UP: Final = 50
"""The first sample comes after this many cycles, when the window is full."""
REFERENCE_LAP: Final = 2
"""The last lap is compared with this one, the first that is driven on a closed map."""

MEAN_RATIO: Final = 2.0
"""A mean cycle takes at most this many times GTSAM's mean."""
P99_MILLISECONDS: Final = 10.0
"""The 99th percentile of a cycle is at most this; a mean cycle of 3 ms was measured when it was chosen."""
LAP_RATIO: Final = 1.1
"""A mean cycle of the last lap takes at most this many times that of lap 2."""
CLOSING_MILLISECONDS: Final = 100.0
"""The cycle that closes the loop takes at most this."""
MEANWHILE_RATIO: Final = 1.1
"""While the batch of the lap is being solved, a mean cycle takes at most this many times one before it."""
SOLVE_SECONDS: Final = 1.5
"""The batch of the lap takes at most this time (s) in its own process."""
SWAP_MILLISECONDS: Final = 100.0
"""The cycle that replaces the map takes at most this."""
AHEAD_MILLISECONDS: Final = 1.0
"""A look at the track ahead takes at most this at the median."""

MEAN_TOLERANCE: Final = 0.2
"""A ratio of two means over the whole run may be worse than its baseline by this share."""
LAP_TOLERANCE: Final = 0.15
"""A ratio of two laps' means may be worse than its baseline by this share."""
TAIL_TOLERANCE: Final = 0.5
"""A ratio of a tail or of a single cycle may be worse than its baseline by this share."""


@dataclass(frozen=True)
class Gtsam:
    """Holds GTSAM's times in its fastest ordering."""

    ordering: str
    """This ordering was fastest on average; it is empty where nothing was sampled."""
    optimize: float
    """This is the mean time of `optimize` (s)."""
    marginal: float
    """This is the mean time of `marginal` (s)."""
    samples: int
    """GTSAM was timed on this many windows."""


@dataclass(frozen=True, eq=False)
class Measurement:
    """Holds what one run gave."""

    cycles: tuple[CycleRecord, ...]
    """These are the mapper's cycles."""
    laps: int
    """The run has this many complete laps."""
    closing: int | None
    """This cycle closed the loop; it is None where the loop stayed open."""
    gtsam: Gtsam
    """These are GTSAM's times."""
    rival: tuple[float, ...]
    """Each update of the landmark graph took this time (s)."""
    swap: int | None = None
    """This cycle replaced the map by one that was solved as a batch; it is None where none did."""
    solve: float = float("nan")
    """That batch took this time (s) in its own process."""
    ahead: tuple[float, ...] = ()
    """Each look at the track ahead took this time (s), after each cycle."""


class _Sampler:
    """Times GTSAM and the landmark graph between cycles, and notes the cycle that closes the loop."""

    def __init__(self, mapper: FixedLagMapper, log: Log, every: int, advance: Callable[[], None]) -> None:
        self._mapper, self._every, self._advance = mapper, every, advance
        self._cycles, self._rival = split_odometry(log), make_online(RIVAL, mapper.settings, log)
        self._timings: defaultdict[str, list[tuple[float, float]]] = defaultdict(list)
        self.rival: list[float] = []
        self.ahead: list[float] = []
        self.closing: ObservedCycle | None = None
        self.swap: ObservedCycle | None = None
        self._interval = log.cycles[-1].t / len(log.cycles)

    def __call__(self, cycle: ObservedCycle) -> None:
        if cycle.result.closed and self.closing is None:
            self.closing = cycle
        if cycle.result.jump is not None:
            self.swap = cycle
        sampled = cycle.number >= WARM_UP and cycle.number % self._every == 0
        if self._solves(cycle):
            time.sleep(self._interval)
        elif sampled and self._mapper.boundaries:
            for ordering, times in time_gtsam(linear_window(self._mapper)).items():
                self._timings[ordering].append(times)
        begin = time.perf_counter()
        self._mapper.ahead(AHEAD)
        self.ahead.append(time.perf_counter() - begin)
        _, seconds = timed_update(self._rival, *next(self._cycles))
        self.rival.append(seconds)
        self._advance()

    def _solves(self, cycle: ObservedCycle) -> bool:
        """Returns whether a batch of the lap may be under way, which is always shorter than the lag."""
        since = np.inf if self.closing is None else cycle.result.t - self.closing.result.t
        return self.swap is None and since < self._mapper.settings.lag

    def fastest(self) -> Gtsam:
        """Returns GTSAM's times in the ordering with the least mean."""
        if not self._timings:
            return Gtsam("", float("nan"), float("nan"), 0)
        best = min(self._timings, key=lambda name: float(np.mean(np.sum(self._timings[name], axis=1))))
        optimize, marginal = np.mean(self._timings[best], axis=0).tolist()
        return Gtsam(best, optimize, marginal, len(self._timings[best]))


def measure(log: Log, settings: MapperSettings, every: int = SAMPLE_EVERY) -> Measurement:
    """Maps a log online, and times GTSAM on the window after every `every`-th cycle."""
    mapper = FixedLagMapper(settings, log.odometry_sigma)
    with progress("benchmark", len(log.cycles)) as advance:
        sampler = _Sampler(mapper, log, every, advance)
        result = run_online(log, mapper, observers=[sampler])
    closing, swap = (None if at is None else at.number for at in (sampler.closing, sampler.swap))
    return Measurement(
        result.cycles,
        result.laps,
        closing,
        sampler.fastest(),
        tuple(sampler.rival),
        swap,
        mapper.lap_seconds,
        tuple(sampler.ahead),
    )


def metrics(measurement: Measurement) -> tuple[Metric, ...]:
    """Returns every figure; those with a bound come first."""
    cycles, best = measurement.cycles, measurement.gtsam
    times = np.array([record.seconds for record in cycles])
    mean, p99 = _mean(times[WARM_UP:]), float(np.quantile(times, 0.99))
    gtsam, rival = best.optimize + best.marginal, _mean(measurement.rival[WARM_UP:])
    laps = _lap_means(cycles, measurement.laps)
    slowdown = laps[-1] / laps[REFERENCE_LAP - 1] if len(laps) > REFERENCE_LAP else float("nan")
    closing = float(times[measurement.closing]) if measurement.closing is not None else float("nan")
    return (
        Metric("mean_by_gtsam", mean / gtsam, "", bound=MEAN_RATIO, tolerance=MEAN_TOLERANCE),
        Metric("mean_by_landmark", mean / rival, "", tolerance=MEAN_TOLERANCE),
        Metric("p99", 1e3 * p99, "ms", bound=P99_MILLISECONDS),
        Metric("last_lap_by_lap_2", slowdown, "", bound=LAP_RATIO, tolerance=LAP_TOLERANCE),
        Metric("closing", 1e3 * closing, "ms", bound=CLOSING_MILLISECONDS),
        *_swap_metrics(measurement, times),
        *_ahead_metrics(measurement),
        Metric("p99_by_mean", p99 / mean, "", tolerance=TAIL_TOLERANCE),
        Metric("closing_by_mean", closing / mean, "", tolerance=TAIL_TOLERANCE),
        Metric("mean", 1e3 * _mean(times), "ms"),
        Metric("median", 1e3 * float(np.median(times)), "ms"),
        Metric("slowest", 1e3 * float(times.max()), "ms"),
        Metric("landmark", 1e3 * rival, "ms"),
        Metric("gtsam", 1e3 * gtsam, "ms"),
        Metric("gtsam_optimize", 1e3 * best.optimize, "ms"),
        Metric("gtsam_marginal", 1e3 * best.marginal, "ms"),
        *(Metric(f"mean_lap_{lap}", 1e3 * value, "ms") for lap, value in enumerate(laps, start=1)),
        *(Metric(f"mean_{stage}", 1e3 * value, "ms") for stage, value in _stage_means(cycles).items()),
    )


def _swap_metrics(measurement: Measurement, times: Array) -> Iterator[Metric]:
    """Yields what it takes to replace the map, where it was replaced."""
    closing, swap = measurement.closing, measurement.swap
    if closing is None or swap is None:
        return
    meanwhile = times[closing + 1 : swap]
    before = times[max(closing - len(meanwhile), 0) : closing]
    ratio = _mean(meanwhile) / _mean(before)
    yield Metric("meanwhile_by_before", ratio, "", bound=MEANWHILE_RATIO, tolerance=TAIL_TOLERANCE)
    yield Metric("solve", measurement.solve, "s", bound=SOLVE_SECONDS)
    yield Metric("swap", 1e3 * float(times[swap]), "ms", bound=SWAP_MILLISECONDS)
    yield Metric("meanwhile_by_after", _mean(meanwhile) / _mean(times[swap + 1 :][: len(meanwhile)]), "")


def _ahead_metrics(measurement: Measurement) -> Iterator[Metric]:
    """Yields the median time of a look ahead, on the open map and on the closed one."""
    closed = np.array([record.closed for record in measurement.cycles[: len(measurement.ahead)]], bool)
    times = 1e3 * np.array(measurement.ahead)
    for name, own in (("ahead_open", times[~closed][WARM_UP:]), ("ahead_closed", times[closed])):
        if len(own):
            yield Metric(name, float(np.median(own)), "ms", bound=AHEAD_MILLISECONDS)


def _lap_means(cycles: Sequence[CycleRecord], laps: int) -> list[float]:
    """Returns the mean time (s) of a cycle in each complete lap."""
    return [_mean([c.seconds for c in cycles if c.lap == lap]) for lap in range(1, laps + 1)]


def _stage_means(cycles: Sequence[CycleRecord]) -> dict[str, float]:
    """Returns the mean time (s) of each stage of the update."""
    names = dict.fromkeys(name for record in cycles for name in record.stages)
    return {name: _mean([record.stages.get(name, 0.0) for record in cycles]) for name in names}


def _mean(values: Iterable[float]) -> float:
    """Returns the mean, or NaN where there are no values."""
    array = np.asarray(list(values))
    return float(array.mean()) if len(array) else float("nan")
