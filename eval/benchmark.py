"""The online mapper's speed: beside GTSAM's ISAM2 on a drive, and against map size, detections and laps.

Estimators get every cycle in turn, in one process with one BLAS thread, so that what slows the machine down
slows all alike. All times but that of the batch are processor times of the thread.
"""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import cycle as cycled
from pathlib import Path
from typing import Any, Final, NamedTuple

import gtsam
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, LogLocator, NullFormatter, ScalarFormatter, StrMethodFormatter
from numpy.random import Generator
from scipy.stats import linregress
from threadpoolctl import threadpool_limits

from pathspace_graph.console import progress
from pathspace_graph.estimators import make_online
from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.noise import ray_sigmas
from pathspace_graph.factors.se2 import compose, to_map
from pathspace_graph.io.files import atomic_folder, write_json
from pathspace_graph.io.log import Detections, Log, Odometry
from pathspace_graph.mapping.motion import integrate_odometry
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.run import ObservedCycle, run_online, split_odometry, timed_update, timed_wait
from pathspace_graph.settings.evaluation import ScalingSettings
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.sim.curves import along_polyline, arc_lengths, left_normals, unit
from pathspace_graph.sim.lines import LINE, LineSettings
from pathspace_graph.sim.sensor import SensorSettings
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track import Track
from pathspace_graph.sim.track_generator import generate_track
from pathspace_graph.sim.vehicle import VehicleSettings

from .experiment.provenance import code_of
from .experiment.run import OnCell, rows_of
from .experiment.tables import Table, write_csv
from .figures import style
from .figures.style import MARKERS, PALETTE, WIDTH
from .metrics.accuracy import mean_of
from .metrics.measures import figure, figures
from .metrics.summary import lap_times, versions

# --- beside ISAM2 ----------------------------------------------------------------------------------------

RIVAL: Final = "landmark-fixed-lag"  # estimator that gets the same cycles in turn
WARM_UP: Final = 50  # number of cycles after which the window is full, before which the means do not begin
SPEED: Final = {  # figures of a drive: label, and digits
    "mean_by_isam2": ("mean update relative to iSAM2 with known data association", 2),
    "p99_by_isam2": ("99th percentile relative to that iSAM2", 2),
    "mean_by_landmark": ("mean update relative to landmark-fixed-lag", 2),
    "mean": ("mean update [ms]", 1),
    "p99": ("99th percentile of an update [ms]", 1),
    "closing": ("update that closes the loop [ms]", 1),
    "swap": ("update that swaps the map [ms]", 1),
    "slowest_other": ("slowest of all other updates [ms]", 1),
    "solve": ("batch of the open lap, in its own process [s]", 1),
}


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


def speed_of_drive(seed: int, laps: int) -> dict[str, float]:
    """Map a drive on a generated track, both of this seed; return the figures of `SPEED`."""
    track = generate_track(np.random.default_rng(seed))
    return speed_on(simulate(track, SimulationSettings(laps=laps), seed), MapperSettings())


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

    def observe(cycle: ObservedCycle) -> None:
        nonlocal closed_at, rival_closed
        ours.append(1e3 * cycle.processor)
        if cycle.result.closed and "closing" not in at:
            at["closing"], closed_at = len(ours) - 1, cycle.result.t
        if cycle.record.jump is not None:
            at["swap"] = len(ours) - 1
        # a batch of the lap, which is always shorter than the lag, may be under way in its own process
        if "swap" not in at and 0.0 <= cycle.result.t - closed_at < settings.lag:
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
    found |= {name: ours[number] for name, number in at.items()}
    return found | ({"solve": mapper.lap_seconds} if "swap" in at else {})


# --- drives of the sweeps --------------------------------------------------------------------------------

GAP, DENSE_GAP, DENSE_RANGE = 5.0, 1.0, 30.0  # distances of cones in a row, and dense with its range (m)
LINE_POINTS: Final = 300  # points of both lines in a cycle, in the mean
LINE_SPACING: Final = 0.2  # distance of a cycle's points along each line, which gives that many (m)
ROAD_WIDTH: Final = 4.0  # distance of the rows (m)
SWING, WAVELENGTH = 0.9, 300.0  # largest turn from a road's direction (rad), and length of a swing (m)
DENT, DENTS = 0.12, 3  # share of the radius by which a closed road leaves its circle, and how often it does
DRIVEN, LATERAL = 20.0, 9.0  # speed of the vehicle (m/s) and its largest lateral acceleration (m/s^2)
STEP: Final = 0.25  # distance of the samples of a road's middle (m)
SPARE: Final = 1.1  # cones of an open road by those to be seen, since some are never detected
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
CONES, READINGS, LAPS, DENSE_LINE = "cones", "readings", "laps", "line"
"""Varied: cones seen, detections of an update, or lap. On a line, 300 points in each update."""


