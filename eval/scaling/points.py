"""Means of the times of updates, and the power laws through them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.stats import linregress

from .lanes import LaneTimes

Array = NDArray[np.float64]

Sweep = Literal["cones", "readings", "laps"]
"""What is varied."""
CONES: Final[Sweep] = "cones"
READINGS: Final[Sweep] = "readings"
LAPS: Final[Sweep] = "laps"
LEAST_POINTS: Final = 3
"""A slope is fitted to so many points at least: two leave nothing to tell its standard error by."""


@dataclass(frozen=True)
class Point:
    """The mean of some updates of an estimator."""

    sweep: Sweep
    """What is varied."""
    estimator: str
    """Its name."""
    at: float
    """Mean number of cones seen, number of readings, or the lap from 1."""
    seconds: float
    """Mean wall time of an update, s."""
    cycles: int
    """Updates that it is the mean of."""
    size: float
    """Mean number of control points or landmarks."""


@dataclass(frozen=True)
class Slope:
    """`seconds ~ at^slope`, fitted to the logarithms."""

    sweep: Sweep
    """What is varied."""
    estimator: str
    """Its name."""
    slope: float
    """The exponent; NaN of too few points."""
    error: float
    """Its standard error."""
    points: int
    """How many it is fitted to."""
    low: float
    """The least of their abscissas, ..."""
    high: float
    """... and the greatest."""
    stopped: str = ""
    """Why the estimator did not come to the end; empty where it did."""


def binned(sweep: Sweep, times: LaneTimes, at: Array, edges: Array) -> list[Point]:
    """A point for each interval between two of `edges` that cycles with abscissas `at` (n,) lie in."""
    at = at[: len(times.seconds)]
    bins = np.searchsorted(edges, at, side="right") - 1
    kept = (number for number in range(len(edges) - 1) if np.any(bins == number))
    return [point(sweep, times, at, bins == number) for number in kept]


def point(sweep: Sweep, times: LaneTimes, at: Array, chosen: NDArray[np.bool_]) -> Point:
    """The mean of the chosen cycles, at least one."""
    return Point(
        sweep=sweep,
        estimator=times.lane.estimator,
        at=float(np.mean(at[chosen])),
        seconds=float(np.mean(times.seconds[chosen])),
        cycles=int(np.sum(chosen)),
        size=float(np.mean(times.sizes[chosen])),
    )


def fit_slope(
    sweep: Sweep, estimator: str, points: Sequence[Point], fit_from: float = 0.0, stopped: str = ""
) -> Slope:
    """Least squares through the logarithms of the points from `fit_from` on."""
    at = np.array([p.at for p in points if p.at >= fit_from])
    seconds = np.array([p.seconds for p in points if p.at >= fit_from])
    low, high = (float(at.min()), float(at.max())) if len(at) else (float("nan"),) * 2
    if len(at) < LEAST_POINTS:
        return Slope(sweep, estimator, float("nan"), float("nan"), len(at), low, high, stopped)
    line = linregress(np.log(at), np.log(seconds))
    return Slope(sweep, estimator, float(line.slope), float(line.stderr), len(at), low, high, stopped)
