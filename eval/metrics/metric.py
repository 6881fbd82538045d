"""The metrics: their names, units and averages."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import repeat
from math import isfinite, nan
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike

from .accuracy import root_mean_square

FACTORS: Final[Mapping[str, float]] = {"%": 100.0, "kB": 1e-3, "°": float(np.rad2deg(1.0)), "mrad/s": 1e3}
"""Factors from the shares, bytes and radians of the columns to the units of the tables."""
UNKNOWN: Final = "–"


@dataclass(frozen=True)
class Metric:
    """A number that is measured of every lap or of every run."""

    key: str  # name of its column in every file
    title: str  # name in tables
    unit: str = ""  # unit in tables; empty for pure numbers and counts
    digits: int = 3  # number of digits after the decimal point in tables
    scope: Literal["lap", "run"] = "lap"  # of laps and the whole run, or of the whole run only
    time: Literal["", "wall", "processor"] = ""  # kind of a time, all that differs when a run is repeated
    average: Literal["mean", "rms"] = "mean"  # over runs: a root mean square for errors with a sign
    best: Literal["", "least", "most"] = ""  # which value is best; some, such as a NEES, have no best

    @property
    def heading(self) -> str:
        return f"{self.title} [{self.unit}]" if self.unit else self.title

    @property
    def factor(self) -> float:
        """Factor from the column's unit to that of the tables."""
        return FACTORS.get(self.unit, 1.0)

    def over(self, values: ArrayLike) -> float:
        """Return the average of values of several runs, without those that aren't known."""
        known = np.asarray(values, float)
        known = known[~np.isnan(known)]
        if len(known) == 0:
            return float("nan")
        return root_mean_square(known) if self.average == "rms" else float(np.mean(known))

    def text(self, value: float, half: float = nan) -> str:
        """Return a value in the unit of the tables, with half the width of its interval."""
        return figure(self.factor * value, self.factor * half, self.digits)


def figure(value: float, half: float = nan, digits: int = 3, sign: str = "") -> str:
    """Return a value and half the width of its interval, `0.165 ± 0.036`, as far as they are known."""
    texts = f"{value:{sign}.{digits}f}", f"{half:.{digits}f}"
    return " ± ".join(text for x, text in zip((value, half), texts, strict=True) if isfinite(x)) or UNKNOWN


def figures(values: Iterable[float], *digits: int) -> list[str]:
    """Return values without intervals, each with its own digits, or all with the same."""
    every = digits if len(digits) > 1 else repeat(*digits)
    return [figure(value, digits=k) for value, k in zip(values, every, strict=False)]