class Part(NamedTuple):
    """A log of a sweep."""

    log: Log
    at: Array  # (n,) abscissa of each cycle; NaN doesn't count
    name: str = ""  # where a sweep has several


@dataclass(frozen=True, eq=False)
class Sweep:
    """Logs that are driven in turn, and the intervals of the abscissa that become points."""

    parts: Sequence[Part]
    edges: Array
    fit_from: float = 0.0  # abscissa at which the slope begins

    @property
    def cycles(self) -> int:
        return max(len(part.log.cycles) for part in self.parts)


def make_drives(settings: ScalingSettings) -> dict[str, Sweep]:
    """Simulate the drives of all sweeps: a long road, a short dense one, and laps of a closed one."""
    seed, rng = settings.seed, np.random.default_rng(settings.seed)
    long = drive_log(open_road(int(settings.cones_max), GAP), seed)
    seen = cones_seen(long)
    count = int(np.searchsorted(seen, settings.cones_max)) + 1
    low, high = np.log(settings.cones_min), np.log(settings.cones_max + 1.0)
    until_seen = replace(long, cycles=long.cycles[:count], truth=None)
    cones = Part(until_seen, seen[:count].astype(float))
    dense_road, far = open_road(settings.readings_cones, DENSE_GAP), SensorSettings(range_max=DENSE_RANGE)
    dense, readings = drive_log(dense_road, seed, sensor=far), []
    for wanted in settings.readings:
        log = thinned(dense, wanted, rng)
        counts = np.array([len(cycle.labels) for cycle in log.cycles])
        counts[: settings.warm_up] = -1
        readings.append(Part(log, np.where(counts == wanted, float(wanted), np.nan), f"{wanted} readings: "))
    closed, sensor = closed_road(settings.laps_cones), replace(LINE, range_max=DENSE_RANGE)
    laps = drive_log(closed, seed, settings.laps)
    ends = lap_times(laps)
    lap = 1.0 + np.searchsorted(ends, [cycle.t for cycle in laps.cycles]).astype(float)
    line = drive_log(closed, seed, 2, sensor=sensor, line=LineSettings(LINE_SPACING))
    points = np.full(len(line.cycles), float(LINE_POINTS))
    return {
        CONES: Sweep([cones], np.exp(np.linspace(low, high, settings.bins + 1)), settings.fit_from),
        READINGS: Sweep(readings, np.append(np.sort(settings.readings), np.inf)),
        LAPS: Sweep([Part(laps, lap)], np.arange(1.0, len(ends) + 2.0), 2.0),
        DENSE_LINE: Sweep([Part(line, points)], np.array([LINE_POINTS, np.inf])),
    }


def open_road(cones: int, gap: float) -> Track:
    """Return a winding road that never comes near itself, on which at least `cones` cones can be seen.

    Its heading is `SWING * sin(2 pi s / WAVELENGTH)` at the length s along it; cones are `gap` (m) apart.
    """
    length = SPARE * cones / 2 * gap
    s = np.arange(0.0, length, STEP)
    heading = SWING * np.sin(2 * np.pi * s / WAVELENGTH)
    middle = STEP * np.cumsum(np.column_stack([np.cos(heading), np.sin(heading)]), axis=0)
    return _with_rows(middle, gap, closed=False)


def closed_road(cones: int) -> Track:
    """Return a dented circle with about `cones` cones: `r = 1 + DENT cos(DENTS phi)`, scaled."""
    phi = np.linspace(0.0, 2 * np.pi, max(int(cones * GAP / STEP), 100))
    r = 1.0 + DENT * np.cos(DENTS * phi)
    unscaled = r[:, None] * np.column_stack([np.cos(phi), np.sin(phi)])
    middle = unscaled * (cones / 2 * GAP / arc_lengths(unscaled)[-1])
    return _with_rows(middle, GAP, closed=True)


def _with_rows(middle: Array, gap: float, closed: bool) -> Track:
    """Return the road with cones on both sides of its middle (n, 2), `gap` (m) apart."""
    tangents = unit(np.gradient(middle, axis=0))
    rows = []
    for side in (0.5, -0.5):
        row = middle + side * ROAD_WIDTH * left_normals(tangents)
        s = arc_lengths(row)
        at = np.linspace(0.0, s[-1], max(round(s[-1] / gap), 2), endpoint=not closed)
        rows.append(along_polyline(at, s, row))
    start = np.append(middle[0], np.arctan2(tangents[0, 1], tangents[0, 0]))
    return Track(rows[0], rows[1], np.zeros((0, 2)), closed, start, "road")


