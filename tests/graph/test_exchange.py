"""Graphs for other programs: what is read again is the same, and re-optimized it stays where it is."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.batch.mapper import BatchMapper, BatchResult
from pathspace_graph.factors.se2 import difference
from pathspace_graph.graph.exchange import portable, read_graph, write_g2o, write_graph
from pathspace_graph.graph.variables import pose_key

from ..scenes.drives import map_log, noisy_lap

Array = NDArray[np.float64]


@cache
def batch() -> BatchResult:
    log = noisy_lap()
    return BatchMapper(odometry_sigma=log.noise).solve(log)


def points_and_poses(values: gtsam.Values) -> Array:
    found = []
    for key in sorted(values.keys()):
        letter = chr(gtsam.Symbol(key).chr())
        if letter == "x":
            pose = values.atPose2(key)
            found.append([pose.x(), pose.y(), pose.theta()])
        elif letter in "lr":
            found.append([*values.atPoint2(key), 0.0])
    return np.array(found)


def test_the_optimum_of_what_is_read_is_ours(tmp_path: Path) -> None:
    """GTSAM's own optimizer comes back to it from 5 cm and half a degree away."""
    result = batch()
    write_graph(tmp_path / "graph.json", result.graph(), result.values())
    graph, values = read_graph(tmp_path / "graph.json")
    written = portable(result.graph(), result.values())
    assert graph.error(values) == pytest.approx(written.error(result.values()), rel=1e-12)
    begin, rng = gtsam.Values(values), np.random.default_rng(0)
    for k in range(len(result.trajectory)):
        pose = values.atPose2(pose_key(k))
        begin.update(pose_key(k), pose.retract(rng.normal(0.0, [0.05, 0.05, 0.01])))
    found = gtsam.LevenbergMarquardtOptimizer(graph, begin).optimize()
    np.testing.assert_allclose(points_and_poses(found), points_and_poses(values), atol=5e-3)


def test_a_portable_graph_has_no_factor_in_python_and_the_same_linearization() -> None:
    result = batch()
    graph, values = result.graph(), result.values()
    found = portable(graph, values)
    assert found.size() == graph.size()
    assert any(isinstance(graph.at(k), gtsam.CustomFactor) for k in range(graph.size()))
    ordering = gtsam.Ordering(sorted(values.keys()))
    for k in range(0, graph.size(), 7):
        assert not isinstance(found.at(k), gtsam.CustomFactor)
        one, other = gtsam.NonlinearFactorGraph(), gtsam.NonlinearFactorGraph()
        one.add(graph.at(k))
        other.add(found.at(k))
        assert set(other.at(0).keys()) <= set(one.at(0).keys())
    expected, right = graph.linearize(values).hessian(ordering)
    hessian, vector = found.linearize(values).hessian(ordering)
    np.testing.assert_allclose(hessian, expected, atol=1e-9 * np.abs(expected).max())
    np.testing.assert_allclose(vector, right, atol=1e-9 * np.abs(right).max())


def test_the_window_of_a_mapper_can_be_taken_away(tmp_path: Path) -> None:
    log = noisy_lap()
    mapper, _ = map_log(replace(log, cycles=log.cycles[:40]))
    write_graph(tmp_path / "graph.json", mapper.graph(), mapper.values())
    graph, values = read_graph(tmp_path / "graph.json")
    assert graph.error(values) == pytest.approx(mapper.graph().error(mapper.values()), rel=1e-9)


def test_g2o_has_every_pose_and_what_relates_them(tmp_path: Path) -> None:
    result, file = batch(), tmp_path / "graph.g2o"
    pose_graph = result.pose_graph()
    write_g2o(file, pose_graph, result.values())
    graph, values = gtsam.readG2o(str(file), False)
    count = len(result.trajectory)
    assert (graph.size(), values.size()) == (count - 1 + len(result.system.revisits), count)
    poses = np.array([[p.x(), p.y(), p.theta()] for p in (values.atPose2(k) for k in range(count))])
    np.testing.assert_allclose(difference(poses, result.trajectory), 0.0, atol=1e-4)
    assert graph.error(values) == pytest.approx(pose_graph.error(result.values()), rel=0.02)
