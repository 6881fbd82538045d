"""The landmark batch finds the associations of an oracle, and maps a log without detections."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial import KDTree

from pathspace_graph.baselines import landmark_graph
from pathspace_graph.baselines.landmark_graph import LandmarkBatch
from pathspace_graph.baselines.landmarks import LandmarkSystem
from pathspace_graph.eval.metrics.reference import solve_oracle_landmarks
from pathspace_graph.io.log import Log
from pathspace_graph.io.map import PointBoundary
from pathspace_graph.labels import BOUNDARIES

from ...scenes.drives import ahead, exact_log, true_poses


def test_it_finds_the_landmarks_of_the_oracle(bean: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    """And it associates anew until hardly any detection changes."""
    assert bean.truth is not None
    real, changed = landmark_graph.reassociate, list[float]()

    def reassociate(system: LandmarkSystem, *others: Any) -> None:
        before = system.detections.landmark.copy()
        real(system, *others)
        changed.append(float(np.mean(before != system.detections.landmark)))

    monkeypatch.setattr(landmark_graph, "reassociate", reassociate)
    result = LandmarkBatch(odometry_sigma=bean.odometry_sigma).solve(bean)
    assert changed[-1] <= 1e-3 < changed[0]
    _, oracle = solve_oracle_landmarks(bean)
    assert result.converged
    assert result.map.closed and result.laps == 2
    assert len(result.trajectory) == len(bean.cycles)
    labels = bean.truth.cone_labels[oracle.numbers]
    for label in BOUNDARIES:
        boundary, expected = result.map.boundaries[label], oracle.landmarks[labels == label]
        assert isinstance(boundary, PointBoundary)
        assert boundary.size == len(expected)
        assert KDTree(boundary.points).query(expected)[0].max() < 0.2


def test_a_log_without_detections_gives_an_empty_map() -> None:
    log = exact_log(ahead(5.0, 2.0), np.zeros((0, 2)), np.zeros(0, np.intp))
    result = LandmarkBatch(odometry_sigma=log.odometry_sigma).solve(log)
    assert result.map.size == 0 and not result.map.closed
    np.testing.assert_allclose(result.trajectory, true_poses(log), atol=1e-6)
