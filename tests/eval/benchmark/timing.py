"""A cycle whose time is known, and a small measurement of scaling."""

from __future__ import annotations

from pathspace_graph.io.results import CycleRecord
from pathspace_graph.settings.evaluation import ScalingSettings

SMALL = ScalingSettings(
    cones_min=20.0,
    cones_max=60.0,
    bins=4,
    fit_from=20.0,
    readings=(2, 6, 12),
    readings_cones=60,
    warm_up=5,
    laps=2,
    laps_cones=40,
    budget=10.0,
)


def record(cycle: int, seconds: float, lap: int, *, closed: bool = False) -> CycleRecord:
    return CycleRecord(cycle, 0.1 * cycle, seconds, 5, 5, 4, lap, {"update": 0.5 * seconds}, closed=closed)
