"""Contrasts of a study: each combination beside its baseline, tested over paired runs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from pathspace_graph.eval.metrics.paired import LEVEL, Estimate, estimate, holm, paired_p

from .frame import COMBINATION, RUN, last_laps
from .study import Study

Runs = dict[tuple[Any, ...], dict[tuple[Any, ...], float]]
"""Each combination has the values of its runs, by track and seed."""


@dataclass(frozen=True)
class Contrast:
    """A contrast holds one metric of one combination, and its difference from the baseline, run by run."""

    noise: str
    """The noise has this name."""
    estimator: str
    """The estimator has this name."""
    variant: str
    """The settings have this name."""
    metric: str
    """The metric has this key."""
    value: Estimate
    """This is the mean over all runs, each at the end of its last lap."""
    difference: Estimate | None
    """This is the mean over the pairs; it is None for the baseline itself."""
    differences: tuple[float, ...] = ()
    """Each pair of runs has its difference here."""
    p: float = float("nan")
    """This is p of the paired t-test, corrected for all comparisons of the metric."""

    @property
    def name(self) -> str:
        """Returns the names of the estimator and its settings."""
        return f"{self.estimator}: {self.variant}"

    @property
    def significant(self) -> bool:
        """Returns whether chance alone rarely makes such a difference anywhere in the study."""
        return bool(self.p < 1.0 - LEVEL)


def contrasts(study: Study, frame: pd.DataFrame, metric: str) -> list[Contrast]:
    """Returns every combination against the baseline of its noise, in the study's order.

    p is corrected by Holm's method over all comparisons of the metric in the study.
    """
    runs = _runs(last_laps(frame), metric)
    found = []
    for noise in study.noise:
        for estimator in study.estimators:
            base = (noise, study.baseline.estimator or estimator, study.baseline_variant)
            for variant in study.points:
                key = (noise, estimator, variant)
                found.append(_compare(key, metric, runs, None if key == base else base))
    corrected = holm(np.array([contrast.p for contrast in found]))
    return [replace(contrast, p=float(p)) for contrast, p in zip(found, corrected, strict=True)]


def _runs(last: pd.DataFrame, metric: str) -> Runs:
    """Returns the metric of every run, by combination and then by track and seed, without NaN."""
    runs: Runs = {}
    names = [last[name] for name in (*COMBINATION, *RUN)]
    for *key, value in zip(*names, last[metric].astype(float), strict=True):
        if not np.isnan(value):
            combination, run = tuple(key[: len(COMBINATION)]), tuple(key[len(COMBINATION) :])
            runs.setdefault(combination, {})[run] = value
    return runs


def _compare(
    key: tuple[str, str, str], metric: str, runs: Runs, base: tuple[str, str, str] | None
) -> Contrast:
    own = runs.get(key, {})
    value = estimate(np.array(list(own.values())))
    if base is None:
        return Contrast(*key, metric, value, None)
    against = runs.get(base, {})
    pairs = np.array([own[run] - against[run] for run in own if run in against])
    return Contrast(*key, metric, value, estimate(pairs), tuple(pairs.tolist()), paired_p(pairs))
