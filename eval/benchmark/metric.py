"""A figure of a benchmark as data: its value, which way is better, its bound and its tolerance."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from rich.table import Table


@dataclass(frozen=True)
class Metric:
    """Holds one figure of a run."""

    key: str
    """The figure has this name, also in a baseline."""
    value: float
    """This is NaN where the run was too short for the figure."""
    unit: str
    """The value has this unit; it is empty for a ratio."""
    direction: Literal["lower", "higher"] = "lower"
    """The figure is better in this direction."""
    bound: float | None = None
    """This is the worst value allowed; it is None where any value is."""
    tolerance: float | None = None
    """The figure may be worse than its baseline by this share; it is None where there is no baseline."""

    @property
    def holds(self) -> bool:
        """Returns whether the bound is kept; an unknown value keeps none."""
        if self.bound is None:
            return True
        return self.value <= self.bound if self.direction == "lower" else self.value >= self.bound

    def worse_than(self, baseline: float) -> bool:
        """Returns whether the figure is worse than the baseline by more than its tolerance, or unknown."""
        spare = (self.tolerance or 0.0) * abs(baseline)
        if self.direction == "lower":
            return not self.value <= baseline + spare
        return not self.value >= baseline - spare


def metrics_table(figures: Iterable[Metric]) -> Table:
    """Returns a table for a terminal: each figure beside its bound."""
    table = Table("figure")
    for name in ("value", "unit", "bound"):
        table.add_column(name, justify="right")
    for metric in figures:
        style = None if metric.holds else "red"
        table.add_row(metric.key, f"{metric.value:.3g}", metric.unit, _bound_text(metric), style=style)
    return table


def _bound_text(metric: Metric) -> str:
    if metric.bound is None:
        return ""
    return f"{'<=' if metric.direction == 'lower' else '>='} {metric.bound:g}"
