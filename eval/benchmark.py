"""The mapper's speed: beside GTSAM's ISAM2, its slowest cycles and why, and against map size and detections.

Estimators get every cycle in turn, in one process with one BLAS thread, so that what slows the machine down
slows all alike. All times but that of the batch of the open lap are processor times of the thread.
"""

import cProfile
import gc
import math
import os
import re
import shutil
import signal
import subprocess
import tempfile
import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, replace
from itertools import cycle
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Final

import gtsam
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from scipy.stats import linregress
from threadpoolctl import threadpool_limits

from pathspace_graph.console import progress
from pathspace_graph.estimators import DEFAULT_BATCH, make_batch, make_online, module_of, settings_of
from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.noise import ray_sigmas
from pathspace_graph.factors.se2 import compose, left_of, to_map
from pathspace_graph.front_end.noise import NoiseLearner
from pathspace_graph.io.files import atomic_folder, write_json
from pathspace_graph.io.log import Detections, Log, Odometry
from pathspace_graph.io.log_files import read_log
from pathspace_graph.loop.closed import Search
from pathspace_graph.loop.closing import fix_gauge
from pathspace_graph.loop.drive import Drive
from pathspace_graph.loop.open import ReturnFinder, Revisits
from pathspace_graph.mapping.growth import Growth
from pathspace_graph.mapping.motion import integrate_odometry
from pathspace_graph.mapping.road import Road
from pathspace_graph.mapping.smoother import CurveSmoother
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.run import (
    ObservedCycle,
    run_online,
    spared_by_collector,
    split_odometry,
    timed_update,
    timed_wait,
)
from pathspace_graph.settings.mapper import CONES_MIN, MapperSettings, ScalingSettings
from pathspace_graph.sim.sensor import LineSettings, SensorSettings
from pathspace_graph.sim.simulate import SimulationSettings, preset, simulate
from pathspace_graph.sim.track import Track, along_polyline, arc_lengths, unit
from pathspace_graph.sim.track_generator import generate_track
from pathspace_graph.sim.vehicle import VehicleSettings

from .experiment.run import code_from, rows_of
from .experiment.tables import TextTable, by_metric, write_csv
from .figures import drawing
from .metrics.accuracy import mean_of
from .metrics.measures import UNKNOWN, Metric, figure, figures, lap_times, versions

# --- beside ISAM2 ----------------------------------------------------------------------------------------