PAPER: Final = (
    Metric("rmse", "rmse", "m", best="least"),
    Metric("missed", "missed", "%", 1, best="least"),
    Metric("size", "size", digits=0),
)
_ALL: Final = (
    *PAPER,
    Metric("size_share", "size by true cones", "%", 1),
    Metric("missed_2m", "missed at 2 m", "%", 1, best="least"),
    Metric("missed_1m", "missed at 1 m", "%", 1, best="least"),
    Metric("rmse_capped", "rmse, a missed cone as 3 m", "m", best="least"),
    Metric("mapped_to_truth", "curve distance, mapped to truth", "m", best="least"),
    Metric("truth_to_mapped", "curve distance, truth to mapped", "m", best="least"),
    Metric("centre", "error of the centre line, across", "m", best="least"),
    Metric("centre_nees", "NEES of the centre line, across", digits=2),
    Metric("half_width", "error of the width to each side", "m", best="least"),
    Metric("half_width_nees", "NEES of the width to each side", digits=2),
    Metric("ghost_landmarks", "ghost landmarks", digits=1, best="least"),
    Metric("ghost_metres", "ghost curve", "m", 1, best="least"),
    Metric("ate", "trajectory error (ATE)", "m", best="least"),
    Metric("along", "trajectory error along", "m", best="least"),
    Metric("across", "trajectory error across", "m", best="least"),
    Metric("reach_median", "reach, median", "m", 1, best="most"),
    Metric("reach_p10", "reach, 10th percentile", "m", 1, best="most"),
    Metric("reach_short", "reach under 4 m, share of cycles", "%", 1, best="least"),
    Metric("reach_error", "error of the cones in reach", "m", best="least"),
    Metric("turn", "turn about the start", "°", 2, average="rms"),
    Metric("turn_nees", "NEES of the turn", digits=2),
    Metric("map_scale", "scale error of the map", "%", 2, average="rms"),
    Metric("map_scale_nees", "NEES of the map's scale", digits=2),
    Metric("rmse_aligned", "rmse without turn and scale", "m", best="least"),
    Metric("turn_from_batch", "turn from the batch", "°", 2, average="rms"),
    Metric("rmse_by_batch", "rmse by that of the batch", digits=2),
    Metric("nees", "NEES per degree of freedom", digits=2),
    Metric("inside", "cones within 2σ of the curve", "%", 1),
    Metric("inside_marginals", "cones within 2σ of the marginals", "%", 1),
    Metric("normalized_error", "mean squared error by variance at the cones", digits=2),
    Metric("normalized_error_marginals", "mean squared error by marginal variance at the cones", digits=2),
    Metric("closed", "loop closed", "%", 0, best="most"),
    Metric("closed_at_end", "loop closed at the end of the log", "%", 0, "run", best="most"),
    Metric("false_closing", "loop closed falsely", "%", 1, "run", best="least"),
    Metric("jump", "jump of the pose where the map is replaced", "m", 2, "run"),
    Metric("error_max", "largest trajectory error", "m", 2, "run", best="least"),
    Metric("end_off", "last pose from its registration on the beginning", "m", 2, "run", best="least"),
    Metric("crossings", "crossings of the boundaries", "", 0, "run", best="least"),
    Metric("agreement", "distance from the maps of the other drives", "m", 3, "run", best="least"),
    Metric("lost_at_end", "vehicle lost at the end", "%", 0, "run", best="least"),
    Metric("divergence_time", "longest time with an error of over 1 m, after closing", "s", 1, "run"),
    Metric("divergence_distance", "longest way with an error of over 1 m, after closing", "m", 0, "run"),
    Metric("reported_degraded", "cycles that the estimator calls degraded", "%", 1, "run"),
    Metric("reported_lost", "cycles that the estimator calls lost", "%", 1, "run"),
    Metric("scale", "scale error of the speeds", "%", 2, "run"),
    Metric("scale_true", "scale error of the speeds, true", "%", 2, "run"),
    Metric("scale_by_sigma", "error of the scale by claimed sigma", "", 2, "run", average="rms"),
    Metric("scale_by_prior", "scale error of the speeds by its prior's sigma", "", 1, "run"),
    Metric("bias", "bias of the yaw rate", "mrad/s", 2, "run"),
    Metric("bias_true", "bias of the yaw rate, true", "mrad/s", 2, "run"),
    Metric("bias_by_sigma", "error of the bias by claimed sigma", "", 2, "run", average="rms"),
    Metric("bias_by_prior", "bias of the yaw rate by its prior's sigma", "", 1, "run"),
    Metric("yaw_by_prior", "yaw of the sensor by its prior's sigma", "", 1, "run"),
    Metric("lateral_by_prior", "lateral offset of the sensor by its prior's sigma", "", 1, "run"),
    Metric("latency_by_prior", "latency of detections by its prior's sigma", "", 1, "run"),
    Metric("range_scale_by_prior", "scale error of ranges by its prior's sigma", "", 1, "run"),
    Metric("range_bias_by_prior", "bias of ranges by its prior's sigma", "", 1, "run"),
    Metric("heading_by_sigma", "error of the last heading by claimed sigma", "", 2, "run", average="rms"),
    Metric("converged", "batch converged", "%", 0, "run", best="most"),
    Metric("cost", "cost of the batch", "", 1, "run"),
    Metric("bytes", "map", "kB", 2),
    Metric("bytes_covariance", "covariance of the map", "kB", 1),
    Metric("ms_mean", "update, mean", "ms", 2, time="wall", best="least"),
    Metric("ms_p99", "update, 99th percentile", "ms", 2, time="wall", best="least"),
    Metric("ms_processor", "update, mean processor time", "ms", 2, time="processor", best="least"),
    Metric("seconds", "whole run", "s", 1, "run", time="wall", best="least"),
    Metric("seconds_processor", "whole run, processor time", "s", 1, "run", time="processor", best="least"),
)
METRICS: Final[Mapping[str, Metric]] = {metric.key: metric for metric in _ALL}  # in the order of tables
