"""What came of each fault: every run beside the clean run of the same track and seed."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import pandas as pd

from pathspace_graph.eval.metrics.measures import METRICS
from pathspace_graph.eval.study.frame import RUN, last_laps
from pathspace_graph.eval.study.study import Study
from pathspace_graph.plausibility.diagnosis import LIMIT

from .suite import CLEAN, Fault, fault_of

BY_PRIOR: Final = "_by_prior"
"""Metrics with this suffix are estimates of a calibration by the sigma of its prior."""
TITLE_BY_PRIOR: Final = " by its prior's sigma"
"""The titles of these metrics end so."""


@dataclass(frozen=True)
class FaultyRun:
    """Holds what came of one run."""

    ratio: float
    """This is the map's rmse by that of the clean run; it is NaN where either has no map."""
    size: float
    """This is the map's size by that of the clean run; it is NaN where either has no map."""
    missed: float
    """This share of the true cones is missed."""
    closed: bool
    """The loop is closed at the end where this is true."""
    lost: bool
    """The vehicle is lost in the last second where this is true."""
    error_max: float
    """The trajectory is wrong by up to this (m)."""
    error_end: float
    """The trajectory is wrong by this in the last second, in the root mean square (m)."""
    astray_time: float
    """After the loop has closed, the vehicle is more than 1 m off for this time (s) at most."""
    astray_way: float
    """After the loop has closed, the vehicle is more than 1 m off for this way (m) at most."""
    said: str
    """These are the notices of the run; it is empty where nothing was said."""
    told_degraded: float
    """The run calls this share of its cycles degraded; it is NaN where it does not judge its health."""
    told_lost: float
    """The run calls this share of its cycles lost; it is NaN where it does not judge its health."""
    calibration: dict[str, float]
    """These are the estimates of the calibration by the sigmas of their priors."""

    @property
    def is_told(self) -> bool:
        """Returns whether the run says that something is wrong."""
        return bool(self.said) or self.told_lost > 0.0


@dataclass(frozen=True)
class Outcome:
    """Holds what came of one fault of one strength."""

    fault: Fault
    """This is the fault."""
    runs: tuple[FaultyRun, ...]
    """These are the runs that finished."""
    failed: int
    """This number of runs ended with an error."""

    @property
    def ratios(self) -> np.ndarray:
        """Returns the ratios of the rmse (k,) of the runs that have one."""
        return _known([run.ratio for run in self.runs])

    @property
    def said(self) -> dict[str, int]:
        """Returns each notice with the number of runs that gave it."""
        return dict(Counter(run.said for run in self.runs if run.said).most_common())

    @property
    def calibration(self) -> dict[str, float]:
        """Returns the mean of each estimate by its prior's sigma, where it is conspicuous."""
        names = dict.fromkeys(name for run in self.runs for name in run.calibration)
        means = {name: mean([run.calibration.get(name, np.nan) for run in self.runs]) for name in names}
        return {name: value for name, value in means.items() if abs(value) > LIMIT}

    def values(self) -> dict[str, Any]:
        """Returns the outcome as a row of plain values; what is not known is NaN."""
        ratios, runs = self.ratios, self.runs
        return {
            "fault": self.fault.kind,
            "strength": self.fault.value,
            "unit": self.fault.unit,
            "runs": len(runs),
            "failed": self.failed,
            "with_map": len(ratios),
            "ratio_mean": mean(ratios),
            "ratio_min": float(ratios.min(initial=np.inf)) if len(ratios) else np.nan,
            "ratio_max": float(ratios.max(initial=0.0)) if len(ratios) else np.nan,
            "size_ratio": mean([run.size for run in runs]),
            "missed": mean([run.missed for run in runs]),
            "closed": sum(run.closed for run in runs),
            "lost": sum(run.lost for run in runs),
            "error_max": max((run.error_max for run in runs), default=np.nan),
            "error_end": max((run.error_end for run in runs), default=np.nan),
            "astray_time": greatest([run.astray_time for run in runs]),
            "astray_way": greatest([run.astray_way for run in runs]),
            "told": sum(run.is_told for run in runs),
            "told_degraded": mean([run.told_degraded for run in runs]),
            "told_lost": mean([run.told_lost for run in runs]),
            "calibration": self.calibration,
            "said": self.said,
        }


def mean(values: Any) -> float:
    """Returns the mean of the values that are known, and NaN if there are none."""
    known = _known(values)
    return float(known.mean()) if len(known) else float("nan")


def greatest(values: Any) -> float:
    """Returns the greatest of the values that are known, and NaN if there are none."""
    return float(max(_known(values), default=np.nan))


def _known(values: Any) -> np.ndarray:
    array = np.asarray(values, float)
    return np.asarray(array[~np.isnan(array)])


def outcomes(study: Study, frame: pd.DataFrame) -> list[Outcome]:
    """Returns the outcome of every noise of a suite, in its order, each at the end of the last lap."""
    last = last_laps(frame)
    clean = {_run(row): row for row in _rows(last, CLEAN)}
    failures = frame[frame["failure"] != ""].groupby("noise").size()
    return [
        Outcome(
            fault_of(noise),
            tuple(_faulty_run(row, clean.get(_run(row), {})) for row in _rows(last, noise)),
            int(failures.get(noise, 0)),
        )
        for noise in study.noise
    ]


def _rows(last: pd.DataFrame, noise: str) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = last[last["noise"] == noise].to_dict("records")
    return rows


def _run(row: dict[str, Any]) -> tuple[Any, ...]:
    return tuple(row[name] for name in RUN)


def _faulty_run(row: dict[str, Any], clean: dict[str, Any]) -> FaultyRun:
    def known(name: str) -> float:
        return float(row.get(name, np.nan))

    def by_clean(name: str) -> float:
        reference = float(clean.get(name, np.nan))
        return known(name) / reference if reference > 0.0 else np.nan

    calibration = {
        METRICS[name].title.removesuffix(TITLE_BY_PRIOR): known(name)
        for name in row
        if name.endswith(BY_PRIOR)
    }
    return FaultyRun(
        ratio=by_clean("rmse"),
        size=by_clean("size"),
        missed=known("missed"),
        closed=known("closed_at_end") == 1.0,
        lost=known("lost_at_end") == 1.0,
        error_max=known("error_max"),
        error_end=known("error_end"),
        astray_time=known("astray_time"),
        astray_way=known("astray_way"),
        said=row["said"],
        told_degraded=known("told_degraded"),
        told_lost=known("told_lost"),
        calibration=calibration,
    )
