"""The tables of a comparison: the paper's Table 1, and every metric at the end of the logs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import pandas as pd

from pathspace_graph.eval.metrics.measures import METRICS, PAPER, Metric
from pathspace_graph.eval.metrics.summary import has_cones
from pathspace_graph.eval.metrics.table1 import LapMetrics
from pathspace_graph.eval.metrics.text_table import TextTable

from .comparison import Comparison

NO_TRUTH: Final = "the log has no true cones, which rmse, missed and most other metrics need"
"""A title says so where the columns of the paper are missing."""
FAILED: Final = "failed"
"""An estimator that failed on every log has this in place of a lap."""
AT_END: Final = "end"
"""An estimator that completed no lap has this in place of a lap."""
_SPACE: Final = "   "
"""Figures that share a column are this far apart."""


def paper_frame(comparison: Comparison) -> pd.DataFrame:
    """Returns rmse (m), missed (share) and size of each estimator and lap, means over `logs` logs.

    An estimator that completed no lap on any log has a row without a lap, of its maps at the end of the logs.
    """
    keys = [metric.key for metric in PAPER]
    frame = comparison.frame().reindex(columns=["log", "estimator", "scope", "lap", *keys])
    rows = []
    for estimator in comparison.estimators:
        own = frame[frame["estimator"] == estimator]
        laps = own[own["scope"] == "lap"]
        for lap, over_logs in laps.groupby("lap") if len(laps) else [(np.nan, own)]:
            means = {key: over_logs[key].astype(float).mean() for key in keys}
            rows.append({"estimator": estimator, "lap": lap, "logs": len(over_logs)} | means)
    table = pd.DataFrame(rows)
    table["lap"] = table["lap"].astype("Int64")
    return table


def paper_table(comparison: Comparison) -> TextTable:
    """Returns the paper's Table 1, lap by lap; without truth it has the sizes only."""
    frame = paper_frame(comparison)
    known = PAPER if has_truth(comparison) else (METRICS["size"],)
    several = len(comparison.logs) > 1
    rows = [
        (
            str(row["estimator"]),
            _lap(row),
            *([str(row["logs"])] if several else []),
            *(_cell(metric, row) for metric in known),
        )
        for _, row in frame.iterrows()
    ]
    names = frame["estimator"].tolist()
    groups = tuple(i for i in range(1, len(names)) if names[i] != names[i - 1])
    header = ("estimator", "lap", *(["logs"] if several else []), *(metric.heading for metric in known))
    return TextTable(_title(comparison, "at the end of each lap"), header, tuple(rows), groups)


def final_table(comparison: Comparison) -> TextTable:
    """Returns the means over the logs of every metric of whole logs, with a column for each estimator."""
    frame = comparison.frame()
    final = frame[frame["scope"] == "log"]
    known = [m for m in METRICS.values() if m.key in frame and not final[m.key].astype(float).isna().all()]
    means = {
        name: {m.key: m.over(final.loc[final["estimator"] == name, m.key]) for m in known}
        for name in comparison.estimators
    }
    rows = tuple(
        (metric.heading, *(metric.text(float(means[name][metric.key])) for name in comparison.estimators))
        for metric in known
    )
    title = _title(comparison, "at the end of the log")
    return TextTable(title, ("metric", *comparison.estimators), rows)


def side_by_side(laps: dict[str, Sequence[LapMetrics]]) -> TextTable:
    """Returns the paper's Table 1 in the paper's form: a row per lap, the estimators beside each other.

    The rmse, missed and size of an estimator share a column, so that its name stands above all three.
    """
    titles = _SPACE.join(metric.heading for metric in PAPER)
    header = ("lap", *(f"{name}\n{titles}" for name in laps))
    count = max((len(rows) for rows in laps.values()), default=0)
    rows = (
        (str(lap + 1), *(_three(own[lap] if lap < len(own) else None) for own in laps.values()))
        for lap in range(count)
    )
    return TextTable("", header, tuple(rows), names=0)


def _three(row: LapMetrics | None) -> str:
    """Returns the paper's three figures of a lap, each as wide as its title."""
    return _SPACE.join(_cell(metric, row).rjust(len(metric.heading)) for metric in PAPER)


def has_truth(comparison: Comparison) -> bool:
    """Returns whether any log has true cones."""
    return any(n.log.truth is not None and has_cones(n.log.truth) for n in comparison.logs)


def _title(comparison: Comparison, when: str) -> str:
    count = len(comparison.logs)
    logs = comparison.logs[0].name if count == 1 else f"mean over {count} logs"
    missing = "" if has_truth(comparison) else f" ({NO_TRUTH})"
    return f"{logs}, {when}{missing}"


def _lap(row: Any) -> str:
    if not pd.isna(row["lap"]):
        return str(int(row["lap"]))
    return AT_END if row["logs"] else FAILED


def _cell(metric: Metric, row: Any) -> str:
    """Returns the text of a metric in a row of a frame, in a lap's metrics, or without either."""
    if row is None:
        return metric.text(float("nan"))
    value = getattr(row, metric.key) if isinstance(row, LapMetrics) else row[metric.key]
    return metric.text(float(value))
