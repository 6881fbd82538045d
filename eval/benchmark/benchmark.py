"""The online mapper's speed, against GTSAM's own solver and the landmark graph, on the same cycles in one
run.

`python -m pathspace_graph.eval.benchmark --laps 5 --seed 0 --json FILE`, and with `--compare` what got worse
than the committed baseline (exit code 1 then), which `--write-baseline` writes. Only ratios are in it, as
times are the machine's.

What GTSAM is timed on is the mapper's graph after a cycle, with the whole map in it and already linearized,
so that neither linearization nor the building of a graph counts: `optimize()` and `marginal(map, calibration,
next pose)`, once each. It is given its fair best: prior, weak priors and damping come as one Hessian factor;
the window is solved in each of several orderings, finding one beforehand not counted; each call is made once
untimed before it is timed; what is reported is the ordering that was fastest on average in the run. BLAS has
one thread. The ratio is of means over all cycles from the first sample on, with the closing one. The landmark
graph gets every cycle right after the mapper.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Final

import gtsam
import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from pathspace_graph.errors import PathspaceError
from pathspace_graph.estimators import make_online
from pathspace_graph.graph.gaussian import combined, factors_of, graph_of, jacobian_factor
from pathspace_graph.graph.keys import are_poses
from pathspace_graph.graph.variables import Layout
from pathspace_graph.io.files import atomic_file, check_file_target
from pathspace_graph.io.json_file import write_json
from pathspace_graph.io.log import Log
from pathspace_graph.io.results import CycleRecord
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.progress import progress
from pathspace_graph.run import run_online, split_odometry
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track_generator import generate_track

from .baseline import BASELINE, baseline_table, compare, read_baseline, write_baseline
from .metric import Metric

SAMPLE_EVERY: Final = 10
"""GTSAM is timed after every so many cycles."""
WARM_UP: Final = 50
"""Cycles before the first sample: the window is full by then."""
REFERENCE_LAP: Final = 2
"""The first lap that is driven on a closed map; the last lap is compared with it."""
MEAN_RATIO: Final = 2.0
"""Mean cycle at most so many times GTSAM's mean."""
RIVAL: Final = "landmark-fixed-lag"
"""The estimator that gets the same cycles in turn."""
P99_MILLISECONDS: Final = 10.0
"""99th percentile of a cycle, where a mean cycle of 3 ms was measured."""
LAP_RATIO: Final = 1.1
"""Mean cycle of the last lap at most so many times that of lap 2."""
CLOSING_MILLISECONDS: Final = 100.0
"""The cycle that closes the loop."""
WORSE: Final = 1
"""Exit code where a figure is worse than the baseline, ..."""
BAD_INPUT: Final = 2
"""... and where a file can't be read or written."""
MEAN_TOLERANCE: Final = 0.2
"""How much worse than the baseline, as a share of it, a ratio of two means over the whole run may be, ..."""
LAP_TOLERANCE: Final = 0.15
"""... one of two laps' means, ..."""
TAIL_TOLERANCE: Final = 0.5
"""... and one of a tail or of a single cycle."""


# --- GTSAM on the mapper's window ------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class LinearWindow:
    """A window with the whole map, linearized at its estimate, as GTSAM is best given it."""

    graph: gtsam.GaussianFactorGraph
    """A factor a cycle; prior, weak priors and damping in one."""
    layout: Layout
    """Its variables."""


def linear_window(mapper: FixedLagMapper) -> LinearWindow:
    """The window of a mapper between two cycles, which is left as it is."""
    smoother = mapper.smoother
    smoother.refresh()
    factors = factors_of(smoother.linear_graph(whole=True))
    moving = [factor for factor in factors if _is_of_a_cycle(factor)]
    held = [factor for factor in factors if not _is_of_a_cycle(factor)]
    together = combined(graph_of(_damping(mapper), *held))
    return LinearWindow(graph_of(together, *moving), smoother.variables.layout)


def _is_of_a_cycle(factor: gtsam.GaussianFactor) -> bool:
    """Whether a factor is of the rows of a cycle; else it is of the prior or of weak priors."""
    rows = isinstance(factor, gtsam.JacobianFactor)
    return rows and bool(are_poses(np.array(list(factor.keys()), np.intp)).any())


def _damping(mapper: FixedLagMapper) -> gtsam.GaussianFactor:
    """What holds the control points in a step, as a factor."""
    keys, variables = mapper.smoother.map.state.map_keys, mapper.smoother.variables
    now, sigma = variables.change(variables.layout.entries(keys)), mapper.settings.sigma_step
    return jacobian_factor(keys, np.eye(len(now)) / sigma, now / sigma)


def orderings(window: LinearWindow) -> dict[str, gtsam.Ordering | None]:
    """What `optimize` may be given: nothing, COLAMD found beforehand, or poses before what they share."""
    keys = window.layout.keys
    shared = ~are_poses(keys)
    return {
        "no ordering given": None,
        "COLAMD given": gtsam.Ordering.ColamdGaussianFactorGraph(window.graph),
        "poses first": gtsam.Ordering(keys[np.argsort(shared, kind="stable")].tolist()),
    }


