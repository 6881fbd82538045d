"""What is measured of a run: the one list of metrics, and the one function that measures them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike

from pathspace_graph.batch.association import path_lengths
from pathspace_graph.batch.mapper import BatchResult
from pathspace_graph.io.log import Log, Truth
from pathspace_graph.io.map import Map
from pathspace_graph.io.results import BatchRun, CycleRecord, RunResult
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.laps import lap_end_indices
from pathspace_graph.lengths import scaled
from pathspace_graph.plausibility.diagnosis import by_prior

from .consistency import joint_cone_error, map_nees, normal_errors, with_marginals
from .cost import covariance_bytes, map_bytes, stage_times
from .curves import centre_line_errors, curve_distance
from .ghosts import GhostSettings, ghosts
from .limit import limit
from .reach import reach_values
from .summary import has_cones, lap_times, vehicle_of
from .table1 import capped_rmse, cone_distances, lap_metrics, missed_share, root_mean_square
from .trajectory import (
    end_of_trajectory,
    longest_astray,
    position_rms,
    trajectory_errors,
    vehicle_errors,
)
from .turn import turn_from_truth

FACTORS: Final[Mapping[str, float]] = {"%": 100.0, "kB": 1e-3, "°": float(np.rad2deg(1.0)), "mrad/s": 1e3}
"""Columns hold shares, bytes and radians, which these factors turn into the units of the tables."""
EARLY: Final = 30.0
"""A loop may close this far before the true drive is back at the start (m), which the sensor sees ahead."""
MEAN_DIGITS: Final = 2
"""A mean with its interval is shown with at least this many digits after the decimal point."""
UNHEALTHY: Final = ("degraded", "lost")
"""An estimator that judges its health calls cycles so (FORMATS) where they are not good."""
UNKNOWN: Final = "–"
"""Tables show this in place of a value that isn't known."""


@dataclass(frozen=True)
class Metric:
    """A metric is one number that is measured of every lap or of every run."""

    key: str
    """Every file has the metric in the column of this name."""
    title: str
    """Tables call the metric so."""
    unit: str = ""
    """Tables show the values in this unit; it is empty for pure numbers and counts."""
    digits: int = 3
    """Tables show this many digits after the decimal point."""
    scope: Literal["lap", "run"] = "lap"
    """A lap's metric is measured of every lap and of the whole run, a run's metric of the whole run only."""
    time: bool = False
    """A wall time differs whenever the same run is repeated; nothing else does."""
    average: Literal["mean", "rms"] = "mean"
    """Tables show this of several runs: an error with a sign has a root mean square, all others a mean."""

    @property
    def heading(self) -> str:
        """Returns the title with the unit in brackets."""
        return f"{self.title} [{self.unit}]" if self.unit else self.title

    @property
    def factor(self) -> float:
        """Returns the factor from the column's unit to that of the tables."""
        return FACTORS.get(self.unit, 1.0)

    def over(self, values: ArrayLike) -> float:
        """Returns the average of values of several runs, without those that aren't known."""
        known = np.asarray(values, float)
        known = known[~np.isnan(known)]
        if len(known) == 0:
            return float("nan")
        return root_mean_square(known) if self.average == "rms" else float(np.mean(known))

    def text(self, value: float) -> str:
        """Returns a value as tables show it."""
        return UNKNOWN if np.isnan(value) else f"{self.factor * value:.{self.digits}f}"