RIVAL: Final = "landmark-fixed-lag"  # estimator that gets the same cycles in turn, and stands in the demo
WARM_UP: Final = 50  # number of cycles after which the window is full, before which the means do not begin
SPEED: Final = (  # of a drive
    Metric("mean_by_isam2", "mean update relative to iSAM2 with known data association", digits=2),
    Metric("p99_by_isam2", "99th percentile relative to that iSAM2", digits=2),
    Metric("mean_by_landmark", "mean update relative to landmark-fixed-lag", digits=2),
    Metric("mean", "mean update", "ms", 1),
    Metric("p99", "99th percentile of an update", "ms", 1),
    Metric("closing", "update that closes the loop", "ms", 1),
    Metric("swap", "update that swaps the map", "ms", 1),
    Metric("slowest_other", "slowest of all other updates", "ms", 1),
    Metric("solve", "batch of the open lap, in its own process", "s", 1),
    Metric("batch", "the whole drive as a batch", "s", 1),
)


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
        ends = np.cumsum([len(seen.labels) for seen in log.cycles])
        self._cones: Iterator[IntArray] = iter(np.split(log.truth.associations, ends[:-1]))
        self._sigma = log.odometry_sigma
        self._pose: Array = np.zeros(3)
        self._count = 0
        self._seen: set[int] = set()

    def advance(self) -> float:
        """Take the next cycle; return the processor time (s) of its update. False positives are left out."""
        odometry, detections = next(self._cycles)
        cones, graph, values = next(self._cones), gtsam.NonlinearFactorGraph(), gtsam.Values()
        key, noises = gtsam.symbol("x", self._count), gtsam.noiseModel
        if self._count == 0:
            known = noises.Diagonal.Sigmas(np.array([1e-3, 1e-3, 1e-4]))  # the origin of the map
            graph.add(gtsam.PriorFactorPose2(key, gtsam.Pose2(), known))
        else:
            motion = integrate_odometry(odometry, detections.t, self._sigma)
            noise = noises.Gaussian.Covariance(motion.covariance)
            graph.add(gtsam.BetweenFactorPose2(key - 1, key, gtsam.Pose2(*motion.delta), noise))
            self._pose = compose(self._pose, motion.delta)
        values.insert(key, gtsam.Pose2(*self._pose))
        points = detections.points_vehicle
        ranges, points_map = np.hypot(*points.T), to_map(points, self._pose[None])
        along, across = ray_sigmas(points, detections.covariances).T
        for i in np.flatnonzero(cones >= 0).tolist():
            cone = int(cones[i])
            landmark = gtsam.symbol("l", cone)
            if cone not in self._seen:
                self._seen.add(cone)
                values.insert(landmark, points_map[i])
            bearing = gtsam.Rot2.relativeBearing(points[i])
            noise = noises.Diagonal.Sigmas(np.array([across[i] / ranges[i], along[i]]))
            graph.add(gtsam.BearingRangeFactor2D(key, landmark, bearing, ranges[i], noise))
        begin = time.thread_time()
        self.isam.update(graph, values)
        newest = self.isam.calculateEstimatePose2(key)
        seconds = time.thread_time() - begin
        self._pose = np.array([newest.x(), newest.y(), newest.theta()])
        self._count += 1
        return seconds


def speed_on(log: Log, settings: MapperSettings) -> dict[str, float]:
    """Map a log online, and give each cycle to the rivals right afterwards; return the figures of `SPEED`.

    From closing until the map is replaced by one that was solved as a batch, the cycles come as they do in a
    car, since another process solves meanwhile. The rival solves its batch in the update that closes, which
    does not count. What the run was too short for is absent.
    """
    mapper, told = FixedLagMapper(settings, log.noise), ToldLandmarks(log)
    rival, cycles = make_online(RIVAL, settings, log), split_odometry(log)
    ours, rivals, isam2, at = list[float](), list[float](), list[float](), dict[str, int]()
    rival_closed = False
    interval, closed_at = log.cycles[-1].t / len(log.cycles), math.inf

    def observe(observed: ObservedCycle) -> None:
        nonlocal closed_at, rival_closed
        ours.append(1e3 * observed.processor)
        if observed.result.closed and "closing" not in at:
            at["closing"], closed_at = len(ours) - 1, observed.result.t
        if observed.record.jump is not None:
            at["swap"] = len(ours) - 1
        # a batch of the lap, which is always shorter than the lag, may be under way in its own process
        if "swap" not in at and 0.0 <= observed.result.t - closed_at < settings.lag:
            time.sleep(interval)
        theirs, _, seconds = timed_update(rival, *next(cycles))
        if theirs.closed == rival_closed:
            rivals.append(1e3 * seconds)
        rival_closed = theirs.closed
        isam2.append(1e3 * told.advance())
        advance()

    with progress("benchmark", len(log.cycles)) as advance:
        run_online(log, mapper, observers=[observe])
    p99, p99_isam2 = (float(np.quantile(times, 0.99)) for times in (ours, isam2))
    warm = {name: mean_of(np.array(of[WARM_UP:])) for name, of in (("landmark", rivals), ("isam2", isam2))}
    found = {f"mean_by_{name}": mean_of(np.array(ours[WARM_UP:])) / of for name, of in warm.items()}
    found |= {"p99_by_isam2": p99 / p99_isam2, "mean": float(np.mean(ours)), "p99": p99}
    found["slowest_other"] = float(np.delete(ours, [*at.values()]).max())
    found |= {name: ours[number] for name, number in at.items()} | {"batch": batch_seconds(log, settings)}
    return found | ({"solve": mapper.lap_seconds} if "swap" in at else {})


