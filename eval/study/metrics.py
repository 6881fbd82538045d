"""What a study measures of every run, lap by lap."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.eval.metrics.table1 import LapMetrics, ate, lap_end_times, lap_metrics, normal_errors
from pathspace_graph.io.log import Log, Truth
from pathspace_graph.io.map import Map, SplineBoundary
from pathspace_graph.io.results import RunResult
from pathspace_graph.labels import BOUNDARIES

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MetricStyle:
    """How a column of the results is told."""

    title: str
    """With its unit."""
    factor: float = 1.0
    """From the column's unit to the title's."""
    digits: int = 3
    """After the point."""


_STYLES: Final = {
    "rmse": MetricStyle("rmse [m]"),
    "missed": MetricStyle("missed [%]", 100.0, 2),
    "size": MetricStyle("size", digits=1),
    "closed": MetricStyle("closed [%]", 100.0, 1),
    "ate": MetricStyle("trajectory error of the lap [m]"),
    "inside": MetricStyle("cones within 2σ [%]", 100.0, 1),
    "inside_marginals": MetricStyle("cones within 2σ of the marginals [%]", 100.0, 1),
    "nees": MetricStyle("mean squared error by variance", digits=2),
    "nees_marginals": MetricStyle("mean squared error by variance of the marginals", digits=2),
    "ms_mean": MetricStyle("mean update [ms]", digits=2),
    "ms_p99": MetricStyle("99th percentile of an update [ms]", digits=1),
    "seconds": MetricStyle("whole run [s]", digits=2),
}
TIMES: Final = ("ms_mean", "ms_p99", "seconds")
"""Columns of wall time: all that differs from one run of a study to the next."""
_LAP_COLUMNS: Final = tuple(entry.name for entry in fields(LapMetrics) if entry.name != "lap")
METRICS: Final[Mapping[str, MetricStyle]] = {
    **{name: _STYLES.get(name, MetricStyle(name)) for name in _LAP_COLUMNS},
    **_STYLES,
}
"""Every column that a summary can tell of."""


def lap_stamps(log: Log) -> Array:
    """When each true lap ends (s), or the log itself where no lap is complete."""
    ends = lap_end_times(_truth(log))
    return ends if len(ends) else np.array([log.cycles[-1].t])


def lap_rows(result: RunResult, log: Log, seconds: float) -> list[dict[str, Any]]:
    """A row for each true lap: the map as it stood then, the trajectory and the updates in between.

    A batch estimator has one map and thus one row, the last lap's. `seconds`: wall time of the whole run.
    """
    truth, ends = _truth(log), lap_stamps(log)
    maps = dict(enumerate(result.snapshots, start=1)) or {len(ends): result.map}
    begins = np.append(-np.inf, ends[:-1])
    return [
        {"lap": lap}
        | map_row(track, truth, lap)
        | _drive_row(result, truth, float(begins[lap - 1]), float(ends[lap - 1]))
        | {"seconds": seconds}
        for lap, track in maps.items()
    ]


def map_row(track: Map, truth: Truth, lap: int) -> dict[str, Any]:
    """The paper's metrics, and whether the covariance tells the truth: the joint one, and its marginals."""
    metrics = lap_metrics(track, truth, lap)
    row = {
        "closed": bool(track.closed),
        "cones": int(np.isin(truth.cone_labels, BOUNDARIES).sum()),
        **_honesty(track, truth, ""),
        **_honesty(with_marginals(track), truth, "_marginals"),
    }
    return {name: getattr(metrics, name) for name in _LAP_COLUMNS} | row


def with_marginals(track: Map) -> Map:
    """The map with its control points' own covariances and no cross terms.

    `B blockdiag(Sigma) B' = sum_j beta_j(u)^2 Sigma_jj`, the squared basis of the paper (State Uncertainty).
    """
    boundaries = {
        label: replace(
            boundary,
            covariance=boundary.covariance * np.kron(np.eye(boundary.size), np.ones((2, 2))),
        )
        for label, boundary in track.boundaries.items()
        if isinstance(boundary, SplineBoundary)
    }
    return Map(track.closed, boundaries)


def _honesty(track: Map, truth: Truth, suffix: str) -> dict[str, float]:
    """Share of the true cones within 2 sigma of the curve, and mean (error / sigma)^2; NaN of landmarks."""
    errors = normal_errors(track, truth)
    nees = float(np.mean((errors.errors / errors.sigmas) ** 2)) if len(errors.errors) else float("nan")
    return {f"inside{suffix}": errors.share_inside(), f"nees{suffix}": nees}


def _drive_row(result: RunResult, truth: Truth, begin: float, end: float) -> dict[str, float]:
    """Of the cycles in (begin, end]: the trajectory's error (m) and the updates' wall time (ms)."""
    of = (result.trajectory_t > begin) & (result.trajectory_t <= end)
    milliseconds = 1e3 * np.array([record.seconds for record in result.cycles if begin < record.t <= end])
    return {
        "ate": ate(result.trajectory_t[of], result.trajectory[of], truth),
        "ms_mean": float(np.mean(milliseconds)) if len(milliseconds) else float("nan"),
        "ms_p99": float(np.quantile(milliseconds, 0.99)) if len(milliseconds) else float("nan"),
    }


def _truth(log: Log) -> Truth:
    if log.truth is None:
        raise ValueError("expected a simulated log, found one without truth")
    return log.truth
