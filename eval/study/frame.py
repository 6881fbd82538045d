"""The results of a study as a data frame with a row for each run and lap."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import pandas as pd

from pathspace_graph.estimators import DEFAULT_BATCH
from pathspace_graph.eval.metrics.gap import from_batch
from pathspace_graph.eval.metrics.measures import METRICS
from pathspace_graph.eval.metrics.summary import versions
from pathspace_graph.overrides import leaves

from .cells import Cell, Record
from .study import Study

COMBINATION: Final = ("noise", "estimator", "variant")
"""These columns name a combination, which is compared with others."""
RUN: Final = ("track", "seed")
"""These columns name a drive; combinations are paired on the same drive and noise."""
SIMULATION: Final = "simulation."
"""Columns with settings of the simulation have this prefix."""
SETTING: Final = "settings."
"""Columns with settings of the estimator have this prefix where another column has their name."""
TIMES: Final = tuple(key for key, metric in METRICS.items() if metric.time)
"""These columns hold wall times, all that differs when a study is run again."""


def frame_of(study: Study, cells: Sequence[tuple[Cell, Record | None]]) -> pd.DataFrame:
    """Returns a row for each run and lap, and one without metrics for a run that failed.

    Every varied setting is a column.
    """
    rows = []
    for cell, record in cells:
        assert record is not None, "every cell has been run by now"
        shared = {"study": study.name} | cell.names | _settings_row(study, cell)
        about = {"failure": record["failure"], "said": record["said"], **record["versions"]}
        rows += [shared | lap | about for lap in record["laps"]] or [shared | {"lap": None} | about]
    add_batch(rows)
    settings = _settings_row(study, cells[0][0])
    order = ["study", *RUN, *COMBINATION, *settings, "lap", *METRICS, "failure", "said", *versions()]
    known = dict.fromkeys([*order, *(name for row in rows for name in row)])
    frame = pd.DataFrame(rows, columns=[name for name in known if any(name in row for row in rows)])
    return frame.astype({"lap": "Int64"})


def add_batch(rows: Sequence[dict[str, Any]]) -> None:
    """Adds how each run compares with the batch on the same log and with the same settings, if it ran."""
    names = (*RUN, "noise", "variant")
    batches = {tuple(row[name] for name in names): row for row in rows if row["estimator"] == DEFAULT_BATCH}
    for row in rows:
        batch = batches.get(tuple(row[name] for name in names))
        if batch is not None and row["estimator"] != DEFAULT_BATCH:
            row.update(from_batch(row, batch))


def _settings_row(study: Study, cell: Cell) -> dict[str, Any]:
    settings, simulation = leaves(cell.settings), leaves(cell.drive.simulation)
    row = {f"{SIMULATION}{name}": _cell(simulation[name]) for name in study.varied_noise}
    own = {"study", *RUN, *COMBINATION}
    return row | {f"{SETTING}{name}" if name in own else name: _cell(settings[name]) for name in study.varied}


def _cell(value: Any) -> Any:
    return " ".join(str(part) for part in value) if isinstance(value, tuple) else value


def without_times(frame: pd.DataFrame) -> pd.DataFrame:
    """Returns the columns that are the same whenever the study is run."""
    return frame.drop(columns=[name for name in TIMES if name in frame])


def times_of(frame: pd.DataFrame) -> pd.DataFrame:
    """Returns the wall times, in the same rows."""
    return frame[["study", *RUN, *COMBINATION, "lap", *(name for name in TIMES if name in frame)]]


def last_laps(frame: pd.DataFrame) -> pd.DataFrame:
    """Returns the last row of each run that finished."""
    finished = frame[frame["failure"] == ""]
    return finished.groupby([*RUN, *COMBINATION], sort=False).tail(1)
