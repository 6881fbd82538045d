"""Drives along lines: points of both boundaries that are at other places in each cycle."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from pathspace_graph.factors.se2 import path_lengths, to_vehicle
from pathspace_graph.io.log import Detections, Log, SensorInfo
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track_generator import generate_track

SIGMA = 0.05  # of a coordinate of a point (m)


@cache
def line_drive(seed: int = 1, spacing: float = 1.0) -> Log:
    """One lap of a generated track whose boundaries are polygons through its cones."""
    log = simulate(generate_track(np.random.default_rng(seed)), SimulationSettings(laps=1), seed)
    truth, rng = log.truth, np.random.default_rng(seed)
    assert truth is not None
    rows = [truth.cones[truth.cone_labels == label] for label in BOUNDARIES]
    closed = [np.concatenate([row, row[:1]]) for row in rows]
    poses = truth.poses[np.searchsorted(truth.pose_t, [cycle.t + 1e-9 for cycle in log.cycles]) - 1]
    cycles = []
    for cycle, pose in zip(log.cycles, poses, strict=True):
        seen = [seen_of(row, pose, spacing, rng) for row in closed]
        labels = np.repeat(BOUNDARIES, [len(points) for points in seen])
        covariances = np.tile(SIGMA**2 * np.eye(2), (len(labels), 1, 1))
        cycles.append(Detections(cycle.t, np.concatenate(seen), covariances, labels))
    return replace(
        log, cycles=tuple(cycles), sensor=SensorInfo(kind="line"), truth=replace(truth, associations=None)
    )


def seen_of(row: np.ndarray, pose: np.ndarray, spacing: float, rng: np.random.Generator) -> np.ndarray:
    """Points of a row that are ahead within 12 m, vehicle frame, at a phase that is drawn."""
    along = path_lengths(row)
    at = np.arange(rng.uniform(0.0, spacing), along[-1], spacing)
    points = np.column_stack([np.interp(at, along, axis) for axis in row.T])
    local = to_vehicle(points, np.tile(pose, (len(points), 1)))
    local = local[(np.hypot(*local.T) < 12.0) & (local[:, 0] > 0.5)]
    return np.asarray(local + SIGMA * rng.standard_normal(local.shape))