# --- single drives: the slowest cycle and its cause, libraries, memory, batch -------------------------------

Drives = Mapping[str, tuple[str, int | Path, int]]
"""Kind of each drive by its name, number of the generated track or of cones or folder of a log, and laps."""
DRIVES: Final[Drives] = {
    **{f"track {number}, 5 laps": ("track", number, 5) for number in range(3)},
    "track 0, 300 laps": ("track", 0, 300),
    "road of 1 km": ("road", 400, 1),
    "road of 5 km": ("road", 2000, 1),
    "ring of 1 km, 2 laps": ("ring", 400, 2),
    "ring of 5 km, 2 laps": ("ring", 2000, 2),
}
QUICK_DRIVES: Final[Drives] = {"road of 200 m": ("road", 80, 1), "ring of 200 m, 2 laps": ("ring", 80, 2)}
CAUSES: Final[Mapping[Callable[..., Any], str]] = {
    Drive.take: "swap of the map",
    Drive.begin_batch: "start of a batch",
    fix_gauge: "fixing of the gauge",
    ReturnFinder.find: "search for a place",
    Revisits.find: "search for a place",
    Search.find: "search for a place",
    NoiseLearner.observe: "measurement of the noise",
    Growth.expand: "growth",
    CurveSmoother.deactivate_distant: "choice of the active part of the map",
    Road.classify: "association",
    Road.update: "Gauss-Newton step",
    Road.marginalize: "marginalization",
}
"""What happens in a cycle, by functions of which none calls another."""
LIBRARIES: Final = {  # by a pattern of the shared object and the symbol, the first that fits
    "Python": "python3",
    "kernels": r"^_kernels",
    "BLAS": "blas",
    "GTSAM": "gtsam|metis|boost",
    "numpy": "umath|mtrand|_mt19937|numpy",
    "malloc": r"^libc\..*(alloc|free|chunk|brk)|gnu_cxx|operator (new|delete)",
    "rest": "",
}


def figures_of(kind: str, of: int | Path, laps: int) -> dict[str, Any]:
    """Map a drive online in this process, which should be a new one; return a row of `drives_table`.

    A second run of the same cycles profiles the slowest one; the first cycle does not count. `causes` are the
    shares of its update that `CAUSES` and garbage collection took. `memory` (MB) is the most that the
    process has had, with the log; NaN except on Linux.
    """
    if isinstance(of, Path):
        log = read_log(of)
    elif kind == "track":
        log = simulate(generate_track(np.random.default_rng(of)), SimulationSettings(laps=laps), of)
    else:
        log = fast_drive(open_road(of, GAP) if kind == "road" else closed_road(of), laps)
    settings, profile, slowest = settings_of(MapperSettings(), log), cProfile.Profile(time.thread_time), -1
    collected, begun = [0.0], 0.0

    def collect(phase: str, _: dict[str, int]) -> None:
        nonlocal begun
        now = time.thread_time()
        if phase == "stop":
            collected[-1] += now - begun
        begun = now

    def observe(observed: ObservedCycle) -> None:
        collected.append(0.0)
        if observed.number == slowest - 1:
            profile.enable()
        elif observed.number == slowest:
            profile.disable()

    gc.callbacks.append(collect)
    try:
        with library_shares() as libraries:
            mapper = FixedLagMapper(settings, log.noise)
            run = run_online(log, mapper, observers=[observe], outlines=True)
    finally:
        gc.callbacks.remove(collect)
    status = Path("/proc/self/status")  # `getrusage` has the memory of the parent, where that is more
    peak = re.search(r"VmHWM:\s+(\d+) kB", status.read_text()) if status.exists() else None
    seconds = np.array([record.processor for record in run.cycles])
    slowest = 1 + int(seconds[1:].argmax())
    shares = defaultdict[str, float](float, {"garbage collection": collected[slowest] / seconds[slowest]})
    until = replace(log, cycles=log.cycles[: slowest + 1], truth=None)
    run_online(until, FixedLagMapper(settings, log.noise), observers=[observe], outlines=True)
    took = {entry.code: entry.totaltime for entry in profile.getstats()}
    for function, cause in CAUSES.items():
        shares[cause] += took.get(function.__code__, 0.0) / took[FixedLagMapper.update.__code__]
    stages = run.cycles[slowest].stages
    return {
        "mean": 1e3 * seconds.mean(),
        "p99": 1e3 * np.quantile(seconds, 0.99),
        "slowest": 1e3 * seconds[slowest],
        "stage": max(stages, key=stages.__getitem__),
        "causes": dict(sorted(shares.items(), key=lambda item: -item[1])),
        "memory": 1e-3 * float(peak[1]) if peak else math.nan,
        "libraries": libraries,
        "batch": batch_seconds(log, settings) if laps <= 5 else math.nan,
    }


