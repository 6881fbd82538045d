"""Laps that online mappers close: each is solved once a session, in place of by a process of every worker."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

from joblib.externals import loky

from pathspace_graph.batch.lap import LapMarginal, OpenLap, solve_lap
from pathspace_graph.loop import worker

from .session import once

IN_A_PROCESS = worker.submit
"""What an online mapper calls where no test is run."""


def solved(lap: OpenLap) -> LapMarginal:
    """Returns a marginal of its own for each caller, as another process does."""
    content = pickle.dumps(lap)
    return pickle.loads(once(lambda: pickle.dumps(solve_lap(pickle.loads(content))), "lap", content))  # type: ignore[no-any-return]


def submit(work: Callable[..., Any], *arguments: Any) -> Future[Any]:
    """In place of `worker.submit`: a lap is solved at once, and all other work is done by the process."""
    future: Future[Any] = loky.Future()
    if work is worker.nothing:
        future.set_result(None)
    elif work is solve_lap:
        try:
            future.set_result(solved(*arguments))
        except Exception as error:
            future.set_exception(error)
    else:
        return IN_A_PROCESS(work, *arguments)
    return future
