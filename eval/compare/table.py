"""The tables of a comparison: the paper's Table 1, and every metric at the end."""

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

NO_TRUTH: Final = "the log has no true cones: only what needs none is told"
"""What a table says that lacks the paper's columns."""
FAILED: Final = "failed"
_AT_END: Final = "end"
"""In place of a lap, where none was completed."""
_SPACE: Final = "   "
"""Between figures that share a column."""


def paper_frame(comparison: Comparison) -> pd.DataFrame:
    """A row per estimator and lap: rmse (m), missed (share) and size, mean over `logs` logs that have it.

    An estimator that completed no lap on any log has its maps at the end of the logs, without a lap.
    """
    names = [metric.key for metric in PAPER]
    frame = comparison.frame().reindex(columns=["log", "estimator", "scope", "lap", *names])
    found = []
    for estimator in comparison.estimators:
        own = frame[frame["estimator"] == estimator]
        laps = own[own["scope"] == "lap"]
        for lap, of in laps.groupby("lap") if len(laps) else [(np.nan, own)]:
            means = {name: of[name].astype(float).mean() for name in names}
            found.append({"estimator": estimator, "lap": lap, "logs": len(of)} | means)
    table = pd.DataFrame(found)
    table["lap"] = table["lap"].astype("Int64")
    return table


def paper_table(comparison: Comparison) -> TextTable:
    """The paper's Table 1, lap by lap; without truth its sizes alone."""
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
    """Every metric of the whole logs: a row per metric, a column per estimator, means over the logs."""
    frame = comparison.frame()
    final = frame[frame["scope"] == "log"]
    known = [m for m in METRICS.values() if m.key in frame and not final[m.key].astype(float).isna().all()]
    means = {
        name: final[final["estimator"] == name][[m.key for m in known]].astype(float).mean()
        for name in comparison.estimators
    }
    rows = tuple(
        (metric.heading, *(metric.text(float(means[name][metric.key])) for name in comparison.estimators))
        for metric in known
    )
    title = _title(comparison, "at the end of the log")
    return TextTable(title, ("metric", *comparison.estimators), rows)


def side_by_side(laps: dict[str, Sequence[LapMetrics]]) -> TextTable:
    """The paper's Table 1 as the paper has it: a row per lap, the estimators beside each other.

    rmse, missed and size of an estimator are one column, so that its name stands over all three.
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
    """The paper's three figures of a lap, each as wide as its title."""
    return _SPACE.join(_cell(metric, row).rjust(len(metric.heading)) for metric in PAPER)


def has_truth(comparison: Comparison) -> bool:
    """Whether any log has true cones that a map can be held against."""
    return any(n.log.truth is not None and has_cones(n.log.truth) for n in comparison.logs)


def _title(comparison: Comparison, when: str) -> str:
    count = len(comparison.logs)
    logs = comparison.logs[0].name if count == 1 else f"mean over {count} logs"
    missing = "" if has_truth(comparison) else f" ({NO_TRUTH})"
    return f"{logs}, {when}{missing}"


def _lap(row: Any) -> str:
    if not pd.isna(row["lap"]):
        return str(int(row["lap"]))
    return _AT_END if row["logs"] else FAILED


def _cell(metric: Metric, row: Any) -> str:
    """Of a row of a frame, of a lap's metrics, or of nothing."""
    if row is None:
        return metric.text(float("nan"))
    value = getattr(row, metric.key) if isinstance(row, LapMetrics) else row[metric.key]
    return metric.text(float(value))
