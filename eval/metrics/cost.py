"""How long the cycles of a run took, and each of their stages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from pathspace_graph.io.map import Map, SplineBoundary
from pathspace_graph.io.results import CycleRecord

WHOLE: Final = "whole"
"""What the whole cycle is called beside its stages."""
_TAIL: Final = 0.99


@dataclass(frozen=True, slots=True)
class StageTime:
    """Wall time of one stage over many cycles, s."""

    stage: str
    """Name, or `whole`."""
    mean: float
    """NaN of no cycles, as the others."""
    median: float
    """Half of the cycles take longer, ..."""
    p99: float
    """... and one in a hundred longer than this."""
    share: float
    """Of the whole's mean."""


def stage_times(cycles: Sequence[CycleRecord]) -> list[StageTime]:
    """The whole cycle first, then its stages as they come; a stage that a cycle hasn't took no time in it."""
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


NUMBER: Final = 8
"""Bytes of a double."""


def map_bytes(track: Map) -> int:
    """8 (2 m + knots) of a spline: distinct control points, one period of its knots; 8 (2 m) of landmarks."""
    numbers = 0
    for boundary in track.boundaries.values():
        numbers += 2 * boundary.size
        if isinstance(boundary, SplineBoundary):
            spline = boundary.spline
            numbers += len(spline.breaks) if spline.periodic else len(spline.knots)
    return NUMBER * numbers


def covariance_bytes(track: Map) -> int:
    """8 n (n + 1) / 2 of each boundary's joint covariance, n = 2 m, whose halves are the same."""
    sizes = [2 * boundary.size for boundary in track.boundaries.values()]
    return NUMBER * sum(n * (n + 1) // 2 for n in sizes)