def marginal_keys(window: LinearWindow) -> list[int]:
    """What stays of the window when its oldest pose leaves, as far as its marginal reaches."""
    keys = window.layout.keys
    poses = are_poses(keys)
    staying: list[int] = np.append(keys[~poses], keys[poses][1:2]).tolist()
    return staying


def time_gtsam(window: LinearWindow) -> dict[str, tuple[float, float]]:
    """Seconds of (`optimize`, `marginal`), once each, by ordering."""
    graph, staying = window.graph, gtsam.KeyVector(marginal_keys(window))
    marginal = seconds(partial(graph.marginal, staying))
    return {
        name: (seconds(partial(graph.optimize, *(() if ordering is None else (ordering,)))), marginal)
        for name, ordering in orderings(window).items()
    }


def seconds(call: Callable[[], object]) -> float:
    """Wall time of the second of two calls, s."""
    call()
    begin = time.perf_counter()
    call()
    return time.perf_counter() - begin


# --- one run ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Gtsam:
    """GTSAM at its best."""

    candidate: str
    """The ordering that was fastest on average; empty where nothing was sampled."""
    optimize: float
    """Mean of `optimize`, s."""
    marginal: float
    """Mean of `marginal`, s."""
    samples: int
    """Windows that it was timed on."""


@dataclass(frozen=True, eq=False)
class Measurement:
    """What one run gave."""

    cycles: tuple[CycleRecord, ...]
    """Every cycle."""
    laps: int
    """Complete laps."""
    closing: int | None
    """The cycle that closed the loop; None where it stayed open."""
    gtsam: Gtsam
    """What it is held against."""
    rival: tuple[float, ...]
    """Time (s) of each of the landmark graph's updates."""


class _Sampler:
    """Times GTSAM and the landmark graph between cycles, and notes the cycle that closes the loop."""

    def __init__(self, mapper: FixedLagMapper, log: Log, every: int, advance: Callable[[], None]) -> None:
        self._mapper, self._every, self._advance = mapper, every, advance
        self._cycles, self._rival = split_odometry(log), make_online(RIVAL, mapper.settings, log)
        self.rival: list[float] = []
        self._timings: defaultdict[str, list[tuple[float, float]]] = defaultdict(list)
        self.closing: int | None = None

    def __call__(self, record: CycleRecord) -> None:
        if self._mapper.closed and self.closing is None:
            self.closing = record.cycle
        if record.cycle >= WARM_UP and record.cycle % self._every == 0 and self._mapper.boundaries:
            for name, pair in time_gtsam(linear_window(self._mapper)).items():
                self._timings[name].append(pair)
        odometry, detections = next(self._cycles)
        begin = time.perf_counter()
        self._rival.update(odometry, detections)
        self.rival.append(time.perf_counter() - begin)
        self._advance()

    def fastest(self) -> Gtsam:
        """The candidate with the least mean."""
        if not self._timings:
            return Gtsam("", float("nan"), float("nan"), 0)
        best = min(self._timings, key=lambda name: float(np.mean(np.sum(self._timings[name], axis=1))))
        optimize, marginal = np.mean(self._timings[best], axis=0).tolist()
        return Gtsam(best, optimize, marginal, len(self._timings[best]))


def measure(log: Log, settings: MapperSettings, every: int = SAMPLE_EVERY) -> Measurement:
    """Map a log online and time GTSAM on the window after every so many cycles."""
    mapper = FixedLagMapper(settings, log.odometry_sigma)
    with progress("benchmark", len(log.cycles)) as advance:
        sampler = _Sampler(mapper, log, every, advance)
        result = run_online(log, mapper, on_cycle=sampler)
    fastest = sampler.fastest()
    return Measurement(result.cycles, result.laps, sampler.closing, fastest, tuple(sampler.rival))