def drive_log(track: Track, seed: int, laps: int = 1, **sensing: Any) -> Log:
    """Simulate a drive along a road at full speed from the start on; `sensing` sets sensor and line."""
    vehicle = VehicleSettings(speed_max=DRIVEN, speed_start=DRIVEN, acceleration_lateral=LATERAL)
    return simulate(track, SimulationSettings(laps=laps, vehicle=vehicle, **sensing), seed)


def cones_seen(log: Log) -> IntArray:
    """Return the number of true cones that had been detected by the end of each cycle (n,)."""
    assert log.truth is not None
    assert log.truth.associations is not None
    ends = np.cumsum([len(cycle.labels) for cycle in log.cycles])
    seen, first = np.unique(log.truth.associations, return_index=True)
    return np.searchsorted(np.sort(first[seen >= 0]), ends, side="left")


def thinned(log: Log, count: int, rng: Generator) -> Log:
    """Return the drive with `count` detections a cycle, chosen at random, or all where there are fewer."""
    cycles = []
    for cycle in log.cycles:
        size = len(cycle.labels)
        chosen = rng.choice(size, min(count, size), replace=False)
        cycles.append(cycle.where(np.isin(np.arange(size), chosen)))
    return replace(log, cycles=tuple(cycles), truth=None)


# --- updates of the sweeps -------------------------------------------------------------------------------

JUDGED: Final = 10  # number of updates whose mean is compared with the budget
POINT: Final = ["sweep", "estimator", "at", "seconds", "cycles", "size"]  # columns of a point of a sweep
SLOPE: Final = [*POINT[:2], "slope", "error", "points", "low", "high", "stopped"]  # and of its slope


@dataclass(eq=False)
class Lane:
    """An estimator that is to map a log, and what was measured, until the log ended or it was stopped.

    The update that closes a loop does not count: some solve their batch in it, others in another process.
    """

    estimator: str
    part: Part
    seconds: list[float] = field(default_factory=list)  # processor time of each update (s)
    sizes: list[int] = field(default_factory=list)  # size of the map after each update
    stopped: str = ""  # why it did not reach the log's end; empty where it did

    def updates(self, settings: MapperSettings, budget: float) -> Iterator[None]:
        """Do an update at each step, until the log ends or the lane is stopped."""
        estimator, closed = make_online(self.estimator, settings, self.part.log), False
        for odometry, detections in split_odometry(self.part.log):
            try:
                timed_wait(estimator)
                estimate, _, seconds = timed_update(estimator, odometry, detections)
            except Exception as error:  # the table reports any failure
                self.stopped = " ".join(f"{type(error).__name__}: {error}".split())
                return
            self.seconds.append(seconds if estimate.closed == closed else np.nan)
            closed = estimate.closed
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
        for number in range(max(len(lane.part.log.cycles) for lane in lanes)):
            first = number % len(runners)
            for runner in (*runners[first:], *runners[:first]):
                next(runner, None)
            on_cycle()


def binned(lane: Lane, edges: Array) -> pd.DataFrame:
    """Return a point for each interval between two `edges` that holds cycles of a lane.

    It has the means of `at`, of `seconds` of an update and of the map's `size`, and the number of `cycles`.
    """
    at = lane.part.at[: len(lane.seconds)]
    frame = pd.DataFrame({"at": at, "seconds": lane.seconds, "size": lane.sizes})
    bins = np.searchsorted(edges, frame["at"], side="right") - 1
    inside = (bins >= 0) & (bins < len(edges) - 1)
    points = frame[inside].groupby(bins[inside])
    return points.mean().assign(cycles=points.size()).reset_index(drop=True)


def fit_slope(points: pd.DataFrame, fit_from: float = 0.0) -> dict[str, float]:
    """Return the power law `seconds ~ at^slope`, a line fitted to the logarithms from `fit_from` on.

    `error` is the standard error of the exponent; both are NaN with too few `points`, from `low` to `high`.
    """
    kept = points[points["at"] >= fit_from].astype({"at": float, "seconds": float})
    slope = error = float("nan")
    if len(kept) > 2:  # two would leave nothing to estimate the error from
        line = linregress(np.log(kept["at"]), np.log(kept["seconds"]))
        slope, error = float(line.slope), float(line.stderr)
    ends = {"low": float(kept["at"].min()), "high": float(kept["at"].max())}
    return {"slope": slope, "error": error, "points": len(kept), **ends}


