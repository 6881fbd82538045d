"""What is measured of a run: all metrics, lap by lap and of the whole; and what its `summary.json` says."""

import platform
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from itertools import repeat
from math import isfinite, nan, pi
from typing import Any, Final, Literal, TypeGuard

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.noise import ray_sigmas
from pathspace_graph.factors.se2 import difference, path_lengths
from pathspace_graph.factors.sensor import SENSOR
from pathspace_graph.front_end.front_end import seen_cycles
from pathspace_graph.health import DEGRADED, LOST, Health, HealthStretch, counts, stretches
from pathspace_graph.io.log import Log, Truth
from pathspace_graph.io.map import Map, SplineBoundary
from pathspace_graph.io.results import BatchRun, CycleRecord, RunNoise, RunResult
from pathspace_graph.labels import BOUNDARIES, NAMES
from pathspace_graph.lengths import scaled
from pathspace_graph.plausibility.diagnosis import by_prior, crossings_of, diagnose, noise_lines
from pathspace_graph.plausibility.judge import Hint

from . import accuracy, trajectory
from .accuracy import LapMetrics
from .alignment import end_by_registration

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
        """Factor from the shares, bytes and radians of the columns to the units of the tables."""
        return {"%": 100.0, "kB": 1e-3, "°": 180.0 / pi, "mrad/s": 1e3}.get(self.unit, 1.0)

    def over(self, values: ArrayLike) -> float:
        """Return the average of values of several runs, without those that aren't known."""
        known = np.asarray(values, float)
        known = known[~np.isnan(known)]
        if len(known) == 0:
            return float("nan")
        return accuracy.root_mean_square(known) if self.average == "rms" else float(np.mean(known))

    def text(self, value: float, half: float = nan, sign: str = "") -> str:
        """Return a value in the unit of the tables, with half the width of its interval."""
        return figure(self.factor * value, self.factor * half, self.digits, sign)


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
METRICS: Final[Mapping[str, Metric]] = {  # in the order of tables
    metric.key: metric
    for metric in (
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
        Metric(
            "normalized_error_marginals", "mean squared error by marginal variance at the cones", digits=2
        ),
        Metric("closed", "loop closed", "%", 0, best="most"),
        Metric("closed_at_end", "loop closed at the end of the log", "%", 0, "run", best="most"),
        Metric("false_closing", "loop closed falsely", "%", 1, "run", best="least"),
        Metric("jump", "jump of the pose where the map is replaced", "m", 2, "run"),
        Metric("error_max", "largest trajectory error", "m", 2, "run", best="least"),
        Metric("end_off", "last pose from its registration on the beginning", "m", 2, "run", best="least"),
        Metric("end_turn", "last heading from its registration on the beginning", "°", 1, "run"),
        Metric("reckoned_off", "dead reckoning's last pose from that registration", "m", 2, "run"),
        Metric("reckoned_turn", "dead reckoning's last heading from that registration", "°", 1, "run"),
        Metric("crossings", "crossings of the boundaries", "", 0, "run", best="least"),
        Metric("crossings_own", "crossings of a boundary with itself", "", 0, "run", best="least"),
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
        Metric(
            "seconds_processor", "whole run, processor time", "s", 1, "run", time="processor", best="least"
        ),
    )
}


# --- the measures of a run -------------------------------------------------------------------------------

WHOLE: Final = "whole"  # name of the whole cycle among its stages


def stage_times(cycles: Sequence[CycleRecord]) -> list[dict[str, Any]]:
    """Return `mean`, `median`, `p99` (s) of the whole cycle and of each stage, and the share of the stage.

    A stage that a cycle lacks took no time in it; without cycles there is none.
    """
    if not cycles:
        return []
    seconds = pd.DataFrame([{WHOLE: record.seconds, **record.stages} for record in cycles]).fillna(0.0)
    means, (medians, p99s) = seconds.mean(), seconds.quantile([0.5, 0.99]).to_numpy()
    found = pd.DataFrame({"stage": seconds.columns, "mean": means, "median": medians, "p99": p99s})
    total = means[WHOLE]
    return [*found.assign(share=means / total if total > 0.0 else np.nan).to_dict("records")]


