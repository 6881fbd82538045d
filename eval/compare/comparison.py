"""Every estimator runs on every log and is measured, and a failure of one does not stop the others."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Final

import pandas as pd

from pathspace_graph import estimators as registry
from pathspace_graph.errors import InputError, SettingsError
from pathspace_graph.eval.harness.attempts import Attempt, attempt, known_estimators
from pathspace_graph.eval.harness.workers import check_jobs, outcomes, workers
from pathspace_graph.eval.metrics.cost import StageTime, stage_times
from pathspace_graph.eval.metrics.ghosts import GhostSettings
from pathspace_graph.eval.metrics.measures import measure, online_cycles
from pathspace_graph.io.log import LOG_FILE, Log
from pathspace_graph.io.results import BatchRun, RunResult
from pathspace_graph.io.temporary import is_temporary
from pathspace_graph.plausibility.hint import Hint
from pathspace_graph.plausibility.reading import read_plausible_log
from pathspace_graph.settings.front_end import LimitSettings
from pathspace_graph.settings.mapper import MapperSettings

Row = dict[str, float | int | str | bool]

RUN: Final = ("log", "estimator")
"""These columns identify a run."""


@dataclass(frozen=True, eq=False)
class NamedLog:
    """Holds a log with its name."""

    name: str
    """This is the name of the log's folder."""
    log: Log
    """This is the log."""
    hints: tuple[Hint, ...] = ()
    """These mistakes are likely in it."""


