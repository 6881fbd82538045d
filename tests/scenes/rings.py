"""Estimators on a round track whose maps are known, for tests of what compares them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph import estimators as registry
from pathspace_graph.io.log import Detections, Log, Odometry
from pathspace_graph.io.log_files import write_log
from pathspace_graph.io.map import Map, PointBoundary, SplineBoundary
from pathspace_graph.io.results import BatchRun
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.run import CycleResult
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track_files import read_track
from pathspace_graph.spline.bspline import BSpline

from .pretenders import write_round_track

Array = NDArray[np.float64]

RADII = {LEFT: 8.0, RIGHT: 12.0}
CENTRE = np.array([0.0, 10.0])
SHIFT = 0.2
"""The boundary of `shifted_ring` has this standard deviation in x and in y (m)."""


class Rings:
    """Both boundaries as closed splines through the truth, 0.1 m too wide."""

    def __init__(self, settings: MapperSettings, odometry_sigma: Array) -> None:
        self.settings = settings

    def update(self, odometry: Odometry, detections: Detections) -> CycleResult:
        return CycleResult(detections.t, np.zeros(3), (16, 16), 1, True, {"guess": 1e-6})

    def map(self) -> Map:
        angle = 2 * np.pi * np.arange(16) / 16
        circle = np.stack([np.sin(angle), -np.cos(angle)], axis=1)
        # control points of a uniform cubic lie outside of the circle that it runs along
        out = 3.0 / (2.0 + np.cos(2 * np.pi / 16))
        return Map(
            True,
            {
                label: SplineBoundary(
                    BSpline.periodic_from(np.arange(17.0), CENTRE + out * (radius + 0.1) * circle),
                    0.01 * np.eye(32),
                )
                for label, radius in RADII.items()
            },
        )


class Gaps(Rings):
    """Every cone as a landmark, but three of the right row on end and one of the left."""

    def map(self) -> Map:
        angle = 2 * np.pi * np.arange(20) / 20
        circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        left, right = (CENTRE + radius * circle for radius in RADII.values())
        kept = {LEFT: np.delete(left, 10, axis=0), RIGHT: np.delete(right, [3, 4, 5], axis=0)}
        return Map(True, {label: PointBoundary(p, 0.01 * np.eye(2 * len(p))) for label, p in kept.items()})


class Broken(Rings):
    """Fails at once."""

    def update(self, odometry: Odometry, detections: Detections) -> CycleResult:
        raise ValueError("lost\nthe way")


class RingsBatch(Rings):
    """The rings as a batch that does not converge."""

    def solve(self, log: Log) -> BatchRun:
        t = np.array([cycle.t for cycle in log.cycles])
        nothing = np.zeros((len(t), 3))
        return BatchRun("rings-batch", {}, self.map(), t, nothing, (), 2, converged=False)


def register(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make these the only estimators that are known."""
    monkeypatch.setattr(registry, "ONLINE", {"rings": Rings, "gaps": Gaps, "broken": Broken})
    monkeypatch.setattr(registry, "BATCH", {"rings-batch": RingsBatch})


def write_logs(folder: Path) -> Path:
    """Two logs of two laps, a and b."""
    folder.mkdir()
    track = read_track(write_round_track(folder))
    for seed, name in enumerate("ab"):
        write_log(simulate(track, SimulationSettings(laps=2), seed), folder / "logs" / name)
    return folder / "logs"


def shifted_ring(radius: float) -> SplineBoundary:
    """A ring around (0, 20) m, travelled anticlockwise, whose control points all move as one."""
    angle = 2 * np.pi * np.arange(16) / 16
    points = radius * np.stack([np.sin(angle), -np.cos(angle)], axis=1) + [0.0, 20.0]
    together = np.tile(np.eye(2), (16, 1))
    return SplineBoundary(BSpline.periodic_from(np.arange(17.0), points), SHIFT**2 * together @ together.T)