def map_bytes(track: Map) -> dict[str, int]:
    """Return 8 (2 m + knots) bytes for each spline, with one period of its knots, 8 (2 m) for landmarks.

    The symmetric joint covariance of each boundary has 8 n (n + 1) / 2 bytes, n = 2 m.
    """
    boundaries = track.boundaries.values()
    splines = [b.spline for b in boundaries if isinstance(b, SplineBoundary)]
    knots = sum(len(spline.breaks if spline.periodic else spline.knots) for spline in splines)
    covariance = sum(boundary.size * (2 * boundary.size + 1) for boundary in boundaries)
    return {"bytes": 8 * (2 * sum(b.size for b in boundaries) + knots), "bytes_covariance": 8 * covariance}


Row = dict[str, Any]
"""Metrics of a `lap`, or of a whole run, whose lap is None.

Counts are whole numbers and `closed` a truth value. Unknown ones, for example without truth, are absent.
"""


def measure(
    run: RunResult,
    log: Log,
    took: tuple[float, float] | None = None,
) -> list[Row]:
    """Return a row for each complete lap, and one for the whole run as the last; lengths are over the scale.

    A lap's row has the map as it stood at its end, and the poses and updates of its cycles. Laps are the true
    ones where the log has a true path and the run a snapshot of each, else the estimator's own. A batch has
    one map for all laps, and so one row, that of the last lap. `took` is the wall time and the processor time
    of the whole run (s).
    """
    run, log = run.at_scale_one(), log.at_scale_one()
    rows = list[Row]()
    for lap, track, begin, end in _laps(run, log):
        of_lap = _map_values(track, log.truth) | _drive_values(run, log.truth, begin, end)
        rows.append({"lap": lap, **of_lap})
    values: Row = {"lap": None} | _map_values(run.map, log.truth)
    values |= _drive_values(run, log.truth, -np.inf, np.inf)
    values |= {"closed_at_end": bool(run.map.closed)} | _end_values(run, log)
    health = [record.health for record in run.cycles]
    if any(health):
        values |= {f"reported_{level}": health.count(level) / len(health) for level in (DEGRADED, LOST)}
    if run.vehicle is not None:
        values |= {f"{name}_by_prior": value for name, value in by_prior(run.vehicle, run.settings).items()}
    if isinstance(run, BatchRun):
        values |= {"converged": run.converged, "cost": run.cost}
    if took is not None:
        values["seconds"], values["seconds_processor"] = took
    return [*rows, values]


def rows_by_lap(rows: Sequence[Row]) -> list[Row]:
    """Return the rows of `measure` by lap, each with the metrics that only the whole run has.

    A run that completed no lap has one row, that of the whole run as lap 1.
    """
    *laps, whole = rows
    of_run = {key: value for key, value in whole.items() if key in METRICS and METRICS[key].scope == "run"}
    return [lap | of_run for lap in laps] or [whole | {"lap": 1}]


def _laps(run: RunResult, log: Log) -> Iterator[tuple[int, Map, float, float]]:
    """Yield (lap, its map, begin, end); the cycles in (begin, end] s belong to the lap."""
    ends = [-np.inf, *lap_times(log)]
    true_laps = len(ends) - 1
    if isinstance(run, BatchRun):
        if true_laps:
            yield true_laps, run.map, ends[-2], ends[-1]
        elif run.laps:
            yield run.laps, run.map, -np.inf, np.inf
        return
    maps = tuple(enumerate(run.snapshots, start=1))
    if not (true_laps and maps):
        maps, ends = run.lap_maps, ends[:1]
        stamps = ([record.t for record in run.cycles if record.lap <= lap] for lap, _ in maps)
        ends += [max(own, default=np.inf) for own in stamps]
    for index, (lap, track) in enumerate(maps):
        yield lap, track, ends[index], ends[index + 1]


