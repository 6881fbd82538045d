"""Everything that is measured of a run: a row for each lap, and one for the whole log."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from pathspace_graph.eval.metrics.consistency import map_consistency
from pathspace_graph.eval.metrics.cost import covariance_bytes, map_bytes, stage_times
from pathspace_graph.eval.metrics.curve_distance import curve_distance
from pathspace_graph.eval.metrics.ghosts import GhostSettings, ghosts
from pathspace_graph.eval.metrics.summary import has_cones, lap_times
from pathspace_graph.eval.metrics.table1 import (
    capped_rmse,
    cone_distances,
    lap_metrics,
    missed_share,
    normal_errors,
    root_mean_square,
    trajectory_errors,
)
from pathspace_graph.io.log import Log, Truth
from pathspace_graph.io.map import Map
from pathspace_graph.io.results import BatchRun, CycleRecord, RunResult

Row = dict[str, float | int | str | bool]


@dataclass(frozen=True)
class Metric:
    """A column of the results."""

    name: str
    """Of the column."""
    title: str
    """In a table, with its unit."""
    digits: int
    """After the point, in a table."""
    factor: float = 1.0
    """From the column's unit to the title's."""
    truth: bool = True
    """Whether it needs the truth."""

    def text(self, value: float) -> str:
        """As a table has it; a dash where it isn't known."""
        return "–" if np.isnan(value) else f"{self.factor * value:.{self.digits}f}"


PAPER: Final = (
    Metric("rmse", "rmse [m]", 3),
    Metric("missed", "missed [%]", 1, 100.0),
    Metric("size", "size", 0, truth=False),
)
"""Columns of the paper's Table 1."""
METRICS: Final = (
    *PAPER,
    Metric("missed_2m", "missed at 2 m [%]", 1, 100.0),
    Metric("missed_1m", "missed at 1 m [%]", 1, 100.0),
    Metric("rmse_capped", "rmse, a missed cone as 3 m [m]", 3),
    Metric("mapped_to_truth", "curve distance, mapped to truth [m]", 3),
    Metric("truth_to_mapped", "curve distance, truth to mapped [m]", 3),
    Metric("two_way", "curve distance, two-way [m]", 3),
    Metric("ghost_landmarks", "ghost landmarks", 1),
    Metric("ghost_metres", "ghost curve [m]", 1),
    Metric("ghost_share", "ghosts, share of the map [%]", 2, 100.0),
    Metric("duplicates", "landmarks of a cone mapped before", 1),
    Metric("ate", "trajectory error (ATE) [m]", 3),
    Metric("along", "trajectory error along [m]", 3),
    Metric("across", "trajectory error across [m]", 3),
    Metric("gap_curves", "gap to batch, curves [m]", 3, truth=False),
    Metric("gap_trajectory", "gap to batch, trajectory [m]", 3, truth=False),
    Metric("nees", "NEES per degree of freedom", 2),
    Metric("nees_low", "its 95 % interval, from", 2),
    Metric("nees_high", "its 95 % interval, to", 2),
    Metric("inside", "cones within 2σ of the curve [%]", 1, 100.0),
    Metric("closed", "loop closed [%]", 0, 100.0, truth=False),
    Metric("bytes", "map [kB]", 2, 1e-3, truth=False),
    Metric("bytes_covariance", "its covariance [kB]", 1, 1e-3, truth=False),
    Metric("ms_mean", "update, mean [ms]", 2, truth=False),
    Metric("ms_median", "update, median [ms]", 2, truth=False),
    Metric("ms_p99", "update, 99th percentile [ms]", 2, truth=False),
    Metric("seconds", "whole run [s]", 1, truth=False),
)
"""All of them, in the order of the tables; less is better of all but `inside` and `closed`, and `nees`."""
METRIC: Final = {metric.name: metric for metric in METRICS}
"""By name."""


