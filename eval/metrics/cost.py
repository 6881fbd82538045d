"""What a run costs: the time of its cycles and their stages, and the memory of its map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from pathspace_graph.io.map import Map, SplineBoundary
from pathspace_graph.io.results import CycleRecord

WHOLE: Final = "whole"
"""The whole cycle has this name among its stages."""
_TAIL: Final = 0.99


@dataclass(frozen=True, slots=True)
class StageTime:
    """Holds the wall time (s) of one stage over many cycles; every figure is NaN without cycles."""

    stage: str
    """The stage has this name; the whole cycle is called `whole`."""
    mean: float
    """This is the mean over the cycles (s)."""
    median: float
    """Half of the cycles take longer than this (s)."""
    p99: float
    """One cycle in a hundred takes longer than this (s)."""
    share: float
    """The stage's mean is this share of the whole cycle's mean."""


def stage_times(cycles: Sequence[CycleRecord]) -> list[StageTime]:
    """Returns the whole cycle and then its stages; a stage that a cycle lacks took no time in it."""
    names = dict.fromkeys(name for record in cycles for name in record.stages)
    whole = [record.seconds for record in cycles]
    columns = {WHOLE: whole} | {name: [r.stages.get(name, 0.0) for r in cycles] for name in names}
    return [_stage(name, values, whole) for name, values in columns.items()]


def _stage(name: str, values: Sequence[float], whole: Sequence[float]) -> StageTime:
    if not values:
        return StageTime(name, *(float("nan"),) * 4)
    mean, total = float(np.mean(values)), float(np.mean(whole))
    share = mean / total if total > 0.0 else float("nan")
    return StageTime(name, mean, float(np.median(values)), float(np.quantile(values, _TAIL)), share)


DOUBLE_BYTES: Final = 8
"""A double has this many bytes."""


def map_bytes(track: Map) -> int:
    """Returns 8 (2 m + knots) bytes for each spline, with one period of its knots, 8 (2 m) for landmarks."""
    numbers = 0
    for boundary in track.boundaries.values():
        numbers += 2 * boundary.size
        if isinstance(boundary, SplineBoundary):
            spline = boundary.spline
            numbers += len(spline.breaks) if spline.periodic else len(spline.knots)
    return DOUBLE_BYTES * numbers


def covariance_bytes(track: Map) -> int:
    """Returns 8 n (n + 1) / 2 bytes for each boundary's symmetric joint covariance, n = 2 m."""
    sizes = [2 * boundary.size for boundary in track.boundaries.values()]
    return DOUBLE_BYTES * sum(n * (n + 1) // 2 for n in sizes)
