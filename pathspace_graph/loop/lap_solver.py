"""Batches of the lap: one at a time, in another process, with a due cycle."""

import os
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from math import ceil
from multiprocessing import current_process, resource_tracker
from multiprocessing.util import Finalize
from threading import Thread
from typing import Any, Final, cast

import numpy as np
from joblib.externals import loky
from joblib.externals.loky.backend import resource_tracker as loky_tracker

from pathspace_graph.batch.lap import LapMarginal, OpenLap, solve_lap
from pathspace_graph.copies import Copyable
from pathspace_graph.errors import SingularSystemError
from pathspace_graph.settings.mapper import MapperSettings

WORKER_IDLE: Final = 600  # idle time after which the process ends (s)
WATCH_SECONDS: Final = 1.0  # interval at which a worker checks that its parent is alive (s)
SOLVED: Final = 3.0  # largest distance of a usable result from its optimum (joint sigmas)


@dataclass(frozen=True)
class Unsolved:
    """Failure of a batch."""

    reason: str


BATCH_LATE: Final = Unsolved("the batch of the lap was late")


class LapBatch:
    """Lap that another process solves while the mapper continues."""

    def __init__(self, lap: OpenLap, t: float, due: int, last: int) -> None:
        self.t = t  # stamp of the cycle that sent the lap (s)
        self.due, self.last = due, last  # first and last cycle in which the result may be used
        self.first_kept = lap.first_kept  # first cycle whose pose stays in the window until then
        self._future: Future[LapMarginal] = submit(solve_lap, lap)

    def wait(self) -> None:
        """Wait for the result without limit."""
        wait([self._future])

    def give_up(self) -> None:
        """Cancel the lap; if the process already solves it, end the process."""
        if not self._future.done() and not self._future.cancel():
            _end_worker()

    def marginal(self, timeout: float) -> LapMarginal | Unsolved | None:
        """Return the solution or the failure; None if there is neither after a `timeout` (s)."""
        try:
            solved = self._future.result(timeout)
        except TimeoutError:
            return None
        except SingularSystemError as error:
            return Unsolved(str(error))
        except BrokenProcessPool:
            return Unsolved("the process of the batch has died")
        except Exception as error:  # the vehicle drives on, whatever fails
            failed = f"the batch of the lap has failed: {type(error).__name__}: {error}"
            return Unsolved(" ".join(failed.split()))
        nearly = solved.convergence.converged or solved.convergence.gradient < SOLVED
        return solved if nearly else Unsolved("the batch of the lap has not converged")


def submit(work: Callable[..., Any], *arguments: Any) -> Future[Any]:
    """Submit work to the process, a new one if it has died; the future fails if none can be started."""
    failed = cast("Future[Any]", loky.Future())
    for _ in range(2):
        try:
            with _spared_by_interrupts():
                return cast("Future[Any]", _worker().submit(work, *arguments))
        except Exception as error:  # the process has died, or cannot be started
            _worker.cache_clear()
            failure = error
    failed.set_exception(failure)
    return failed


@contextmanager
def _spared_by_interrupts() -> Iterator[None]:
    """Block SIGINT, so that processes started within ignore Ctrl-C and print no traceback."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    for tracker in (resource_tracker, loky_tracker):
        tracker.ensure_running()  # if started within, it would unblock signals
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@cache
def _worker() -> Any:
    if current_process().daemon:  # such as a worker of Dask, which may have no children
        return ThreadPoolExecutor(max_workers=1)
    executor = loky.ProcessPoolExecutor(
        max_workers=1, timeout=WORKER_IDLE, initializer=end_with, initargs=(os.getpid(),)
    )
    # an exiting process waits for its children, and this one may idle for minutes
    ended = {"wait": False, "kill_workers": True}
    Finalize(None, executor.shutdown, kwargs=ended, exitpriority=1)
    return executor


def end_with(parent: int) -> None:
    """End this process soon after its parent: a killed parent cannot end its workers."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(WATCH_SECONDS)
        os._exit(1)

    if os.getpid() != parent:
        Thread(target=watch, daemon=True).start()


def _end_worker() -> None:
    worker = _worker()
    options = {} if isinstance(worker, ThreadPoolExecutor) else {"kill_workers": True}
    worker.shutdown(wait=False, **options)
    _worker.cache_clear()


