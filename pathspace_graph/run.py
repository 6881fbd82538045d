"""Interfaces of the estimators, and the loop that feeds a log to an online one."""

import gc
import time
from array import array
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass, field, is_dataclass, replace
from functools import cache, cached_property
from math import nan
from operator import methodcaller
from typing import Any, Protocol, TypeVar, runtime_checkable

import gtsam
import numpy as np
from threadpoolctl import threadpool_limits

from pathspace_graph.brief import Brief
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.linear import keys_of_factor
from pathspace_graph.io.log import Detections, Log, Odometry
from pathspace_graph.io.map import Map
from pathspace_graph.io.results import BatchRun, CycleRecord, RunResult
from pathspace_graph.lengths import scaled

from .errors import check_type, solving
from .health import Health
from .labels import LEFT, RIGHT
from .laps import LapCounter

Result = TypeVar("Result", bound=RunResult)


@dataclass(frozen=True, eq=False, repr=False)
class CycleResult(Brief):
    """Result of an online estimator in one perception cycle."""

    t: float
    """Stamp of the cycle (s)."""
    pose: Array
    """Pose (x, y, theta) (3,) of the vehicle in m and rad, map frame; theta is not wrapped."""
    sizes: tuple[int, int]
    """Numbers of control points or landmarks of the left and the right boundary."""
    readings: int
    """Number of detections in use."""
    closed: bool
    """Whether the loop has closed."""
    stages: Mapping[str, float] = field(default_factory=dict)
    """Time of each stage of the update (s), by name."""
    jump: Array | None = None
    """Jump (3,) of the newest pose in m, m and rad, map frame, if this cycle has replaced map or pose."""
    notice: str = ""
    """Message for the user; empty in most cycles."""
    health: Health = field(default_factory=Health)
    """Health of the estimate; empty for an estimator without a monitor."""
    dropped: int = 0
    """Number of detections dropped as impossible."""
    refused: int = 0
    """Number of cycles refused since the last admitted one."""


@runtime_checkable
class OnlineEstimator(Protocol):
    """Interface of an online estimator; `docs/extending.md` lists optional methods."""

    @property
    def settings(self) -> Any:
        """Return a frozen dataclass with all settings of the estimator."""

    def update(self, odometry: Odometry, detections: Detections) -> CycleResult:
        """Process one perception cycle: the twists since the previous one, and its detections."""

    def map(self) -> Map:
        """Return a copy of the present map."""


class BatchEstimator(Protocol):
    """Interface of a batch estimator."""

    @property
    def settings(self) -> Any:
        """Return a frozen dataclass with all settings of the estimator."""

    def solve(self, log: Log) -> BatchRun:
        """Return the optimum over a whole log; its truth is not used."""


@dataclass(frozen=True, eq=False)
class Readings:
    """Detections of the newest cycle with their use, placed by the newest pose."""

    points: Array
    """Detected positions (k, 2) in m, map frame, corrected by the calibration."""
    labels: IntArray
    """Boundary (k,) of each detection: LEFT, RIGHT or UNKNOWN."""
    used: BoolArray
    """Whether each detection (k,) is in use; the others were gated."""
    feet: Array
    """Foot point (k, 2) of each used detection on its curve or landmark, in m, map frame; otherwise NaN."""


def _ask(estimator: OnlineEstimator, method: str, *arguments: Any) -> Any:
    """Call an optional method of an estimator; None if it has none."""
    return getattr(estimator, method, lambda *_: None)(*arguments)


def outline_of(estimator: OnlineEstimator) -> Map:
    """Return the present map, without covariances if the estimator has an `outline`."""
    track: Map | None = _ask(estimator, "outline")
    return estimator.map() if track is None else track


