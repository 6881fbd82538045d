"""A short drive that is mapped once alone, and once with the recorder."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from pathspace_graph.eval.view.recording import recording
from pathspace_graph.io.log import Log
from pathspace_graph.io.map import Map, PointBoundary
from pathspace_graph.io.results import RunResult
from pathspace_graph.labels import ORANGE
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.run import ObservedCycle, run_online

from ...scenes.drives import noisy_lap


@dataclass(frozen=True, eq=False)
class Watched:
    """Holds a run and what has watched it."""

    log: Log
    alone: RunResult
    watched: RunResult
    cycles: list[ObservedCycle]
    window: list[int]
    """(n,) Each cycle had this number of poses in the window."""
    rrd: Path


@pytest.fixture(scope="session")
def run(tmp_path_factory: pytest.TempPathFactory) -> Watched:
    folder = tmp_path_factory.mktemp("view")
    log = noisy_lap()
    alone = run_online(log, FixedLagMapper(odometry_sigma=log.odometry_sigma))
    cycles: list[ObservedCycle] = []
    window: list[int] = []
    rrd = folder / "run.rrd"
    with recording(rrd, truth=log.truth) as recorder:
        mapper = FixedLagMapper(odometry_sigma=log.odometry_sigma)
        look = [recorder, cycles.append, lambda cycle: window.append(len(cycle.window))]
        watched = run_online(log, mapper, observers=look)
    return Watched(log, alone, watched, cycles, window, rrd)


class OrangeMapper(FixedLagMapper):
    """Maps two orange cones, wherever it is."""

    cones = np.array([[3.0, 2.5], [3.0, -2.5]])

    def map(self) -> Map:
        return replace(super().map(), points={ORANGE: PointBoundary(self.cones, np.eye(4))})

    def outline(self) -> Map:
        return replace(super().outline(), points={ORANGE: PointBoundary(self.cones, np.eye(4))})