def _map_values(track: Map, truth: Truth | None) -> dict[str, float]:
    """Return the metrics of a map as it stands; without true cones or covariances those that need none."""
    values: dict[str, float] = {"size": track.size, "closed": bool(track.closed), **map_bytes(track)}
    if not has_cones(truth):
        return values
    values |= accuracy.cone_errors(track, truth) | accuracy.boundary_errors(track, truth)
    if any(own.size and not own.covariance.size for own in track.boundaries.values()):
        return values  # an outline
    values |= {"nees": accuracy.map_nees(track, truth)} | accuracy.consistency_at_cones(track, truth)
    for name, (error, sigma) in accuracy.centre_line_errors(track, truth).items():
        known = ~np.isnan(error)
        if known.any():
            values[name] = accuracy.root_mean_square(error[known])
            if (sigma[known] > 0.0).all():
                values[f"{name}_nees"] = float(np.mean((error[known] / sigma[known]) ** 2))
    (turn,) = accuracy.similarity_from_truth(track, truth, 1)
    turned, scale = accuracy.similarity_from_truth(track, truth)
    whole = {"turn": turn.value, "turn_nees": turn.nees}
    whole |= {"map_scale": scale.value, "map_scale_nees": scale.nees}
    if not np.isnan(scale.value):
        found = accuracy.cone_errors(track, accuracy.aligned(truth, turned.value, scale.value))
        whole["rmse_aligned"] = found["rmse"] / np.exp(scale.value)
    values |= {key: value for key, value in whole.items() if not np.isnan(value)}
    found = accuracy.consistency_at_cones(accuracy.with_marginals(track), truth)
    return values | {f"{key}_marginals": value for key, value in found.items()}


def _end_values(run: RunResult, log: Log) -> dict[str, float]:
    """Return errors of the vehicle at the log's end, its largest jump (m), and whether it closed falsely.

    Without true cones there are crossings of the map, and how far (m) the last pose is from its registration.
    """
    values: dict[str, float] = {}
    truth, t, poses = log.truth, run.trajectory_t, run.trajectory
    if not has_cones(truth):
        others, values["crossings_own"] = accuracy.crossings(run.map)
        values["crossings"] = others + values["crossings_own"]
        seen = seen_cycles(log)
        end = end_by_registration(seen, log.measured) if len(poses) else None
        if end is not None:
            for name, pose in (("end", poses[-1]), ("reckoned", seen[-1].pose)):
                off = difference(pose, end)
                values |= {f"{name}_off": float(np.hypot(*off[:2])), f"{name}_turn": float(off[2])}
    if truth is None or len(poses) == 0:
        return values
    if run.vehicle is not None:
        values |= trajectory.vehicle_errors(run.vehicle, float(t[-1]), truth)
    if len(truth.poses):
        values["false_closing"] = closes_falsely(run, truth)
        values |= trajectory.end_of_trajectory(t, poses, truth)
        values |= trajectory.longest_divergence(t, poses, truth, closing_stamp(run))
    jumps = [np.hypot(*record.jump[:2]) for record in run.cycles if record.jump is not None]
    return values | ({"jump": float(max(jumps))} if jumps else {})


def closes_falsely(run: RunResult, truth: Truth) -> bool:
    """Return whether the loop closed, a batch at its end, before the true drive was back at the start.

    It may close 30 m before, as the sensor sees ahead.
    """
    if not run.map.closed:
        return False
    t, ends = closing_stamp(run), accuracy.true_lap_ends(truth)
    if len(ends) == 0:
        return True
    driven = path_lengths(truth.poses)
    return bool(np.interp(t, truth.pose_t, driven) < driven[ends[0]] - 30.0)


def closing_stamp(run: RunResult) -> float:
    """Return the stamp (s) at which an online run has closed the loop; it is infinite for any other run."""
    closed = (record.t for record in run.cycles if record.closed)
    return float("inf") if isinstance(run, BatchRun) else next(closed, float("inf"))


