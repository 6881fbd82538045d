"""The process that solves laps: one lap at a time, handed over, waited for, or taken from it."""

import os
import signal
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from multiprocessing import current_process, resource_tracker
from multiprocessing.util import Finalize
from threading import Thread
from typing import Any, Final, cast

from joblib.externals import loky
from joblib.externals.loky.backend import resource_tracker as loky_tracker

from pathspace_graph.batch.lap import LapMarginal, OpenLap, solve_lap
from pathspace_graph.errors import SingularSystemError

WORKER_IDLE: Final = 600  # time with nothing to do after which the process that solves laps ends (s)
WATCH_SECONDS: Final = 1.0  # at which a worker checks whether the process that started it is still there
SOLVED: Final = 3.0  # distance from the optimum of a solved batch (joint sigmas): its marginal has the rest


@dataclass(frozen=True)
class Unsolved:
    """Why there is no marginal of a lap."""

    reason: str
    is_final: bool = True  # whether another attempt, after more of the drive, would fail as well


BATCH_LATE: Final = Unsolved("the batch of the lap was late")


class LapBatch:
    """A lap that is being solved in a process of its own, while the mapper goes on."""

    def __init__(self, lap: OpenLap, t: float, due: int, last: int) -> None:
        self.t = t  # stamp of the cycle in which the lap was sent (s)
        self.due, self.last = due, last  # first and last cycle in which the marginal may replace the prior
        self.first_kept = lap.first_kept  # cycle from which on the window holds the poses until then
        self._lap = lap
        self._future: Future[LapMarginal] | None = None
        self.send()

    def send(self) -> Future[LapMarginal]:
        """Hand the lap to the process, unless it has it already; a snapshot holds the lap alone."""
        if self._future is None:
            self._future = submit(solve_lap, self._lap)
        return self._future

    def wait(self) -> None:
        """Wait for the process, however long it takes."""
        wait([self.send()])

    def give_up(self) -> None:
        """Take the lap from the process, which is ended if it is at it; the next lap has a new one then."""
        future = self.send()
        if not future.done() and not future.cancel():
            _end_worker()

    def marginal(self, timeout: float) -> LapMarginal | Unsolved | None:
        """Return the solution, or why there is none, or None if it is not there after a time (s)."""
        try:
            solved = self.send().result(timeout)
        except TimeoutError:
            return None
        except SingularSystemError as error:
            return Unsolved(str(error), is_final=False)
        except BrokenProcessPool:
            return Unsolved("the process of the batch has died")
        except Exception as error:  # a vehicle drives on, whatever has failed there
            failed = f"the batch of the lap has failed: {type(error).__name__}: {error}"
            return Unsolved(" ".join(failed.split()))
        nearly = solved.convergence.converged or solved.convergence.gradient < SOLVED
        return solved if nearly else Unsolved("the batch of the lap has not converged", is_final=False)


def submit(work: Callable[..., Any], *arguments: Any) -> Future[Any]:
    """Hand work to the process that solves laps, a new one if it has died; if none begins, the work fails."""
    failed = cast("Future[Any]", loky.Future())
    for _ in range(2):
        try:
            with _spared_by_interrupts():
                return cast("Future[Any]", _worker().submit(work, *arguments))
        except Exception as error:  # it has died, or cannot be begun
            _worker.cache_clear()
            failure = error
    failed.set_exception(failure)
    return failed


@contextmanager
def _spared_by_interrupts() -> Iterator[None]:
    """Let processes begin that Ctrl-C does not reach, lest each prints where it was; it waits meanwhile."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    for tracker in (resource_tracker, loky_tracker):
        tracker.ensure_running()  # else it would be begun within, and let signals through
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@cache
def _worker() -> Any:
    if current_process().daemon:  # it may have no children: a worker of Dask is one
        return ThreadPoolExecutor(max_workers=1)
    executor = loky.ProcessPoolExecutor(
        max_workers=1, timeout=WORKER_IDLE, initializer=end_with, initargs=(os.getpid(),)
    )
    # a process that ends waits for its children first, and this one would be idle for minutes
    ended = {"wait": False, "kill_workers": True}
    Finalize(None, executor.shutdown, kwargs=ended, exitpriority=1)
    return executor


def end_with(parent: int) -> None:
    """End this process soon after its parent, since a parent that is killed can't end its workers."""

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
    """Do nothing: the process has imported what it needs by then."""
