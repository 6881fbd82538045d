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

from pathspace_graph.console import progress
from pathspace_graph.errors import InputError, SettingsError
from pathspace_graph.estimators import make_online
from pathspace_graph.eval.experiment.tables import TextTable
from pathspace_graph.eval.metrics.accuracy import mean_of
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
AHEAD: Final = 20.0  # distance ahead (m) at which the track is looked at each cycle, as a controller does
RIVAL: Final = "landmark-fixed-lag"  # estimator that gets the same cycles in turn
WARM_UP: Final = 50  # number of cycles after which the window is full, before which the means do not begin
BOUNDS: Final = {  # largest value allowed of a figure, in its unit
    "p99": 10.0,  # a mean cycle of 3 ms was measured when it was chosen
    "last_lap_by_lap_2": 1.1,
    "closing": 100.0,
    "slowest_other": 100.0,
    "meanwhile_by_before": 1.1,
    "solve": 1.5,
    "swap": 100.0,
    "ahead_open": 1.0,
    "ahead_closed": 1.0,
}
TOLERANCES: Final = {  # share by which a ratio may be larger than its baseline
    # two means over the whole run
    **dict.fromkeys(("mean_by_landmark", "mean_by_isam2"), 0.2),
    "last_lap_by_lap_2": 0.15,
    **dict.fromkeys(("p99_by_mean", "closing_by_mean"), 0.5),  # tails, single cycles
}


@dataclass(frozen=True)
class Metric:
    """One figure of a run, of which less is better."""

    key: str
    value: float  # value; NaN where the run was too short for the figure
    unit: str  # unit of the value; empty for a ratio
    bound: float | None = None  # largest value allowed, if any value is not
    tolerance: float | None = None  # share by which it may be larger than its baseline, if there is one

    @property
    def holds(self) -> bool:
        """Whether the bound is kept; an unknown value keeps none."""
        return self.bound is None or self.value <= self.bound

    def worse_than(self, baseline: float | None) -> bool:
        """Return whether the figure is larger than the baseline by more than its tolerance, or unknown."""
        return baseline is not None and not self.value <= baseline * (1.0 + (self.tolerance or 0.0))


Compared = tuple[Metric, float | None]  # a figure of this run, and that of the baseline


def ratios(figures: Iterable[Metric]) -> dict[str, Metric]:
    """Return the figures that have a baseline, by their names: ratios with a tolerance."""
    return {m.key: m for m in figures if not m.unit and m.tolerance is not None}


def compare(figures: Iterable[Metric], baseline: Mapping[str, float]) -> list[Compared]:
    """Return every figure that has a baseline or should; one that the run lacks is unknown."""
    known = ratios(figures)
    keys = dict.fromkeys([*known, *baseline])
    return [(known.get(key, Metric(key, math.nan, "")), baseline.get(key)) for key in keys]


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


def metrics_table(figures: Iterable[Metric]) -> TextTable:
    """Return each figure beside its bound."""
    rows = []
    for metric in figures:
        bound = "" if metric.bound is None else f"{'' if metric.holds else 'NOT '}<= {metric.bound:g}"
        rows.append((metric.key, f"{metric.value:.3g}", metric.unit, bound))
    return TextTable("", ("figure", "value", "unit", "bound"), tuple(rows))


def baseline_table(compared: Sequence[Compared]) -> TextTable:
    """Return each ratio beside its baseline, and which are worse."""
    rows = []
    for metric, before in compared:
        old = "-" if before is None else f"{before:.3g}"
        share = metric.value / before - 1.0 if before else math.nan
        change = f"{100 * share:+.0f} %" if math.isfinite(share) else "-"
        verdict = "WORSE" if metric.worse_than(before) else "new" if before is None else "ok"
        tolerance = f"{100 * (metric.tolerance or 0.0):.0f} %"
        rows.append((metric.key, old, f"{metric.value:.3g}", change, tolerance, verdict))
    header = ("ratio", "baseline", "now", "change", "tolerance", "")
    return TextTable("against the baseline", header, tuple(rows))


