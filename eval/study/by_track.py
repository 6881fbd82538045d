"""A study's results by track: means over the seeds, and below them the mean and more over all runs."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import pandas as pd

from pathspace_graph.eval.metrics.measures import Metric
from pathspace_graph.eval.metrics.text_table import TextTable

from .frame import COMBINATION, RUN, last_laps
from .study import LATER_LAPS, Study, column_of

_OVER_ALL: Final = {"all, mean": "mean", "all, median": "median", "all, largest": "max"}
"""These rows stand below the tracks, and each is made by a function of pandas."""


def track_tables(study: Study, frame: pd.DataFrame) -> list[TextTable]:
    """Returns a table for each combination of noise, estimator and settings, if the study wants columns."""
    columns = {column: column_of(column) for column in study.columns}
    if not columns:
        return []
    several = [name for name in COMBINATION if frame[name].nunique() > 1] or ["estimator"]
    header = ("track", "runs", *(_title(metric, laps) for metric, laps in columns.values()))
    return [
        TextTable(", ".join(str(runs[name].iloc[0]) for name in several), header, tuple(_rows(columns, runs)))
        for _, runs in frame.groupby([*COMBINATION], sort=False)
    ]


def _title(metric: Metric, laps: str) -> str:
    if laps.isdecimal():
        return f"{metric.heading}, lap {laps}"
    return f"{metric.heading}, {laps} laps" if laps else metric.heading


def _rows(columns: dict[str, tuple[Metric, str]], frame: pd.DataFrame) -> Iterator[tuple[str, ...]]:
    """Yields a row of texts for each track, and those over all runs."""
    finished = frame.groupby([*RUN], sort=False)["failure"].first() == ""
    values = pd.DataFrame(
        {name: _values(frame, metric, laps) for name, (metric, laps) in columns.items()}, index=finished.index
    )

    def row(name: str, done: pd.Series[bool], figures: pd.Series[float]) -> tuple[str, ...]:
        texts = (metric.text(float(figures[column])) for column, (metric, _) in columns.items())
        return (name, f"{int(done.sum())} of {len(done)}", *texts)

    for track, of in values.groupby(level=0, sort=False):
        yield row(str(track), finished.loc[of.index], of.mean())
    for name, over in _OVER_ALL.items():
        yield row(name, finished, values.agg(over))


def _values(frame: pd.DataFrame, metric: Metric, laps: str) -> pd.Series[float]:
    """Returns a value for each run that finished, by track and seed."""
    if metric.key not in frame:
        return pd.Series(dtype=float)
    done = frame[frame["failure"] == ""] if laps else last_laps(frame)
    if laps == LATER_LAPS:
        done = done[done["lap"] > 1]
    elif laps.isdecimal():
        done = done[done["lap"] == int(laps)]
    return done.assign(value=done[metric.key].astype(float)).groupby([*RUN], sort=False)["value"].mean()