PAPER: Final = (
    Metric("rmse", "rmse", "m"),
    Metric("missed", "missed", "%", 1),
    Metric("size", "size", digits=0),
)
"""These are the metrics of the paper's Table 1."""
_ALL: Final = (
    *PAPER,
    Metric("cones", "true cones", digits=0),
    Metric("size_share", "size by true cones", "%", 1),
    Metric("missed_2m", "missed at 2 m", "%", 1),
    Metric("missed_1m", "missed at 1 m", "%", 1),
    Metric("rmse_capped", "rmse, a missed cone as 3 m", "m"),
    Metric("mapped_to_truth", "curve distance, mapped to truth", "m"),
    Metric("truth_to_mapped", "curve distance, truth to mapped", "m"),
    Metric("two_way", "curve distance, two-way", "m"),
    Metric("centre", "error of the centre line, across", "m"),
    Metric("centre_nees", "NEES of the centre line, across", digits=2),
    Metric("half_width", "error of the width to each side", "m"),
    Metric("half_width_nees", "NEES of the width to each side", digits=2),
    Metric("ghost_landmarks", "ghost landmarks", digits=1),
    Metric("ghost_metres", "ghost curve", "m", 1),
    Metric("ghost_share", "ghosts, share of the map", "%", 2),
    Metric("duplicates", "landmarks of a cone mapped before", digits=1),
    Metric("ate", "trajectory error (ATE)", "m"),
    Metric("along", "trajectory error along", "m"),
    Metric("across", "trajectory error across", "m"),
    Metric("reach_median", "reach, median", "m", 1),
    Metric("reach_p10", "reach, 10th percentile", "m", 1),
    Metric("reach_short", "reach under 4 m, share of cycles", "%", 1),
    Metric("reach_error", "error of the cones in reach", "m"),
    Metric("turn", "turn about the start", "°", 2, average="rms"),
    Metric("turn_sigma", "turn about the start, claimed sigma", "°", 2, average="rms"),
    Metric("turn_nees", "NEES of the turn", digits=2),
    Metric("turn_from_batch", "turn from the batch", "°", 2, average="rms"),
    Metric("rmse_by_batch", "rmse by that of the batch", digits=2),
    Metric("gap_curves", "gap to batch, curves", "m", scope="run"),
    Metric("gap_trajectory", "gap to batch, trajectory", "m", scope="run"),
    Metric("l", "limit, landmarks", "m", scope="run"),
    Metric("f", "limit, fit", "m", scope="run"),
    Metric("limit", "limit", "m", scope="run"),
    Metric("nees", "NEES per degree of freedom", digits=2),
    Metric("nees_low", "NEES, 95 % interval from", digits=2),
    Metric("nees_high", "NEES, 95 % interval to", digits=2),
    Metric("nees_inside", "NEES within its 95 % interval", "%", 1),
    Metric("nees_marginals", "NEES per degree of freedom, of the marginals", digits=2),
    Metric("inside", "cones within 2σ of the curve", "%", 1),
    Metric("inside_marginals", "cones within 2σ of the marginals", "%", 1),
    Metric("normalized_error", "mean squared error by variance at the cones", digits=2),
    Metric(
        "normalized_error_marginals",
        "mean squared error by marginal variance at the cones",
        digits=2,
    ),
    Metric(
        "normalized_error_joint",
        "squared error by the joint covariance of the batch at the cones",
        digits=2,
        scope="run",
    ),
    Metric(
        "normalized_error_joint_inside",
        "joint squared error within its 95 % interval",
        "%",
        1,
        scope="run",
    ),
    Metric("closed", "loop closed", "%", 0),
    Metric("closed_at_end", "loop closed at the end of the log", "%", 0, scope="run"),
    Metric("false_closing", "loop closed falsely", "%", 1, scope="run"),
    Metric("jump", "jump of the pose where the map is replaced", "m", 2, scope="run"),
    Metric("error_max", "largest trajectory error", "m", 2, scope="run"),
    Metric("error_end", "trajectory error in the last second", "m", 2, scope="run"),
    Metric("lost_at_end", "vehicle lost at the end", "%", 0, scope="run"),
    Metric("astray_time", "longest time with an error of over 1 m, after closing", "s", 1, scope="run"),
    Metric("astray_way", "longest way with an error of over 1 m, after closing", "m", 0, scope="run"),
    Metric("told_degraded", "cycles that the estimator calls degraded", "%", 1, scope="run"),
    Metric("told_lost", "cycles that the estimator calls lost", "%", 1, scope="run"),
    Metric("scale", "scale error of the speeds", "%", 2, scope="run"),
    Metric("scale_true", "scale error of the speeds, true", "%", 2, scope="run"),
    Metric("scale_sigma", "scale error of the speeds, claimed sigma", "%", 2, scope="run", average="rms"),
    Metric("scale_error", "error of the scale", "%", 2, scope="run", average="rms"),
    Metric("scale_by_sigma", "error of the scale by claimed sigma", digits=2, scope="run", average="rms"),
    Metric("scale_by_prior", "scale error of the speeds by its prior's sigma", digits=1, scope="run"),
    Metric("bias", "bias of the yaw rate", "mrad/s", 2, scope="run"),
    Metric("bias_true", "bias of the yaw rate, true", "mrad/s", 2, scope="run"),
    Metric("bias_sigma", "bias of the yaw rate, claimed sigma", "mrad/s", 2, scope="run", average="rms"),
    Metric("bias_error", "error of the bias", "mrad/s", 2, scope="run", average="rms"),
    Metric("bias_by_sigma", "error of the bias by claimed sigma", digits=2, scope="run", average="rms"),
    Metric("bias_by_prior", "bias of the yaw rate by its prior's sigma", digits=1, scope="run"),
    Metric("yaw_by_prior", "yaw of the sensor by its prior's sigma", digits=1, scope="run"),
    Metric("lateral_by_prior", "lateral offset of the sensor by its prior's sigma", digits=1, scope="run"),
    Metric("latency_by_prior", "latency of detections by its prior's sigma", digits=1, scope="run"),
    Metric("range_scale_by_prior", "scale error of ranges by its prior's sigma", digits=1, scope="run"),
    Metric("range_bias_by_prior", "bias of ranges by its prior's sigma", digits=1, scope="run"),
    Metric("heading_sigma", "last heading, claimed sigma", "°", 2, scope="run", average="rms"),
    Metric("heading_error", "error of the last heading", "°", 2, scope="run", average="rms"),
    Metric(
        "heading_by_sigma", "error of the last heading by claimed sigma", digits=2, scope="run", average="rms"
    ),
    Metric("converged", "batch converged", "%", 0, scope="run"),
    Metric("cost", "cost of the batch", digits=1, scope="run"),
    Metric("bytes", "map", "kB", 2),
    Metric("bytes_covariance", "covariance of the map", "kB", 1),
    Metric("ms_mean", "update, mean", "ms", 2, time=True),
    Metric("ms_median", "update, median", "ms", 2, time=True),
    Metric("ms_p99", "update, 99th percentile", "ms", 2, time=True),
    Metric("seconds", "whole run", "s", 1, scope="run", time=True),
)
METRICS: Final[Mapping[str, Metric]] = {metric.key: metric for metric in _ALL}
"""These are all metrics by key, in the order of the tables."""