class ToldLandmarks:
    """GTSAM's ISAM2 over the cycles of a log whose associations are known, as a user would write it.

    A pose for each cycle, a point for each cone, odometry factors between poses, and a bearing-range factor
    for each detection: all GTSAM's own, in C++, with default parameters. `update` and the newest pose are
    timed; building the graph is not.
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

    def _add_pose(self, graph: gtsam.NonlinearFactorGraph, odometry: Odometry, t: float) -> None:
        key = gtsam.symbol("x", self._count)
        if self._count == 0:
            known = gtsam.noiseModel.Diagonal.Sigmas(np.array([1e-3, 1e-3, 1e-4]))  # the origin of the map
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


@dataclass(frozen=True, eq=False)
class Measurement:
    """Result of one run."""

    cycles: Sequence[CycleRecord]  # cycles, with processor times in place of wall times
    laps: int  # number of complete laps
    rival: Sequence[float]  # time of each update of the landmark graph (s)
    isam2: Sequence[float]  # time of each update of ISAM2 (s)
    solve: float = math.nan  # time of the batch of the open lap in its own process (s)
    ahead: Sequence[float] = ()  # time of each look at the track ahead (s), after each cycle

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


def metrics(run: Measurement) -> tuple[Metric, ...]:
    """Return every figure; those with a bound come first, and those of what did not happen are left out."""
    cycles, times = run.cycles, 1e3 * np.array([record.seconds for record in run.cycles])
    rivals, isam2s, ahead = (1e3 * np.asarray(of, float) for of in (run.rival, run.isam2, run.ahead))
    mean, rival, isam2 = (mean_of(of[WARM_UP:]) for of in (times, rivals, isam2s))
    p99, isam2_p99 = float(np.quantile(times, 0.99)), float(np.quantile(isam2s, 0.99))
    lap = np.array([record.lap for record in cycles])
    laps = [mean_of(times[lap == k]) for k in range(1, run.laps + 1)]
    closing = math.nan if run.closing is None else float(times[run.closing])
    others = np.delete(times, [k for k in (run.closing, run.swap) if k is not None])
    found = {
        "mean_by_landmark": mean / rival,
        "mean_by_isam2": mean / isam2,
        "p99_by_isam2": p99 / isam2_p99,
        "p99": p99,
        "last_lap_by_lap_2": laps[-1] / laps[1] if len(laps) > 2 else math.nan,
        "closing": closing,
        "slowest_other": float(others.max()),
    }
    if run.closing is not None and run.swap is not None:
        meanwhile = times[run.closing + 1 : run.swap]
        before = times[max(run.closing - len(meanwhile), 0) : run.closing]
        found["meanwhile_by_before"] = mean_of(meanwhile) / mean_of(before)
        found |= {"solve": run.solve, "swap": float(times[run.swap])}
        after = times[run.swap + 1 :][: len(meanwhile)]
        found["meanwhile_by_after"] = mean_of(meanwhile) / mean_of(after)
    closed = np.array([record.closed for record in cycles[: len(ahead)]], bool)
    looks = {"ahead_open": ahead[~closed][WARM_UP:], "ahead_closed": ahead[closed]}
    found |= {key: float(np.median(of)) for key, of in looks.items() if len(of)}
    found |= {"p99_by_mean": p99 / mean, "closing_by_mean": closing / mean}
    found |= {"mean": mean_of(times), "median": float(np.median(times))}
    found |= {"landmark": rival, "isam2": isam2, "isam2_p99": isam2_p99}
    found |= {f"mean_lap_{number}": value for number, value in enumerate(laps, start=1)}
    found |= {f"mean_{stage['stage']}": 1e3 * stage["mean"] for stage in stage_times(cycles)[1:]}
    units = {key: "" if "_by_" in key else "s" if key == "solve" else "ms" for key in found}
    return tuple(Metric(k, v, units[k], BOUNDS.get(k), TOLERANCES.get(k)) for k, v in found.items())
