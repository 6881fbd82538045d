"""Cells of a study: each is one estimator with one set of settings on one log."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import cached_property, partial
from typing import Any, Final

from pathspace_graph.eval.harness.attempts import Attempt, attempt
from pathspace_graph.eval.harness.drives import Drive, identity
from pathspace_graph.eval.metrics.measures import METRICS, measure
from pathspace_graph.eval.metrics.summary import vehicle_of, versions
from pathspace_graph.io.log import Log
from pathspace_graph.io.results import RunResult
from pathspace_graph.plausibility.diagnosis import diagnose
from pathspace_graph.settings.mapper import MapperSettings

FORMAT: Final = "pathspace-cell/3"

Record = dict[str, Any]
"""It has the types of JSON only."""


@dataclass(frozen=True, eq=False)
class Cell:
    """A cell is one run."""

    drive: Drive
    """The run is on the log of this drive."""
    estimator: str
    """This is the name of the estimator."""
    variant: str
    """This is the name of the settings."""
    settings: MapperSettings
    """The estimator has these settings."""
    yardsticks: bool = False
    """The limit of the run is computed, too."""

    @cached_property
    def id(self) -> str:
        """Returns an identity of everything that the result depends on, except the code."""
        settings = asdict(self.settings)
        return identity(
            drive=self.drive.id, estimator=self.estimator, settings=settings, yardsticks=self.yardsticks
        )

    @property
    def names(self) -> dict[str, Any]:
        """Returns what distinguishes it from the other cells of its study."""
        drive = self.drive
        shared = {"track": drive.track.name, "seed": drive.seed, "noise": drive.noise}
        return shared | {"estimator": self.estimator, "variant": self.variant}


# --- runs ------------------------------------------------------------------------------------------------


def run_cell(cell: Cell, log: Log) -> Record:
    """Runs the cell's estimator on its log; a failure gives a record, too."""
    measured = partial(lap_rows, yardsticks=cell.yardsticks)
    return record_of(cell, attempt(cell.estimator, cell.settings, log, measured))


def record_of(cell: Cell, what: Attempt[list[dict[str, Any]]]) -> Record:
    """Returns the record of an attempt at a cell."""
    return {
        "format": FORMAT,
        "id": cell.id,
        "cell": cell.names,
        "versions": versions(),
        "failure": what.failure,
        "traceback": what.trace,
        "said": said(what.result),
        "laps": what.measured or [],
    }


def said(run: RunResult | None) -> str:
    """Returns the notices of a run's cycles and its diagnosis, each once, or an empty text."""
    if run is None:
        return ""
    state = vehicle_of(run)
    lines = [record.notice for record in run.cycles if record.notice]
    lines += [] if state is None else diagnose(state, run.settings)
    return "; ".join(dict.fromkeys(lines))


def failed(cell: Cell, error: BaseException) -> Record:
    """Returns the record of a cell that could not be run."""
    return record_of(cell, Attempt.failed(error))


def lap_rows(run: RunResult, log: Log, seconds: float, *, yardsticks: bool = False) -> list[dict[str, Any]]:
    """Returns a row for each lap, with the metrics of the whole run beside its own.

    A run that completed no lap has one row, that of the whole run as lap 1.
    """
    *laps, whole = measure(run, log, seconds, marginals=True, yardsticks=yardsticks)
    shared = {key: value for key, value in whole.values.items() if METRICS[key].scope == "run"}
    return [{"lap": row.lap, **row.values, **shared} for row in laps] or [{"lap": 1, **whole.values}]
