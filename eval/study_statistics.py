"""What differs from a study's baseline by more than chance."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.stats import t as student

from .study import Study
from .study_frame import COMBINATION, RUN, last_laps

Array = NDArray[np.float64]
Runs = dict[tuple[Any, ...], dict[tuple[Any, ...], float]]

LEVEL: Final = 0.95
"""Of the intervals; a difference is significant where its corrected p is below what is left of 1."""
CORRECTION: Final = "Holm"
"""Correction for multiple comparisons, over all comparisons of one metric in the study."""


@dataclass(frozen=True)
class Estimate:
    """A mean and its 95 % interval, Student's t over runs."""

    mean: float
    """NaN of nothing."""
    half: float
    """Half the interval; NaN of fewer than two runs."""
    count: int
    """Runs, or pairs of them."""


@dataclass(frozen=True)
class Comparison:
    """One metric of one combination, and its difference from the baseline on the same runs."""

    noise: str
    """Name of the noise."""
    estimator: str
    """Name of the estimator."""
    variant: str
    """Name of the settings."""
    metric: str
    """Column of the results."""
    value: Estimate
    """At the end of the last lap."""
    difference: Estimate | None
    """Paired; None of the baseline itself."""
    differences: tuple[float, ...] = ()
    """Of each pair."""
    p: float = float("nan")
    """Of the paired t-test, corrected."""

    @property
    def name(self) -> str:
        """Of the estimator and its settings."""
        return f"{self.estimator}: {self.variant}"

    @property
    def significant(self) -> bool:
        """Whether chance alone rarely makes such a difference anywhere in the study."""
        return bool(self.p < 1.0 - LEVEL)


def compare(study: Study, frame: pd.DataFrame, metric: str) -> list[Comparison]:
    """Every combination against the baseline of its noise, in the study's order, p corrected after Holm."""
    runs = _runs(last_laps(frame), metric)
    found = []
    for noise in study.noise:
        for estimator in study.estimators:
            base = (noise, study.baseline.estimator or estimator, study.baseline_variant)
            for variant in study.points:
                key = (noise, estimator, variant)
                found.append(_compare(key, metric, runs, None if key == base else base))
    corrected = holm(np.array([comparison.p for comparison in found]))
    return [replace(comparison, p=float(p)) for comparison, p in zip(found, corrected, strict=True)]


def _runs(last: pd.DataFrame, metric: str) -> Runs:
    """The metric of every run, by combination and then by track and seed; NaN is none."""
    runs: Runs = {}
    names = [last[name] for name in (*COMBINATION, *RUN)]
    for *key, value in zip(*names, last[metric].astype(float), strict=True):
        if not np.isnan(value):
            combination, run = tuple(key[: len(COMBINATION)]), tuple(key[len(COMBINATION) :])
            runs.setdefault(combination, {})[run] = value
    return runs


def _compare(
    key: tuple[str, str, str], metric: str, runs: Runs, base: tuple[str, str, str] | None
) -> Comparison:
    own = runs.get(key, {})
    value = estimate(np.array(list(own.values())))
    if base is None:
        return Comparison(*key, metric, value, None)
    against = runs.get(base, {})
    pairs = np.array([own[run] - against[run] for run in own if run in against])
    return Comparison(*key, metric, value, estimate(pairs), tuple(pairs.tolist()), paired_p(pairs))


def estimate(values: Array) -> Estimate:
    """mean +- t(0.975, n - 1) s / sqrt(n)."""
    n = len(values)
    if n < 2:
        return Estimate(float(values[0]) if n else float("nan"), float("nan"), n)
    error = float(np.std(values, ddof=1) / np.sqrt(n))
    return Estimate(float(np.mean(values)), float(student.ppf(0.5 + LEVEL / 2, n - 1)) * error, n)


def paired_p(differences: Array) -> float:
    """Two-sided p of the paired t-test that the mean difference is 0; NaN of fewer than two pairs."""
    n = len(differences)
    if n < 2:
        return float("nan")
    mean, error = float(np.mean(differences)), float(np.std(differences, ddof=1) / np.sqrt(n))
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
