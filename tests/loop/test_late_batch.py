"""A batch that is late: no cycle waits for it longer than its period, and a replay does not depend on it."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from threading import Timer
from typing import Any

import numpy as np
import pytest
from joblib.externals import loky
from threadpoolctl import threadpool_limits

from pathspace_graph.batch.lap import LapMarginal, OpenLap, solve_lap
from pathspace_graph.errors import SingularSystemError
from pathspace_graph.factors.se2 import path_lengths, relative, wrap_angle
from pathspace_graph.io.log import Detections, Log, Odometry
from pathspace_graph.labels import LEFT
from pathspace_graph.loop import lap_solver
from pathspace_graph.loop.known_loop import REPAIRED
from pathspace_graph.loop.lap_solver import LONGEST_WAIT
from pathspace_graph.loop.open import RETRY, STAYS_OPEN, Open, ReturnFinder, Revisits
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.run import CycleResult, run_online, split_odometry
from pathspace_graph.settings.mapper import MapperSettings

from ..scenes.drives import map_log, mapped, replay, true_poses
from ..scenes.drives import noisy_lap as log
from ..scenes.holes import unseen
from ..scenes.kidnapped import laps_log, pear_track
from ..shared.copied import copied
from ..shared.laps import IN_A_PROCESS, solved

Work = Callable[..., Any]
PERIOD, NEVER = 0.1, -1


class Slow(Future[LapMarginal]):
    """A batch that is under way until it is told to end, and at once says that it is."""

    def __init__(self, lap: OpenLap) -> None:
        super().__init__()
        self.lap = lap
        self.timeouts: list[float] = []
        self.set_running_or_notify_cancel()

    def result(self, timeout: float | None = None) -> LapMarginal:
        assert timeout is not None
        self.timeouts.append(timeout)
        return super().result(0.0)

    def end(self) -> None:
        self.set_result(solved(self.lap))


@pytest.fixture
def sent(monkeypatch: pytest.MonkeyPatch) -> list[Slow]:
    """The batches that were sent."""
    batches: list[Slow] = []

    def submit(work: Work, *arguments: Any) -> Future[Any]:
        if work is not solve_lap:
            return Future()
        batches.append(Slow(*arguments))
        return batches[-1]

    monkeypatch.setattr(lap_solver, "submit", submit)
    return batches


def with_settings(**changes: object) -> FixedLagMapper:
    settings = MapperSettings()
    settings = replace(settings, open_lap=replace(settings.open_lap, **changes))  # type: ignore[arg-type]
    return FixedLagMapper(settings, log().noise)


@dataclass(frozen=True)
class Stem:
    """The open lap with the settings as they are, from which each test goes on with a mapper of its own."""

    before: FixedLagMapper
    results: list[CycleResult]

    def mapper(self) -> FixedLagMapper:
        return copied(self.before)

    def rest(self, log: Log) -> Iterator[tuple[Odometry, Detections]]:
        """The cycles that follow."""
        return islice(split_odometry(log), len(self.results), None)


@pytest.fixture(scope="module")
def stem() -> Stem:
    mapper, results = map_log(replace(log(), cycles=log().cycles[:130]))
    assert not results[-1].closed and mapper.drive.solver._batch is None
    return Stem(mapper, results)


def drive(
    mapper: FixedLagMapper, sent: list[Slow], late: int, log: Log, known: Sequence[CycleResult] = ()
) -> list[CycleResult]:
    """Drives as a vehicle does; each batch ends so many cycles after the one in which it is due.

    What is known was said of the first cycles by the same mapper.
    """
    results = [*known]
    with threadpool_limits(limits=1):
        for odometry, detections in islice(split_odometry(log), len(known), None):
            batch = mapper.drive.solver._batch
            if late >= 0 and batch is not None and mapper.road.smoother.next_cycle == batch.due + late:
                sent[-1].end()
            results.append(mapper.update(odometry, detections))
    return results


def due_cycle(batch: Slow) -> int:
    """The cycle in which a batch is due that was sent in the last one of its lap."""
    return len(batch.lap.chain) - 1 + MapperSettings().open_lap.cycles


def test_no_cycle_waits_longer_than_its_period_and_the_swap_comes_once_the_result_is_there(
    sent: list[Slow], stem: Stem
) -> None:
    mapper = stem.mapper()
    results = drive(mapper, sent, 7, log(), stem.results)
    (batch,) = sent
    due = due_cycle(batch)
    assert [k for k, result in enumerate(results) if result.jump is not None] == [due + 7]
    assert [result.closed for result in results] == [k >= due + 7 for k in range(len(results))]
    assert mapper.batches().ends == (due + 7,)
    assert len(batch.timeouts) == 8
    assert all(0.0 <= timeout < PERIOD + 1e-9 for timeout in batch.timeouts)
    assert not any(result.notice for result in results)


def test_where_the_stamps_jump_a_cycle_does_not_wait_for_all_that_time(sent: list[Slow], stem: Stem) -> None:
    drive(stem.mapper(), sent, 0, log(), stem.results)
    due = due_cycle(sent[0])
    sent.clear()
    gap = replace(log(), cycles=(*log().cycles[: due + 1], *log().cycles[due + 16 :]))
    drive(stem.mapper(), sent, 3, gap, stem.results)
    first, jumped, *later = sent[0].timeouts
    assert max(first, *later) < PERIOD + 1e-9 < jumped < LONGEST_WAIT


@pytest.mark.parametrize("late", [7, NEVER])
def test_the_recorded_cycle_replays_the_drive_to_the_bit(
    late: int, sent: list[Slow], stem: Stem, monkeypatch: pytest.MonkeyPatch
) -> None:
    """That is so too where the drive has ended before its late batch has."""
    vehicle = stem.mapper()
    drive(vehicle, sent, late, log(), stem.results)
    assert_replayed(log(), vehicle, 1, sent, monkeypatch)


def test_a_map_is_mended_by_a_late_batch_and_replayed_to_the_bit(
    sent: list[Slow], monkeypatch: pytest.MonkeyPatch
) -> None:
    log, vehicle = unseen(laps_log(pear_track()), [LEFT], 6.0, 11.0), with_settings()
    log = replace(log, cycles=log.cycles[:380])
    results = drive(vehicle, sent, 9, log)
    assert_replayed(log, vehicle, 2, sent, monkeypatch)
    assert [result.notice.startswith(REPAIRED) for result in results if result.notice] == [True]


def assert_replayed(
    log: Log, vehicle: FixedLagMapper, batches: int, sent: list[Slow], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another mapper, with the cycles in which the batches ended, maps the log from its beginning."""
    ends = vehicle.batches().ends
    assert len(ends) == len(sent) == batches
    monkeypatch.undo()
    again = with_settings(ends=ends)
    result = run_online(log, again)
    assert result.batches is not None and result.batches.ends == ends
    assert_same(again, vehicle)


