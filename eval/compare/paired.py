"""Differences between the estimators of a comparison, paired over logs, with their confidence interval."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import pandas as pd

from pathspace_graph.eval.metrics.measures import MEAN_DIGITS, METRICS, UNKNOWN, Metric
from pathspace_graph.eval.metrics.paired import difference
from pathspace_graph.eval.metrics.text_table import TextTable

from .comparison import Comparison

_COMPARED: Final = (
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
"""Metrics whose differences are printed; the file has all."""
_NOT_PAIRED: Final = ("nees_low", "nees_high")
"""Metrics whose differences say nothing."""


def paired_frame(comparison: Comparison) -> pd.DataFrame:
    """A tidy row per estimator and metric of the whole logs: the difference from the reference."""
    frame = comparison.frame()
    final = frame[frame["scope"] == "log"].set_index(["log", "estimator"])
    names = [key for key in METRICS if key in frame and key not in _NOT_PAIRED]
    logs = [named.name for named in comparison.logs]
    found = []
    for estimator in comparison.estimators:
        for name in names if estimator != comparison.reference else ():
            column = final[name].astype(float)
            own, reference = (
                column.reindex([(log, who) for log in logs]).to_numpy()
                for who in (estimator, comparison.reference)
            )
            d = difference(own, reference)
            row = {"metric": name, "mean": d.mean, "low": d.low, "high": d.high, "pairs": d.count}
            found.append({"estimator": estimator, "reference": comparison.reference} | row)
    return pd.DataFrame(found, columns=["estimator", "reference", "metric", "mean", "low", "high", "pairs"])


def paired_table(comparison: Comparison, paired: pd.DataFrame) -> TextTable:
    """Differences from the reference with their intervals: a row per metric, a column per other estimator."""
    others = [name for name in comparison.estimators if name != comparison.reference]
    rows = []
    for metric in (METRICS[key] for key in _COMPARED):
        of = paired[paired["metric"] == metric.key].set_index("estimator")
        if len(of) and of["mean"].notna().any():
            rows.append((metric.heading, *(_interval(metric, of.loc[name]) for name in others)))
    title = (
        f"Difference from {comparison.reference}, mean [95 % interval] over {len(comparison.logs)} logs, "
        "paired; * where 0 is outside of it. Positive: the reference has less."
    )
    return TextTable(title, ("metric", *others), tuple(rows))


def _interval(metric: Metric, row: Any) -> str:
    """mean [low, high], in the metric's own unit."""
    mean, low, high = (metric.factor * float(row[name]) for name in ("mean", "low", "high"))
    if np.isnan(mean):
        return UNKNOWN
    digits = max(metric.digits, MEAN_DIGITS)
    mark = "*" if low > 0.0 or high < 0.0 else ""
    return f"{mean:+.{digits}f} [{low:+.{digits}f}, {high:+.{digits}f}]{mark}"
