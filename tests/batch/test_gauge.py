"""The gauge of a whole curve: its rows and Jacobians, and that the map stays as free as it was."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.batch.system import CurveGauge, curve_gauge
from pathspace_graph.front_end.log_odometry import half_square
from pathspace_graph.graph.variables import are_poses
from pathspace_graph.mapping.state import State

from ..scenes.batch import SMOOTHNESS, state_of, straight

Array = NDArray[np.float64]


@cache
def scene() -> tuple[State, CurveGauge]:
    _, state = straight()
    return state, curve_gauge(state, 0, 0.2)


def test_it_has_no_residual_where_it_begins() -> None:
    state, gauge = scene()
    np.testing.assert_allclose(gauge.rows(state.control_points(0), state.poses).residual, 0.0, atol=1e-9)


def test_each_control_point_is_held_beside_the_nearest_pose() -> None:
    """That is within half the distance of two cycles where the vehicle drove."""
    state, gauge = scene()
    boundary, poses = state.boundaries[0], state.poses
    x = boundary.evaluate(state.control_points(0), boundary.abscissae)[:, 0]
    driven = (x > poses[0, 0]) & (x < poses[-1, 0])
    assert driven.sum() > 3
    assert np.abs(x[driven] - poses[gauge.cycle[driven], 0]).max() < 0.31


def test_its_jacobians_are_its_derivatives() -> None:
    state, gauge = scene()
    rng = np.random.default_rng(0)
    points = state.control_points(0) + rng.normal(0.0, 0.5, state.control_points(0).shape)
    poses = state.poses + rng.normal(0.0, 0.3, state.poses.shape)
    rows, h = gauge.rows(points, poses), 1e-6
    for k in range(3):
        step = h * np.eye(3)[k]
        slope = gauge.rows(points, poses + step).residual - gauge.rows(points, poses - step).residual
        np.testing.assert_allclose(rows.jacobian[:, 2 + k], slope / (2.0 * h), atol=1e-6)
    for k in range(2):
        step = h * np.eye(2)[k]
        slope = gauge.rows(points + step, poses).residual - gauge.rows(points - step, poses).residual
        np.testing.assert_allclose(rows.jacobian[:, k], slope / (2.0 * h), atol=1e-6)


def test_a_map_that_moves_with_its_poses_costs_nothing() -> None:
    """It is turned and shifted as a whole."""
    state, gauge = scene()
    c, s = np.cos(0.7), np.sin(0.7)
    rotation, shift = np.array([[c, -s], [s, c]]), np.array([3.0, -5.0])
    points = state.control_points(0) @ rotation.T + shift
    poses = np.column_stack([state.poses[:, :2] @ rotation.T + shift, state.poses[:, 2] + 0.7])
    np.testing.assert_allclose(gauge.rows(points, poses).residual, 0.0, atol=1e-9)


def test_the_problem_holds_the_shape_of_its_curves_as_the_window_does() -> None:
    """On a parabola `y = k x^2` each second difference is `2 k` times the squared mean distance of points."""
    system, start = straight()
    state, k, expected = start.copy(), 0.01, 0.0
    for label, boundary in state.boundaries.items():
        u, mean = boundary.abscissae, float(np.mean(boundary.nominal))
        state.control_points(label)[:] = np.column_stack([u, k * u**2])
        expected += 0.5 * (boundary.size - 2) * (2.0 * k * mean / SMOOTHNESS) ** 2
    rows = [group for group in system.rows(system.evaluate(state)) if len(group)]
    weak = [group for group in rows if (group.owner < 0).all()]
    assert not any(are_poses(group.keys).any() for group in weak)
    assert half_square(weak) == pytest.approx(expected)
    anchors = sum(len(group) for group in weak if group.keys.shape[1] == 1)
    assert anchors == state.map_points.size


def test_a_hairpin_holds_each_control_point_beside_the_leg_of_its_own_direction() -> None:
    """The other leg is nearer."""
    x = np.arange(0.0, 40.0, 1.0)
    there = np.column_stack([x, np.zeros((len(x), 2))])
    back = np.column_stack([x[::-1], np.full(len(x), 3.0), np.full(len(x), np.pi)])
    points = np.column_stack([x, np.full(len(x), 2.0)])
    gauge = curve_gauge(state_of({0: points}, np.concatenate([there, back])), 0, 0.2)
    assert gauge.cycle.max() < len(there)


def test_an_open_curve_over_itself_is_held_by_the_poses_of_its_own_stretch() -> None:
    """It turns by a whole turn and a quarter; the second time the poses are nearer to the first stretch."""
    phi = np.linspace(0.0, 2.5 * np.pi, 120)
    spiral = (20.0 + 0.5 * phi / phi[-1])[:, None] * np.column_stack([np.cos(phi), np.sin(phi)])
    driven = 22.0 - 0.5 * phi / phi[-1]
    poses = np.column_stack([driven * np.cos(phi), driven * np.sin(phi), phi + 0.5 * np.pi])
    gauge = curve_gauge(state_of({0: spiral}, poses), 0, 0.2)
    assert (np.diff(gauge.cycle) >= 0).all()
    assert np.abs(gauge.ahead).max() < 3.0