def batch_seconds(log: Log, settings: MapperSettings) -> float:
    """Solve a whole drive as a batch; return the processor time (s)."""
    begin = time.thread_time()
    make_batch(DEFAULT_BATCH, settings, log).solve(log)
    return time.thread_time() - begin


@contextmanager
def library_shares() -> Iterator[dict[str, float]]:
    """Sample this process with Linux' `perf`; yield the shares of `LIBRARIES`, known at the end.

    Without `perf`, or where it is not permitted, there are none.
    """
    shares, perf = dict[str, float](), shutil.which("perf")
    if perf is None:
        yield shares
        return
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "perf.data"
        command = [perf, "record", "-q", "-F", "499", "-o", str(file), "-p", str(os.getpid())]
        with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as sampler:
            try:
                yield shares
            finally:
                sampler.send_signal(signal.SIGINT)
        command = [perf, "report", "-i", str(file), "--stdio", "-t", ";", "--sort", "dso,symbol"]
        shares |= shares_of(subprocess.run(command, capture_output=True, text=True, check=False).stdout)


def shares_of(report: str) -> dict[str, float]:
    """Add up the lines `12.34%;shared object;[.] symbol` of a report of `perf` to shares of `LIBRARIES`."""
    shares = defaultdict[str, float](float)
    for percent, of in re.findall(r"^ *([\d.]+)% *;(.*)$", report, flags=re.MULTILINE):
        library = next(name for name, pattern in LIBRARIES.items() if re.search(pattern, of))
        shares[library] += float(percent)
    total = sum(shares.values())
    return {name: shares[name] / total for name in LIBRARIES} if shares else {}


def measure_speed(quick: bool, logs: Sequence[Path] = ()) -> dict[str, TextTable]:
    """Time estimators in turn on tracks; then measure single drives, also of logs, each in its own process.

    The tables are that of `SPEED`, `drives` and, with `perf`, `libraries`.
    """
    for folder in logs:
        read_log(folder)  # so that a wrong one is an error now
    beside, rows = list[dict[str, float]](), dict[str, dict[str, Any]]()
    for seed in (0,) if quick else (0, 1, 2):
        laps = SimulationSettings(laps=1 if quick else 5)
        log = simulate(generate_track(np.random.default_rng(seed)), laps, seed)
        beside.append({"track": seed, **speed_on(log, MapperSettings())})
    drives = {**(QUICK_DRIVES if quick else DRIVES), **{folder.name: ("log", folder, 1) for folder in logs}}
    with ProcessPoolExecutor(1, get_context("spawn"), max_tasks_per_child=1) as processes:
        measured = processes.map(figures_of, *zip(*drives.values(), strict=True))
        with progress("single drives", len(drives)) as advance:
            for name in drives:
                rows[name] = next(measured)
                advance()
    found = {"": by_metric({"measured": pd.DataFrame(beside)}, SPEED), "drives": drives_table(rows)}
    shares = {
        name: pd.DataFrame([row["libraries"]]).assign(track=name)
        for name, row in rows.items()
        if row["libraries"]
    }
    titles = [Metric(name, name, "%", 0) for name in LIBRARIES]
    return found | ({"libraries": by_metric(shares, titles)} if shares else {})


