"""Drives whose sensor misses a boundary for a while, or sees cones that are not there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pathspace_graph.io.log import Log
from pathspace_graph.labels import LEFT, RIGHT

from .drives import FOV, RANGE_MAX, detections


def unseen(log: Log, labels: Sequence[int], since: float, until: float) -> Log:
    """Returns the log without the detections of some labels between two stamps (s)."""
    cycles = []
    for cycle in log.cycles:
        kept = ~np.isin(cycle.labels, labels) | (cycle.t < since) | (cycle.t >= until)
        points, covariances = cycle.points_vehicle[kept], cycle.covariances[kept]
        cycles.append(
            replace(cycle, points_vehicle=points, covariances=covariances, labels=cycle.labels[kept])
        )
    return replace(log, cycles=tuple(cycles))


def cluttered(log: Log, per_cycle: int, seed: int) -> Log:
    """Returns the log with this number of false detections a cycle, anywhere in view and of either colour."""
    rng, cycles = np.random.default_rng(seed), []
    for cycle in log.cycles:
        r = RANGE_MAX * np.sqrt(rng.uniform(0.02, 1.0, per_cycle))
        angle = FOV * rng.uniform(-0.5, 0.5, per_cycle)
        false = np.column_stack([r * np.cos(angle), r * np.sin(angle)])
        points = np.concatenate([cycle.points_vehicle, false])
        labels = np.append(cycle.labels, rng.choice([LEFT, RIGHT], per_cycle))
        cycles.append(detections(cycle.t, points, labels.astype(np.intp)))
    return replace(log, cycles=tuple(cycles))
