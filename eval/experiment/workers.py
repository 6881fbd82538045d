"""Work is spread over processes or a cluster, and goes on when a worker dies."""

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import Any, Final, TypeVar

from joblib import Parallel, delayed, parallel_config

from pathspace_graph.errors import SettingsError
from pathspace_graph.loop.drive_record import end_with

T = TypeVar("T")
R = TypeVar("R")

CONNECT_SECONDS: Final = 20.0
"""Time (s) within which a cluster has to answer."""


class WorkerDiedError(RuntimeError):
    """The process that did the work was killed, ran out of memory or crashed."""


@contextmanager
def workers(jobs: int, cluster: str | None) -> Iterator[None]:
    """Start processes on this machine with one BLAS thread each, or connect to a Dask cluster's workers."""
    if cluster is None:
        leave = {"initializer": end_with, "initargs": (os.getpid(),)}
        with parallel_config(backend="loky", n_jobs=jobs, inner_max_num_threads=1, **leave):
            yield
        return
    try:
        from distributed import Client  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise SettingsError("--cluster: expected the extra pathspace-graph[cluster], found none") from error
    try:
        client = Client(cluster, timeout=CONNECT_SECONDS)
    except (OSError, ValueError) as error:
        raise SettingsError(f"--cluster: expected a Dask scheduler, found none at {cluster}") from error
    with client, parallel_config(backend="dask", wait_for_workers_timeout=CONNECT_SECONDS):
        yield


def check_jobs(jobs: int) -> None:
    """Raise SettingsError unless the number of processes is at least 1, or -1."""
    if jobs < 1 and jobs != -1:
        raise SettingsError(f"jobs: expected at least 1, or -1 for every core, found {jobs}")


def outcomes(work: Callable[[T], R], items: Sequence[T]) -> Iterator[tuple[T, R | WorkerDiedError]]:
    """Yield (item, work(item)) in the order in which they finish; `work` must not raise.

    When a worker dies, nobody knows which item it had, so each item under way is tried again alone.
    """
    remaining = dict(enumerate(items))
    while remaining:
        sent: list[int] = []
        try:
            for index, result in _run(work, _noted(remaining, sent)):
                yield remaining.pop(index), result
        except _deaths():
            for index in sent:
                if index in remaining:
                    item = remaining.pop(index)
                    yield item, _alone(work, item)


def _noted(remaining: dict[int, T], sent: list[int]) -> Iterator[tuple[int, T]]:
    for index, item in list(remaining.items()):
        sent.append(index)
        yield index, item


def _run(work: Callable[[T], R], tasks: Iterable[tuple[int, T]], **options: Any) -> Iterator[tuple[int, R]]:
    parallel = Parallel(return_as="generator_unordered", batch_size=1, **options)
    yield from parallel(delayed(_numbered)(work, index, item) for index, item in tasks)


def _numbered(work: Callable[[T], R], index: int, item: T) -> tuple[int, R]:
    return index, work(item)


def _alone(work: Callable[[T], R], item: T) -> R | WorkerDiedError:
    try:
        ((_, result),) = _run(work, [(0, item)], n_jobs=2)  # one job would be done by this very process
    except _deaths() as error:
        return WorkerDiedError(f"the process that ran it died ({type(error).__name__})")
    return result


def _deaths() -> tuple[type[Exception], ...]:
    try:
        from distributed import KilledWorker  # noqa: PLC0415 - an extra
    except ImportError:
        return (BrokenProcessPool,)
    return (BrokenProcessPool, KilledWorker)
