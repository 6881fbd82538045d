"""The interface of estimators, and the loop that feeds a log to an online one cycle by cycle."""

import gc
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass, field, is_dataclass
from functools import cached_property
from math import nan
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np
from threadpoolctl import threadpool_limits

from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.io.brief import Brief
from pathspace_graph.io.log import Detections, Log, Odometry
from pathspace_graph.io.map import Map
from pathspace_graph.io.results import BatchRun, CycleRecord, RunResult
from pathspace_graph.lengths import POSE_LENGTHS, times

from .errors import check_type
from .health import Health
from .labels import LEFT, RIGHT
from .laps import LapCounter


@dataclass(frozen=True, eq=False, repr=False)
class CycleResult(Brief):
    """Result of an online estimator in one perception cycle."""

    LENGTHS: ClassVar = {"pose": POSE_LENGTHS, "jump": POSE_LENGTHS, "notice": 0, "health": 0}

    t: float
    """Stamp of the cycle (s)."""
    pose: Array
    """Pose [x, y, theta] (3,) of the vehicle, m and rad, map frame; theta isn't wrapped."""
    sizes: tuple[int, int]
    """Numbers of control points, or of landmarks, of the left and of the right boundary."""
    readings: int
    """Number of the cycle's detections that were used."""
    closed: bool
    stages: Mapping[str, float] = field(default_factory=dict)
    """Time of each stage of the update (s), by the stage's name."""
    jump: Array | None = None
    """Jump (3,) [m, m, rad] of the newest pose in the map frame, where the map was replaced in this cycle by
    one that was solved as a batch."""
    notice: str = ""
    """What a user should know of the cycle; empty if there is nothing."""
    health: Health = field(default_factory=Health)
    """How far the estimate can be trusted; empty for an estimator without a monitor."""
    dropped: int = 0
    """Number of the cycle's detections that were dropped as impossible."""
    refused: int = 0
    """Number of cycles that were refused since the last one that was used."""


@runtime_checkable
class OnlineEstimator(Protocol):
    """Interface of every online estimator; `docs/estimators.md` lists methods that it may have as well."""

    @property
    def settings(self) -> Any:
        """Return a frozen dataclass with all settings of the estimator."""

    def update(self, odometry: Odometry, detections: Detections) -> CycleResult:
        """Process one perception cycle: the twists since the last one, and the detections of this one."""

    def map(self) -> Map:
        """Return a copy of the map as it stands."""


class BatchEstimator(Protocol):
    """Interface of every batch estimator."""

    @property
    def settings(self) -> Any:
        """Return a frozen dataclass with all settings of the estimator."""

    def solve(self, log: Log) -> BatchRun:
        """Return the optimum over a whole log, whose truth is not read."""


@dataclass(frozen=True, eq=False)
class Readings:
    """Detections of the newest cycle as the estimator took them, seen from its newest pose."""

    LENGTHS: ClassVar = {"points": 1, "feet": 1}

    points: Array
    """Detected positions (k, 2) in m, map frame, corrected as the estimator corrects them."""
    labels: IntArray
    """Boundary (k,) of each detection, LEFT, RIGHT or UNKNOWN."""
    used: BoolArray
    """Whether each detection (k,) was used; otherwise it was gated."""
    feet: Array
    """Foot point (k, 2) of each used detection on its curve or landmark, in m, map frame; NaN for others."""


def scale(estimator: OnlineEstimator) -> float:
    """Return the scale of the scene as an estimator knows it; 1 where it takes every scene as it is."""
    return float(getattr(estimator, "scale", 1.0))


def _ask(estimator: OnlineEstimator, method: str, *arguments: Any) -> Any:
    """Return the answer of a method that an estimator may have, or None where it has none."""
    return getattr(estimator, method, lambda *_: None)(*arguments)


@dataclass(frozen=True, eq=False)
class ObservedCycle:
    """A cycle that is over, as an observer sees it: its input, its result, and the estimator as it stands.

    Map, readings and window are taken when first asked for, once for all observers, and must not be changed.
    """

    estimator: OnlineEstimator
    detections: Detections
    """Detections of the cycle, as they were handed over."""
    result: CycleResult
    number: int = 0
    """Number of the cycle, from 0."""
    seconds: float = nan
    """Wall time of the whole update (s), where it was measured."""
    lap: int = 1
    """Lap of the estimated trajectory, counted from 1."""
    processor: float = nan
    """Processor time of this thread in the update (s), which other work on the machine hardly changes."""

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
            stages=dict(result.stages),
            jump=None if result.jump is None else tuple(np.asarray(result.jump).tolist()),
            offered=len(self.detections.labels),
            health=result.health.condition,
            reason=result.health.reason,
            processor=self.processor,
            **{name: getattr(result, name) for name in same},
        )

    @cached_property
    def outline(self) -> Map:
        """Return the map as it stands, without covariances where the estimator can give it so."""
        track: Map | None = _ask(self.estimator, "outline")
        return self.estimator.map() if track is None else track

    @cached_property
    def map(self) -> Map:
        """Return the map as it stands, with its covariances, which takes much longer than the outline."""
        estimator = self.estimator
        with estimator.looked_at() if hasattr(estimator, "looked_at") else nullcontext():
            return estimator.map()

    @cached_property
    def readings(self) -> Readings | None:
        """Return which detections were used; None where the estimator does not say it."""
        readings: Readings | None = _ask(self.estimator, "readings")
        return readings

    @cached_property
    def window(self) -> Array:
        """Return the poses (P, 3) in the window, the oldest first; a filter has none."""
        poses: Array | None = _ask(self.estimator, "window_poses")
        return np.zeros((0, 3)) if poses is None else poses


