"""A figure of a benchmark as data: its value, which way is better, and what it is held to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Metric:
    """One figure, and what it is held to."""

    key: str
    """Name, for a baseline to be compared with."""
    value: float
    """NaN where the run was too short for it."""
    unit: str
    """Empty for a ratio."""
    direction: Literal["lower", "higher"] = "lower"
    """Which way is better."""
    bound: float | None = None
    """Worst value allowed; None where nothing is asked."""
    tolerance: float | None = None
    """How much worse than its baseline it may be, as a share of that; None where it has no baseline."""

    @property
    def holds(self) -> bool:
        """Whether the bound is kept; a value that isn't known keeps none."""
        if self.bound is None:
            return True
        return self.value <= self.bound if self.direction == "lower" else self.value >= self.bound

    def worse_than(self, baseline: float) -> bool:
        """Whether it is worse than the baseline by more than its tolerance; one that isn't known is."""
        spare = (self.tolerance or 0.0) * abs(baseline)
        if self.direction == "lower":
            return not self.value <= baseline + spare
        return not self.value >= baseline - spare
