"""One run of the mapper, timed beside the landmark graph and GTSAM's ISAM2, and the figures of it.

Both get every cycle right after the mapper. BLAS has one thread. All times but that of the batch are
processor times of the thread, so that other work on the machine hardly changes them. From closing until the
map is replaced by one that was solved as a batch, the cycles come as they do in a car, since another process
solves meanwhile. Only ratios are in the committed baseline, since times depend on the machine.
"""

import math
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import gtsam
import numpy as np
from rich.table import Table

from pathspace_graph.console import progress
from pathspace_graph.errors import InputError, SettingsError
from pathspace_graph.estimators import make_online
from pathspace_graph.eval.metrics.measures import stage_times
from pathspace_graph.eval.metrics.summary import versions
from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.noise import ray_sigmas
from pathspace_graph.factors.se2 import compose, to_map
from pathspace_graph.io.files import atomic_file, write_json
from pathspace_graph.io.log import Detections, Log, Odometry
from pathspace_graph.io.parsing import read_json
from pathspace_graph.io.results import CycleRecord
from pathspace_graph.mapping.motion import integrate_odometry
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.run import ObservedCycle, run_online, split_odometry, timed_update
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track_generator import generate_track

FORMAT: Final = "pathspace-benchmark-baseline/1"
BASELINE: Final = Path(__file__).with_name("baseline.json")
AHEAD: Final = 20.0
"""Distance ahead (m) at which the track is looked at after every cycle, as a controller does."""
RIVAL: Final = "landmark-fixed-lag"
"""Estimator that gets the same cycles in turn."""
WARM_UP: Final = 50
"""Number of cycles after which the window is full, before which the means do not begin."""
REFERENCE_LAP: Final = 2
"""Lap that the last one is compared with, the first on a closed map."""
BOUNDS: Final = {
    "p99": 10.0,  # a mean cycle of 3 ms was measured when it was chosen
    "last_lap_by_lap_2": 1.1,
    "closing": 100.0,
    "meanwhile_by_before": 1.1,
    "solve": 1.5,
    "swap": 100.0,
    "ahead_open": 1.0,
    "ahead_closed": 1.0,
}
"""Largest value allowed of a figure, in its unit."""
TOLERANCES: Final = {
    # two means over the whole run
    **dict.fromkeys(("mean_by_landmark", "mean_by_isam2"), 0.2),
    "last_lap_by_lap_2": 0.15,
    **dict.fromkeys(("p99_by_mean", "closing_by_mean"), 0.5),  # tails, single cycles
}
"""Share by which a ratio may be larger than its baseline; those of the solver's delay have none."""


# --- figures and their baseline --------------------------------------------------------------------------


@dataclass(frozen=True)
class Metric:
    """One figure of a run, of which less is better."""

    key: str
    """Name of the figure, also in a baseline."""
    value: float
    """Value; NaN where the run was too short for the figure."""
    unit: str
    """Unit of the value; empty for a ratio."""
    bound: float | None = None
    """Largest value allowed, if any value is not."""
    tolerance: float | None = None
    """Share by which the figure may be larger than its baseline, if there is one."""

    @property
    def holds(self) -> bool:
        """Whether the bound is kept; an unknown value keeps none."""
        return self.bound is None or self.value <= self.bound

    def worse_than(self, baseline: float | None) -> bool:
        """Return whether the figure is larger than the baseline by more than its tolerance, or unknown."""
        return baseline is not None and not self.value <= baseline * (1.0 + (self.tolerance or 0.0))


Compared = tuple[Metric, float | None]
"""A figure of this run, and that of the baseline."""


def ratios(figures: Iterable[Metric]) -> dict[str, Metric]:
    """Return the figures that have a baseline, by their names: ratios with a tolerance."""
    return {m.key: m for m in figures if not m.unit and m.tolerance is not None}


def compare(figures: Iterable[Metric], baseline: Mapping[str, float]) -> list[Compared]:
    """Return every figure that has a baseline or should; one that the run lacks is unknown."""
    known = ratios(figures)
    return [
        (known.get(key, Metric(key, math.nan, "")), baseline.get(key))
        for key in dict.fromkeys([*known, *baseline])
    ]