@dataclass(frozen=True, eq=False)
class ObservedCycle:
    """A finished cycle for observers: its input, its result, and the estimator.

    Map, readings and window are computed at the first access, once for all observers, and must not be
    changed.
    """

    estimator: OnlineEstimator
    detections: Detections
    """Detections of the cycle, as given to the estimator."""
    result: CycleResult
    number: int = 0
    """Number of the cycle, from 0."""
    seconds: float = nan
    """Wall time of the whole update (s), if measured."""
    lap: int = 1
    """Lap of the estimated trajectory, counted from 1."""
    processor: float = nan
    """CPU time of this thread in the update (s); other processes hardly affect it."""

    @cached_property
    def record(self) -> CycleRecord:
        result = self.result
        same = ("readings", "closed", "notice", "dropped", "refused")
        return CycleRecord(
            cycle=self.number,
            t=self.detections.t,
            seconds=self.seconds,
            size_left=result.sizes[LEFT],
            size_right=result.sizes[RIGHT],
            lap=self.lap,
            stages=StageTimes(result.stages),
            jump=None if result.jump is None else tuple(np.asarray(result.jump).tolist()),
            offered=len(self.detections.labels),
            health=result.health.condition,
            reason=result.health.reason,
            processor=self.processor,
            **{name: getattr(result, name) for name in same},
        )

    @cached_property
    def outline(self) -> Map:
        """Return the present map, without covariances if the estimator has an `outline`."""
        return outline_of(self.estimator)

    @cached_property
    def map(self) -> Map:
        """Return the present map with covariances, which takes much longer than `outline`."""
        estimator = self.estimator
        with estimator.looked_at() if hasattr(estimator, "looked_at") else nullcontext():
            return estimator.map()

    @cached_property
    def readings(self) -> Readings | None:
        """Return the detections with their use; None if the estimator has no `readings`."""
        readings: Readings | None = _ask(self.estimator, "readings")
        return readings

    @cached_property
    def window(self) -> Array:
        """Return the poses (P, 3) in the window, oldest first; a filter has none."""
        poses: Array | None = _ask(self.estimator, "window_poses")
        return np.zeros((0, 3)) if poses is None else poses


Observer = Callable[[ObservedCycle], None]
"""Function that is called after each cycle; its time is not counted as the estimator's."""


class StageTimes(Mapping[str, float]):
    """Times of the stages of an update (s), in two fifths of the memory of a dictionary."""

    __slots__ = ("_names", "_times")

    def __init__(self, times: Mapping[str, float]) -> None:
        self._names, self._times = _shared(tuple(times)), array("d", [*times.values()])

    def __getitem__(self, name: str) -> float:
        if name not in self._names:
            raise KeyError(name)
        return self._times[self._names.index(name)]

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


@cache
def _shared(names: tuple[str, ...]) -> tuple[str, ...]:
    return names


class Stopwatch:
    """Stopwatch of the stages of an update; it starts at construction."""

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        """Time of each stage (s)."""
        self._last = time.perf_counter()

    @property
    def spent(self) -> float:
        return sum(self.laps.values())

    def lap(self, name: str) -> None:
        """Add the time since the last call to the stage `name`."""
        begin, self._last = self._last, time.perf_counter()
        self.laps[name] = self.laps.get(name, 0.0) + self._last - begin


def split_odometry(log: Log) -> Iterator[tuple[Odometry, Detections]]:
    """Yield each perception cycle with the twists since the previous cycle, up to its stamp.

    The first row starts at the previous cycle with the twist in force there; the last one is held to this
    cycle.
    """
    since = float(log.odometry.t[0])
    for detections in log.cycles:
        yield log.odometry.between(since, detections.t), detections
        since = detections.t


def timed_wait(estimator: OnlineEstimator, method: str = "wait") -> float:
    """Wait for a batch whose result the next update may use, or `finish`; return the wall time (s)."""
    begin = time.perf_counter()
    _ask(estimator, method)
    return time.perf_counter() - begin


def by_cycle(factors: Iterable[gtsam.NonlinearFactor]) -> Mapping[int, list[gtsam.NonlinearFactor]]:
    """Return factors by the cycle of their newest pose; those without a pose are of the first cycle."""
    found = defaultdict[int, list[gtsam.NonlinearFactor]](list)
    for factor in factors:
        keys = keys_of_factor(factor).tolist()
        poses = (gtsam.symbolIndex(key) for key in keys if gtsam.symbolChr(key) == ord("x"))
        found[max(poses, default=0)].append(factor)
    return found


def timed_update(
    estimator: OnlineEstimator, odometry: Odometry, detections: Detections, *factors: Any
) -> tuple[CycleResult, float, float]:
    update: Callable[..., CycleResult] = estimator.update
    worked, begin = time.thread_time(), time.perf_counter()
    estimate = update(odometry, detections, *factors)
    seconds = time.perf_counter() - begin
    return estimate, seconds, time.thread_time() - worked


@contextmanager
def spared_by_collector() -> Iterator[None]:
    """Exclude existing objects, and later all that survive a collection, from garbage collection.

    A full collection looks at every object of the process, which would delay a cycle by up to 0.1 s.
    Reference cycles that survive one collection are freed after the context.
    """
    if gc.get_freeze_count():  # a caller has frozen them
        yield
        return

    def freeze_survivors(phase: str, _: dict[str, int]) -> None:
        if phase == "stop":
            gc.freeze()

    gc.collect()
    gc.freeze()
    gc.callbacks.append(freeze_survivors)
    try:
        yield
    finally:
        gc.callbacks.remove(freeze_survivors)
        gc.unfreeze()


