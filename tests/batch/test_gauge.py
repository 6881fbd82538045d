"""What holds control points along their curve: its Jacobians, and that the map stays as free as it was."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.batch.gauge import CurveGauge, curve_gauge
from pathspace_graph.mapping.state import State

from ..scenes.batch import straight

Array = NDArray[np.float64]


@cache
def scene() -> tuple[State, CurveGauge]:
    _, state = straight()
    return state, curve_gauge(state, 0, 0.2)


def test_it_begins_at_rest() -> None:
    state, gauge = scene()
    np.testing.assert_allclose(gauge.beside(state.control_points(0), state.poses).residual, 0.0, atol=1e-9)


def test_each_control_point_is_held_beside_the_nearest_pose() -> None:
    """Within half a cycle's way, where the drive has been; else beside its first or last pose."""
    state, gauge = scene()
    boundary, poses = state.boundaries[0], state.poses
    x = boundary.evaluate(state.control_points(0), boundary.abscissae)[:, 0]
    there = (x > poses[0, 0]) & (x < poses[-1, 0])
    assert there.sum() > 3
    assert np.abs(x[there] - poses[gauge.cycle[there], 0]).max() < 0.31


def test_its_jacobians_are_its_derivatives() -> None:
    state, gauge = scene()
    rng = np.random.default_rng(0)
    points = state.control_points(0) + rng.normal(0.0, 0.5, state.control_points(0).shape)
    poses = state.poses + rng.normal(0.0, 0.3, state.poses.shape)
    rows, h = gauge.beside(points, poses), 1e-6
    for k in range(3):
        step = h * np.eye(3)[k]
        slope = gauge.beside(points, poses + step).residual - gauge.beside(points, poses - step).residual
        np.testing.assert_allclose(rows.jacobian[:, 2 + k], slope / (2.0 * h), atol=1e-6)
    for k in range(2):
        step = h * np.eye(2)[k]
        slope = gauge.beside(points + step, poses).residual - gauge.beside(points - step, poses).residual
        np.testing.assert_allclose(rows.jacobian[:, k], slope / (2.0 * h), atol=1e-6)


def test_smoothness_is_of_second_differences() -> None:
    """Its rows make its cost, and are theirs of whom they name."""
    state, gauge = scene()
    rng = np.random.default_rng(1)
    points = state.control_points(0) + rng.normal(0.0, 0.5, state.control_points(0).shape)
    rows, place = gauge.smooth(points), {key: k for k, key in enumerate(gauge.keys.tolist())}
    near = np.array([[place[key] for key in row] for row in rows.keys.tolist()])
    linear = (rows.jacobian * points[near].reshape(len(rows), -1)).sum(axis=1)
    np.testing.assert_allclose(linear, rows.residual, atol=1e-9)
    beside = gauge.beside(points, state.poses).residual
    cost = 0.5 * (beside @ beside + rows.residual @ rows.residual)
    np.testing.assert_allclose(gauge.cost(points, state.poses), cost)


def test_a_map_that_moves_with_its_drive_costs_nothing() -> None:
    """Turned and shifted as a whole."""
    state, gauge = scene()
    c, s = np.cos(0.7), np.sin(0.7)
    rotation, shift = np.array([[c, -s], [s, c]]), np.array([3.0, -5.0])
    points = state.control_points(0) @ rotation.T + shift
    poses = np.column_stack([state.poses[:, :2] @ rotation.T + shift, state.poses[:, 2] + 0.7])
    np.testing.assert_allclose(gauge.beside(points, poses).residual, 0.0, atol=1e-9)
    np.testing.assert_allclose(
        gauge.cost(points, poses), gauge.cost(state.control_points(0), state.poses), atol=1e-6
    )