def write_baseline(file: Path, figures: Iterable[Metric]) -> None:
    """Write this run's ratios; raise SettingsError where one isn't known because the run is too short."""
    chosen = {key: round(metric.value, 4) for key, metric in ratios(figures).items()}
    for key, value in chosen.items():
        if not math.isfinite(value):
            raise SettingsError(f"--write-baseline: expected a figure for {key}, found none")
    with atomic_file(file) as temporary:
        write_json(temporary, {"format": FORMAT, "versions": versions(), "ratios": chosen})


def read_baseline(file: Path) -> dict[str, float]:
    """Return the ratios by name; raise InputError where the file isn't a baseline."""
    content = read_json(file, "a baseline (--write-baseline makes one)")
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise InputError(file, f'expected "format": "{FORMAT}"')
    entries = content.get("ratios")
    if not isinstance(entries, dict) or not all(type(value) in (int, float) for value in entries.values()):
        raise InputError(file, 'expected "ratios": an object of numbers')
    return entries


def metrics_table(figures: Iterable[Metric]) -> Table:
    """Return a table for a terminal: each figure beside its bound."""
    table = _table("figure", "value", "unit", "bound")
    for metric in figures:
        bound = "" if metric.bound is None else f"<= {metric.bound:g}"
        style = None if metric.holds else "red"
        table.add_row(metric.key, f"{metric.value:.3g}", metric.unit, bound, style=style)
    return table


def baseline_table(compared: Sequence[Compared]) -> Table:
    """Return a table for a terminal, where figures that are worse are marked in words and in red."""
    table = _table("ratio", "baseline", "now", "change", "tolerance", "", title="against the baseline")
    for metric, before in compared:
        worse = metric.worse_than(before)
        table.add_row(
            metric.key,
            "-" if before is None else f"{before:.3g}",
            f"{metric.value:.3g}",
            f"{100 * (metric.value / before - 1.0):+.0f} %"
            if before and math.isfinite(metric.value)
            else "-",
            f"{100 * (metric.tolerance or 0.0):.0f} %",
            "WORSE" if worse else ("new" if before is None else "ok"),
            style="red" if worse else None,
        )
    return table


def _table(name: str, *numbers: str, title: str | None = None) -> Table:
    table = Table(name, title=title, title_justify="left")
    for number in numbers:
        table.add_column(number, justify="right")
    return table


# --- ISAM2 on landmarks ----------------------------------------------------------------------------------


FIRST_POSE: tuple[float, float, float] = (1e-3, 1e-3, 1e-4)
"""Standard deviations (m, m, rad) of the first pose, at the origin."""


