"""The content of a run's `summary.json` (docs/formats.md)."""

import platform
from collections.abc import Sequence
from dataclasses import asdict, replace
from importlib.metadata import version
from typing import Any, TypeGuard

import numpy as np

from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.noise import ray_sigmas
from pathspace_graph.factors.sensor import SENSOR
from pathspace_graph.health import Health, HealthStretch, counts, stretches
from pathspace_graph.io.log import Log, Truth
from pathspace_graph.io.map import Map
from pathspace_graph.io.results import BatchRun, CycleRecord, RunNoise, RunResult
from pathspace_graph.labels import BOUNDARIES, NAMES
from pathspace_graph.lengths import scaled
from pathspace_graph.plausibility.diagnosis import crossings_of, diagnose, noise_lines
from pathspace_graph.plausibility.judge import Hint

from .accuracy import LapMetrics, lap_metrics, root_mean_square, true_lap_ends
from .consistency import consistency_at_cones
from .trajectory import position_rms, trajectory_errors


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
        **_cycles(result),
    }
    if crossed := crossings_of(result):
        places = [(NAMES[one.label], *one.place.tolist(), one.driven) for one in crossed]
        keys = ("boundary", "x", "y", "driven")
        summary["crossings"] = [dict(zip(keys, place, strict=True)) for place in places]
    if hints:
        summary["hints"] = [vars(hint) for hint in hints]
    if result.noise is not None:
        summary["noise"] = _noise(result.noise, log)
        notes = noise_lines(scaled(result.noise, factor))
        summary |= {"notes": notes} if notes else {}
    if result.vehicle is not None:
        named, found = result.vehicle.by_name, diagnose(scaled(result.vehicle, factor), result.settings)
        values = {name: value for name, (value, _) in named.items()}
        values |= {f"{name}_sigma": sigma for name, (_, sigma) in named.items()}
        summary |= {"calibration": values, "heading_sigma": float(result.vehicle.sigmas[2])}
        summary |= {"diagnosis": found} if found else {}
    if log is not None and log.truth is not None:
        summary |= _errors(result, log, log.truth)
    return summary


def _cycles(result: RunResult) -> dict[str, Any]:
    """Times of the updates, batches, notices and health of a run."""
    seconds = [record.seconds for record in result.cycles]
    found: dict[str, Any] = {"seconds": None}
    if seconds:
        p99 = float(np.quantile(seconds, 0.99))
        found["seconds"] = {"mean": float(np.mean(seconds)), "p99": p99, "max": max(seconds)}
    if result.batches is not None:
        found["batches"] = {**asdict(result.batches), "waited_seconds": result.waited}
    told = [record for record in result.cycles if record.jump is not None or record.notice]
    if told:
        keys = ("cycle", "t", "jump", "notice")
        found["events"] = [{key: getattr(record, key) for key in keys} for record in told]
    if any(record.health for record in result.cycles):
        number = counts([health_of(record) for record in result.cycles])
        found["health"] = {**number, "stretches": [asdict(of) for of in stretches_of(result)]}
    return found


def _errors(result: RunResult, log: Log, truth: Truth) -> dict[str, Any]:
    """Errors of the map, and of the trajectory: `ate`, rms along (m), across (m) and in heading (rad)."""
    found: dict[str, Any] = {}
    if has_cones(truth):
        found["laps"] = [asdict(row) for row in laps_of(result, log)]
        found["final"] = asdict(_metrics(result.map, truth, result.laps, result.scale))
        del found["final"]["lap"]
        at_cones = consistency_at_cones(result.at_scale_one().map, scaled(truth, 1.0 / result.scale))
        found["inside_two_sigma"] = at_cones["inside"]
    if len(truth.poses) and len(result.trajectory):
        errors = trajectory_errors(result.trajectory_t, result.trajectory, truth)
        names = ("rmse_along", "rmse_across", "rmse_heading")
        found["ate"] = position_rms(errors)
        found |= dict(zip(names, map(root_mean_square, errors.T), strict=True))
    return found


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
    return log.truth.pose_t[true_lap_ends(scaled(log.truth, 1.0 / log.scale))]


def laps_of(result: RunResult, log: Log) -> list[LapMetrics]:
    """Return the paper's table: a row at the end of each true lap, or that of the end where there is none.

    Without a true path the laps are the estimated ones; without true cones there is no row. The snapshots of
    `result` are those at `lap_times`. A batch has one row.
    """
    if not has_cones(log.truth):
        return []
    if isinstance(result, BatchRun):
        return [_metrics(result.map, log.truth, result.laps, result.scale)]
    by_truth = tuple(enumerate(result.snapshots, start=1))
    maps = by_truth if len(log.truth.poses) else result.lap_maps
    return [_metrics(track, log.truth, lap, result.scale) for lap, track in maps or ((0, result.map),)]


def _metrics(track: Map, truth: Truth, lap: int, scale: float) -> LapMetrics:
    found = lap_metrics(scaled(track, 1.0 / scale), scaled(truth, 1.0 / scale), lap)
    return replace(found, rmse=found.rmse * scale)


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
