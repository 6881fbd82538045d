"""The whole log's problem: gradients against the cost, steps against GTSAM."""

from __future__ import annotations

from functools import cache

import gtsam
import numpy as np
from numpy.typing import NDArray

from pathspace_graph.batch import own_settings
from pathspace_graph.batch_data import Chain, collect_readings, integrate_log
from pathspace_graph.batch_dead_reckoning import start_odometry
from pathspace_graph.batch_gating import associate, locate_poses
from pathspace_graph.batch_kernel import Kernel
from pathspace_graph.batch_system import BatchSystem, Evaluation, linear_graph_of, moved
from pathspace_graph.factors.linear_graph import window_keys
from pathspace_graph.settings import MapperSettings
from pathspace_graph.state import State
from tests.scenes import bean_track, lap_log, true_poses

Array = NDArray[np.float64]


@cache
def small_system() -> tuple[BatchSystem, State]:
    """An exact lap with some noise on its readings, linearized beside the optimum."""
    log = lap_log(bean_track())
    settings = own_settings(MapperSettings())
    chain = integrate_log(log, log.odometry_sigma, settings.odometry)
    readings = collect_readings(log)
    readings.point = readings.point + np.random.default_rng(1).normal(0.0, 0.1, readings.point.shape)
    state = start_odometry(chain, readings, settings)
    system = BatchSystem(readings, chain, settings, Kernel(settings.gate.chi, settings.gate.huber))
    system.begin(state)
    state.vector = state.vector + np.random.default_rng(2).normal(0.0, 0.01, len(state.vector))
    locate_poses(state)
    associate(state, readings, settings, 8.0, False)
    system.hold_sigmas(state)
    return system, state


def turn(theta: float) -> Array:
    """(3, 3) from GTSAM's tangent of a pose to (x, y, theta) in the map frame."""
    c, s = np.cos(theta), np.sin(theta)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def split(state: State, vector: Array) -> tuple[Array, Array]:
    n = state.pose_column(0)
    return vector[n:], vector[:n]


def test_dead_reckoning_of_an_exact_log_is_the_truth() -> None:
    log = lap_log(bean_track())
    chain: Chain = integrate_log(log, log.odometry_sigma, MapperSettings().odometry)
    np.testing.assert_allclose(chain.dead_reckoned(np.zeros(2))[:, :2], true_poses(log)[:, :2], atol=1e-6)


def test_the_gradient_is_that_of_the_cost() -> None:
    system, state = small_system()
    equations = system.normal_equations(system.evaluate(state))
    gradient = -np.concatenate([equations.descent_border, equations.descent_poses])
    rng = np.random.default_rng(5)
    for _ in range(5):
        direction = rng.normal(size=len(gradient))
        h = 1e-5
        costs = [system.evaluate(moved(state, *split(state, s * h * direction))).cost for s in (1.0, -1.0)]
        slope = (costs[0] - costs[1]) / (2.0 * h)
        np.testing.assert_allclose(gradient @ direction, slope, rtol=1e-4)


def test_the_step_is_that_of_gtsam() -> None:
    """A map of 30 to 40 control points and some hundred poses as one Gaussian factor graph."""
    system, state = small_system()
    at: Evaluation = system.evaluate(state)
    n = state.pose_column(0)
    step_poses, step_border = system.normal_equations(at).reduced().step(np.zeros((n, n)))
    graph, keys = linear_graph_of(system, at)
    solution = graph.optimize()
    values = np.concatenate([solution.at(key) for key in keys.keys])
    poses = values[n:].reshape(-1, 3)
    turned = np.stack([turn(theta) @ pose for theta, pose in zip(state.poses[:, 2], poses, strict=True)])
    np.testing.assert_allclose(step_border, values[:n], atol=1e-9)
    np.testing.assert_allclose(step_poses, turned.ravel(), atol=1e-9)


def test_pose_marginals_are_those_of_gtsam() -> None:
    system, state = small_system()
    at = system.evaluate(state)
    marginals = system.normal_equations(at).reduced().pose_marginals()
    graph, keys = linear_graph_of(system, at)
    n = len(keys.keys) - len(state.poses)
    for k in (0, len(state.poses) // 2, len(state.poses) - 1):
        information = graph.marginal([keys.keys[n + k]]).hessian()[0]
        rotation = turn(state.poses[k, 2])
        expected = rotation @ np.linalg.inv(information) @ rotation.T
        np.testing.assert_allclose(marginals[k], expected, rtol=1e-6, atol=1e-12)


def test_keys_name_every_entry() -> None:
    system, state = small_system()
    _, keys = linear_graph_of(system, system.evaluate(state))
    sizes = tuple(state.boundaries[b].size for b in (0, 1))
    assert keys.keys == window_keys((sizes[0], sizes[1]), 2, state.poses).keys
    assert int(sum(keys.dims)) == len(state.vector)
    assert isinstance(linear_graph_of(system, system.evaluate(state))[0], gtsam.GaussianFactorGraph)
