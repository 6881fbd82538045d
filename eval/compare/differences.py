"""Differences within a comparison: of a run from the batch on its log, of estimators paired over logs."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Final

import numpy as np
import pandas as pd

from pathspace_graph import estimators as registry
from pathspace_graph.eval.metrics.gap import from_batch, gap
from pathspace_graph.eval.metrics.measures import MEAN_DIGITS, METRICS, UNKNOWN, Metric
from pathspace_graph.eval.metrics.paired import difference
from pathspace_graph.eval.metrics.text_table import TextTable
from pathspace_graph.io.map import Map, SplineBoundary
from pathspace_graph.io.results import RunResult

from .comparison import Comparison, Outcome, Row

_PRINTED: Final = (
    "rmse",
    "rmse_capped",
    "missed",
    "missed_2m",
    "missed_1m",
    "two_way",
    "ghost_share",
    "size",
    "ate",
    "ms_mean",
)
"""The table has the differences of these metrics, the file those of all."""
_NOT_PAIRED: Final = ("nees_low", "nees_high")
"""Differences of these metrics mean nothing."""


# --- from the batch --------------------------------------------------------------------------------------


def with_gaps(comparison: Comparison) -> Comparison:
    """Returns the comparison with the gaps to the batch in the rows of whole logs, where `spline` ran too.

    Every row has the turn from the batch over the whole log, and the rmse by that of the batch.
    """
    outcomes: list[Outcome] = []
    for named in comparison.logs:
        of_log = comparison.of(named.name)
        batch = next((o for o in of_log if o.estimator == registry.DEFAULT_BATCH), None)
        outcomes += of_log if batch is None else [_with_gap(outcome, batch) for outcome in of_log]
    return replace(comparison, outcomes=tuple(outcomes))


def _with_gap(outcome: Outcome, batch: Outcome) -> Outcome:
    if outcome.result is None or batch.result is None or outcome.estimator == registry.DEFAULT_BATCH:
        return outcome
    columns, whole = gap_columns(outcome.result, batch.result), batch.rows[-1]
    rows = tuple(row | columns if row["scope"] == "log" else row for row in outcome.rows)
    return replace(outcome, rows=tuple(row | from_batch(row, whole) for row in rows))


def gap_columns(result: RunResult, batch: RunResult) -> Row:
    """Returns the mean two-way distance of the curves (m) and the rms distance of the poses (m).

    Landmarks are no curves, so a landmark map has the distance of the poses only.
    """
    found = gap(result, batch)
    row: Row = {"gap_trajectory": float(np.hypot(found.along, found.across))}
    if found.curves and _has_curves(result.map):
        row["gap_curves"] = float(np.mean(list(found.curves.values())))
    return row


def _has_curves(track: Map) -> bool:
    return all(isinstance(boundary, SplineBoundary) for boundary in track.boundaries.values())


# --- from the reference ----------------------------------------------------------------------------------


def paired_frame(comparison: Comparison) -> pd.DataFrame:
    """Returns a tidy row for each estimator and metric of whole logs: its difference from the reference."""
    frame = comparison.frame()
    final = frame[frame["scope"] == "log"].set_index(["log", "estimator"])
    keys = [key for key in METRICS if key in frame and key not in _NOT_PAIRED]
    logs = [named.name for named in comparison.logs]
    rows = []
    for estimator in comparison.estimators:
        for key in keys if estimator != comparison.reference else ():
            column = final[key].astype(float)
            own, reference = (
                column.reindex([(log, name) for log in logs]).to_numpy()
                for name in (estimator, comparison.reference)
            )
            d = difference(own, reference)
            row = {"metric": key, "mean": d.mean, "low": d.low, "high": d.high, "pairs": d.count}
            rows.append({"estimator": estimator, "reference": comparison.reference} | row)
    return pd.DataFrame(rows, columns=["estimator", "reference", "metric", "mean", "low", "high", "pairs"])


def paired_table(comparison: Comparison, paired: pd.DataFrame) -> TextTable:
    """Returns the differences with their intervals: a row for each metric, a column for each estimator."""
    others = [name for name in comparison.estimators if name != comparison.reference]
    rows = []
    for metric in (METRICS[key] for key in _PRINTED):
        by_estimator = paired[paired["metric"] == metric.key].set_index("estimator")
        if len(by_estimator) and by_estimator["mean"].notna().any():
            cells = (_interval(metric, by_estimator.loc[name]) for name in others)
            rows.append((metric.heading, *cells))
    title = (
        f"Difference from {comparison.reference}, mean [95 % interval] over {len(comparison.logs)} logs, "
        "paired; * where 0 is outside of it. Positive: the reference has less."
    )
    return TextTable(title, ("metric", *others), tuple(rows))


def _interval(metric: Metric, row: Any) -> str:
    """Returns `mean [low, high]` in the metric's unit, with * where it excludes 0."""
    mean, low, high = (metric.factor * float(row[name]) for name in ("mean", "low", "high"))
    if np.isnan(mean):
        return UNKNOWN
    digits = max(metric.digits, MEAN_DIGITS)
    mark = "*" if low > 0.0 or high < 0.0 else ""
    return f"{mean:+.{digits}f} [{low:+.{digits}f}, {high:+.{digits}f}]{mark}"
