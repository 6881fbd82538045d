"""Means and paired differences with their intervals, and tests of them, over drives that share tracks."""

from dataclasses import dataclass, replace
from itertools import product
from typing import Final

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy import stats

from pathspace_graph.eval.metrics.measures import METRICS, figure
from pathspace_graph.factors.arrays import Array

from .study import Study

COMBINATION: Final = ("noise", "estimator", "variant")  # columns of a combination, which is compared
RUN: Final = ("track", "seed")  # columns of a drive; combinations are paired on the same drive and noise
RUN_OF: Final = (*RUN, *COMBINATION)
TIMES: Final = tuple(key for key, metric in METRICS.items() if metric.time)
LEVEL: Final = 0.95  # confidence level of intervals; a difference is significant if p < 1 - LEVEL
ROUND_OFF: Final = 1e-12  # share of differences below which they are all the same


@dataclass(frozen=True, slots=True)
class Estimate:
    """Mean and its 95 % interval over independent samples."""

    mean: float  # NaN without samples
    half: float  # half the width of the interval; NaN for fewer than two samples
    count: int  # number of samples

    def text(self, digits: int = 3, factor: float = 1.0, sign: str = "") -> str:
        return figure(factor * self.mean, factor * self.half, digits, sign)


def by_track(values: pd.Series) -> pd.Series:
    """Return the mean of each track, of values by track and seed; of a single track the values themselves.

    Drives of one track meet the same bends and cones, so tracks are the independent samples. Of a single
    track nothing can be said but about its drives.
    """
    tracks = values.groupby(level="track", sort=False).mean()
    return tracks if len(tracks) > 1 else values


def estimate(values: ArrayLike) -> Estimate:
    """Return the mean m of independent values (n,) that are known, and Student's `m -+ t s / sqrt(n)`."""
    known = np.asarray(values, float)
    known = known[np.isfinite(known)]
    n = len(known)
    if n < 2:
        return Estimate(float(known[0]) if n else float("nan"), float("nan"), n)
    half = stats.t.ppf(0.5 + LEVEL / 2, n - 1) * stats.sem(known)
    return Estimate(float(np.mean(known)), float(half), n)


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


# --- contrasts -------------------------------------------------------------------------------------------


def last_laps(frame: pd.DataFrame) -> pd.DataFrame:
    """Return the last row of each run that finished."""
    finished = frame[frame["failure"] == ""]
    return finished.groupby(list(RUN_OF), sort=False).tail(1)


@dataclass(frozen=True)
class Contrast:
    """One metric of one combination, and its difference from the baseline, drive by drive."""

    noise: str
    estimator: str
    variant: str
    metric: str  # key of the metric
    runs: int  # number of runs with a value at the end of their last lap
    value: Estimate  # mean over the tracks
    difference: Estimate | None  # mean over the tracks; None for the baseline itself
    differences: tuple[float, ...] = ()  # of each track, or of each drive of a single track
    p: float = float("nan")  # p of the paired t-test over them, corrected for all hypotheses of the metric
    wilcoxon: float = float("nan")  # p of Wilcoxon's signed-rank test over them, not corrected

    @property
    def significant(self) -> bool:
        """Whether chance alone rarely makes such a difference anywhere in the study."""
        return bool(self.p < 1.0 - LEVEL)


def contrasts(study: Study, frame: pd.DataFrame, metric: str) -> list[Contrast]:
    """Return every combination against the baseline of its noise, in the study's order.

    Nothing is tested where all differences are 0, as between cells that mean the same, nor of a wall time,
    which depends on what else the machine does. The cells of a drive are run one after another, so that
    processor times are.
    """
    known = last_laps(frame).astype({metric: float}).dropna(subset=[metric])
    runs = {key: of.set_index([*RUN])[metric] for key, of in known.groupby([*COMBINATION], sort=False)}
    nothing = pd.Series(dtype=float, index=pd.MultiIndex.from_arrays([[], []], names=RUN))
    contrasted = []
    for key in product(study.noises, study.estimators, study.points):
        base = (key[0], study.baseline.estimator or key[1], study.baseline_variant)
        values, against = runs.get(key, nothing), runs.get(base, nothing)
        contrast = Contrast(*key, metric, len(values), estimate(by_track(values)), None)
        if key != base:
            d = by_track((values - against).dropna()).to_numpy()
            contrast = replace(contrast, difference=estimate(d), differences=tuple(d.tolist()))
            if d.any() and METRICS[metric].time != "wall":
                contrast = replace(contrast, p=paired_p(d), wilcoxon=wilcoxon_p(d))
        contrasted.append(contrast)
    corrected = holm(np.array([contrast.p for contrast in contrasted]))
    return [replace(contrast, p=float(p)) for contrast, p in zip(contrasted, corrected, strict=True)]