@dataclass(frozen=True)
class Task:
    """A task is one estimator on one log."""

    log: int
    """This is the number of the log."""
    estimator: str
    """This is the name of the estimator."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """Holds what came of a task."""

    log: str
    """This is the name of the log."""
    estimator: str
    """This is the name of the estimator."""
    result: RunResult | None = None
    """The run gave this; it is None if the run failed."""
    failure: str = ""
    """This line names the error; it is empty if there was none."""
    rows: tuple[Row, ...] = ()
    """These are the metrics, a row for each lap and one for the whole run."""
    times: tuple[StageTime, ...] = ()
    """These are the times of the cycles and of their stages; a batch has none."""

    @property
    def unsettled(self) -> bool:
        """Returns whether the run is a batch that did not converge."""
        return isinstance(self.result, BatchRun) and not self.result.converged


@dataclass(frozen=True, eq=False)
class Comparison:
    """Holds all outcomes, log by log, in the order of the estimators."""

    logs: tuple[NamedLog, ...]
    """These logs were mapped."""
    estimators: tuple[str, ...]
    """These estimators mapped them."""
    reference: str
    """The others are compared with this estimator."""
    outcomes: tuple[Outcome, ...] = field(default=())
    """There is one for each estimator on each log."""

    def frame(self) -> pd.DataFrame:
        """Returns a tidy row per run and lap, and one per run for the whole log."""
        found = [{"log": o.log, "estimator": o.estimator, **row} for o in self.outcomes for row in o.rows]
        return pd.DataFrame(found, columns=None if found else [*RUN, "scope", "lap"])

    def times(self) -> pd.DataFrame:
        """Returns a tidy row per run and stage, in s."""
        names = ["stage", "mean", "median", "p99", "share"]
        found = [
            [o.log, o.estimator, *(getattr(stage, name) for name in names)]
            for o in self.outcomes
            for stage in o.times
        ]
        return pd.DataFrame(found, columns=[*RUN, *names])

    def of(self, log: str) -> list[Outcome]:
        """Returns the outcomes on one log."""
        return [outcome for outcome in self.outcomes if outcome.log == log]

    @property
    def paired(self) -> bool:
        """Returns whether there are differences to show: several estimators on several logs."""
        return len(self.logs) > 1 and len({outcome.estimator for outcome in self.outcomes}) > 1

    @property
    def failures(self) -> list[Outcome]:
        """Returns the outcomes that failed."""
        return [outcome for outcome in self.outcomes if outcome.failure]


def read_logs(folder: Path, limits: LimitSettings | None = None) -> tuple[NamedLog, ...]:
    """Returns the log of a log folder, or those of a folder of log folders by name; InputError if there
    are none, or if a cycle of one cannot be used."""
    limits = limits or LimitSettings()
    if (folder / LOG_FILE).exists() or not folder.is_dir():
        return (_named(folder.resolve().name, folder, limits),)
    entries = (entry for entry in folder.iterdir() if not is_temporary(entry.name))
    inside = sorted(entry for entry in entries if (entry / LOG_FILE).is_file())
    if not inside:
        raise InputError(folder, f"expected a log ({LOG_FILE}) or folders that are logs, found neither")
    return tuple(_named(entry.name, entry, limits) for entry in inside)


def _named(name: str, folder: Path, limits: LimitSettings) -> NamedLog:
    log, hints = read_plausible_log(folder, limits)
    return NamedLog(name, log, tuple(hints))


def choose(names: Sequence[str]) -> tuple[str, ...]:
    """Returns estimators by name, or all that are known if none is named; SettingsError if one is unknown."""
    known = known_estimators()
    for name in names:
        if name not in known:
            raise SettingsError(f"--estimators: expected known ones ({', '.join(known)}), found '{name}'")
    return tuple(dict.fromkeys(names or known))


def choose_reference(name: str | None, estimators: Sequence[str]) -> str:
    """Returns the named one, or the default estimator if it is compared, or else the first."""
    if name is None:
        return registry.DEFAULT if registry.DEFAULT in estimators else estimators[0]
    if name not in estimators:
        raise SettingsError(
            f"--reference: expected one that is compared ({', '.join(estimators)}), found '{name}'"
        )
    return name


def compare(
    logs: Sequence[NamedLog],
    estimators: Sequence[str],
    settings: MapperSettings | None = None,
    *,
    reference: str | None = None,
    ghosts: GhostSettings | None = None,
    jobs: int = 1,
    on_run: Callable[[], None] | None = None,
) -> Comparison:
    """Runs every estimator on every log, `jobs` at a time on one BLAS thread each; calls `on_run` after
    each."""
    check_jobs(jobs)
    settings, ghosts = settings or MapperSettings(), ghosts or GhostSettings()
    tasks = [Task(number, name) for number in range(len(logs)) for name in estimators]
    done: dict[Task, Outcome] = {}
    with workers(jobs, None):
        for task, outcome in outcomes(run_task, tasks, lambda task: (logs[task.log], settings, ghosts)):
            done[task] = (
                outcome
                if isinstance(outcome, Outcome)
                else _outcome(task, logs[task.log], Attempt.failed(outcome))
            )
            if on_run is not None:
                on_run()
    chosen = choose_reference(reference, estimators)
    return Comparison(tuple(logs), tuple(estimators), chosen, tuple(done[task] for task in tasks))


def run_task(task: Task, named: NamedLog, settings: MapperSettings, ghosts: GhostSettings) -> Outcome:
    """Runs and measures an estimator; a failure gives an outcome, too."""
    what = attempt(task.estimator, settings, named.log, partial(_measure, ghosts=ghosts))
    return _outcome(task, named, what)


def _measure(
    result: RunResult, log: Log, seconds: float, ghosts: GhostSettings
) -> tuple[tuple[Row, ...], tuple[StageTime, ...]]:
    rows: tuple[Row, ...] = tuple(
        {"scope": "lap" if row.lap else "log", "lap": row.lap or result.laps, **row.values}
        for row in measure(result, log, seconds, ghosts)
    )
    cycles = online_cycles(result)
    return rows, tuple(stage_times(cycles)) if cycles else ()


def _outcome(
    task: Task, named: NamedLog, what: Attempt[tuple[tuple[Row, ...], tuple[StageTime, ...]]]
) -> Outcome:
    measured, times = what.measured or ((), ())
    return Outcome(named.name, task.estimator, what.result, what.failure, measured, times)