def rows(result: RunResult, log: Log, seconds: float, settings: GhostSettings | None = None) -> list[Row]:
    """A row for each lap (`scope` lap: its driving, the map as it stood at its end), and one for the log.

    Laps are the true ones where there is a true path, else the estimator's own. A batch has one map, which
    is that of its last lap too. `seconds`: wall time of the whole run.
    """
    found = []
    for lap, track, begin, end in _laps(result, log):
        row: Row = {"scope": "lap", "lap": lap}
        found.append(row | map_metrics(track, log.truth, settings) | _drive(result, log.truth, begin, end))
    whole: Row = {"scope": "log", "lap": result.laps}
    whole |= map_metrics(result.map, log.truth, settings)
    whole |= _drive(result, log.truth, -np.inf, np.inf) | {"seconds": seconds}
    return [*found, whole]


def _laps(result: RunResult, log: Log) -> Iterator[tuple[int, Map, float, float]]:
    """(lap, its map, begin, end) of each lap, cycles in (begin, end] s belong to it."""
    if isinstance(result, BatchRun):
        if result.laps:
            yield result.laps, result.map, -np.inf, np.inf
        return
    ends = lap_times(log)
    maps = tuple(enumerate(result.snapshots, start=1)) if len(ends) else result.lap_maps
    own = {lap: max(c.t for c in result.cycles if c.lap <= lap) for lap, _ in result.lap_maps}
    begin = -np.inf
    for lap, track in maps:
        end = float(ends[lap - 1]) if len(ends) else own[lap]
        yield lap, track, begin, end
        begin = end


def map_metrics(track: Map, truth: Truth | None, settings: GhostSettings | None = None) -> Row:
    """Of a map as it stands; without true cones only what needs none."""
    row: Row = {
        "size": track.size,
        "closed": track.closed,
        "bytes": map_bytes(track),
        "bytes_covariance": covariance_bytes(track),
    }
    if truth is None or not has_cones(truth):
        return row
    paper, distances = lap_metrics(track, truth, 0), cone_distances(track, truth)
    curve, ghost, consistency = (
        curve_distance(track, truth),
        ghosts(track, truth, settings),
        map_consistency(track, truth),
    )
    low, high = consistency.interval
    return row | {
        "rmse": paper.rmse,
        "missed": paper.missed,
        "missed_2m": missed_share(distances, 2.0),
        "missed_1m": missed_share(distances, 1.0),
        "rmse_capped": capped_rmse(distances),
        "mapped_to_truth": curve.mapped_to_truth,
        "truth_to_mapped": curve.truth_to_mapped,
        "two_way": curve.two_way,
        "ghost_landmarks": ghost.landmarks,
        "ghost_metres": ghost.metres,
        "ghost_share": ghost.share,
        "duplicates": ghost.duplicates,
        "nees": consistency.ratio,
        "nees_low": low,
        "nees_high": high,
        "inside": normal_errors(track, truth).share_inside(),
    }


def _drive(result: RunResult, truth: Truth | None, begin: float, end: float) -> Row:
    """Of the cycles in (begin, end]: the trajectory's error (m), and an online run's updates (ms)."""
    row: Row = {}
    if truth is not None and len(truth.poses):
        of = (result.trajectory_t > begin) & (result.trajectory_t <= end)
        errors = trajectory_errors(result.trajectory_t[of], result.trajectory[of], truth)
        row["ate"] = root_mean_square(np.linalg.norm(errors[:, :2], axis=1))
        row["along"], row["across"] = (root_mean_square(column) for column in errors[:, :2].T)
    whole = stage_times(online_cycles(result, begin, end))[0]
    for name in ("mean", "median", "p99"):
        row[f"ms_{name}"] = 1e3 * getattr(whole, name)
    return row


def online_cycles(result: RunResult, begin: float = -np.inf, end: float = np.inf) -> list[CycleRecord]:
    """The cycles in (begin, end] s; a batch has none that took a time of its own."""
    if isinstance(result, BatchRun):
        return []
    return [record for record in result.cycles if begin < record.t <= end]
