"""Weak priors of control points: rows and Jacobians, what they hold and what they leave free."""

from __future__ import annotations

from functools import cache

import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.batch.system import weak_priors
from pathspace_graph.front_end.log_odometry import half_square
from pathspace_graph.graph.variables import pose_keys
from pathspace_graph.mapping.curve_map import factor_beside
from pathspace_graph.mapping.detection_rows import WeakPriors
from pathspace_graph.mapping.state import State
from pathspace_graph.settings.mapper import GaugeSettings
from pathspace_graph.spline.boundary import Boundary

from ..scenes.batch import state_of, straight
from ..scenes.graph import dense_rows

Array = NDArray[np.float64]
GAUGE = GaugeSettings()


@cache
def scene() -> tuple[State, WeakPriors]:
    state = straight()[1]
    return state, weak_priors(state, GAUGE)[0]


def bent(rng: np.random.Generator) -> State:
    """The scene with other control points and poses."""
    state = scene()[0].copy()
    state.control_points(0)[:] += rng.normal(0.0, 0.5, state.control_points(0).shape)
    state.poses[:] += rng.normal(0.0, 0.3, state.poses.shape)
    return state


def test_a_place_has_no_residual_where_it_was_taken() -> None:
    state, weak = scene()
    np.testing.assert_allclose(weak.rows(state.variables)[0].residual, 0.0, atol=1e-9)


def test_a_slide_along_the_curve_costs_its_share_of_the_spacing_and_one_across_next_to_nothing() -> None:
    state, weak = scene()
    spacing = float(np.mean(state.boundaries[0].nominal))
    for direction, sigma in (([1.0, 0.0], GAUGE.sigma_spacing * spacing), ([0.0, 1.0], GAUGE.sigma_anchor)):
        moved = state.copy()
        moved.control_points(0)[:] += direction
        residual = weak.rows(moved.variables)[0].residual.reshape(-1, 2)
        np.testing.assert_allclose(np.hypot(*residual.T), 1.0 / sigma, rtol=1e-2)


def test_each_control_point_of_a_batch_is_held_beside_the_nearest_pose() -> None:
    """That is within half the distance of two cycles where the vehicle drove."""
    state, weak = scene()
    boundary, poses = state.boundaries[0], state.poses
    x = boundary.evaluate(state.control_points(0), boundary.abscissae)[:, 0]
    driven = (x > poses[0, 0]) & (x < poses[-1, 0])
    assert driven.sum() > 3
    assert np.abs(x[driven] - poses[weak.cycle[driven], 0]).max() < 0.31


def test_the_jacobians_are_the_derivatives() -> None:
    weak, state = scene()[1], bent(np.random.default_rng(0))
    variables, h = state.variables, 1e-6
    J, _, _ = dense_rows(weak.rows(variables), variables.keys)

    def residual(values: Array) -> Array:
        there = state.copy().variables
        there.values[:] = values
        return np.concatenate([rows.residual for rows in weak.rows(there)])

    for k, step in enumerate(h * np.eye(len(variables.values))):
        slope = (residual(variables.values + step) - residual(variables.values - step)) / (2.0 * h)
        np.testing.assert_allclose(J[:, k], slope, atol=1e-6)


def test_a_map_that_moves_with_its_poses_costs_no_more() -> None:
    """It is turned and shifted as a whole."""
    weak, state = scene()[1], bent(np.random.default_rng(1))
    c, s = np.cos(0.7), np.sin(0.7)
    turn, shift, moved = np.array([[c, -s], [s, c]]), np.array([3.0, -5.0]), state.copy()
    moved.control_points(0)[:] = state.control_points(0) @ turn.T + shift
    moved.poses[:] = np.column_stack([state.poses[:, :2] @ turn.T + shift, state.poses[:, 2] + 0.7])
    before, after = (half_square(weak.rows(one.variables)) for one in (state, moved))
    assert before > 0.1
    assert after == pytest.approx(before)


