"""Means over runs, differences between paired runs, and whether a difference may be chance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

Array = NDArray[np.float64]

LEVEL: Final = 0.95
"""Intervals have this confidence level; a difference is significant where its p is below 1 - LEVEL."""
CORRECTION: Final = "Holm"
"""Multiple comparisons are corrected by this method."""
_MIN_RUNS: Final = 2
"""An interval and a test need at least this many runs."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """Holds a mean and its 95 % interval by Student's t over runs."""

    mean: float
    """The mean is NaN without runs."""
    half: float
    """This is half the width of the interval; it is NaN for fewer than two runs."""
    count: int
    """The mean is over this many runs, or pairs of runs."""

    @property
    def low(self) -> float:
        """Returns the lower end of the interval."""
        return self.mean - self.half

    @property
    def high(self) -> float:
        """Returns the upper end of the interval."""
        return self.mean + self.half


def estimate(values: Array) -> Estimate:
    """Returns the mean of the values (n,) and its interval, mean -+ t(0.975, n - 1) s / sqrt(n)."""
    n = len(values)
    if n < _MIN_RUNS:
        return Estimate(float(values[0]) if n else float("nan"), float("nan"), n)
    half = float(stats.t.ppf(0.5 + LEVEL / 2, n - 1) * stats.sem(values))
    return Estimate(float(np.mean(values)), half, n)


def difference(values: ArrayLike, reference: ArrayLike) -> Estimate:
    """Returns the estimate of values - reference (n,) over the pairs of which both are finite."""
    own, others = np.asarray(values, dtype=float), np.asarray(reference, dtype=float)
    finite = np.isfinite(own) & np.isfinite(others)
    return estimate(own[finite] - others[finite])


def paired_p(differences: Array) -> float:
    """Returns the two-sided p of the paired t-test that the mean of the differences (n,) is 0.

    It is NaN for fewer than two pairs. Without any spread it is 1 where all differences are 0, else 0.
    """
    if len(differences) < _MIN_RUNS:
        return float("nan")
    if np.ptp(differences) == 0.0:
        return float(differences[0] == 0.0)
    return float(stats.ttest_1samp(differences, 0.0).pvalue)


def holm(p: Array) -> Array:
    """Returns p (m,) corrected by Holm's method.

    The i-th smallest becomes `max over j <= i of (m - j) p_(j)`, j from 0, at most 1. NaN isn't counted and
    stays NaN. scipy.stats corrects the false discovery rate only, so this is written by hand.
    """
    corrected = np.full(len(p), np.nan)
    known = np.flatnonzero(~np.isnan(p))
    order = known[np.argsort(p[known], kind="stable")]
    factors = len(order) - np.arange(len(order))
    corrected[order] = np.minimum(np.maximum.accumulate(factors * p[order]), 1.0)
    return corrected
