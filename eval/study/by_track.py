"""A study's results by track: averages over the seeds, and below them the average and more over all runs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

import pandas as pd

from pathspace_graph.eval.metrics.text_table import TextTable

from .column import LATER_LAPS, Column, column_of
from .frame import COMBINATION, RUN, last_laps
from .study import Study

_EXTREMES: Final = {"all, median": "median", "all, largest": "max"}
"""These rows stand below the average over all runs, and each is made by a function of pandas."""


def track_tables(study: Study, frame: pd.DataFrame) -> list[TextTable]:
    """Returns a table for each combination of noise, estimator and settings, if the study wants columns."""
    columns = [column_of(text) for text in study.columns]
    if not columns:
        return []
    several = [name for name in COMBINATION if frame[name].nunique() > 1] or ["estimator"]
    header = ("track", "runs", *(column.title for column in columns))
    return [
        TextTable(", ".join(str(runs[name].iloc[0]) for name in several), header, tuple(_rows(columns, runs)))
        for _, runs in frame.groupby([*COMBINATION], sort=False)
    ]


def _rows(columns: Sequence[Column], frame: pd.DataFrame) -> Iterator[tuple[str, ...]]:
    """Yields a row of texts for each track, and those over all runs."""
    finished = frame.groupby([*RUN], sort=False)["failure"].first() == ""
    values = [_values(column, frame).reindex(finished.index) for column in columns]
    whole = (f"{int(finished.sum())} of {len(finished)}",)
    for track, done in finished.groupby(level=0, sort=False):
        texts = (c.average(v.loc[done.index]) for c, v in zip(columns, values, strict=True))
        yield (str(track), f"{int(done.sum())} of {len(done)}", *texts)
    yield ("all, mean", *whole, *(c.average(v) for c, v in zip(columns, values, strict=True)))
    for name, over in _EXTREMES.items():
        yield (name, *whole, *(c.extreme(v, over) for c, v in zip(columns, values, strict=True)))


def _values(column: Column, frame: pd.DataFrame) -> pd.DataFrame:
    """Returns a row for each run that finished, by track and seed: the values of the metrics by key."""
    laps = column.laps
    done = frame[frame["failure"] == ""] if laps else last_laps(frame)
    if laps == LATER_LAPS:
        done = done[done["lap"] > 1]
    elif laps.isdecimal():
        done = done[done["lap"] == int(laps)]
    done = done.reindex(columns=[*RUN, *(metric.key for metric in column.metrics)])
    by_run = done.groupby([*RUN], sort=False)
    return pd.DataFrame({m.key: by_run[m.key].agg(m.over) for m in column.metrics})
