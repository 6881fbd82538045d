"""The loop over a log: every twist once, none from the future, and maps kept from the right moment."""

from __future__ import annotations

import gc
import pickle
import time
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from typing import Any

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from threadpoolctl import threadpool_info

from pathspace_graph.io.log import Detections, Log, Odometry
from pathspace_graph.io.map import Map, PointBoundary
from pathspace_graph.labels import LEFT
from pathspace_graph.run import CycleResult, ObservedCycle, StageTimes, Stopwatch, run_online, split_odometry


def detections(t: float) -> Detections:
    return Detections(t, np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0, dtype=int))


def make_log(odometry_t: np.ndarray, cycle_t: np.ndarray, twist: np.ndarray | None = None) -> Log:
    twist = np.arange(3.0 * len(odometry_t)).reshape(-1, 3) if twist is None else twist
    return Log(Odometry(odometry_t, twist), tuple(detections(float(t)) for t in cycle_t), np.ones(3))


@dataclass(frozen=True)
class Settings:
    """Holds the settings of the estimator below."""

    inner: dict[str, float] = field(default_factory=lambda: {"a": 1.0})


class Counting:
    """An estimator whose map has as many points as there were cycles, and that drives given poses."""

    def __init__(self, poses: np.ndarray | None = None) -> None:
        self.settings = Settings()
        self.poses = poses
        self.count = 0
        self.threads: set[int] = set()

    def update(self, odometry: Odometry, detections: Detections) -> CycleResult:
        assert (odometry.t < detections.t).all()
        self.threads |= {pool["num_threads"] for pool in threadpool_info()}
        self.count += 1
        pose = np.zeros(3) if self.poses is None else self.poses[self.count - 1]
        return CycleResult(detections.t, pose, (self.count, 0), 5, False)

    def map(self) -> Map:
        size = self.count
        return Map(False, {LEFT: PointBoundary(np.zeros((size, 2)), np.zeros((2 * size, 2 * size)))})


def circles(laps: float, n: int = 200) -> np.ndarray:
    """Poses of n per lap (a hair more, to pass the line) around a circle of 20 m radius, from (0, 0, 0)."""
    angle = np.arange(round(laps * n)) * 2 * np.pi / n * (1 + 1e-6)
    return np.column_stack([20.0 * np.sin(angle), 20.0 * (1.0 - np.cos(angle)), angle])


# --- split_odometry --------------------------------------------------------------------------------------

stamps = st.lists(st.integers(0, 60), min_size=1, max_size=12, unique=True).map(sorted)


@given(odometry=stamps, cycles=stamps)
def test_segments_tile_the_time_with_the_twist_in_force(odometry: list[int], cycles: list[int]) -> None:
    odometry_t = np.array(odometry) / 4.0
    cycle_t = np.array([t for t in cycles if t >= odometry[0]]) / 4.0
    log = make_log(odometry_t, cycle_t)
    since = odometry_t[0]
    for segment, cycle in split_odometry(log):
        edges = np.append(segment.t, cycle.t)
        assert edges[0] == since or cycle.t == since
        assert (np.diff(edges) > 0).all()
        for twist, (begin, end) in zip(segment.twist, pairwise(edges), strict=True):
            middle = (begin + end) / 2
            in_force = log.odometry.twist[np.flatnonzero(odometry_t <= middle)[-1]]
            np.testing.assert_array_equal(twist, in_force)
        assert np.diff(edges).sum() == cycle.t - since
        since = cycle.t


# --- run_online ------------------------------------------------------------------------------------------


def run(cycles: int, poses: np.ndarray | None = None, **options: Any) -> tuple[Any, Counting]:
    estimator = Counting(poses)
    t = np.arange(cycles) / 10.0
    return run_online(make_log(np.array([0.0]), t), estimator, **options), estimator