def _drive_values(run: RunResult, truth: Truth | None, begin: float, end: float) -> dict[str, float]:
    """Return the trajectory's errors (m), the reach (m) and the update times (ms) in (begin, end] s."""
    values: dict[str, float] = {}
    if truth is not None and len(truth.poses):
        inside = (run.trajectory_t > begin) & (run.trajectory_t <= end)
        errors = trajectory.trajectory_errors(run.trajectory_t[inside], run.trajectory[inside], truth)
        values["ate"] = trajectory.position_rms(errors)
        values["along"], values["across"] = (accuracy.root_mean_square(column) for column in errors[:, :2].T)
        if run.reach is not None:
            values |= trajectory.reach_values(run.reach[inside])
    cycles = online_cycles(run, begin, end)
    for whole in stage_times(cycles)[:1]:
        values |= {f"ms_{name}": 1e3 * whole[name] for name in ("mean", "p99")}
        values["ms_processor"] = 1e3 * float(np.mean([record.processor for record in cycles]))
    return values


def online_cycles(run: RunResult, begin: float = -np.inf, end: float = np.inf) -> list[CycleRecord]:
    """Return the cycles in (begin, end] s; a batch has none, since its cycles take no time of their own."""
    if isinstance(run, BatchRun):
        return []
    return [record for record in run.cycles if begin < record.t <= end]


# --- the summary of a run (docs/formats.md) --------------------------------------------------------------


def summarize(result: RunResult, log: Log | None, hints: Sequence[Hint] = ()) -> dict[str, Any]:
    """Return the estimator, settings, versions, laps, timing, hints, and with truth the paper's metrics.

    Without the log, what only it can say is left out.
    """
    factor = 1.0 / result.scale
    summary: dict[str, Any] = {
        "estimator": result.estimator,
        "settings": result.settings,
        "scale": result.scale,
        "sensor_kind": result.settings.get("kind") or (log and log.sensor.kind) or "cones",
        "versions": versions(),
        "lap_count": result.laps,
        "closed": result.map.closed,
        "size": result.map.size,
        "not_mapped": not_mapped(result.map, log) if log is not None else [],
        "points": {NAMES[label]: own.size for label, own in sorted(result.map.points.items())},
        "gate": {
            "dropped": sum(record.dropped for record in result.cycles),
            "refused": sum(record.refused for record in result.cycles),
        },
        "seconds": None,
    }
    if seconds := [record.seconds for record in result.cycles]:
        p99 = float(np.quantile(seconds, 0.99))
        summary["seconds"] = {"mean": float(np.mean(seconds)), "p99": p99, "max": max(seconds)}
    if result.batches is not None:
        summary["batches"] = {**asdict(result.batches), "waited_seconds": result.waited}
    if told := [record for record in result.cycles if record.jump is not None or record.notice]:
        keys = ("cycle", "t", "jump", "notice")
        summary["events"] = [{key: getattr(record, key) for key in keys} for record in told]
    if any(record.health for record in result.cycles):
        number = counts([health_of(record) for record in result.cycles])
        summary["health"] = {**number, "stretches": [asdict(of) for of in stretches_of(result)]}
    if crossed := crossings_of(result):
        places = [(NAMES[one.label], *one.place.tolist(), one.driven) for one in crossed]
        names = ("boundary", "x", "y", "driven")
        summary["crossings"] = [dict(zip(names, place, strict=True)) for place in places]
    if hints:
        summary["hints"] = [vars(hint) for hint in hints]
    if result.noise is not None:
        summary["noise"] = _noise(result.noise, log)
        notes = noise_lines(scaled(result.noise, factor))
        summary |= {"notes": notes} if notes else {}
    if result.vehicle is not None:
        named, lines = result.vehicle.by_name, diagnose(scaled(result.vehicle, factor), result.settings)
        values = {name: value for name, (value, _) in named.items()}
        values |= {f"{name}_sigma": sigma for name, (_, sigma) in named.items()}
        summary |= {"calibration": values, "heading_sigma": float(result.vehicle.sigmas[2])}
        summary |= {"diagnosis": lines} if lines else {}
    if log is not None and log.truth is not None:
        if has_cones(log.truth):
            summary["laps"] = [asdict(row) for row in laps_of(result, log)]
            track, of_one = result.at_scale_one().map, scaled(log.truth, factor)
            found = accuracy.cone_errors(track, of_one)
            final = {"rmse": found["rmse"] * result.scale, "missed": found["missed"], "size": track.size}
            summary["final"] = final
            summary["inside_two_sigma"] = accuracy.consistency_at_cones(track, of_one)["inside"]
        if len(log.truth.poses) and len(result.trajectory):
            errors = trajectory.trajectory_errors(result.trajectory_t, result.trajectory, log.truth)
            summary["ate"] = trajectory.position_rms(errors)
            parts = ("rmse_along", "rmse_across", "rmse_heading")  # m, m, rad
            summary |= dict(zip(parts, map(accuracy.root_mean_square, errors.T), strict=True))
    return summary