class ToldLandmarks:
    """GTSAM's ISAM2 over the cycles of a log whose associations are known.

    It is what a user would write instead of the mapper: a pose for each cycle, a point for each cone,
    odometry factors between poses, and a bearing-range factor for each detection. All factors are GTSAM's
    own, in C++; its parameters are the defaults. `update` and the newest pose are timed; building the graph
    is not.
    """

    def __init__(self, log: Log) -> None:
        """Begin before the first cycle; ValueError where the log has no associations."""
        if log.truth is None or log.truth.associations is None:
            raise ValueError("expected a simulated log, whose associations are known, found one without")
        self.isam = gtsam.ISAM2()
        self._cycles: Iterator[tuple[Odometry, Detections]] = split_odometry(log)
        ends = np.cumsum([len(cycle.labels) for cycle in log.cycles])
        self._cones: Iterator[IntArray] = iter(np.split(log.truth.associations, ends[:-1]))
        self._sigma = log.odometry_sigma
        self._pose: Array = np.zeros(3)
        self._count = 0
        self._seen: set[int] = set()

    def advance(self) -> float:
        """Take the next cycle; return the processor time (s) of its update."""
        odometry, detections = next(self._cycles)
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        key = gtsam.symbol("x", self._count)
        self._add_pose(graph, odometry, detections.t)
        values.insert(key, gtsam.Pose2(*self._pose))
        self._add_detections(graph, values, detections, next(self._cones))
        begin = time.thread_time()
        self.isam.update(graph, values)
        newest = self.isam.calculateEstimatePose2(key)
        seconds = time.thread_time() - begin
        self._pose = np.array([newest.x(), newest.y(), newest.theta()])
        self._count += 1
        return seconds

    def landmarks(self) -> dict[int, Array]:
        """Return the points (2,) of the landmarks (m), map frame, by the number of their cone."""
        estimate = self.isam.calculateEstimate()
        return {cone: estimate.atPoint2(gtsam.symbol("l", cone)) for cone in sorted(self._seen)}

    def _add_pose(self, graph: gtsam.NonlinearFactorGraph, odometry: Odometry, t: float) -> None:
        key = gtsam.symbol("x", self._count)
        if self._count == 0:
            known = gtsam.noiseModel.Diagonal.Sigmas(np.array(FIRST_POSE))
            graph.add(gtsam.PriorFactorPose2(key, gtsam.Pose2(), known))
            return
        motion = integrate_odometry(odometry, t, self._sigma)
        noise = gtsam.noiseModel.Gaussian.Covariance(motion.covariance)
        graph.add(gtsam.BetweenFactorPose2(key - 1, key, gtsam.Pose2(*motion.delta), noise))
        self._pose = compose(self._pose, motion.delta)

    def _add_detections(
        self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, detections: Detections, cones: IntArray
    ) -> None:
        """Add bearing and range of each detection of a cone; false positives are left out."""
        points, key = detections.points_vehicle, gtsam.symbol("x", self._count)
        ranges = np.hypot(*points.T)
        along, across = ray_sigmas(points, detections.covariances).T
        sigmas = np.stack([across / ranges, along], axis=1)
        points_map = to_map(points, self._pose[None])
        for i in np.flatnonzero(cones >= 0).tolist():
            cone = int(cones[i])
            landmark = gtsam.symbol("l", cone)
            if cone not in self._seen:
                self._seen.add(cone)
                values.insert(landmark, points_map[i])
            bearing = gtsam.Rot2.relativeBearing(points[i])
            noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas[i])
            graph.add(gtsam.BearingRangeFactor2D(key, landmark, bearing, ranges[i], noise))


# --- a run ---------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Measurement:
    """Result of one run."""

    cycles: Sequence[CycleRecord]
    """Cycles, with processor times in place of wall times."""
    laps: int
    """Number of complete laps."""
    rival: Sequence[float]
    """Time of each update of the landmark graph (s)."""
    isam2: Sequence[float]
    """Time of each update of ISAM2 (s)."""
    solve: float = math.nan
    """Time of the batch of the open lap in its own process (s)."""
    ahead: Sequence[float] = ()
    """Time of each look at the track ahead (s), after each cycle."""

    @property
    def closing(self) -> int | None:
        """Cycle that closed the loop; None where the loop stayed open."""
        return next((k for k, record in enumerate(self.cycles) if record.closed), None)

    @property
    def swap(self) -> int | None:
        """Last cycle that replaced the map by one that was solved as a batch; None where none did."""
        return max((k for k, record in enumerate(self.cycles) if record.jump is not None), default=None)


def measure_drive(seed: int, laps: int) -> Measurement:
    """Map a simulated drive on a generated track; the seed is that of the track, the drive and its noise."""
    track = generate_track(np.random.default_rng(seed))
    return measure(simulate(track, SimulationSettings(laps=laps), seed), MapperSettings())


def measure(log: Log, settings: MapperSettings) -> Measurement:
    """Map a log online, and give each cycle to the rivals right afterwards."""
    mapper, told = FixedLagMapper(settings, log.odometry_sigma), ToldLandmarks(log)
    rival, cycles = make_online(RIVAL, settings, log), split_odometry(log)
    records, rivals, isam2, ahead = list[CycleRecord](), list[float](), list[float](), list[float]()
    interval = log.cycles[-1].t / len(log.cycles)

    def observe(cycle: ObservedCycle) -> None:
        share = cycle.processor / cycle.seconds
        stages = {name: share * seconds for name, seconds in cycle.record.stages.items()}
        records.append(replace(cycle.record, seconds=cycle.processor, stages=stages))
        so_far = Measurement(records, 0, rivals, isam2)
        # a batch of the lap, which is always shorter than the lag, may be under way in its own process
        if so_far.closing is not None and so_far.swap is None:
            time.sleep(interval if cycle.result.t - records[so_far.closing].t < settings.lag else 0.0)
        begin = time.thread_time()
        mapper.ahead(AHEAD)
        ahead.append(time.thread_time() - begin)
        *_, seconds = timed_update(rival, *next(cycles))
        rivals.append(seconds)
        isam2.append(told.advance())
        advance()

    with progress("benchmark", len(log.cycles)) as advance:
        result = run_online(log, mapper, observers=[observe])
    return Measurement(records, result.laps, rivals, isam2, mapper.lap_seconds, ahead)


