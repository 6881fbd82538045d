"""ISAM2 maps what it is told, so that its time is that of a solution."""

import gtsam
import numpy as np
import pytest

from pathspace_graph.eval.benchmark.measurement import ToldLandmarks
from pathspace_graph.sim.simulate import SimulationSettings, simulate

from ...scenes.drives import ahead, bean_track, corridor, exact_log


def test_the_landmarks_are_the_detected_cones() -> None:
    log = simulate(bean_track(), SimulationSettings(laps=2), 0)
    told = ToldLandmarks(log)
    assert all(told.advance() > 0.0 for _ in log.cycles)
    assert log.truth is not None and log.truth.associations is not None
    cones, estimate = sorted(set(np.unique(log.truth.associations)) - {-1}), told.isam.calculateEstimate()
    points = [estimate.atPoint2(gtsam.symbol("l", cone)) for cone in cones]
    assert estimate.size() == len(log.cycles) + len(cones)
    errors = np.linalg.norm(np.array(points) - log.truth.cones[cones], axis=1)
    assert np.sqrt(np.mean(np.square(errors))) < 0.3


def test_a_log_without_associations_is_refused() -> None:
    with pytest.raises(ValueError, match="associations"):
        ToldLandmarks(exact_log(ahead(8.0, 1.0), *corridor(20.0)))
