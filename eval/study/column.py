"""A column of a study's table by track: a metric of one lap or several, or a slope of one on another."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final

import numpy as np
import pandas as pd

from pathspace_graph.errors import SettingsError, check_name
from pathspace_graph.eval.metrics.measures import METRICS, UNKNOWN, Metric

EVERY_LAP: Final = "all"
"""A column `rmse@all` is the average over all laps."""
LATER_LAPS: Final = "later"
"""A column `rmse@later` is the average over the laps from the second on."""
_SLOPE: Final = re.compile(r"slope\((\w+), (\w+)\)")
"""A column of this form is a slope."""
_SLOPE_DIGITS: Final = 2
"""A slope is shown with this many digits after the decimal point."""


@dataclass(frozen=True)
class Column:
    """A column has a figure for several runs together."""

    metric: Metric
    """It is of this metric."""
    laps: str = ""
    """It is of this lap, or of the laps `later` or `all`; the last one counts where it is empty."""
    given: Metric | None = None
    """The column is the slope of the metric on this one, where there is one."""

    @property
    def title(self) -> str:
        """Returns what stands above the column."""
        if self.given is not None:
            return f"slope of {self.metric.title} on {self.given.title}"
        if self.laps.isdecimal():
            return f"{self.metric.heading}, lap {self.laps}"
        return f"{self.metric.heading}, {self.laps} laps" if self.laps else self.metric.heading

    @property
    def metrics(self) -> list[Metric]:
        """Returns every metric that the column needs."""
        return [self.metric] if self.given is None else [self.metric, self.given]

    def average(self, values: pd.DataFrame) -> str:
        """Returns the text of the average over runs, whose metrics are columns by key, or of the slope."""
        of = values[self.metric.key].astype(float)
        if self.given is None:
            return self.metric.text(self.metric.over(of))
        slope = slope_of(of.to_numpy(), values[self.given.key].astype(float).to_numpy())
        return UNKNOWN if np.isnan(slope) else f"{slope:.{_SLOPE_DIGITS}f}"

    def extreme(self, values: pd.DataFrame, name: str) -> str:
        """Returns the text of the `median` or the `max` over runs, of magnitudes where there are signs."""
        if self.given is not None:
            return UNKNOWN
        of = values[self.metric.key].astype(float)
        return self.metric.text(float((of.abs() if self.metric.average == "rms" else of).agg(name)))


def column_of(text: str) -> Column:
    """Returns a column such as `rmse`, `rmse@1`, `rmse@later`, `rmse@all` or `slope(bias, bias_true)`.

    SettingsError where a metric or the laps are unknown.
    """
    slope = _SLOPE.fullmatch(text)
    if slope is not None:
        return Column(_metric(slope[1]), given=_metric(slope[2]))
    key, _, laps = text.partition("@")
    metric = _metric(key)
    if laps and laps not in (EVERY_LAP, LATER_LAPS) and not laps.isdecimal():
        raise SettingsError(
            f"columns: expected a lap's number, '{LATER_LAPS}' or '{EVERY_LAP}' after @, found '{text}'"
        )
    return Column(metric, laps)


def slope_of(estimates: np.ndarray, truths: np.ndarray) -> float:
    """Returns `sum e t / sum t^2` over the runs (n,) whose estimate and truth are known; NaN without any.

    The line leads through the origin, since estimator and simulator both expect zero.
    """
    known = ~(np.isnan(estimates) | np.isnan(truths))
    moment = float(truths[known] @ truths[known])
    return float(estimates[known] @ truths[known]) / moment if moment > 0.0 else float("nan")


def _metric(key: str) -> Metric:
    check_name(key, METRICS, "columns: expected a known metric")
    return METRICS[key]