def assert_same(mapper: FixedLagMapper, expected: FixedLagMapper) -> None:
    assert (mapper.poses == expected.poses).all()
    for label in expected.boundaries:
        assert (mapper.control_points(label) == expected.control_points(label)).all()
    keys = expected.road.smoother.map.state.map_keys
    assert (mapper.road.smoother.covariance(keys) == expected.road.smoother.covariance(keys)).all()


def test_a_slow_machine_changes_nothing_of_a_replay(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its process is slower than the log by far; the run waits for it between two cycles."""

    def submit(work: Work, *arguments: Any) -> Future[Any]:
        future: Future[Any] = Future()
        if work is solve_lap:
            slower = replace(solved(*arguments), seconds=5.0)
            Timer(1.0, future.set_result, [slower]).start()
        return future

    expected, mapper = mapped(log())[0], with_settings()
    monkeypatch.setattr(lap_solver, "submit", submit)
    result = run_online(log(), mapper)
    assert_same(mapper, expected)
    assert result.waited > 0.0
    assert result.batches is not None
    assert result.batches.ends == expected.batches().ends
    assert result.cycles[result.batches.ends[0]].jump is not None
    assert result.batches.late == pytest.approx((5.0 - 2.0) / PERIOD, abs=1)


def test_a_batch_that_never_ends_is_given_up_and_the_window_is_the_lag_again(
    sent: list[Slow], monkeypatch: pytest.MonkeyPatch
) -> None:
    ended: list[bool] = []
    monkeypatch.setattr(lap_solver, "_end_worker", lambda: ended.append(True))
    monkeypatch.setattr("pathspace_graph.loop.lap_solver.MOST_LATE", 12)
    monkeypatch.setattr("pathspace_graph.loop.open.RETRY", 1e3)  # the next one would be sent at once
    mapper = with_settings()
    results = drive(mapper, sent, NEVER, log())
    end = due_cycle(sent[0]) + 13
    notices = {k: result.notice for k, result in enumerate(results) if result.notice}
    assert notices == {end: f"{STAYS_OPEN}: the batch of the lap was late"}
    assert not any(result.closed for result in results)
    assert mapper.batches().ends == (end,)
    assert ended == [True]
    assert len(mapper.poses) == 31
    replayed = with_settings(ends=(end,))
    run_online(log(), replayed)  # waits for nothing, since the batch ends in no cycle
    assert_same(replayed, mapper)


def test_a_late_batch_makes_the_window_no_longer_than_the_longest(sent: list[Slow], stem: Stem) -> None:
    mapper = stem.mapper()
    mapper.drive.solver._max_poses = 40
    sizes = []
    for cycle in stem.rest(log()):
        mapper.update(*cycle)
        sizes.append(len(mapper.poses))
    assert max(sizes) == 40


def test_a_process_that_was_given_up_does_not_block_the_next_batch() -> None:
    stuck = lap_solver.submit(time.sleep, 600.0)
    while not stuck.running():
        time.sleep(0.01)
    batch = object.__new__(lap_solver.LapBatch)
    batch._future = stuck
    batch.give_up()
    assert lap_solver.submit(sum, [1, 2]).result(120.0) == 3


USES_A_WORKER = """
from multiprocessing import get_context
from pathspace_graph.loop import lap_solver

def use():
    assert lap_solver.submit(sum, [1, 2]).result(120.0) == 3

if __name__ == "__main__":
    process = get_context("spawn").Process(target=use)
    process.start()
    process.join()
    raise SystemExit(process.exitcode)
"""


def test_a_process_ends_though_its_own_one_for_laps_is_idle(tmp_path: Path) -> None:
    """A worker of a study that is replaced would wait for it, and the study with it."""
    script = tmp_path / "uses_a_worker.py"
    script.write_text(USES_A_WORKER)
    assert subprocess.run([sys.executable, str(script)], timeout=120.0, check=False).returncode == 0


@pytest.mark.skipif(not hasattr(signal, "pthread_sigmask"), reason="Windows")
def test_the_process_starts_with_the_mapper_and_cycles_submit_laps_only(
    stem: Stem, monkeypatch: pytest.MonkeyPatch
) -> None:
    submitted = list[Work]()

    def submit(work: Work, *_: Any) -> Future[Any]:
        submitted.append(work)
        return Future()

    monkeypatch.setattr(lap_solver, "submit", submit)
    FixedLagMapper()
    assert submitted == [lap_solver.nothing]
    mapper = stem.mapper()
    for odometry, cycle in stem.rest(log()):
        mapper.update(odometry, cycle)
        if mapper.drive.solver.is_busy:
            break
    assert submitted[1:] == [solve_lap]


def test_an_interrupt_does_not_reach_the_process_of_the_batch_and_reaches_this_one() -> None:
    """Ctrl-C goes to all processes of a terminal; one that is still importing would print where it was."""
    if lap_solver._worker.cache_info().currsize:
        lap_solver._end_worker()
    blocked = lap_solver.submit(signal.pthread_sigmask, signal.SIG_BLOCK, ()).result(120.0)
    assert signal.SIGINT in blocked
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ())


@pytest.mark.parametrize("error", [ValueError("a\nb"), np.linalg.LinAlgError("c"), KeyError(3)])
def test_what_fails_in_the_process_is_a_notice(error: Exception, sent: list[Slow], stem: Stem) -> None:
    mapper, notices = stem.mapper(), []
    for cycle in stem.rest(log()):
        if sent and not sent[0].done():
            sent[0].set_exception(error)
        notices.append(mapper.update(*cycle).notice)
    told = " ".join(str(error).split())
    failed = f"the batch of the lap has failed: {type(error).__name__}: {told}"
    assert [notice for notice in notices if notice] == [f"{STAYS_OPEN}: {failed}"]
    assert len(sent) == 2  # the next one is sent some metres later


def test_where_no_process_can_be_begun_there_is_a_notice(stem: Stem, monkeypatch: pytest.MonkeyPatch) -> None:
    class Executor:
        def submit(self, *_: Any) -> Any:
            raise OSError("out of memory")

        def shutdown(self, **_: Any) -> None: ...

    lap_solver._worker.cache_clear()
    monkeypatch.setattr(loky, "ProcessPoolExecutor", lambda **_: Executor())
    monkeypatch.setattr(lap_solver, "submit", IN_A_PROCESS)
    mapper = stem.mapper()
    results = [replay(mapper, *cycle) for cycle in stem.rest(log())]
    failed = f"{STAYS_OPEN}: the batch of the lap has failed: OSError: out of memory"
    assert {result.notice for result in results if result.notice} == {failed}


KILLED = """
import os, signal
from pathspace_graph.loop import lap_solver

print(lap_solver.submit(os.getpid).result(), flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_the_process_of_the_batch_ends_with_a_mapper_that_is_killed() -> None:
    run = subprocess.run([sys.executable, "-c", KILLED], stdout=subprocess.PIPE, timeout=60.0, check=False)
    assert run.returncode == -signal.SIGKILL
    assert int(run.stdout) > 0  # it was begun; and its end was waited for, since it has the same output


# --- what a batch begins with ----------------------------------------------------------------------------


def test_a_return_begins_the_batch_with_a_pose_beside_an_early_one(sent: list[Slow], stem: Stem) -> None:
    mapper, truth = stem.mapper(), true_poses(log())
    for cycle in stem.rest(log()):
        mapper.update(*cycle)
        if sent:
            break
    (revisit,) = sent[0].lap.revisits
    assert sent[0].lap.start is None and revisit.later == mapper.road.smoother.next_cycle - 2
    assert np.hypot(*revisit.local[:2]) < 3.0 and path_lengths(truth)[revisit.earlier] < 60.0
    off = revisit.local - relative(truth[revisit.earlier], truth[revisit.later])
    assert np.hypot(*off[:2]) < 0.8
    assert abs(wrap_angle(off[2:])[0]) < 0.05


def test_a_return_in_the_last_cycle_of_a_drive_closes_the_loop(stem: Stem) -> None:
    mapper = stem.mapper()
    for cycle in stem.rest(log()):
        mapper.update(*cycle)
        assert isinstance(mapper.phase, Open)
        if mapper.phase._found is not None:
            break
    assert not mapper.drive.solver.is_busy
    mapper.finish()
    assert mapper.closed


# --- a batch that does not agree -------------------------------------------------------------------------

Refuse = Callable[[Slow], None]


def says(objection: str) -> Refuse:
    """What ends a batch whose map is objected to."""

    def end(batch: Slow) -> None:
        batch.set_result(replace(solved(batch.lap), objection=objection))

    return end


def is_singular(batch: Slow) -> None:
    batch.set_exception(SingularSystemError("singular"))


@pytest.mark.parametrize(
    ("refuse", "reason"),
    [
        (says("its boundaries cross"), "its boundaries cross"),
        (is_singular, "singular"),
    ],
)
def test_a_loop_stays_open_until_a_batch_agrees(
    refuse: Refuse, reason: str, sent: list[Slow], stem: Stem
) -> None:
    """The next one is sent some metres later."""
    mapper, results = stem.mapper(), []
    for cycle in stem.rest(log()):
        for batch in sent:
            if not batch.done():
                refuse(batch) if batch is sent[0] else batch.end()
        results.append(mapper.update(*cycle))
    notices = [k for k, result in enumerate(results) if result.notice]
    assert [results[k].notice for k in notices] == [f"{STAYS_OPEN}: {reason}"]
    assert results[notices[0]].jump is None and not results[notices[0]].closed
    jumps = [k for k, result in enumerate(results) if result.jump is not None]
    assert [result.closed for result in results].index(True) == jumps[0] > notices[0]
    assert len(sent) == 2 and mapper.failures == 0
    between = sent[1].lap.chain.dead_reckoned(np.zeros(2))[len(sent[0].lap.chain) - 1 :]
    assert path_lengths(between)[-1] >= RETRY


def test_nothing_changes_before_a_batch_agrees(
    sent: list[Slow], stem: Stem, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A mapper whose batches are all refused maps on as one that never sends any.

    Its window is longer while a batch is under way.
    """
    refused, open_map = stem.mapper(), stem.mapper()
    for cycle in stem.rest(log()):
        for batch in sent:
            if not batch.done():
                is_singular(batch)
        refused.update(*cycle)
    assert len(sent) >= 1 and not refused.closed
    for finder in (ReturnFinder, Revisits):
        monkeypatch.setattr(finder, "find", lambda *_: None)
    for cycle in stem.rest(log()):
        open_map.update(*cycle)
    assert not open_map.closed
    np.testing.assert_allclose(refused.poses[-1], open_map.poses[-1], atol=0.02)
    for label, boundary in open_map.boundaries.items():
        u = np.linspace(0.0, boundary.confirmed_end, 100)
        curves = (m.boundaries[label].evaluate(m.control_points(label), u) for m in (refused, open_map))
        np.testing.assert_allclose(*curves, atol=0.05)