def metrics(measurement: Measurement) -> tuple[Metric, ...]:
    """Return every figure; those with a bound come first."""
    return tuple(
        Metric(key, value, unit, bound=BOUNDS.get(key), tolerance=TOLERANCES.get(key))
        for key, value, unit in _figures(measurement)
    )


def _figures(measurement: Measurement) -> Iterator[tuple[str, float, str]]:
    """Yield the key, the value and the unit of each figure."""
    cycles = measurement.cycles
    times = np.array([record.seconds for record in cycles])
    mean, p99 = _mean(times[WARM_UP:]), float(np.quantile(times, 0.99))
    rival = _mean(measurement.rival[WARM_UP:])
    isam2, isam2_p99 = _mean(measurement.isam2[WARM_UP:]), float(np.quantile(measurement.isam2, 0.99))
    laps = [_mean([c.seconds for c in cycles if c.lap == k]) for k in range(1, measurement.laps + 1)]
    closing = float(times[measurement.closing]) if measurement.closing is not None else float("nan")
    yield "mean_by_landmark", mean / rival, ""
    yield "mean_by_isam2", mean / isam2, ""
    yield "p99_by_isam2", p99 / isam2_p99, ""
    yield "p99", 1e3 * p99, "ms"
    yield "last_lap_by_lap_2", laps[-1] / laps[REFERENCE_LAP - 1] if len(laps) > REFERENCE_LAP else np.nan, ""
    yield "closing", 1e3 * closing, "ms"
    yield from _swap_figures(measurement, times)
    yield from _ahead_figures(measurement)
    yield "p99_by_mean", p99 / mean, ""
    yield "closing_by_mean", closing / mean, ""
    milliseconds = {
        "mean": _mean(times),
        "median": float(np.median(times)),
        "slowest": float(times.max()),
        "landmark": rival,
        "isam2": isam2,
        "isam2_p99": isam2_p99,
        **{f"mean_lap_{lap}": value for lap, value in enumerate(laps, start=1)},
        **{f"mean_{stage['stage']}": stage["mean"] for stage in stage_times(cycles)[1:]},
    }
    yield from ((key, 1e3 * seconds, "ms") for key, seconds in milliseconds.items())


def _swap_figures(measurement: Measurement, times: Array) -> Iterator[tuple[str, float, str]]:
    """Yield what it takes to replace the map, where it was replaced."""
    closing, swap = measurement.closing, measurement.swap
    if closing is None or swap is None:
        return
    meanwhile = times[closing + 1 : swap]
    before = times[max(closing - len(meanwhile), 0) : closing]
    yield "meanwhile_by_before", _mean(meanwhile) / _mean(before), ""
    yield "solve", measurement.solve, "s"
    yield "swap", 1e3 * float(times[swap]), "ms"
    yield "meanwhile_by_after", _mean(meanwhile) / _mean(times[swap + 1 :][: len(meanwhile)]), ""


def _ahead_figures(measurement: Measurement) -> Iterator[tuple[str, float, str]]:
    """Yield the median time of a look ahead, on the open map and on the closed one."""
    closed = np.array([record.closed for record in measurement.cycles[: len(measurement.ahead)]], bool)
    times = 1e3 * np.array(measurement.ahead)
    for name, own in (("ahead_open", times[~closed][WARM_UP:]), ("ahead_closed", times[closed])):
        if len(own):
            yield name, float(np.median(own)), "ms"


def _mean(values: Iterable[float]) -> float:
    array = np.asarray(list(values))
    return float(array.mean()) if len(array) else float("nan")
