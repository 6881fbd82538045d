"""The paper's spline filter on whole drives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pathspace_graph.baselines.filters import CkfMapper
from pathspace_graph.estimators import make_online
from pathspace_graph.eval.metrics.accuracy import lap_metrics
from pathspace_graph.io.log import Detections
from pathspace_graph.io.map import SplineBoundary
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.run import run_online
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track_generator import TrackGeneratorSettings, generate_track

from ...scenes.drives import ahead, corridor, exact_log


def test_a_straight_drive_is_mapped_straight() -> None:
    cones, labels = corridor(80.0)
    log = exact_log(ahead(6.0, 10.0), cones, labels)
    result = run_online(log, CkfMapper(odometry_sigma=log.odometry_sigma), name="ckf")
    assert np.abs(result.trajectory[:, 1]).max() < 0.05
    for label, y in ((LEFT, 2.0), (RIGHT, -2.0)):
        boundary = result.map.boundaries[label]
        assert isinstance(boundary, SplineBoundary)
        points = boundary.spline.evaluate(np.linspace(*boundary.spline.domain, 200))
        assert points[-1, 0] > 55.0
        assert np.abs(points[:, 1] - y).max() < 0.1


@pytest.mark.slow
def test_a_noisy_lap_is_mapped_with_few_control_points() -> None:
    log = simulate(
        generate_track(np.random.default_rng(2), TrackGeneratorSettings()), SimulationSettings(laps=2), 0
    )
    result = run_online(log, make_online("ckf", MapperSettings(), log), name="ckf")
    assert log.truth is not None
    metrics = lap_metrics(result.map, log.truth, 2)
    assert result.map.closed
    assert metrics.rmse < 0.8
    assert metrics.missed < 0.05
    assert metrics.size < 0.5 * len(log.truth.cones)


def test_a_log_without_detections_gives_an_empty_map() -> None:
    cones, labels = corridor(80.0)
    log = exact_log(ahead(6.0, 4.0), cones, labels)
    blind = replace(
        log,
        cycles=tuple(
            Detections(c.t, c.points_vehicle[:0], c.covariances[:0], c.labels[:0]) for c in log.cycles
        ),
    )
    result = run_online(blind, CkfMapper(), name="ckf")
    assert result.map.size == 0
    driven = 6.0 * result.trajectory_t[-1]
    assert result.trajectory[-1] == pytest.approx([driven, 0.0, 0.0], abs=1e-2)
    assert result.trajectory[-1, 0] < driven  # the mean over all headings is a shorter path
