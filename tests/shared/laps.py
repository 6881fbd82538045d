"""Laps that online mappers close: each is solved once a session, by the process of one lap_solver."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

from joblib.externals import loky

from pathspace_graph.batch.lap import LapMarginal, OpenLap, solve_lap
from pathspace_graph.loop import lap_solver

from .session import once

IN_A_PROCESS = lap_solver.submit
"""What an online mapper calls where no test is run."""


def solved(lap: OpenLap) -> LapMarginal:
    """Returns a marginal of its own for each caller; what a test patches does not reach the process."""
    marginal = once(lambda: pickle.dumps(IN_A_PROCESS(solve_lap, lap).result()), "lap", pickle.dumps(lap))
    return pickle.loads(marginal)  # type: ignore[no-any-return]


def submit(work: Callable[..., Any], *arguments: Any) -> Future[Any]:
    """In place of `lap_solver.submit`: a lap that was solved before is not handed to the process again."""
    future: Future[Any] = loky.Future()
    if work is lap_solver.nothing:
        future.set_result(None)
    elif work is solve_lap:
        try:
            future.set_result(solved(*arguments))
        except Exception as error:
            future.set_exception(error)
    else:
        return IN_A_PROCESS(work, *arguments)
    return future