def drives_table(rows: Mapping[str, Mapping[str, Any]]) -> TextTable:
    """Return a row for each drive: its updates, the slowest with what took over a fifth, memory, batch."""
    header = ("drive", "mean update [ms]", "p99 [ms]", "slowest [ms]", "stage", "cause", "memory [MB]")
    texts = []
    for name, row in rows.items():
        times = figures([row["mean"], row["p99"], row["slowest"]], 1)
        causes = ", ".join(f"{cause} {share:.0%}" for cause, share in row["causes"].items() if share > 0.2)
        texts.append((name, *times, row["stage"], causes, *figures([row["memory"], row["batch"]], 0, 1)))
    return TextTable.of((*header, "as a batch [s]"), texts)


# --- sweeps ----------------------------------------------------------------------------------------------

CONES, READINGS, LAPS, DENSE_LINE = "cones", "readings", "laps", "line"
"""Varied: cones seen, detections of an update, or lap. On a line, 300 points in each update."""
GAP, DENSE_RANGE = 5.0, 30.0  # distance of cones in a row, and range of a dense sensor (m)
LINE_POINTS: Final = 300  # points of both lines in a cycle, in the mean
ROAD_WIDTH: Final = 4.0  # distance of the rows (m)
STEP: Final = 0.25  # distance of the samples of a road's middle (m)
SEED: Final = 1  # of the drives and of the choice of detections
JUDGED: Final = 10  # number of updates whose mean is compared with the budget
QUICK: Final = ScalingSettings(  # takes less than a minute; its slopes mean little
    cones_max=200.0,
    bins=8,
    fit_from=50.0,
    readings=(2, 8, 20),
    readings_cones=160,
    warm_up=20,
    laps=4,
    laps_cones=60,
    budget=0.1,
)


def fast_drive(track: Track, laps: int = 1, **sensing: Any) -> Log:
    """Simulate a drive at up to 20 m/s."""
    vehicle = VehicleSettings(speed_max=20.0, speed_start=20.0, acceleration_lateral=9.0)
    return simulate(track, SimulationSettings(laps=laps, vehicle=vehicle, **sensing), SEED)


def open_road(cones: int, gap: float) -> Track:
    """Return a winding road that never comes near itself, on which at least `cones` cones can be seen.

    Its heading (rad) is `0.9 sin(2 pi s / 300 m)` at the length s along it; cones are `gap` (m) apart.
    """
    s = np.arange(0.0, 1.1 * cones / 2 * gap, STEP)  # a tenth more, since some are never detected
    heading = 0.9 * np.sin(2 * np.pi * s / 300.0)
    middle = STEP * np.cumsum(np.column_stack([np.cos(heading), np.sin(heading)]), axis=0)
    return _with_rows(middle, gap, closed=False)


def closed_road(cones: int) -> Track:
    """Return a dented circle with about `cones` cones: `r = 1 + 0.12 cos(3 phi)`, scaled."""
    phi = np.linspace(0.0, 2 * np.pi, max(int(cones * GAP / STEP), 100))
    r = 1.0 + 0.12 * np.cos(3 * phi)
    unscaled = r[:, None] * np.column_stack([np.cos(phi), np.sin(phi)])
    return _with_rows(unscaled * (cones / 2 * GAP / arc_lengths(unscaled)[-1]), GAP, closed=True)