def metrics(measurement: Measurement) -> tuple[Metric, ...]:
    """Every figure, those that something is asked of first."""
    cycles, best = measurement.cycles, measurement.gtsam
    times = np.array([record.seconds for record in cycles])
    mean, p99 = _mean(times[WARM_UP:]), float(np.quantile(times, 0.99))
    reference, rival = best.optimize + best.marginal, _mean(measurement.rival[WARM_UP:])
    laps = _lap_means(cycles, measurement.laps)
    slowdown = laps[-1] / laps[REFERENCE_LAP - 1] if len(laps) > REFERENCE_LAP else float("nan")
    closing = times[measurement.closing] if measurement.closing is not None else float("nan")
    return (
        Metric("mean_by_gtsam", mean / reference, "", bound=MEAN_RATIO, tolerance=MEAN_TOLERANCE),
        Metric("mean_by_landmark", mean / rival, "", tolerance=MEAN_TOLERANCE),
        Metric("p99", 1e3 * p99, "ms", bound=P99_MILLISECONDS),
        Metric("last_lap_by_lap_2", slowdown, "", bound=LAP_RATIO, tolerance=LAP_TOLERANCE),
        Metric("closing", 1e3 * float(closing), "ms", bound=CLOSING_MILLISECONDS),
        Metric("p99_by_mean", p99 / mean, "", tolerance=TAIL_TOLERANCE),
        Metric("closing_by_mean", float(closing) / mean, "", tolerance=TAIL_TOLERANCE),
        Metric("mean", 1e3 * _mean(times), "ms"),
        Metric("median", 1e3 * float(np.median(times)), "ms"),
        Metric("slowest", 1e3 * float(times.max()), "ms"),
        Metric("landmark", 1e3 * rival, "ms"),
        Metric("gtsam", 1e3 * reference, "ms"),
        Metric("gtsam_optimize", 1e3 * best.optimize, "ms"),
        Metric("gtsam_marginal", 1e3 * best.marginal, "ms"),
        *(Metric(f"mean_lap_{lap}", 1e3 * value, "ms") for lap, value in enumerate(laps, start=1)),
        *(Metric(f"mean_{stage}", 1e3 * value, "ms") for stage, value in _stage_means(cycles).items()),
    )


def _lap_means(cycles: Sequence[CycleRecord], laps: int) -> list[float]:
    """Mean cycle (s) of each complete lap."""
    return [_mean([c.seconds for c in cycles if c.lap == lap]) for lap in range(1, laps + 1)]


def _stage_means(cycles: Sequence[CycleRecord]) -> dict[str, float]:
    """Mean time (s) of each stage of the update."""
    names = dict.fromkeys(name for record in cycles for name in record.stages)
    return {name: _mean([record.stages.get(name, 0.0) for record in cycles]) for name in names}


def _mean(values: Iterable[float]) -> float:
    array = np.asarray(list(values))
    return float(array.mean()) if len(array) else float("nan")


# --- command ---------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Benchmark:
    """Time the online mapper on a generated track of 200 cones, and GTSAM's linear algebra on its windows."""

    laps: int = 5
    """Laps driven."""
    seed: int = 0
    """Of the track, the drive and its noise."""
    json: Path | None = None
    """File to write the figures to."""
    compare: bool = False
    """Say what is worse than the baseline by more than its tolerance; exit code 1 where anything is."""
    write_baseline: bool = False
    """Make this run's ratios the baseline."""
    baseline: Path = BASELINE
    """The baseline's file: the one that comes with the package where none is named."""

    def check(self) -> None:
        """Before anything runs: OutputError or InputError where a file can't be written or read."""
        for file in (self.json, self.baseline if self.write_baseline else None):
            if file is not None:
                check_file_target(file)
        if self.compare:
            read_baseline(self.baseline)

    def measure(self) -> Measurement:
        """The run."""
        track = generate_track(np.random.default_rng(self.seed))
        log = simulate(track, SimulationSettings(laps=self.laps), self.seed)
        return measure(log, MapperSettings())


def rich_table(figures: Iterable[Metric]) -> Table:
    """For a terminal: each figure beside what is asked of it."""
    table = Table("figure")
    for name in ("value", "unit", "asked"):
        table.add_column(name, justify="right")
    for metric in figures:
        style = None if metric.holds else "red"
        table.add_row(metric.key, f"{metric.value:.3g}", metric.unit, _asked(metric), style=style)
    return table


def _asked(metric: Metric) -> str:
    if metric.bound is None:
        return ""
    return f"{'<=' if metric.direction == 'lower' else '>='} {metric.bound:g}"


def main() -> None:
    """The script: exit code 1 where a figure is worse than the baseline, 2 on bad files."""
    benchmark = tyro.cli(Benchmark)
    try:
        worse = _run(benchmark)
    except PathspaceError as error:
        Console(stderr=True, soft_wrap=True, highlight=False, markup=False).print(f"benchmark: {error}")
        raise SystemExit(BAD_INPUT) from error
    if worse:
        raise SystemExit(WORSE)


def _run(benchmark: Benchmark) -> bool:
    """Measure, write, report; whether anything is worse than the baseline."""
    benchmark.check()
    measurement = benchmark.measure()
    figures = metrics(measurement)
    if benchmark.json is not None:
        with atomic_file(benchmark.json) as temporary:
            write_json(temporary, [asdict(metric) for metric in figures])
    console = Console(highlight=False)
    console.print(rich_table(figures))
    best = measurement.gtsam
    console.print(f"GTSAM at its best over {best.samples} windows: {best.candidate}")
    found = compare(figures, read_baseline(benchmark.baseline)) if benchmark.compare else ()
    if benchmark.compare:
        console.print(baseline_table(found))
    if benchmark.write_baseline:
        write_baseline(benchmark.baseline, figures)
        console.print(f"baseline written to {benchmark.baseline}", soft_wrap=True)
    return any(comparison.worse for comparison in found)