def run_online(
    log: Log,
    estimator: OnlineEstimator,
    *,
    name: str = "fixed-lag",
    snapshot_times: Sequence[float] | Array = (),
    observers: Sequence[Observer] = (),
    outlines: bool = False,
) -> RunResult:
    """Feed a log to an online estimator, cycle by cycle, never reading ahead.

    The result has copies of the map at the `snapshot_times` (s, ascending) and at the end of each lap; with
    `outlines` they have no covariances, which take most of the memory of a long drive. `observers` are called
    after each cycle, and their time is not counted. BLAS runs on one thread. Between cycles the run waits for
    batches, and garbage collection excludes objects older than the run. Estimator and observers see lengths
    divided by the scale of the log, the result has them in metres of the log. An estimator with a method
    `factors` gets each of the factors that this returns for the log in the cycle of its newest pose.
    """
    check_type("log", log, Log)
    check_type("estimator", estimator, OnlineEstimator)
    map_of: Callable[[OnlineEstimator], Map] = outline_of if outlines else methodcaller("map")
    upcoming, snapshots = deque(float(t) for t in snapshot_times), list[Map]()
    laps, lap_maps, observing, waited = LapCounter(), list[tuple[int, Map]](), 0.0, 0.0
    poses, records, log_at_one = array("d"), list[CycleRecord](), log.at_scale_one()
    given = by_cycle(_ask(estimator, "factors", log_at_one) or ())
    with threadpool_limits(limits=1), spared_by_collector():
        for number, (odometry, detections) in enumerate(split_odometry(log_at_one)):
            while upcoming and upcoming[0] < detections.t:
                upcoming.popleft()
                snapshots.append(map_of(estimator))
            waited += timed_wait(estimator)
            factors = [given[number]] if number in given else []
            result, seconds, processor = timed_update(estimator, odometry, detections, *factors)
            lap_before = laps.lap
            lap = laps.update(np.asarray(result.pose))
            if lap > lap_before:
                lap_maps.append((lap_before, map_of(estimator)))
            poses.extend(result.pose)
            cycle = ObservedCycle(estimator, detections, result, number, seconds, lap, processor)
            records.append(cycle.record)
            begin = time.perf_counter()
            for observer in observers:
                observer(cycle)
            observing += time.perf_counter() - begin if observers else 0.0
        snapshots += [map_of(estimator) for _ in upcoming]
        waited += timed_wait(estimator, "finish")
        track, t = estimator.map(), np.array([record.t for record in records])
        if laps.last_lap_is_complete:
            lap_maps.append((laps.lap, track))
        trajectory, smoothed = np.array(poses).reshape(-1, 3), _ask(estimator, "smoothed", t)
        smoothed = np.full(3, np.nan) if smoothed is None else smoothed
        is_smoothed = np.isfinite(smoothed)
        run = RunResult(
            estimator=name,
            settings=settings_dict(estimator.settings),
            map=track,
            trajectory_t=t,
            trajectory=trajectory,
            cycles=tuple(records),
            laps=laps.completed,
            lap_maps=tuple(lap_maps),
            snapshots=tuple(snapshots),
            vehicle=_ask(estimator, "vehicle_state") if records else None,
            observing=observing,
            batches=_ask(estimator, "batches"),
            waited=waited,
            noise=_ask(estimator, "noise_used"),
            smoothed=np.where(is_smoothed, smoothed, trajectory) if is_smoothed.any() else None,
        )
    return scaled(run, log.scale)


def solved(solve: Callable[[Log], Result], log: Log) -> Result:
    """Solve a batch at scale 1, and return its result in metres of the log.

    BLAS runs on one thread, and a numerical failure raises a SolveError.
    """
    check_type("log", log, Log)
    with threadpool_limits(limits=1), solving("the batch"):
        return scaled(solve(log.at_scale_one()), log.scale)


def settings_dict(settings: Any) -> dict[str, Any]:
    """Convert a dataclass of settings to nested dictionaries; empty for anything else."""
    return asdict(settings) if is_dataclass(settings) and not isinstance(settings, type) else {}


def with_own(result: Result, parameters: Any) -> Result:
    """Return a result whose settings have the own parameters of its estimator, as a section of its name."""
    if parameters is None:
        return result
    return replace(result, settings=result.settings | {result.estimator: settings_dict(parameters)})