def _with_rows(middle: Array, gap: float, closed: bool) -> Track:
    """Return the road with cones on both sides of its middle (n, 2), `gap` (m) apart."""
    tangents = unit(np.gradient(middle, axis=0))
    rows = []
    for side in (0.5, -0.5):
        row = middle + side * ROAD_WIDTH * left_of(tangents)
        s = arc_lengths(row)
        at = np.linspace(0.0, s[-1], max(round(s[-1] / gap), 2), endpoint=not closed)
        rows.append(along_polyline(at, s, row))
    start = np.append(middle[0], np.arctan2(tangents[0, 1], tangents[0, 0]))
    return Track(rows[0], rows[1], np.zeros((0, 2)), closed, start, "road")


def sweep_drives(sweep: str, settings: ScalingSettings) -> list[tuple[Log, Array]]:
    """Simulate the drives of a sweep: logs, and the abscissa (n,) of each cycle, NaN where it does not count.

    A long road as its cones are seen, a short dense one with so many detections of each cycle, or a closed
    one. Numbers of cones are the geometric means of intervals.
    """
    if sweep == CONES:
        log = fast_drive(open_road(int(settings.cones_max), GAP))
        assert log.truth is not None
        assert log.truth.associations is not None
        ends = np.cumsum([len(cycle.labels) for cycle in log.cycles])
        cones, first = np.unique(log.truth.associations, return_index=True)
        seen = np.searchsorted(np.sort(first[cones >= 0]), ends)  # number of cones by the end of each cycle
        edges = np.geomspace(CONES_MIN, settings.cones_max + 1.0, settings.bins + 1)
        middles = np.concatenate([[np.nan], np.sqrt(edges[:-1] * edges[1:]), [np.nan]])
        count = int(np.searchsorted(seen, settings.cones_max)) + 1
        until_seen = replace(log, cycles=log.cycles[:count], truth=None)
        return [(until_seen, middles[np.searchsorted(edges, seen[:count], side="right")])]
    if sweep == READINGS:
        road, rng = open_road(settings.readings_cones, 1.0), np.random.default_rng(SEED)
        dense, drives = (
            fast_drive(road, sensor=SensorSettings(range_max=DENSE_RANGE)),
            list[tuple[Log, Array]](),
        )
        for wanted in settings.readings:
            cycles = list[Detections]()
            for detected in dense.cycles:  # as many at random, or all where there are fewer
                size = len(detected.labels)
                kept = rng.choice(size, min(wanted, size), replace=False)
                cycles.append(detected.where(np.isin(np.arange(size), kept)))
            counts = np.array([len(detected.labels) for detected in cycles])
            counted = (counts == wanted) & (np.arange(len(cycles)) >= settings.warm_up)
            log = replace(dense, cycles=tuple(cycles), truth=None)
            drives.append((log, np.where(counted, float(wanted), np.nan)))
        return drives
    closed = closed_road(settings.laps_cones)
    if sweep == LAPS:
        log = fast_drive(closed, settings.laps)
        lap = 1.0 + np.searchsorted(lap_times(log), [seen.t for seen in log.cycles])
        return [(log, np.where(lap <= settings.laps, lap, np.nan))]
    points = preset({"sensor": "line"}).sensor
    # a spacing (m) that gives so many points
    log = fast_drive(closed, 2, sensor=replace(points, range_max=DENSE_RANGE), line=LineSettings(0.2))
    return [(log, np.full(len(log.cycles), float(LINE_POINTS)))]


