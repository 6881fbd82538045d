"""Means and paired differences with their intervals, and tests of them, over drives that share tracks."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import pandas as pd
from scipy import stats

from pathspace_graph.factors.arrays import Array

LEVEL: Final = 0.95  # confidence level of intervals; a difference is significant if p < 1 - LEVEL
RESAMPLES: Final = 2000
ROUND_OFF: Final = 1e-12  # share of differences below which they are all the same
FEWEST: Final = 8  # samples that can be resampled: fewer have too few different resamples


@dataclass(frozen=True, slots=True)
class Estimate:
    """Mean and its 95 % interval over independent samples."""

    mean: float  # NaN without samples
    half: float  # half the width of the interval; NaN for fewer than two samples
    count: int  # number of samples


def by_track(values: pd.Series) -> pd.Series:
    """Return the mean of each track, of values by track and seed; of a single track the values themselves.

    Drives of one track meet the same bends and cones, so tracks are the independent samples. Of a single
    track nothing can be said but about its drives.
    """
    tracks = values.groupby(level="track", sort=False).mean()
    return tracks if len(tracks) > 1 else values


def estimate(values: Array) -> Estimate:
    """Return the mean m of independent values (n,) and its interval m -+ q s / sqrt(n).

    From `FEWEST` values on, q is the quantile of `|m* - m| sqrt(n) / s*` over resamples with replacement (the
    bootstrap-t, which covers skewed values better than Student's t); below, it is Student's. The plain
    percentiles of m* would cover the mean of five normal values in 84 % of the cases only. Half an
    interval by resamples is at most the range of the values: s* is tiny in resamples without an outlier.
    """
    n = len(values)
    if n < 2:
        return Estimate(float(values[0]) if n else float("nan"), float("nan"), n)
    mean, sem = float(np.mean(values)), float(np.std(values, ddof=1) / n**0.5)
    quantile = float(stats.t.ppf(0.5 + LEVEL / 2, n - 1))
    if n >= FEWEST and sem > 0.0:
        drawn = values[np.random.default_rng(0).integers(0, n, (RESAMPLES, n))]
        off, spread = np.abs(drawn.mean(axis=1) - mean), drawn.std(axis=1, ddof=1) / n**0.5
        quantile = float(np.quantile(off[spread > 0.0] / spread[spread > 0.0], LEVEL))
        quantile = min(quantile, float(np.ptp(values)) / sem)
    return Estimate(mean, quantile * sem, n)


def paired_p(differences: Array) -> float:
    """Return the two-sided p of the paired t-test that the mean of the differences (n,) is 0.

    It is NaN for fewer than two pairs. Without any spread it is 1 where all differences are 0, else 0.
    """
    if len(differences) < 2:
        return float("nan")
    if np.ptp(differences) <= ROUND_OFF * np.abs(differences).max():
        return float(differences[0] == 0.0)
    return float(stats.ttest_1samp(differences, 0.0).pvalue)


def wilcoxon_p(differences: Array) -> float:
    """Return the two-sided p of Wilcoxon's signed-rank test, which asks for no normal distribution.

    It is at least `2^(1 - n)` for n pairs, and NaN without a pair that differs.
    """
    different = differences[differences != 0.0]
    return float(stats.wilcoxon(different).pvalue) if len(different) else float("nan")


def holm(p: Array) -> Array:
    """Return p (m,) corrected by Holm's method.

    The i-th smallest becomes `max over j <= i of (m - j) p_(j)`, j from 0, at most 1. NaN isn't counted and
    stays NaN. scipy.stats corrects the false discovery rate only, so this is written by hand.
    """
    corrected = np.full(len(p), np.nan)
    known = np.flatnonzero(~np.isnan(p))
    order = known[np.argsort(p[known], kind="stable")]
    factors = len(order) - np.arange(len(order))
    corrected[order] = np.minimum(np.maximum.accumulate(factors * p[order]), 1.0)
    return corrected