def test_a_parabola_costs_its_second_differences() -> None:
    """On `y = k x^2` each is `2 k` times the squared mean distance of control points."""
    state, k = scene()[0].copy(), 0.01
    boundary = state.boundaries[0]
    u, mean = boundary.abscissae, float(np.mean(boundary.nominal))
    state.control_points(0)[:] = np.column_stack([u, k * u**2])
    bending = scene()[1].rows(state.variables)[1]
    expected = 0.5 * (boundary.size - 2) * (2.0 * k * mean / GAUGE.sigma_smoothness) ** 2
    assert half_square([bending]) == pytest.approx(expected)


def test_a_closed_curve_bends_across_its_seam_too() -> None:
    knots, state = np.arange(-9.0, 34.0, 3.0), State()
    closed = Boundary(knots, True, scene()[0].boundaries[0].settings)
    angle = 2.0 * np.pi * np.arange(8) / 8
    circle = 5.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    state.add_boundary(0, closed, circle)
    state.variables.insert(pose_keys(np.array([0])), np.zeros(3))
    weak = WeakPriors.of(state, 0, closed.everything, np.zeros(8, np.intp), GAUGE)
    numbers = weak.triples - state.control_keys(0)[0]
    assert numbers.tolist() == [[(j - 2) % 8, (j - 1) % 8, j] for j in range(8)]
    np.testing.assert_allclose(weak.bending, np.tile([1.0, -2.0, 1.0], (8, 1)) / 3.0)
    along = weak.whitener[:, 0] * GAUGE.sigma_spacing * 3.0
    np.testing.assert_allclose(along, np.column_stack([-np.sin(angle), np.cos(angle)]), atol=1e-12)


def test_a_curve_of_two_control_points_has_no_second_difference() -> None:
    state = state_of({0: np.column_stack([np.arange(0.0, 40.0, 3.0), np.full(14, 2.0)])}, np.zeros((2, 3)))
    two = WeakPriors.of(state, 0, np.array([0, 1]), np.zeros(2, np.intp), GAUGE)
    assert not two.bending.any()


def test_the_factor_of_gtsam_is_the_rows() -> None:
    weak, state = scene()[1], bent(np.random.default_rng(2))
    place = weak.rows(state.variables)[0]
    factor = factor_beside(weak, 3)
    values = state.variables.gtsam_values(np.array(factor.keys()))
    linear = gtsam.JacobianFactor(factor.linearize(values))
    A, b = linear.jacobian()
    rows = place.where(slice(6, 8))
    c, s = np.cos(state.poses[weak.cycle[3], 2]), np.sin(state.poses[weak.cycle[3], 2])
    to_map = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    assert list(linear.keys()) == list(factor.keys())
    np.testing.assert_allclose(A[:, :2], rows.jacobian[:, 3:], atol=1e-12)
    np.testing.assert_allclose(A[:, 2:], rows.jacobian[:, :3] @ to_map, atol=1e-12)
    np.testing.assert_allclose(b, -rows.residual, atol=1e-12)


def test_a_hairpin_holds_each_control_point_beside_the_leg_of_its_own_direction() -> None:
    """The other leg is nearer."""
    x = np.arange(0.0, 40.0, 1.0)
    there = np.column_stack([x, np.zeros((len(x), 2))])
    back = np.column_stack([x[::-1], np.full(len(x), 3.0), np.full(len(x), np.pi)])
    points = np.column_stack([x, np.full(len(x), 2.0)])
    weak = weak_priors(state_of({0: points}, np.concatenate([there, back])), GAUGE)[0]
    assert weak.cycle.max() < len(there)


def test_an_open_curve_over_itself_is_held_by_the_poses_of_its_own_stretch() -> None:
    """It turns by a whole turn and a quarter; the second time the poses are nearer to the first stretch."""
    phi = np.linspace(0.0, 2.5 * np.pi, 120)
    spiral = (20.0 + 0.5 * phi / phi[-1])[:, None] * np.column_stack([np.cos(phi), np.sin(phi)])
    driven = 22.0 - 0.5 * phi / phi[-1]
    poses = np.column_stack([driven * np.cos(phi), driven * np.sin(phi), phi + 0.5 * np.pi])
    weak = weak_priors(state_of({0: spiral}, poses), GAUGE)[0]
    assert (np.diff(weak.cycle) >= 0).all()
    assert np.abs(weak.place[:, 0]).max() < 3.0
