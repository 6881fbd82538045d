"""The gap between two runs over one log, for example an online run and the batch optimum."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pathspace_graph.io.results import RunResult
from pathspace_graph.labels import NAMES

from .curves import two_way_distance
from .table1 import root_mean_square
from .trajectory import pose_errors


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