def update_times(
    drives: Sequence[tuple[Log, Array]], estimators: Sequence[str], mapper: MapperSettings, budget: float
) -> pd.DataFrame:
    """Return processor time (`seconds`) and map `size` of the updates of estimators, and their abscissa `at`.

    On logs of one length all get each cycle in turn. The one that is first changes, so that none always
    follows the same other. One whose last updates took over `budget` s on average stops, and the abscissa
    that it had reached does not count. Nor do updates that close a loop: some solve their batch in it, others
    in another process.
    """
    logs = [log for log, _ in drives]
    running = {(k, name): make_online(name, mapper, log) for k, log in enumerate(logs) for name in estimators}
    closed, last = dict.fromkeys(running, False), {key: deque[float]([], JUDGED) for key in running}
    rows = list[tuple[str, float, float, int]]()
    with threadpool_limits(limits=1), spared_by_collector():
        for number, cycles in enumerate(zip(*map(split_odometry, logs), strict=True)):
            order = deque(running)
            order.rotate(-number)
            for key in order:
                (k, name), estimator = key, running[key]
                at = drives[k][1][number]
                timed_wait(estimator)
                estimate, _, seconds = timed_update(estimator, *cycles[k])
                if estimate.closed == closed[key]:
                    rows.append((name, at, seconds, sum(estimate.sizes)))
                closed[key] = estimate.closed
                last[key].append(seconds)
                if len(last[key]) == JUDGED and np.mean(last[key]) > budget:
                    del running[key]
                    rows = [row for row in rows if row[:2] != (name, at)]
    return pd.DataFrame(rows, columns=["estimator", "at", "seconds", "size"]).dropna()


def sweep_points(
    sweep: str, estimators: Sequence[str], settings: ScalingSettings, mapper: MapperSettings
) -> list[dict[str, Any]]:
    """Return the points of a sweep: mean `seconds` of an update and map `size` of the `cycles` at each."""
    times = update_times(sweep_drives(sweep, settings), estimators, mapper, settings.budget)
    rows = list[dict[str, Any]]()
    for name in estimators:
        updates = times[times["estimator"] == name].groupby("at")[["seconds", "size"]]
        points = updates.mean().assign(cycles=updates.size()).reset_index()
        rows += [{"sweep": sweep, "estimator": name, **point} for point in points.to_dict("records")]
    return rows


def measure_scaling(
    estimators: Sequence[str],
    settings: ScalingSettings,
    mapper: MapperSettings | None = None,
    folder: Path | None = None,
    **how: Any,
) -> pd.DataFrame:
    """Return the points of all sweeps, which are kept in a folder; `how` is that of `rows_of`."""
    same = {"estimators": tuple(estimators), "settings": settings, "mapper": mapper or MapperSettings()}
    sweeps = [{"sweep": sweep, **same} for sweep in (CONES, READINGS, LAPS, DENSE_LINE)]
    depends = [code_from(module_of(name)) for name in estimators]
    return rows_of(sweep_points, sweeps, folder, depends=depends, **how)


# --- tables and files of the sweeps ----------------------------------------------------------------------

MARKER: Final = "scaling.json"  # file by which a folder of results is known
COMPARED_AT: Final = 200.0  # number of cones at which estimators are compared, that of an ordinary track


def slopes_of(points: pd.DataFrame, settings: ScalingSettings) -> pd.DataFrame:
    """Fit `seconds ~ at^slope` to the points of each sweep and estimator, on logarithms from some point on.

    `error` is the standard error of the slope. With fewer than three points nothing estimates it.
    """
    begins, rows = {CONES: settings.fit_from, LAPS: 2.0}, []
    for (sweep, name), every in points.groupby(["sweep", "estimator"], sort=False):
        own = every[every["at"] >= begins.get(str(sweep), 0.0)]
        row = {"sweep": sweep, "estimator": name, "slope": math.nan, "error": math.nan, "points": len(own)}
        if len(own) > 2:
            line = linregress(np.log(own["at"]), np.log(own["seconds"]))
            row |= {"slope": line.slope, "error": line.stderr}
        rows.append(row | {"low": own["at"].min(), "high": own["at"].max()})
    return pd.DataFrame(rows)


def seconds_at(points: pd.DataFrame, cones: float) -> float:
    """Return the mean update (s) at a number of cones, by the power law between points; NaN beyond them."""
    if points.empty:
        return math.nan
    at, seconds = np.log(points["at"]), np.log(points["seconds"])
    return float(np.exp(np.interp(np.log(cones), at, seconds, left=np.nan, right=np.nan)))


