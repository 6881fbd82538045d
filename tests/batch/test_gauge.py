"""The gauge of a whole curve: its rows and Jacobians, and that the map stays as free as it was."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.batch.gauge import CurveGauge, curve_gauge
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


def test_the_rows_of_smoothness_are_linear_in_the_control_points_that_they_name() -> None:
    """Together with the other rows they make the cost."""
    state, gauge = scene()
    rng = np.random.default_rng(1)
    points = state.control_points(0) + rng.normal(0.0, 0.5, state.control_points(0).shape)
    rows, place = gauge.smooth(points), {key: k for k, key in enumerate(gauge.keys.tolist())}
    neighbours = np.array([[place[key] for key in row] for row in rows.keys.tolist()])
    linear = (rows.jacobian * points[neighbours].reshape(len(rows), -1)).sum(axis=1)
    np.testing.assert_allclose(linear, rows.residual, atol=1e-9)
    beside = gauge.beside(points, state.poses).residual
    cost = 0.5 * (beside @ beside + rows.residual @ rows.residual)
    np.testing.assert_allclose(gauge.cost(points, state.poses), cost)


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
    beside = gauge.beside(points, state.poses).owner
    alone = np.concatenate([gauge.smooth(points).owner, gauge.anchor().owner])
    assert beside.min() >= 0
    assert alone.max() < 0


def test_a_hairpin_holds_each_control_point_beside_the_leg_of_its_own_direction() -> None:
    """The other leg is nearer."""
    x = np.arange(0.0, 40.0, 1.0)
    there = np.column_stack([x, np.zeros((len(x), 2))])
    back = np.column_stack([x[::-1], np.full(len(x), 3.0), np.full(len(x), np.pi)])
    points = np.column_stack([x, np.full(len(x), 2.0)])
    gauge = curve_gauge(state_of({0: points}, np.concatenate([there, back])), 0, 0.2)
    assert gauge.cycle.max() < len(there)
