"""The gap between two runs over one log, for example an online run and the batch optimum."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.se2 import inverse, left_of, to_map
from pathspace_graph.io.map import Map, MapBoundary
from pathspace_graph.io.results import RunResult
from pathspace_graph.labels import NAMES

from .curves import mapped_points, two_way_distance
from .table1 import boundary_distances, root_mean_square
from .trajectory import pose_errors
from .turn import near_pairs

Array = NDArray[np.float64]

STEP: Final = 0.5
"""Maps are aligned by points of their curves that are this far apart (m)."""
STARTS: Final = (0.0, -4.0, -2.0, 2.0, 4.0)
"""The vehicle started this much farther ahead (m) in one of two maps, or less."""
ROUNDS: Final = 30
"""Their points are paired this often."""


@dataclass(frozen=True)
class Gap:
    """Holds how far one run is from another."""

    curves: dict[str, float]
    """Each boundary that both runs have mapped has the two-way distance (m) of its two curves."""
    along: float
    """This is the root mean square distance (m) of the poses along the reference's heading."""
    across: float
    """This is the root mean square distance (m) of the poses across it."""
    heading: float
    """This is the root mean square difference (rad) of the headings."""


def from_batch(values: Mapping[str, Any], batch: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the turn (rad) of a map from that of the batch over the same log, and the rmse by the batch's.

    Both are given by their metrics. Small turns about one point add up, so the turn from the batch is the
    difference of the turns from the truth. Where either map has no such metric, the result has none.
    """
    found: dict[str, Any] = {}
    if {"turn", "rmse"} <= set(values) & set(batch):
        found["turn_from_batch"] = float(values["turn"] - batch["turn"])
        found["rmse_by_batch"] = float(values["rmse"] / batch["rmse"])
    return found


def gap(run: RunResult, reference: RunResult) -> Gap:
    """Returns the gap of a run from a reference over the same log."""
    shared = sorted(set(run.map.boundaries) & set(reference.map.boundaries))
    curves = {
        NAMES[label]: two_way_distance(run.map.boundaries[label], reference.map.boundaries[label])
        for label in shared
    }
    errors = pose_errors(run.trajectory_t, run.trajectory, reference.trajectory_t, reference.trajectory)
    return Gap(curves, *(root_mean_square(column) for column in errors.T))


def aligned_distance(track: Map, reference: Map) -> float:
    """Returns the mean two-way distance (m) of a map from another one of the same cones, rigidly aligned.

    Each drive has its own map frame. Of the motions that closest points lead to from several starts, the one
    with the least distance counts. It is infinite where the maps share no boundary.
    """
    shared = sorted(set(track.boundaries) & set(reference.boundaries))
    own = [mapped_points(track.boundaries[label], STEP) for label in shared]
    other = [mapped_points(reference.boundaries[label], STEP) for label in shared]
    best = np.inf
    for start in STARTS:
        motion = _aligning(own, [reference.boundaries[label] for label in shared], start)
        back = inverse(motion)
        forth = [
            boundary_distances(reference.boundaries[label], to_map(points, motion[None]))
            for label, points in zip(shared, own, strict=True)
        ]
        forth += [
            boundary_distances(track.boundaries[label], to_map(points, back[None]))
            for label, points in zip(shared, other, strict=True)
        ]
        best = min([best, *([float(np.mean(np.concatenate(forth)))] if forth else [])])
    return float(best)


def _aligning(points: list[Array], boundaries: list[MapBoundary], start: float) -> Array:
    """Returns the motion (3,) that lays points (k, 2) of curves on the boundaries of another map."""
    motion = np.array([start, 0.0, 0.0])
    for _ in range(ROUNDS):
        rows, errors = [np.zeros((0, 3))], [np.zeros(0)]
        for own, boundary in zip(points, boundaries, strict=True):
            point, normal, position, _ = near_pairs(boundary, to_map(own, motion[None]))
            lever = np.einsum("kd,kd->k", normal, left_of(point - motion[:2]))
            rows.append(np.column_stack([normal, lever]))
            errors.append(np.einsum("kd,kd->k", normal, position - point))
        change = np.linalg.lstsq(np.concatenate(rows), np.concatenate(errors), rcond=None)[0]
        motion = motion + change
    return motion
