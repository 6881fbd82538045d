"""One attempt: an estimator runs on a log and is measured, and a failure is a result as well."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

from threadpoolctl import threadpool_limits

from pathspace_graph import estimators as registry
from pathspace_graph.eval.metrics.reach import ReachObserver
from pathspace_graph.eval.metrics.summary import has_cones, lap_times
from pathspace_graph.io.log import Log
from pathspace_graph.io.results import RunResult
from pathspace_graph.run import run_online
from pathspace_graph.settings.mapper import MapperSettings

M = TypeVar("M")
Measure = Callable[[RunResult, Log, float], M]
"""Measures a run on a log that took some time (s)."""


@dataclass(frozen=True, eq=False)
class Attempt(Generic[M]):
    """Holds what came of one attempt."""

    result: RunResult | None = None
    """The run gave this; it is None where the attempt failed."""
    measured: M | None = None
    """The run was measured so; it is None where the attempt failed."""
    failure: str = ""
    """This line names the error; it is empty where there was none."""
    trace: str = ""
    """This is the error's traceback."""

    @classmethod
    def failed(cls, error: BaseException) -> Attempt[M]:
        """Makes the attempt that ended with an error."""
        return cls(
            failure=" ".join(f"{type(error).__name__}: {error}".split()),
            trace="".join(traceback.format_exception(error)),
        )


def known_estimators() -> list[str]:
    """Returns the name of every estimator, online ones first."""
    return [*registry.ONLINE, *registry.BATCH]


def attempt(estimator: str, settings: MapperSettings, log: Log, measure: Measure[M]) -> Attempt[M]:
    """Runs an estimator on a log and measures it, with one thread of BLAS; it never raises."""
    try:
        with threadpool_limits(limits=1):
            begin = time.perf_counter()
            result = run_estimator(estimator, settings, log)
            seconds = time.perf_counter() - begin - result.observing
            return Attempt(result, measure(result, log, seconds))
    except Exception as error:  # whatever ends a run belongs into the results
        return Attempt.failed(error)


def run_estimator(name: str, settings: MapperSettings, log: Log) -> RunResult:
    """Runs an online estimator cycle by cycle, with its map at the end of each true lap, or a batch one.

    The reach of an online one is measured where there is truth.
    """
    if name not in registry.ONLINE:
        return registry.make_batch(name, settings, log).solve(log)
    estimator, times = registry.make_online(name, settings, log), lap_times(log)
    if log.truth is None or not has_cones(log.truth) or len(log.truth.poses) == 0:
        return run_online(log, estimator, name=name, snapshot_times=times)
    observer = ReachObserver(log.truth)
    result = run_online(log, estimator, name=name, snapshot_times=times, observers=[observer])
    return replace(result, reach=observer.rows)