def nothing() -> None:
    """Do nothing, but import this module in the process."""


# --- the schedule -------------------------------------------------------------------------------------------


LONGEST_WAIT: Final = 1.0  # longest wait of a cycle for a batch (s)
MOST_LATE: Final = 100  # most cycles by which a batch may be late, after which it is abandoned
CYCLES_SHARE: Final = 0.03  # of a long lap's cycles, after which its result is due, where these are more

Outcome = LapMarginal | Unsolved


class LapSolver(Copyable):
    """The running batch, if there is one, and the cycles in which batches have ended."""

    def __init__(self, settings: MapperSettings) -> None:
        self.late_cycles = 0  # cycles by which the slowest batch would be late in a vehicle, by wall time
        self._settings = settings.open_lap
        self._max_poses = settings.max_poses
        self._batch: LapBatch | None = None
        self._ends: tuple[int, ...] = ()

    @property
    def is_busy(self) -> bool:
        """Whether a batch is running."""
        return self._batch is not None

    @property
    def first_kept(self) -> int | None:
        """Return the first cycle whose pose must stay in the window for a running batch."""
        return self._batch.first_kept if self._batch else None

    def ends(self, next_cycle: int) -> tuple[int, ...]:
        """Return the cycles in which batches ended, with the latest possible one of a batch that is due."""
        batch, ends = self._batch, self._ends
        if batch is None or next_cycle <= batch.due <= batch.last:
            return ends
        return (*ends, batch.last + 1)

    # --- the batch ---------------------------------------------------------------------------------------

    def begin(self, lap: Callable[[int], OpenLap], window: tuple[int, int], t: float) -> None:
        """Send a lap, built for its first kept cycle, at t (s) in the newest cycle of the window.

        The result is due some cycles later; in a replay, in the recorded cycle.
        """
        settings, (first, cycle) = self._settings, window
        wait = max(min(settings.cycles, cycle - first), int(CYCLES_SHARE * cycle))
        first_kept, due = min(first + wait, cycle), cycle + wait
        last = max(due, min(due + MOST_LATE, first_kept + self._max_poses - 1))
        recorded = settings.ends[len(self._ends) :][:1]
        due = min(max([due, *recorded]), last + 1)
        self._batch = LapBatch(lap(first_kept), t, due, last)

    def give_up(self, next_cycle: int) -> None:
        """Cancel the running batch."""
        if self._batch is not None:
            self._batch.give_up()
            self._batch = None
            self._ends = (*self._ends, next_cycle)

    # --- results -----------------------------------------------------------------------------------------

    def wait(self, next_cycle: int) -> None:
        """Wait without limit for the batch whose result may be due in the next cycle."""
        batch = self._batch
        if batch is not None and batch.due <= next_cycle <= batch.last:
            batch.wait()

    def outcome(self, cycle: int, times: Sequence[float], first_cycle: int, spent: float) -> Outcome | None:
        """Return the result of the batch if it is due and ready; None otherwise.

        The window has stamps `times` (s) from `first_cycle` on. The wait ends with the period of the cycle,
        of which `spent` (s) is over. A batch past its last cycle is cancelled.
        """
        batch = self._batch
        if batch is None or cycle < batch.due:
            return None
        period = float(np.ptp(times[-2:]))
        outcome: Outcome | None = BATCH_LATE
        if cycle <= batch.last:
            outcome = batch.marginal(max(min(period, LONGEST_WAIT) - spent, 0.0))
        else:
            batch.give_up()
        if outcome is None:
            return None
        if isinstance(outcome, LapMarginal) and period > 0.0:
            given = times[batch.due - first_cycle] - batch.t
            self.late_cycles = max(self.late_cycles, ceil((outcome.seconds - given) / period))
        self._batch = None
        self._ends = (*self._ends, cycle)
        return outcome

    def last_outcome(self, cycle: int) -> Outcome | None:
        """Wait for the result of the running batch after the last cycle of a drive.

        In a replay, a batch that ended later keeps running.
        """
        if self._batch is None or self._settings.ends[len(self._ends) :]:
            return None
        self._batch.wait()
        outcome, self._batch = self._batch.marginal(0.0), None
        self._ends = (*self._ends, cycle)
        return outcome
