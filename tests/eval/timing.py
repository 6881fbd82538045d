"""A small measurement of scaling."""

from __future__ import annotations

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