def sweep_rows(
    name: str,
    estimators: Sequence[str],
    settings: ScalingSettings,
    mapper: MapperSettings,
    sweep: Sweep,
    on_cycle: Callable[[], None],
) -> list[dict[str, Any]]:
    """Return the points of a sweep, each with its `cycles`, and the slope of each estimator."""
    lanes = [Lane(estimator, part) for part in sweep.parts for estimator in estimators]
    run_lanes(lanes, mapper, settings.budget, on_cycle)
    rows: list[dict[str, Any]] = []
    for estimator in estimators:
        about = {"sweep": name, "estimator": estimator}
        own = [lane for lane in lanes if lane.estimator == estimator]
        found = [binned(lane, sweep.edges) for lane in own]
        points = pd.concat([of for of in found if len(of)] or found[:1], ignore_index=True)
        stopped = "; ".join(f"{lane.part.name}{lane.stopped}" for lane in own if lane.stopped)
        rows += [about | point for point in points.to_dict("records")]
        rows.append({**about, **fit_slope(points, sweep.fit_from), "stopped": stopped})
    return rows


# --- scaling ---------------------------------------------------------------------------------------------

MARKER: Final = "scaling.json"  # file by which a folder of results is known
COMPARED_AT: Final = 200.0  # number of cones at which estimators are compared, that of an ordinary track
_HEIGHT: Final = 3.1  # height of a figure (in)


@dataclass(frozen=True, eq=False)
class Scaling:
    """All results of the measurement."""

    settings: ScalingSettings
    mapper: dict[str, Any]
    points: pd.DataFrame  # row for each mean of some updates, as `binned` returns them
    slopes: pd.DataFrame  # row for each sweep and estimator, as `fit_slope` returns it

    def of(self, sweep: str, estimator: str) -> pd.DataFrame:
        return self.points[(self.points["sweep"] == sweep) & (self.points["estimator"] == estimator)]

    def slope(self, sweep: str, estimator: str) -> pd.Series:
        return self.slopes.set_index(["sweep", "estimator"]).loc[(sweep, estimator)]

    @property
    def estimators(self) -> tuple[str, ...]:
        return tuple(self.slopes["estimator"].unique())

    def seconds_at(self, cones: float, estimator: str) -> float:
        """Return the mean update (s) at a number of cones, between the points; NaN beyond them."""
        points = self.of(CONES, estimator)
        if not len(points):
            return float("nan")
        at, seconds = np.log(points["at"]), np.log(points["seconds"])
        return float(np.exp(np.interp(np.log(cones), at, seconds, left=np.nan, right=np.nan)))


def measure_scaling(
    estimators: Sequence[str],
    drives: dict[str, Sweep],
    settings: ScalingSettings,
    mapper: MapperSettings | None = None,
    folder: Path | None = None,
    on_cycle: OnCell = lambda *_: None,
) -> Scaling:
    """Measure all sweeps, each kept in a folder at once, or read from there.

    `on_cycle` gets the numbers of cycles that are done, and of all that remained.
    """
    mapper, code = mapper or MapperSettings(), {name: code_of(name) for name in estimators}
    shared = {"estimators": tuple(estimators), "settings": settings, "mapper": mapper}
    done, total, found = 0, sum(sweep.cycles for sweep in drives.values()), []

    def count() -> None:
        nonlocal done
        done += 1
        on_cycle(done, total)

    for name, sweep in drives.items():
        before, others = done, {"sweep": sweep, "on_cycle": count}
        found.append(rows_of(sweep_rows, [{"name": name, **shared}], folder, others=others, depends=code))
        total -= sweep.cycles if done == before else 0  # it was kept
    rows = pd.concat(found, ignore_index=True)
    points, slopes = rows[rows["cycles"].notna()], rows[rows["cycles"].isna()]
    return Scaling(settings, asdict(mapper), points[POINT].reset_index(drop=True), slopes[SLOPE])


# --- table and files -------------------------------------------------------------------------------------