def _noise(noise: RunNoise, log: Log | None) -> dict[str, Any]:
    stated: dict[str, Any] = {}
    if log is not None and log.odometry_stated:
        stated["odometry"] = log.odometry_sigma.tolist()
    cycles = log.cycles if log is not None and log.detections_stated else ()
    points = np.concatenate([np.zeros((0, 2)), *(cycle.points_vehicle for cycle in cycles)])
    if len(points):
        covariances = np.concatenate([cycle.covariances for cycle in cycles])
        along, across = np.median(ray_sigmas(points, covariances), axis=0).tolist()
        distance = float(np.median(np.hypot(*points.T)))
        stated["detections"] = {"range": distance, "along": along, "across": across}
    sources = {"odometry": noise.odometry, "detections": noise.detections, "stated": stated}
    measured = noise.measured
    if measured is None:
        return sources
    values: dict[str, Any] = {"odometry": measured.odometry.tolist(), "drift": measured.drift.tolist()}
    values["seconds"] = measured.seconds
    for name, ray in (("along", measured.along), ("across", measured.across)):
        if ray is not None:
            begin, growth = ray.sigma.tolist()
            values[name] = {"sigma": begin, "growth": growth, "share": ray.share, "time": ray.time}
    if measured.along is not None:
        sigmas = (f"{name}_sigma" for name in SENSOR)
        values |= dict(zip(SENSOR, measured.sensor.tolist(), strict=True))
        values |= dict(zip(sigmas, measured.sensor_sigma.tolist(), strict=True))
        values["range_bend"] = measured.range_bend
    return sources | {"measured": values}


def stretches_of(result: RunResult) -> list[HealthStretch]:
    return stretches([r.t for r in result.cycles], [health_of(r) for r in result.cycles])


def health_of(record: CycleRecord) -> Health:
    return Health(record.health, record.reason)


def versions() -> dict[str, str]:
    """Return the versions of Python and the libraries that a result depends on."""
    libraries = {name: version(name) for name in ("pathspace-graph", "gtsam", "numpy", "scipy")}
    return {"python": platform.python_version(), **libraries}


def lap_times(log: Log) -> Array:
    """Return the stamps (s) at which true laps end; without a true path there are none."""
    if log.truth is None or len(log.truth.poses) == 0:
        return np.zeros(0)
    return log.truth.pose_t[accuracy.true_lap_ends(scaled(log.truth, 1.0 / log.scale))]


def laps_of(result: RunResult, log: Log) -> list[LapMetrics]:
    """Return the paper's table for the laps of `measure`, else the last map as lap 0; empty without cones."""
    run, log = result.at_scale_one(), log.at_scale_one()
    if not has_cones(log.truth):
        return []
    maps = [(lap, track) for lap, track, *_ in _laps(run, log)] or [(0, run.map)]
    found = (accuracy.lap_metrics(track, log.truth, lap) for lap, track in maps)
    return [replace(row, rmse=row.rmse * result.scale) for row in found]


def not_mapped(track: Map, log: Log) -> list[str]:
    """Return a line for each boundary that the map lacks, with the reason."""
    labels = np.concatenate([np.zeros(0, dtype=int), *(cycle.labels for cycle in log.cycles)])
    lines = []
    for label in BOUNDARIES:
        if label not in track.boundaries:
            name, count = NAMES[label], int(np.sum(labels == label))
            reason = f"{count} {name} detections were too few or agreed too little"
            lines.append(f"{name} boundary: not mapped, " + (reason if count else f"no {name} detections"))
    return lines


def has_cones(truth: Truth | None) -> TypeGuard[Truth]:
    """Return whether there is a truth that holds cones of a boundary."""
    return truth is not None and bool(np.isin(truth.cone_labels, BOUNDARIES).any())
