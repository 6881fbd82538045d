"""The problem of a whole log as GTSAM's nonlinear factors, and its optimum by GTSAM's own optimizer."""

from __future__ import annotations

import pickle
from dataclasses import replace
from functools import cache
from pathlib import Path

import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.batch.mapper import BatchMapper, BatchResult
from pathspace_graph.batch.system import Evaluation, nonlinear_graph
from pathspace_graph.factors.gtsam_factors import pose_array
from pathspace_graph.factors.noise import huber_loss
from pathspace_graph.factors.se2 import rotation
from pathspace_graph.graph.exchange import read_graph, write_graph
from pathspace_graph.graph.variables import CALIBRATION_KEY, POSE, are_poses
from pathspace_graph.mapping.motion import BiasMeasurement
from pathspace_graph.mapping.state import State
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.settings.mapper import MapperSettings

from ..scenes.batch import drawn, settled, straight
from ..scenes.drives import ahead, corridor, exact_log

Array = NDArray[np.float64]


@cache
def solved() -> BatchResult:
    """Returns the result of a short straight drive between two rows of cones, with noisy detections."""
    cones, labels = corridor(60.0)
    log = exact_log(ahead(6.0, 5.0), cones, labels)
    rng = np.random.default_rng(1)
    for cycle in log.cycles:
        cycle.points_vehicle[:] += rng.normal(0.0, 0.1, cycle.points_vehicle.shape)
    return BatchMapper(None, log.odometry_sigma, FixedLagMapper).solve(log, "odometry")


def rotations(state: State) -> Array:
    """Returns (N, N) that takes GTSAM's tangents, a pose's in its own frame, to changes in the map frame."""
    layout = state.variables.layout
    matrix = np.eye(layout.size)
    for start, pose in zip(layout.starts[are_poses(layout.keys)], state.poses, strict=True):
        matrix[start : start + 2, start : start + 2] = rotation(pose[2])
    return matrix


def vector_of(values: gtsam.Values, state: State) -> Array:
    """Returns the values (N,) in the order of the state's."""
    keys = state.variables.keys
    return np.concatenate(
        [
            pose_array(values.atPose2(key)) if is_pose else values.atVector(key)
            for key, is_pose in zip(keys.tolist(), are_poses(keys).tolist(), strict=True)
        ]
    )


def at_optimum() -> tuple[BatchResult, Evaluation]:
    """Returns a result, and its problem some steps nearer to the optimum than the tolerances ask for."""
    result = solved()
    system = result.system
    state = result.optimum.state
    for _ in range(4):
        system.evaluate(state, hold=True)
        state = settled(system, state)
    return result, system.evaluate(state, hold=True)


def test_its_linearization_is_ours() -> None:
    result = solved()
    state, graph = result.optimum.state, result.graph()
    theirs = graph.linearize(result.values())
    ours = result.system.linear_graph(result.system.evaluate(state, hold=True))
    ordering = state.variables.layout.ordering
    information, vector = theirs.hessian(ordering)
    expected, negative_gradient = ours.hessian(ordering)
    turn = rotations(state)
    size = np.sqrt(np.diagonal(expected))
    np.testing.assert_allclose(
        turn @ information @ turn.T / np.outer(size, size), expected / np.outer(size, size), atol=1e-7
    )
    np.testing.assert_allclose(turn @ vector / size, negative_gradient / size, atol=1e-6)


def test_its_error_is_the_cost_of_the_detections_in_use() -> None:
    result = solved()
    system, values = result.system, result.values()
    at, settings = system.evaluate(result.optimum.state, hold=True), system.settings
    unused = len(system.detections) - np.isfinite(at.across.sigma).sum()
    constant = unused * huber_loss(np.array([system.gate]), settings.gate.huber)[0]
    assert nonlinear_graph(system, at).error(values) == pytest.approx(at.cost - constant, rel=1e-6)