def scaling_table(scaling: Scaling) -> Table:
    """Return a row for each estimator: slopes with standard errors, times, the ratio to the first."""
    settings, first = scaling.settings, scaling.estimators[0]
    shown = [*dict.fromkeys((2, settings.laps))]
    header = (
        *("estimator", f"slope, cones ({settings.fit_from:g} to {settings.cones_max:g})", "slope, readings"),
        *(f"ms at {COMPARED_AT:g} cones", f"{first} / this", "most cones"),
        *(f"ms, lap {lap}" for lap in shown),
        f"ms, {LINE_POINTS} points of lines",
    )
    rows = []
    for name in scaling.estimators:
        slopes = (scaling.slope(sweep, name) for sweep in (CONES, READINGS))
        both = (figure(slope["slope"], slope["error"], 2) for slope in slopes)
        at, laps = scaling.seconds_at(COMPARED_AT, name), scaling.of(LAPS, name).set_index("at")["seconds"]
        alone = [1e3 * at, scaling.seconds_at(COMPARED_AT, first) / at, scaling.of(CONES, name)["at"].max()]
        alone += [1e3 * laps.get(float(lap), math.nan) for lap in shown]
        on_line = scaling.of(DENSE_LINE, name)["seconds"]
        alone.append(math.nan if scaling.slope(DENSE_LINE, name)["stopped"] else 1e3 * on_line.iloc[0])
        rows.append((name, *both, *figures(alone, 1, 2, 0, *[1] * len(shown), 1)))
    return Table.of(header, rows, "Time per update: slopes of the logarithms, ± standard error")


def stops(scaling: Scaling) -> list[str]:
    """Return a line for each estimator and sweep that did not reach the end."""
    lines = []
    for row in scaling.slopes.to_dict("records"):
        if row["stopped"]:
            reached = f" (slope to {row['high']:.0f})" if row["points"] else ""
            lines.append(f"{row['estimator']}, {row['sweep']}: stopped, {row['stopped']}{reached}")
    return lines


def write_scaling(out: Path, scaling: Scaling, *, force: bool = False) -> None:
    """Write `points.csv`, `scaling.json` (with slopes and settings), `table.md` and the figure."""
    at = {name: scaling.seconds_at(COMPARED_AT, name) for name in scaling.estimators}
    content = {
        "format": "pathspace-scaling/1",
        "slopes": scaling.slopes.to_dict("records"),
        "compared_at_cones": COMPARED_AT,
        "seconds_compared": at,
        "settings": asdict(scaling.settings),
        "estimator_settings": scaling.mapper,
        "versions": versions(),
    }
    with atomic_folder(out, MARKER, force=force) as folder:
        write_csv(folder / "points.csv", scaling.points)
        scaling_table(scaling).write(folder, "table", "md")
        write_json(folder / MARKER, content)
        style.save_figures(folder, {"scaling": plot_scaling(scaling)})


def plot_scaling(scaling: Scaling) -> Figure:
    """Draw two sweeps on logarithmic axes, with fitted lines, and a cross where an estimator was stopped."""
    titles = {CONES: ("cones seen", "(a) map size"), READINGS: ("detections per update", "(b) detections")}
    ticks = {
        CONES: [n for n in (50, 100, 200, 500, 1000, 2000) if n <= scaling.settings.cones_max],
        READINGS: scaling.settings.readings,
    }
    with style.figure_context():
        figure = Figure(figsize=(WIDTH, _HEIGHT), layout="constrained")
        panels = figure.subplots(1, 2, sharey=True)
        for axes, (sweep, (abscissa, title)) in zip(panels, titles.items(), strict=True):
            for name, color, marker in zip(
                scaling.estimators, cycled(PALETTE), cycled(MARKERS), strict=False
            ):
                points, slope = scaling.of(sweep, name), scaling.slope(sweep, name)
                at, milliseconds = points["at"], 1e3 * points["seconds"]
                if not len(points):
                    continue
                axes.plot(at, milliseconds, marker, color=color, label=name, markersize=3.6)
                if np.isfinite(slope["slope"]):
                    ends = slope[["low", "high"]].to_numpy(float)
                    fitted = points[at.between(*ends)][["at", "seconds"]]
                    middle, seconds = np.exp(np.log(fitted).mean())
                    law = 1e3 * seconds * (ends / middle) ** slope["slope"]
                    axes.plot(ends, law, color=color, linewidth=0.9, alpha=0.8)
                if sweep == CONES and slope["stopped"]:
                    axes.plot(at.iloc[-1], milliseconds.iloc[-1], "x", color=color, markersize=10.8)
            axes.set(xscale="log", yscale="log", xlabel=abscissa, title=title)
            axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
            axes.yaxis.set_minor_formatter(NullFormatter())
            axes.grid(which="both")
            axes.xaxis.set_major_locator(FixedLocator(ticks[sweep]))
            axes.xaxis.set_major_formatter(ScalarFormatter())
            axes.xaxis.set_minor_formatter(NullFormatter())
        panels[0].set_ylabel("mean update [ms]")
        style.shared_legend(figure)
    return figure