@dataclass(frozen=True, slots=True)
class Row:
    """Holds what was measured of one lap, or of a whole run."""

    lap: int | None
    """The lap counts from 1; it is None for the whole run."""
    values: dict[str, float]
    """These are the values by the metric's key, counts as whole numbers and `closed` as a truth value. What
    isn't known, for example without truth, is absent."""


def measure(
    run: RunResult,
    log: Log,
    seconds: float | None = None,
    ghost_settings: GhostSettings | None = None,
    *,
    marginals: bool = False,
    yardsticks: bool = False,
) -> list[Row]:
    """Returns a row for each complete lap, and one for the whole run as the last; lengths are over the scale.

    The row of a lap has the map as it stood at its end, and the poses and updates of its cycles. Laps are the
    true ones where the log has a true path, else the estimator's own. A batch has one map for all laps, and
    so one row, that of the last lap. `seconds` is the wall time of the whole run. `marginals` asks for the
    metrics of the paper's squared basis, `yardsticks` for `l`, `f` and `limit`, which take a batch with
    oracle association and thus a simulated log (ValueError without associations).
    """
    run, log = run.at_scale_one(), scaled(log, 1.0 / run.scale)
    rows = []
    for lap, track, begin, end in _laps(run, log):
        values = _map_values(track, log.truth, ghost_settings, marginals)
        rows.append(Row(lap, values | _drive_values(run, log.truth, begin, end)))
    values = _map_values(run.map, log.truth, ghost_settings, marginals)
    values |= _drive_values(run, log.truth, -np.inf, np.inf)
    values |= {"closed_at_end": bool(run.map.closed)} | _end_values(run, log.truth)
    values |= _told_values(run.cycles) | _calibration_values(run)
    if isinstance(run, BatchRun):
        values |= {"converged": run.converged, "cost": run.cost}
    if isinstance(run, BatchResult) and log.truth is not None and has_cones(log.truth):
        joint = joint_cone_error(run, log.truth)
        values |= {"normalized_error_joint": joint.ratio, "normalized_error_joint_inside": joint.honest}
    if yardsticks:
        least = limit(log, run.map)
        values |= {"l": least.l, "f": least.f, "limit": least.total}
    if seconds is not None:
        values["seconds"] = seconds
    return [*rows, Row(None, values)]


