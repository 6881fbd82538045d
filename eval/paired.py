"""Differences between estimators, paired over logs, with their confidence interval."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy.stats import ttest_rel

from .comparison import Comparison
from .comparison_metrics import METRICS

LEVEL: Final = 0.95
"""Of the intervals."""
_FEWEST: Final = 2
"""Pairs that have an interval."""
_NOT_PAIRED: Final = ("nees_low", "nees_high")
"""Metrics whose differences say nothing."""


@dataclass(frozen=True, slots=True)
class Difference:
    """Mean of value - reference's value over the logs that both have one on."""

    mean: float
    """NaN of no pairs."""
    low: float
    """95 % interval of the mean, by Student's t over the pairs: from here ..."""
    high: float
    """... to here; NaN of fewer than two pairs."""
    pairs: int
    """How many."""

    @property
    def significant(self) -> bool:
        """Whether 0 is outside of the interval."""
        return bool(self.low > 0.0 or self.high < 0.0)


def difference(values: ArrayLike, reference: ArrayLike) -> Difference:
    """mean(d) -+ t(0.975, n - 1) s(d) / sqrt(n) of d = values - reference (n,) where both are finite."""
    own, others = np.asarray(values, dtype=float), np.asarray(reference, dtype=float)
    both = np.isfinite(own) & np.isfinite(others)
    own, others = own[both], others[both]
    n = len(own)
    mean = float(np.mean(own - others)) if n else float("nan")
    if n < _FEWEST:
        return Difference(mean, float("nan"), float("nan"), n)
    if np.ptp(own - others) == 0.0:  # no spread, for which the t-test has no number
        return Difference(mean, mean, mean, n)
    interval = ttest_rel(own, others).confidence_interval(LEVEL)
    return Difference(mean, float(interval.low), float(interval.high), n)


def paired_frame(comparison: Comparison) -> pd.DataFrame:
    """A tidy row per estimator and metric of the whole logs: the difference from the reference."""
    frame = comparison.frame()
    final = frame[frame["scope"] == "log"].set_index(["log", "estimator"])
    names = [m.name for m in METRICS if m.name in frame and m.name not in _NOT_PAIRED]
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
            row = {"metric": name, "mean": d.mean, "low": d.low, "high": d.high, "pairs": d.pairs}
            found.append({"estimator": estimator, "reference": comparison.reference} | row)
    return pd.DataFrame(found, columns=["estimator", "reference", "metric", "mean", "low", "high", "pairs"])
