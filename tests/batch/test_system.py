"""The problem of a whole log: its loss, its gradient against its cost, and its steps against GTSAM's."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.batch.association import associate, locate_poses
from pathspace_graph.batch.simplification import own_settings
from pathspace_graph.batch.start import start_odometry
from pathspace_graph.batch.system import BatchSystem, moved
from pathspace_graph.factors.noise import huber_loss
from pathspace_graph.front_end.front_end import judge_log
from pathspace_graph.front_end.log_odometry import LogOdometry
from pathspace_graph.graph.elimination import solution
from pathspace_graph.graph.variables import pose_key
from pathspace_graph.mapping.detections import DetectionTable
from pathspace_graph.mapping.state import State
from pathspace_graph.settings.mapper import MapperSettings

from ..scenes.drives import bean_track, lap_log, true_poses

Array = NDArray[np.float64]


@cache
def small_system() -> tuple[BatchSystem, State]:
    """Returns an exact lap with some noise on its detections, linearized beside the optimum."""
    log = lap_log(bean_track())
    settings = own_settings(MapperSettings())
    chain = judge_log(log, log.noise, settings).chain
    detections = DetectionTable.of(log.cycles)
    noise = np.random.default_rng(1).normal(0.0, 0.1, detections.measured.shape)
    detections.measured = detections.measured + noise
    system = BatchSystem(detections, [chain], [settings])
    system.gate = settings.batch.gate
    state = start_odometry(system)
    system.begin(state)
    state = moved(state, np.random.default_rng(2).normal(0.0, 0.01, state.variables.layout.size))
    locate_poses(state)
    associate(state, detections, settings, 8.0, False)
    system.evaluate(state, hold=True)
    return system, state


def test_dead_reckoning_of_an_exact_log_is_the_truth() -> None:
    log = lap_log(bean_track())
    chain: LogOdometry = judge_log(log, log.noise, MapperSettings()).chain
    np.testing.assert_allclose(chain.dead_reckoned(np.zeros(2))[:, :2], true_poses(log)[:, :2], atol=1e-6)


def test_the_gradient_is_that_of_the_cost() -> None:
    system, state = small_system()
    at, layout = system.evaluate(state), state.variables.layout
    _, negative_gradient = system.linear_graph(at).hessian(layout.ordering)
    rng = np.random.default_rng(5)
    for _ in range(5):
        direction = rng.normal(size=layout.size)
        h = 1e-5
        costs = [system.evaluate(moved(state, s * h * direction)).cost for s in (1.0, -1.0)]
        slope = (costs[0] - costs[1]) / (2.0 * h)
        np.testing.assert_allclose(-negative_gradient @ direction, slope, rtol=1e-4)


def test_the_step_is_that_of_gtsam() -> None:
    """The map has 30 to 40 control points and some hundred poses."""
    system, state = small_system()
    at, keys = system.evaluate(state), state.variables.keys.tolist()
    expected = system.linear_graph(at).optimize().vector(keys)
    found = solution(system.linear_graph(at), state.variables.layout)
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_poses_alone_move_as_beside_a_map_that_is_held() -> None:
    system, state = small_system()
    at = system.evaluate(state)
    hessian, vector = system.linear_graph(at).hessian(state.variables.layout.ordering)
    n = len(vector) - state.poses.size
    held = np.linalg.solve(hessian[n:, n:], vector[n:])
    np.testing.assert_allclose(system.poses_alone(at), held, atol=1e-9)


def test_pose_marginals_are_those_of_gtsam() -> None:
    system, state = small_system()
    at = system.evaluate(state)
    marginals = system.eliminated(at).pose_marginals
    graph = system.linear_graph(at)
    for k in (0, len(state.poses) // 2, len(state.poses) - 1):
        information = graph.marginal([pose_key(k)]).hessian()[0]
        np.testing.assert_allclose(marginals[k], np.linalg.inv(information), rtol=1e-6, atol=1e-12)


def test_a_step_in_relative_coordinates_is_the_step_to_first_order() -> None:
    system, state = small_system()
    direction = np.random.default_rng(6).normal(size=state.variables.layout.size)
    for h in (1e-3, 1e-4):
        linear, relative = (make(state, h * direction) for make in (moved, system.retract))
        off = np.abs(relative.variables.values - linear.variables.values).max()
        assert off < 1e4 * h**2


def test_a_map_that_swings_in_one_step_keeps_its_shape() -> None:
    """Everything turns about the first pose by 0.5 rad: the step is as long as the turn's derivative."""
    system, state = small_system()
    turn, variables = 0.5, state.variables
    swing = state.copy()
    swing.variables.values[:] = 0.0
    places = (swing.poses[:, :2], state.poses[:, :2]), (swing.map_points, state.map_points)
    for change, place in places:
        arm = place - state.poses[0, :2]
        change[:] = turn * np.column_stack([-arm[:, 1], arm[:, 0]])
    swing.poses[:, 2] = turn
    after = system.retract(state, swing.variables.values)
    for points, before in ((after.poses[:, :2], state.poses[:, :2]), (after.map_points, state.map_points)):
        arm = (before - state.poses[0, :2]) @ [[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]
        np.testing.assert_allclose(points - state.poses[0, :2], arm, atol=1e-9)
    np.testing.assert_allclose(after.poses[:, 2], state.poses[:, 2] + turn)
    np.testing.assert_array_equal(after.variables.calibration, variables.calibration)


def test_a_swing_of_the_map_with_its_poses_is_not_damped() -> None:
    system, state = small_system()
    after = system.retract(state, np.zeros(state.variables.layout.size))
    np.testing.assert_allclose(after.variables.values, state.variables.values, atol=1e-9)
    for (label, weak), rows in zip(system.weak.items(), system.damping(state, 0.5), strict=True):
        points, poses = state.control_points(label), state.poses
        arms = (poses[weak.cycle, :2] - poses[0, :2], points - poses[0, :2])
        of_pose, of_point = (np.column_stack([-arm[:, 1], arm[:, 0]]) for arm in arms)
        swing = np.column_stack([of_pose, np.ones(len(points)), of_point]).repeat(2, axis=0)
        np.testing.assert_allclose((rows.jacobian * swing).sum(axis=1), 0.0, atol=1e-9)
        np.testing.assert_allclose((rows.jacobian[:, 3:] ** 2).sum(axis=1), 4.0)


def test_a_step_of_the_poses_leaves_the_rest() -> None:
    _, state = small_system()
    step = np.ones(state.poses.size)
    after = moved(state, step)
    np.testing.assert_array_equal(after.poses, state.poses + 1.0)
    np.testing.assert_array_equal(after.map_points, state.map_points)
    np.testing.assert_array_equal(after.variables.calibration, state.variables.calibration)


def test_a_detection_that_is_not_in_use_costs_as_much_as_one_at_the_gate() -> None:
    system, state = small_system()
    used, before = system.detections.used.copy(), system.evaluate(state)
    row = before.across.rows[before.across.whitened.argmin()]
    whitened = before.across.whitened[before.across.rows == row]
    system.detections.release(np.array([row]))
    after = system.evaluate(state).cost
    system.detections.used[:] = used
    expected = huber_loss(np.array([system.gate, *whitened]), system.settings.gate.huber)
    assert after - before.cost == pytest.approx(expected[0] - expected[1], rel=1e-6)


def test_wider_priors_hold_the_calibration_of_the_odometry_less() -> None:
    """Their rows are `b / sigma`, with the sigmas of the other settings."""
    system, state = small_system()
    settings, before = system.settings, ([*system.chains], [*system.priors])
    odometry = replace(settings.odometry, sigma_scale=0.5, sigma_bias=0.25)
    system.widen_priors(0, replace(settings, odometry=odometry))
    (key,) = state.variables.calibration_keys[:1]
    rows = [one for one in system.drive_rows(state) if one.keys.shape[1] == 1 and (one.keys == key).all()]
    system.chains, system.priors = before
    (prior,) = rows
    np.testing.assert_allclose(prior.jacobian, np.diag([2.0, 4.0]))