def _laps(run: RunResult, log: Log) -> Iterator[tuple[int, Map, float, float]]:
    """Yields (lap, its map, begin, end); the cycles in (begin, end] s belong to the lap."""
    ends = [-np.inf, *lap_times(log)]
    true_laps = len(ends) - 1
    if isinstance(run, BatchRun):
        if true_laps:
            yield true_laps, run.map, ends[-2], ends[-1]
        elif run.laps:
            yield run.laps, run.map, -np.inf, np.inf
        return
    maps = tuple(enumerate(run.snapshots, start=1))
    if not true_laps:
        maps = run.lap_maps
        ends += [max(record.t for record in run.cycles if record.lap <= lap) for lap, _ in maps]
    for index, (lap, track) in enumerate(maps):
        yield lap, track, ends[index], ends[index + 1]


def _map_values(
    track: Map, truth: Truth | None, ghost_settings: GhostSettings | None, marginals: bool
) -> dict[str, float]:
    """Returns the metrics of a map as it stands; without true cones only those that need none."""
    values: dict[str, float] = {
        "size": track.size,
        "closed": bool(track.closed),
        "bytes": map_bytes(track),
        "bytes_covariance": covariance_bytes(track),
    }
    if truth is None or not has_cones(truth):
        return values
    values |= _cone_values(track, truth) | _curve_values(track, truth, ghost_settings)
    values |= _consistency_values(track, truth) | _turn_values(track, truth) | _centre_values(track, truth)
    if marginals:
        by_marginals = _consistency_values(with_marginals(track), truth)
        keys = ("nees", "inside", "normalized_error")
        values |= {f"{key}_marginals": by_marginals[key] for key in keys}
    return values


def _cone_values(track: Map, truth: Truth) -> dict[str, float]:
    paper, distances = lap_metrics(track, truth, 0), cone_distances(track, truth)
    cones = int(np.isin(truth.cone_labels, BOUNDARIES).sum())
    return {
        "rmse": paper.rmse,
        "missed": paper.missed,
        "cones": cones,
        "size_share": track.size / cones,
        "missed_2m": missed_share(distances, 2.0),
        "missed_1m": missed_share(distances, 1.0),
        "rmse_capped": capped_rmse(distances),
    }


def _curve_values(track: Map, truth: Truth, ghost_settings: GhostSettings | None) -> dict[str, float]:
    curve, ghost = curve_distance(track, truth), ghosts(track, truth, ghost_settings)
    return {
        "mapped_to_truth": curve.mapped_to_truth,
        "truth_to_mapped": curve.truth_to_mapped,
        "two_way": curve.two_way,
        "ghost_landmarks": ghost.landmarks,
        "ghost_metres": ghost.metres,
        "ghost_share": ghost.share,
        "duplicates": ghost.duplicates,
    }


def _consistency_values(track: Map, truth: Truth) -> dict[str, float]:
    nees, at_cones = map_nees(track, truth), normal_errors(track, truth)
    low, high = nees.interval
    known = {} if np.isnan(nees.ratio) else {"nees_inside": nees.honest}
    return {
        "nees": nees.ratio,
        "nees_low": low,
        "nees_high": high,
        **known,
        "inside": at_cones.share_inside(),
        "normalized_error": at_cones.mean_squared(),
    }


def _turn_values(track: Map, truth: Truth) -> dict[str, float]:
    """Returns the turn of a map from the truth (rad), and what its covariance says of it."""
    found = turn_from_truth(track, truth)
    values = {"turn": found.angle, "turn_sigma": found.sigma, "turn_nees": found.nees}
    return {key: value for key, value in values.items() if not np.isnan(value)}