def scaling_table(points: pd.DataFrame, settings: ScalingSettings) -> TextTable:
    """Return a row for each estimator: slopes with standard errors, times, the ratio to the first."""
    names, laps = [*points["estimator"].unique()], [*dict.fromkeys((2, settings.laps))]
    header = (
        *("estimator", f"slope, cones ({settings.fit_from:g} to {settings.cones_max:g})", "slope, readings"),
        *(f"ms at {COMPARED_AT:g} cones", f"{names[0]} / this", "most cones"),
        *(f"ms, lap {lap}" for lap in laps),
        f"ms, {LINE_POINTS} points of lines",
    )
    fitted: Any = slopes_of(points, settings).itertuples()
    slopes = {(of.sweep, of.estimator): figure(of.slope, of.error, 2) for of in fitted}
    milliseconds = (1e3 * points.set_index(["sweep", "estimator", "at"])["seconds"]).to_dict()
    cones = {name: points[(points["sweep"] == CONES) & (points["estimator"] == name)] for name in names}
    first, rows = seconds_at(cones[names[0]], COMPARED_AT), []
    for name in names:
        at = seconds_at(cones[name], COMPARED_AT)
        values = [1e3 * at, first / at, cones[name]["at"].max()]
        places = [*((LAPS, name, float(lap)) for lap in laps), (DENSE_LINE, name, float(LINE_POINTS))]
        values += [milliseconds.get(place, math.nan) for place in places]
        both = (slopes.get((sweep, name), UNKNOWN) for sweep in (CONES, READINGS))
        rows.append((name, *both, *figures(values, 1, 2, 0, *[1] * len(places))))
    return TextTable.of(header, rows, "Time per update: slopes of the logarithms, ± standard error")


def write_scaling(
    out: Path, points: pd.DataFrame, settings: ScalingSettings, mapper: MapperSettings, *, force: bool = False
) -> None:
    """Write `points.csv`, `scaling.json` (with slopes and settings), `table.md` and the figure."""
    content = {
        "format": "pathspace-scaling/1",
        "slopes": slopes_of(points, settings).to_dict("records"),
        "settings": asdict(settings),
        "estimator_settings": asdict(mapper),
        "versions": versions(),
    }
    with atomic_folder(out, MARKER, force=force) as folder:
        write_csv(folder / "points.csv", points)
        scaling_table(points, settings).write(folder, "table", "md")
        write_json(folder / MARKER, content)
        drawing.save_figures(folder, {"scaling": plot_scaling(points)})


def plot_scaling(points: pd.DataFrame) -> Figure:
    """Draw update times against map size and against detections, on logarithmic axes."""
    titles = {CONES: ("cones seen", "(a) map size"), READINGS: ("detections per update", "(b) detections")}
    looks = zip(cycle(drawing.PALETTE), cycle("os^Dv*<>PXphd"), strict=True)
    look_of = dict(zip(points["estimator"].unique(), looks, strict=False))
    with drawing.figure_context():
        drawn = Figure(figsize=(drawing.WIDTH, 3.1), layout="constrained")
        panels = drawn.subplots(1, 2, sharey=True)
        for axes, (sweep, (abscissa, title)) in zip(panels, titles.items(), strict=True):
            for name, (color, marker) in look_of.items():
                own = points[(points["sweep"] == sweep) & (points["estimator"] == name)]
                line: dict[str, Any] = {"marker": marker, "color": color, "markersize": 3.6, "linewidth": 0.9}
                axes.loglog(own["at"], 1e3 * own["seconds"], label=name, **line)
            axes.set(xlabel=abscissa, title=title)
            axes.grid(which="both")
        panels[0].set_ylabel("mean update [ms]")
        drawing.shared_legend(drawn)
    return drawn