Observer = Callable[[ObservedCycle], None]
"""Function that is called after each cycle, whose time is not the estimator's."""


class Stopwatch:
    """Times of the stages of an update, from the moment that it is made."""

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
    """Yield each perception cycle with the twists since the cycle before it, none later than its stamp.

    The first row begins at the cycle before with the twist held then; the last is held until this one.
    """
    since = float(log.odometry.t[0])
    for detections in log.cycles:
        yield log.odometry.between(since, detections.t), detections
        since = detections.t


def timed_wait(estimator: OnlineEstimator) -> float:
    """Wait for what the next update may take from another process; return the wall time (s) of that."""
    begin = time.perf_counter()
    _ask(estimator, "wait")
    return time.perf_counter() - begin


def timed_update(
    estimator: OnlineEstimator, odometry: Odometry, detections: Detections
) -> tuple[CycleResult, float, float]:
    begin, worked = time.perf_counter(), time.thread_time()
    estimate = estimator.update(odometry, detections)
    return estimate, time.perf_counter() - begin, time.thread_time() - worked


@contextmanager
def spared_by_collector() -> Iterator[None]:
    """Keep what exists already out of garbage collections, of which a full one would take a cycle 0.1 s."""
    begins = gc.get_freeze_count() == 0  # else a caller has done it, and goes on with it
    if begins:
        gc.freeze()
    try:
        yield
    finally:
        if begins:
            gc.unfreeze()


def run_online(
    log: Log,
    estimator: OnlineEstimator,
    *,
    name: str = "fixed-lag",
    snapshot_times: Sequence[float] | Array = (),
    observers: Sequence[Observer] = (),
) -> RunResult:
    """Feed a log's odometry and cycles to an online estimator, in order of time and never ahead of it.

    Maps are kept as they stood at the `snapshot_times` (s, ascending). The `observers` are shown each cycle,
    outside of its time. BLAS has one thread, results of another process are waited for between cycles, and
    Python's collector leaves alone what there was before the run.
    """
    check_type("log", log, Log)
    check_type("estimator", estimator, OnlineEstimator)
    run = _Run(estimator, [float(t) for t in snapshot_times], observers)
    with threadpool_limits(limits=1), spared_by_collector():
        for odometry, detections in split_odometry(log):
            run.cycle(odometry, detections)
        return run.result(name)


class _Run:
    def __init__(
        self, estimator: OnlineEstimator, times: Sequence[float], observers: Sequence[Observer]
    ) -> None:
        self._estimator, self._observers = estimator, observers
        self._observing = self._waited = 0.0
        self._snapshot_times, self._snapshots = deque(times), list[Map]()
        self._laps, self._lap_maps = LapCounter(), list[tuple[int, Map]]()
        self._poses, self._records = list[Array](), list[CycleRecord]()

    def cycle(self, odometry: Odometry, detections: Detections) -> None:
        self._take_snapshots(before=detections.t)
        self._waited += timed_wait(self._estimator)
        result, seconds, processor = timed_update(self._estimator, odometry, detections)
        lap_before = self._laps.lap
        lap = self._laps.update(times(np.asarray(result.pose), POSE_LENGTHS, 1.0 / scale(self._estimator)))
        if lap > lap_before:
            self._lap_maps.append((lap_before, self._estimator.map()))
        self._poses.append(np.array(result.pose, dtype=float))
        number = len(self._records)
        cycle = ObservedCycle(self._estimator, detections, result, number, seconds, lap, processor)
        self._records.append(cycle.record)
        begin = time.perf_counter()
        for observer in self._observers:
            observer(cycle)
        if self._observers:
            self._observing += time.perf_counter() - begin

    def result(self, name: str) -> RunResult:
        self._take_snapshots(before=float("inf"))
        begin = time.perf_counter()
        _ask(self._estimator, "finish")
        self._waited += time.perf_counter() - begin
        estimator, records, track = self._estimator, self._records, self._estimator.map()
        if self._laps.last_lap_is_complete:
            self._lap_maps.append((self._laps.lap, track))
        t = np.array([record.t for record in records])
        trajectory = np.array(self._poses).reshape(-1, 3)
        smoothed = _ask(estimator, "smoothed", t)
        smoothed = np.full(3, np.nan) if smoothed is None else smoothed
        is_smoothed = np.isfinite(smoothed)
        return RunResult(
            estimator=name,
            settings=settings_dict(estimator.settings),
            map=track,
            trajectory_t=t,
            trajectory=trajectory,
            cycles=tuple(records),
            laps=self._laps.completed,
            lap_maps=tuple(self._lap_maps),
            snapshots=tuple(self._snapshots),
            vehicle=_ask(estimator, "vehicle_state") if records else None,
            observing=self._observing,
            batches=_ask(estimator, "batches"),
            waited=self._waited,
            noise=_ask(estimator, "noise_used"),
            scale=scale(estimator),
            smoothed=np.where(is_smoothed, smoothed, trajectory) if is_smoothed.any() else None,
        )

    def _take_snapshots(self, before: float) -> None:
        while self._snapshot_times and self._snapshot_times[0] < before:
            self._snapshot_times.popleft()
            self._snapshots.append(self._estimator.map())


def settings_dict(settings: Any) -> dict[str, Any]:
    """Return a settings dataclass with all nested ones as dictionaries, empty for anything else."""
    return asdict(settings) if is_dataclass(settings) and not isinstance(settings, type) else {}
