"""The gauge of a whole curve: its rows and Jacobians, and that the map stays as free as it was."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.batch.system import CurveGauge, curve_gauge
from pathspace_graph.mapping.state import State

from ..scenes.batch import state_of, straight

Array = NDArray[np.float64]


@cache
def scene() -> tuple[State, CurveGauge]:
    _, state = straight()
    return state, curve_gauge(state, 0, 0.2)


def test_it_has_no_residual_where_it_begins() -> None:
    state, gauge = scene()
    np.testing.assert_allclose(gauge.beside(state.control_points(0), state.poses).residual, 0.0, atol=1e-9)


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
    rows, h = gauge.beside(points, poses), 1e-6
    for k in range(3):
        step = h * np.eye(3)[k]
        slope = gauge.beside(points, poses + step).residual - gauge.beside(points, poses - step).residual
        np.testing.assert_allclose(rows.jacobian[:, 2 + k], slope / (2.0 * h), atol=1e-6)
    for k in range(2):
        step = h * np.eye(2)[k]
        slope = gauge.beside(points + step, poses).residual - gauge.beside(points - step, poses).residual
        np.testing.assert_allclose(rows.jacobian[:, k], slope / (2.0 * h), atol=1e-6)


def test_the_jacobians_of_smoothness_are_its_derivatives() -> None:
    """The residuals are far from zero."""
    state, gauge = scene()
    rng = np.random.default_rng(1)
    points = state.control_points(0) + rng.normal(0.0, 0.5, state.control_points(0).shape)
    poses = state.poses + rng.normal(0.0, 0.3, state.poses.shape)
    rows, place = gauge.smooth(points, poses), {key: k for k, key in enumerate(gauge.keys.tolist())}
    neighbours = np.array([[place[key] for key in row] for row in rows.keys[:, :3].tolist()])
    change, h = rng.normal(size=points.shape), 1e-6
    ends = [gauge.smooth(points + sign * h * change, poses).residual for sign in (1.0, -1.0)]
    linear = (rows.jacobian[:, :6] * change[neighbours].reshape(len(rows), -1)).sum(axis=1)
    np.testing.assert_allclose(linear, (ends[0] - ends[1]) / (2.0 * h), atol=1e-6)
    turn = h * np.array([0.0, 0.0, 1.0])
    ends = [gauge.smooth(points, poses + sign * turn).residual for sign in (1.0, -1.0)]
    np.testing.assert_allclose(rows.jacobian[:, 8], (ends[0] - ends[1]) / (2.0 * h), atol=1e-6)
    np.testing.assert_array_equal(rows.jacobian[:, 6:8], 0.0)


def test_all_rows_together_make_the_cost() -> None:
    state, gauge = scene()
    rng = np.random.default_rng(1)
    points = state.control_points(0) + rng.normal(0.0, 0.5, state.control_points(0).shape)
    rows = gauge.beside(points, state.poses).residual, gauge.smooth(points, state.poses).residual
    cost = 0.5 * sum(residual @ residual for residual in rows)
    np.testing.assert_allclose(gauge.cost(points, state.poses), cost)


def test_no_row_is_changed_by_a_turn_of_the_map_with_its_poses() -> None:
    """Linearized in the map frame, a bent curve would seem to hold its heading."""
    state, gauge = scene()
    rng = np.random.default_rng(2)
    points = state.control_points(0) + rng.normal(0.0, 0.5, state.control_points(0).shape)
    rows, place = gauge.smooth(points, state.poses), {key: k for k, key in enumerate(gauge.keys.tolist())}
    neighbours = np.array([[place[key] for key in row] for row in rows.keys[:, :3].tolist()])
    by_turn = np.column_stack([-points[:, 1], points[:, 0]])
    change = (rows.jacobian[:, :6] * by_turn[neighbours].reshape(len(rows), -1)).sum(axis=1)
    np.testing.assert_allclose(change + rows.jacobian[:, 8], 0.0, atol=1e-9)
    assert np.abs(rows.jacobian[:, 8]).max() > 1e-3


def test_a_map_that_moves_with_its_poses_costs_nothing() -> None:
    """It is turned and shifted as a whole."""
    state, gauge = scene()
    c, s = np.cos(0.7), np.sin(0.7)
    rotation, shift = np.array([[c, -s], [s, c]]), np.array([3.0, -5.0])
    points = state.control_points(0) @ rotation.T + shift
    poses = np.column_stack([state.poses[:, :2] @ rotation.T + shift, state.poses[:, 2] + 0.7])
    np.testing.assert_allclose(gauge.beside(points, poses).residual, 0.0, atol=1e-9)
    np.testing.assert_allclose(
        gauge.cost(points, poses), gauge.cost(state.control_points(0), state.poses), atol=1e-6
    )


def test_an_anchor_has_no_gradient_and_its_own_sigma() -> None:
    _, gauge = scene()
    rows = gauge.anchor()
    np.testing.assert_array_equal(rows.residual, 0.0)
    assert len(rows) == 2 * len(gauge.keys)
    np.testing.assert_allclose((rows.jacobian**2).sum(axis=1), gauge.sigma_anchor**-2.0)


def test_rows_on_control_points_alone_have_factors_of_their_own() -> None:
    """No factor of a pose has their number."""
    state, gauge = scene()
    points = state.control_points(0)
    seen = [gauge.beside(points, state.poses).owner, gauge.smooth(points, state.poses).owner]
    assert np.concatenate(seen).min() >= 0
    assert gauge.anchor().owner.max() < 0


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
