"""One loop for every online estimator: a log goes in cycle by cycle, a map and a trajectory come out."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, is_dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pathspace_graph.io.log import Detections, Log, Odometry
from pathspace_graph.io.map import Map
from pathspace_graph.io.results import BatchRun, CycleRecord, RunResult

from .labels import LEFT, RIGHT
from .laps import LapCounter

Array = NDArray[np.float64]


class OnlineEstimate(Protocol):
    """What an online estimator says after one perception cycle."""

    @property
    def pose(self) -> Array:
        """The vehicle's pose [x, y, theta] (3,), map frame, at the cycle's stamp."""

    @property
    def sizes(self) -> tuple[int, int]:
        """Control points or landmarks of the left and the right boundary."""

    @property
    def readings(self) -> int:
        """How many of the cycle's readings were used."""

    @property
    def stages(self) -> Mapping[str, float]:
        """Time (s) that each stage of the update took, by its name."""


class OnlineEstimator(Protocol):
    """The one face of every online estimator."""

    @property
    def settings(self) -> Any:
        """A frozen dataclass of everything that it was told."""

    def update(self, odometry: Odometry, detections: Detections) -> OnlineEstimate:
        """One perception cycle: the twists since the last one, and what was detected now."""

    def map(self) -> Map:
        """The map as it stands, a copy."""


class BatchEstimator(Protocol):
    """The one face of every batch estimator."""

    @property
    def settings(self) -> Any:
        """A frozen dataclass of everything that it was told."""

    def solve(self, log: Log) -> BatchRun:
        """The optimum over a whole log, whose truth isn't read."""


def split_odometry(log: Log) -> Iterator[tuple[Odometry, Detections]]:
    """Each perception cycle with the twists in force since the one before, nothing later than its own stamp.

    Rows [t_i, t_(i+1)) tile the time from the first odometry stamp to the cycle: the first row begins at the
    last cycle's stamp with the twist that was held there, the last one is held until the cycle.
    """
    since = float(log.odometry.t[0])
    for detections in log.cycles:
        yield log.odometry.between(since, detections.t), detections
        since = detections.t


def timed_update(
    estimator: OnlineEstimator, odometry: Odometry, detections: Detections
) -> tuple[OnlineEstimate, float]:
    """Does one update, and returns the estimate and the wall time (s) that the update took."""
    begin = time.perf_counter()
    estimate = estimator.update(odometry, detections)
    return estimate, time.perf_counter() - begin


def run_online(
    log: Log,
    estimator: OnlineEstimator,
    *,
    name: str = "fixed-lag",
    snapshot_times: Sequence[float] | Array = (),
    on_cycle: Callable[[CycleRecord], None] | None = None,
) -> RunResult:
    """Feeds a log's odometry and cycles to an online estimator, in order of time and never ahead of it.

    The truth of the log is not read. `snapshot_times` (s, ascending): a map is kept as it stood then, after
    the last cycle that isn't later. `on_cycle` is told of each cycle when it is done. BLAS has one thread.
    """
    run = _Run(estimator, [float(t) for t in snapshot_times])
    with threadpool_limits(limits=1):
        for odometry, detections in split_odometry(log):
            record = run.cycle(odometry, detections)
            if on_cycle is not None:
                on_cycle(record)
        return run.result(name)


class _Run:
    """A run in progress."""

    def __init__(self, estimator: OnlineEstimator, snapshot_times: list[float]) -> None:
        self._estimator = estimator
        self._snapshot_times = snapshot_times
        self._snapshots: list[Map] = []
        self._laps = LapCounter()
        self._lap_maps: list[tuple[int, Map]] = []
        self._poses: list[Array] = []
        self._records: list[CycleRecord] = []

    def cycle(self, odometry: Odometry, detections: Detections) -> CycleRecord:
        """One update, timed, and what it did to the map and the lap."""
        self._take_snapshots(before=detections.t)
        estimate, seconds = timed_update(self._estimator, odometry, detections)
        lap_before = self._laps.lap
        lap = self._laps.update(estimate.pose)
        if lap > lap_before:
            self._lap_maps.append((lap_before, self._estimator.map()))
        self._poses.append(np.array(estimate.pose, dtype=float))
        self._records.append(
            CycleRecord(
                cycle=len(self._records),
                t=detections.t,
                seconds=seconds,
                size_left=estimate.sizes[LEFT],
                size_right=estimate.sizes[RIGHT],
                readings=estimate.readings,
                lap=lap,
                stages=dict(estimate.stages),
            )
        )
        return self._records[-1]

    def result(self, name: str) -> RunResult:
        """All of it, after the last cycle."""
        self._take_snapshots(before=float("inf"))
        track = self._estimator.map()
        if self._laps.last_lap_is_complete:
            self._lap_maps.append((self._laps.lap, track))
        return RunResult(
            estimator=name,
            settings=settings_dict(self._estimator.settings),
            map=track,
            trajectory_t=np.array([record.t for record in self._records]),
            trajectory=np.array(self._poses).reshape(-1, 3),
            cycles=tuple(self._records),
            laps=self._laps.completed,
            lap_maps=tuple(self._lap_maps),
            snapshots=tuple(self._snapshots),
        )

    def _take_snapshots(self, before: float) -> None:
        while len(self._snapshots) < len(self._snapshot_times):
            if self._snapshot_times[len(self._snapshots)] >= before:
                return
            self._snapshots.append(self._estimator.map())


def settings_dict(settings: Any) -> dict[str, Any]:
    """A settings dataclass, nested ones included, as plain dicts."""
    return asdict(settings) if is_dataclass(settings) and not isinstance(settings, type) else {}


@dataclass(frozen=True, eq=False)
class CycleResult:
    """The estimate after one perception cycle."""

    t: float
    """Stamp, s."""
    pose: Array
    """(3,) x (m), y (m), theta (rad, not wrapped), map frame."""
    sizes: tuple[int, int]
    """Control points, or landmarks, of the left and the right boundary."""
    readings: int
    """How many of the cycle's readings were used."""
    closed: bool
    """Whether the loop has closed."""
    stages: dict[str, float] = field(default_factory=dict)
    """Time (s) that each stage of the update took, by its name."""