def test_a_bias_that_was_measured_at_rest_is_a_factor_that_can_be_written(tmp_path: Path) -> None:
    system, state = straight()
    system.chains[0] = replace(system.chains[0], bias=BiasMeasurement(0.001, 0.0005))
    at, variables = system.evaluate(state, hold=True), state.variables
    graph, values = nonlinear_graph(system, at), variables.gtsam_values(variables.keys)
    ordering = variables.layout.ordering
    information, vector = graph.linearize(values).hessian(ordering)
    expected, negative_gradient = system.linear_graph(at).hessian(ordering)
    known = variables.layout.entries(np.array([CALIBRATION_KEY]))
    np.testing.assert_allclose(information[np.ix_(known, known)], expected[np.ix_(known, known)], rtol=1e-6)
    np.testing.assert_allclose(vector[known], negative_gradient[known], rtol=1e-6, atol=1e-6)
    assert graph.error(values) == pytest.approx(2.0)  # the drive is exact, and the bias off by two sigmas
    write_graph(tmp_path / "graph.json", graph, values)
    assert read_graph(tmp_path / "graph.json")[0].size() == graph.size()


def test_its_gradient_vanishes_at_the_optimum() -> None:
    """Each entry is in units of its own sigma."""
    result, at = at_optimum()
    variables = at.state.variables
    graph, values = nonlinear_graph(result.system, at), variables.gtsam_values(variables.keys)
    information, vector = graph.linearize(values).hessian(variables.layout.ordering)
    assert np.abs(vector / np.sqrt(np.diagonal(information))).max() < 1e-5


def test_gtsam_stays_at_the_optimum() -> None:
    result, at = at_optimum()
    variables = at.state.variables
    graph, values = nonlinear_graph(result.system, at), variables.gtsam_values(variables.keys)
    theirs = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    np.testing.assert_allclose(vector_of(theirs, at.state), variables.values, atol=1e-5)


def test_gtsam_has_the_same_covariances() -> None:
    result = solved()
    state = result.optimum.state
    marginals = gtsam.Marginals(result.graph(), result.values())
    keys, eliminated = state.variables.keys, result.system.eliminated(result.optimum)
    for k, key in list(enumerate(keys[are_poses(keys)].tolist()))[:: len(state.poses) // 3]:
        turn = np.eye(POSE)
        turn[:2, :2] = rotation(state.poses[k, 2])
        expected = turn @ marginals.marginalCovariance(key) @ turn.T
        np.testing.assert_allclose(result.pose_covariances[k], expected, rtol=1e-4, atol=1e-9)
    for key in state.map_keys[::5]:
        ours = eliminated.joint(np.array([key]))
        np.testing.assert_allclose(ours, marginals.marginalCovariance(int(key)), rtol=1e-4, atol=1e-9)


def test_a_result_can_be_pickled() -> None:
    """That holds after all of it has been used: it keeps arrays, and makes GTSAM's objects anew."""
    result = solved()
    assert len(result.pose_covariances) == len(result.trajectory)
    assert result.graph().size() == pickle.loads(pickle.dumps(result)).graph().size()


def test_it_can_be_drawn_and_printed(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    graph, values = solved().graph(), solved().values()
    graph.saveGraph(str(tmp_path / "graph.dot"), values)
    assert "x0" in (tmp_path / "graph.dot").read_text()
    graph.printErrors(values)
    assert "b0" in capfd.readouterr().out


@pytest.mark.slow
def test_levenberg_marquardt_finds_the_same_optimum() -> None:
    """It begins where the curves began, a tenth of a metre away."""
    exact, begun = straight(4.0, MapperSettings().batch.sigma_smoothness)
    system, _ = drawn(exact, np.random.default_rng(3))
    system.begin(begun)
    system.evaluate(begun, hold=True)
    at = system.evaluate(settled(system, begun, 8))
    graph = nonlinear_graph(system, at)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(0.0)
    parameters.setAbsoluteErrorTol(1e-12)
    first = begun.variables.gtsam_values(begun.variables.keys)
    theirs = vector_of(gtsam.LevenbergMarquardtOptimizer(graph, first, parameters).optimize(), begun)
    assert np.abs(theirs - begun.variables.values).max() > 0.05
    np.testing.assert_allclose(theirs, at.state.variables.values, atol=1e-3)
