"""The process that solves laps: submit one lap at a time, wait for it, or cancel it."""

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
