"""What is measured: means of the times of updates, the power laws through them, and everything together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final, Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.stats import linregress

from .lanes import LaneTimes
from .settings import ScalingSettings

Array = NDArray[np.float64]

Sweep = Literal["cones", "readings", "laps"]
"""A sweep varies the cones seen, the detections of an update (readings), or the lap."""
CONES: Final[Sweep] = "cones"
READINGS: Final[Sweep] = "readings"
LAPS: Final[Sweep] = "laps"
LEAST_POINTS: Final = 3
"""A slope is fitted to at least this many points: two would leave nothing to estimate its error from."""


@dataclass(frozen=True)
class Point:
    """Holds the mean of some updates of an estimator."""

    sweep: Sweep
    """The updates are of this sweep."""
    estimator: str
    """The estimator has this name."""
    at: float
    """This is the mean number of cones seen, the number of detections, or the lap from 1."""
    seconds: float
    """An update took this wall time on average (s)."""
    cycles: int
    """The mean is over this many updates."""
    size: float
    """The map had this many control points or landmarks on average."""


@dataclass(frozen=True)
class Slope:
    """Holds the power law `seconds ~ at^slope` through some points, fitted to the logarithms."""

    sweep: Sweep
    """The points are of this sweep."""
    estimator: str
    """The estimator has this name."""
    slope: float
    """This is the exponent; it is NaN where there are too few points."""
    error: float
    """The exponent has this standard error."""
    points: int
    """The power law is fitted to this many points."""
    low: float
    """This is the least abscissa of those points."""
    high: float
    """This is the greatest abscissa of those points."""
    stopped: str = ""
    """This says why the estimator did not reach the end; it is empty where it did."""


@dataclass(frozen=True)
class Scaling:
    """Holds everything that was measured."""

    settings: ScalingSettings
    """This was asked for."""
    mapper: dict[str, Any]
    """These are the settings of the estimators, in full."""
    points: tuple[Point, ...]
    """These are the points of all sweeps, estimator by estimator."""
    slopes: tuple[Slope, ...]
    """Each sweep and estimator has a slope."""
    memory: dict[str, float]
    """Python and numpy held at most this much memory (MB) while each estimator mapped the first lap."""

    def of(self, sweep: Sweep, estimator: str) -> list[Point]:
        """Returns the points of a sweep of an estimator."""
        return [p for p in self.points if (p.sweep, p.estimator) == (sweep, estimator)]

    def slope(self, sweep: Sweep, estimator: str) -> Slope:
        """Returns the slope of a sweep of an estimator."""
        return next(s for s in self.slopes if (s.sweep, s.estimator) == (sweep, estimator))

    @property
    def estimators(self) -> tuple[str, ...]:
        """Returns the names of the estimators, in order."""
        return tuple(self.memory)

    def seconds_at(self, cones: float, estimator: str) -> float:
        """Returns the mean update (s) at a number of cones, between the points; NaN beyond them."""
        points = self.of(CONES, estimator)
        if not points:
            return float("nan")
        at, seconds = np.log([p.at for p in points]), np.log([p.seconds for p in points])
        return float(np.exp(np.interp(np.log(cones), at, seconds, left=np.nan, right=np.nan)))

    def frame(self) -> pd.DataFrame:
        """Returns a row for each point."""
        return pd.DataFrame([asdict(point) for point in self.points])


def binned(sweep: Sweep, times: LaneTimes, at: Array, edges: Array) -> list[Point]:
    """Returns a point for each interval between two `edges` that holds cycles; `at` (n,): their abscissas."""
    at = at[: len(times.seconds)]
    bins = np.searchsorted(edges, at, side="right") - 1
    kept = (number for number in range(len(edges) - 1) if np.any(bins == number))
    return [mean_point(sweep, times, at, bins == number) for number in kept]


def mean_point(sweep: Sweep, times: LaneTimes, at: Array, chosen: NDArray[np.bool_]) -> Point:
    """Returns the mean of the chosen cycles, of which there must be at least one."""
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
    """Fits a line by least squares to the logarithms of the points from the abscissa `fit_from` on."""
    at = np.array([p.at for p in points if p.at >= fit_from])
    seconds = np.array([p.seconds for p in points if p.at >= fit_from])
    low, high = (float(at.min()), float(at.max())) if len(at) else (float("nan"),) * 2
    if len(at) < LEAST_POINTS:
        return Slope(sweep, estimator, float("nan"), float("nan"), len(at), low, high, stopped)
    line = linregress(np.log(at), np.log(seconds))
    return Slope(sweep, estimator, float(line.slope), float(line.stderr), len(at), low, high, stopped)