def test_outlines_are_maps_of_laps_and_snapshots_without_covariances() -> None:
    class Outlined(Counting):
        def outline(self) -> Map:
            return Map(False, {LEFT: PointBoundary(np.zeros((self.count, 2)), np.zeros((0, 0)))})

    poses = circles(2.1)
    log = make_log(np.array([0.0]), np.arange(len(poses)) / 10.0)
    result = run_online(log, Outlined(poses), snapshot_times=[5.0], outlines=True)
    assert [track.left.size for _, track in result.lap_maps] == [201, 401]
    assert all(track.left.covariance.size == 0 for _, track in result.lap_maps)
    assert [track.left.size for track in result.snapshots] == [51]
    assert result.map.left.covariance.shape == (840, 840)


def test_every_cycle_has_its_record_and_its_pose() -> None:
    poses = circles(0.1, 100)
    seen: list[ObservedCycle] = []
    result, _ = run(10, poses, observers=[seen.append], name="counting")
    assert result.estimator == "counting"
    assert result.settings == {"inner": {"a": 1.0}}
    records = result.cycles
    assert [record.cycle for record in records] == [cycle.number for cycle in seen] == list(range(10))
    assert [record.size_left for record in records] == list(range(1, 11))
    assert {(record.size_right, record.readings, record.lap) for record in records} == {(0, 5, 1)}
    assert [record.seconds for record in records] == [cycle.seconds for cycle in seen]
    assert all(record.seconds > 0 for record in records)
    np.testing.assert_array_equal(result.trajectory, poses)
    np.testing.assert_array_equal(result.trajectory_t, [record.t for record in records])
    assert result.map.size == 10


def test_snapshots_are_the_maps_as_they_stood_then() -> None:
    result, _ = run(10, snapshot_times=[-1.0, 0.0, 0.05, 0.3, 0.3, 0.9, 5.0, 7.0])
    assert [track.size for track in result.snapshots] == [0, 1, 1, 4, 4, 10, 10, 10]


def test_laps_are_counted_on_the_estimated_trajectory() -> None:
    result, _ = run(450, circles(2.25))
    assert result.laps == 2
    assert [record.lap for record in result.cycles[:200]] == [1] * 200
    assert [lap for lap, _ in result.lap_maps] == [1, 2]
    assert [track.size for _, track in result.lap_maps] == [201, 401]
    assert result.cycles[-1].lap == 3


def test_a_log_without_cycles_gives_an_empty_result() -> None:
    result, estimator = run(0, snapshot_times=[1.0])
    assert estimator.count == 0
    assert result.trajectory.shape == (0, 3)
    assert result.trajectory_t.shape == (0,)
    assert result.cycles == ()
    assert [track.size for track in result.snapshots] == [0]


def test_observers_see_each_cycle_with_the_map_as_it_stands_then() -> None:
    seen: list[tuple[float, int, int]] = []
    others: list[Map] = []

    def look(cycle: ObservedCycle) -> None:
        seen.append((cycle.result.t, cycle.outline.size, cycle.map.size))

    result, _ = run(5, observers=[look, lambda cycle: others.append(cycle.map)])
    assert seen == [(k / 10.0, k + 1, k + 1) for k in range(5)]
    assert [track.size for track in others] == [1, 2, 3, 4, 5]
    assert result.observing > 0.0 and result.reach is None
    assert run(5)[0].observing == 0.0


def test_the_time_of_an_observer_is_not_the_cycle_s(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: clock[0])

    def look(_: ObservedCycle) -> None:
        clock[0] += 1.0

    result, _ = run(3, observers=[look])
    assert result.observing == 3.0
    assert [record.seconds for record in result.cycles] == [0.0, 0.0, 0.0]


def test_what_an_estimator_does_not_say_is_not_shown() -> None:
    seen: list[ObservedCycle] = []
    run(1, observers=[seen.append])
    assert seen[0].readings is None
    assert seen[0].window.shape == (0, 3)