def _centre_values(track: Map, truth: Truth) -> dict[str, float]:
    """Returns the rms errors (m) of the centre line and of its widths, and mean e^2 / sigma^2 of each."""
    errors = centre_line_errors(track, truth)
    if errors is None:
        return {}
    values = {}
    for name, error, sigma in (
        ("centre", errors.across, errors.across_sigma),
        ("half_width", errors.width, errors.width_sigma),
    ):
        known = ~np.isnan(error)
        if known.any():
            values[name] = root_mean_square(error[known])
            if (sigma[known] > 0.0).all():
                values[f"{name}_nees"] = float(np.mean((error[known] / sigma[known]) ** 2))
    return values


def _end_values(run: RunResult, truth: Truth | None) -> dict[str, float]:
    """Returns what is known of the vehicle at the end of the log, how far its pose jumped where the map was
    replaced (m), and whether the loop has closed falsely."""
    values: dict[str, float] = {}
    if truth is None or len(run.trajectory) == 0:
        return values
    state = vehicle_of(run)
    if state is not None:
        values |= vehicle_errors(state, float(run.trajectory_t[-1]), truth)
    if len(truth.poses):
        values["false_closing"] = closes_falsely(run, truth)
        values |= end_of_trajectory(run.trajectory_t, run.trajectory, truth)
        values |= longest_astray(run.trajectory_t, run.trajectory, truth, closing_stamp(run))
    jumps = [np.hypot(*record.jump[:2]) for record in run.cycles if record.jump is not None]
    return values | ({"jump": float(max(jumps))} if jumps else {})


def _told_values(cycles: Sequence[CycleRecord]) -> dict[str, float]:
    """Returns the shares of the cycles whose health the estimator calls so, if it judges its health."""
    told = [getattr(record, "health", "") for record in cycles]
    return {f"told_{level}": told.count(level) / len(told) for level in UNHEALTHY} if any(told) else {}


def _calibration_values(run: RunResult) -> dict[str, float]:
    """Returns the calibrations in standard deviations of their priors, where both are known."""
    state = vehicle_of(run)
    found = {} if state is None else by_prior(state, run.settings)
    return {f"{name}_by_prior": value for name, value in found.items()}


def closes_falsely(run: RunResult, truth: Truth) -> bool:
    """Returns whether the loop closed before the true drive was back at the start.

    An online run closes at a cycle, and a batch at the end of the log.
    """
    if not run.map.closed:
        return False
    t, ends = closing_stamp(run), lap_end_indices(truth.poses)
    if len(ends) == 0:
        return True
    driven = path_lengths(truth.poses)
    return bool(np.interp(t, truth.pose_t, driven) < driven[ends[0]] - EARLY)


def closing_stamp(run: RunResult) -> float:
    """Returns the stamp (s) at which an online run has closed the loop; it is infinite for any other run."""
    closed = (record.t for record in run.cycles if record.closed)
    return float("inf") if isinstance(run, BatchRun) else next(closed, float("inf"))


def _drive_values(run: RunResult, truth: Truth | None, begin: float, end: float) -> dict[str, float]:
    """Returns the trajectory's errors (m), the reach (m) and the update times (ms) in (begin, end] s."""
    values: dict[str, float] = {}
    if truth is not None and len(truth.poses):
        inside = (run.trajectory_t > begin) & (run.trajectory_t <= end)
        errors = trajectory_errors(run.trajectory_t[inside], run.trajectory[inside], truth)
        values["ate"] = position_rms(errors)
        values["along"], values["across"] = (root_mean_square(column) for column in errors[:, :2].T)
        if run.reach is not None:
            values |= reach_values(run.reach[inside])
    cycles = online_cycles(run, begin, end)
    if cycles:
        whole = stage_times(cycles)[0]
        values |= {f"ms_{name}": 1e3 * getattr(whole, name) for name in ("mean", "median", "p99")}
    return values


def online_cycles(run: RunResult, begin: float = -np.inf, end: float = np.inf) -> list[CycleRecord]:
    """Returns the cycles in (begin, end] s; a batch has none, since its cycles take no time of their own."""
    if isinstance(run, BatchRun):
        return []
    return [record for record in run.cycles if begin < record.t <= end]
