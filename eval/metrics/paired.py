"""Means over runs, differences between runs that are paired, and what of them may be chance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import t as student

Array = NDArray[np.float64]

LEVEL: Final = 0.95
"""Of the intervals; a difference is significant where its p is below what is left of 1."""
CORRECTION: Final = "Holm"
"""Correction for multiple comparisons."""
_FEWEST: Final = 2
"""Runs that have an interval."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """A mean and its 95 % interval, Student's t over runs."""

    mean: float
    """NaN of nothing."""
    half: float
    """Half the interval; NaN of fewer than two runs."""
    count: int
    """Runs, or pairs of them."""

    @property
    def low(self) -> float:
        """The interval is from here ..."""
        return self.mean - self.half

    @property
    def high(self) -> float:
        """... to here."""
        return self.mean + self.half

    @property
    def significant(self) -> bool:
        """Whether 0 is outside of the interval."""
        return bool(self.low > 0.0 or self.high < 0.0)


def estimate(values: Array) -> Estimate:
    """mean -+ t(0.975, n - 1) s / sqrt(n) of the values (n,)."""
    n = len(values)
    if n < _FEWEST:
        return Estimate(float(values[0]) if n else float("nan"), float("nan"), n)
    return Estimate(float(np.mean(values)), float(student.ppf(0.5 + LEVEL / 2, n - 1)) * _error(values), n)


def difference(values: ArrayLike, reference: ArrayLike) -> Estimate:
    """The estimate of values - reference (n,), pair by pair where both are finite."""
    own, others = np.asarray(values, dtype=float), np.asarray(reference, dtype=float)
    both = np.isfinite(own) & np.isfinite(others)
    return estimate(own[both] - others[both])


def paired_p(differences: Array) -> float:
    """Two-sided p of the paired t-test that the mean difference is 0; NaN of fewer than two pairs."""
    n = len(differences)
    if n < _FEWEST:
        return float("nan")
    mean, error = float(np.mean(differences)), _error(differences)
    if error == 0.0:
        return 1.0 if mean == 0.0 else 0.0
    return float(2.0 * student.sf(abs(mean) / error, n - 1))


def holm(p: Array) -> Array:
    """p of each comparison after Holm: `max over j <= i of (m - j) p_(j)`, j from 0, at most 1; NaN stays."""
    corrected = np.full(len(p), np.nan)
    known = np.flatnonzero(~np.isnan(p))
    order = known[np.argsort(p[known], kind="stable")]
    factors = len(order) - np.arange(len(order))
    corrected[order] = np.minimum(np.maximum.accumulate(factors * p[order]), 1.0)
    return corrected


def _error(values: Array) -> float:
    """s / sqrt(n), the standard error of the mean."""
    return float(np.std(values, ddof=1) / np.sqrt(len(values)))