def test_closing_and_jumps_are_recorded() -> None:
    class Closing(Counting):
        def update(self, odometry: Odometry, detections: Detections) -> CycleResult:
            result = super().update(odometry, detections)
            jump = np.array([0.1, 0.2, 0.0]) if self.count == 4 else None
            return replace(result, closed=self.count >= 3, jump=jump, notice="hm" if self.count == 2 else "")

    result = run_online(make_log(np.array([0.0]), np.arange(5) / 10.0), Closing())
    assert [record.closed for record in result.cycles] == [False, False, True, True, True]
    assert [record.jump for record in result.cycles] == [None, None, None, (0.1, 0.2, 0.0), None]
    assert result.cycles[1].notice == "hm"


def test_an_outline_is_preferred_to_a_map() -> None:
    class Outlining(Counting):
        def outline(self) -> Map:
            return Map(True, {})

    log, closed = make_log(np.array([0.0]), np.array([0.1])), []
    for estimator in (Outlining(), Counting()):
        run_online(log, estimator, observers=[lambda cycle: closed.append(cycle.outline.closed)])
    assert closed == [True, False]


def test_blas_has_one_thread_while_it_runs() -> None:
    _, estimator = run(2)
    assert estimator.threads == {1}


def test_the_collector_leaves_alone_what_there_was_before_and_what_survives() -> None:
    """A full collection of all that is imported, or of a long drive's record, takes a cycle 0.1 s."""
    frozen, kept, callbacks = list[int](), list[object](), [*gc.callbacks]

    def observe(_: ObservedCycle) -> None:
        kept.append([[] for _ in range(1000)])
        gc.collect(0)
        frozen.append(gc.get_freeze_count())

    run(2, observers=[observe])
    assert frozen[0] > 0 and frozen[1] > frozen[0] + 900
    assert gc.get_freeze_count() == 0 and gc.callbacks == callbacks


def test_what_a_caller_froze_stays_frozen() -> None:
    gc.freeze()
    try:
        run(2)
        assert gc.get_freeze_count() > 0
    finally:
        gc.unfreeze()


class Forbidden:
    """A truth that may not be looked at."""

    def __getattribute__(self, name: str) -> Any:
        raise AssertionError(f"an online run read the truth's {name}")


def test_the_truth_is_not_read() -> None:
    log = replace(make_log(np.array([0.0]), np.arange(5) / 10), truth=Forbidden())
    assert len(run_online(log, Counting()).cycles) == 5


def test_a_stage_that_comes_twice_keeps_the_time_of_both(monkeypatch: pytest.MonkeyPatch) -> None:
    times = iter([0.0, 1.0, 3.0, 6.0])
    monkeypatch.setattr("pathspace_graph.run.time.perf_counter", lambda: next(times))
    watch = Stopwatch()
    for stage in ("optimum", "start", "optimum"):
        watch.lap(stage)
    assert watch.laps == {"optimum": 4.0, "start": 2.0}
    kept = pickle.loads(pickle.dumps(StageTimes(watch.laps)))
    assert kept == watch.laps and [*kept] == [*watch.laps]
    with pytest.raises(KeyError):
        kept["end"]
    assert watch.spent == 6.0


def test_an_estimator_gets_its_own_factors_with_the_cycle_of_their_newest_pose() -> None:
    x, b = (partial(gtsam.symbol, letter) for letter in "xb")
    noise = gtsam.noiseModel.Isotropic.Sigma(3, 1.0)
    span = gtsam.BetweenFactorPose2(x(2), x(0), gtsam.Pose2(), noise)
    alone = [gtsam.PriorFactorPose2(x(k), gtsam.Pose2(), noise) for k in (1, 2)]
    calibration = gtsam.PriorFactorPoint2(b(0), np.zeros(2), gtsam.noiseModel.Unit.Create(2))

    given: dict[float, list[gtsam.NonlinearFactor]] = {}

    class Asked(Counting):
        def factors(self, log: Log) -> list[gtsam.NonlinearFactor]:
            return [span, *alone, calibration]

        def update(self, odometry: Odometry, seen: Detections, factors: Any = ()) -> CycleResult:
            if factors:
                given[seen.t] = factors
            return super().update(odometry, seen)

    log = make_log(np.arange(5.0), np.arange(5.0))
    run_online(log, Asked())
    assert given == {0: [calibration], 1: [alone[0]], 2: [span, alone[1]]}
