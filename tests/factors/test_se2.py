"""Motions of the plane against GTSAM's Pose2 and by hand."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from pathspace_graph.factors.gtsam_factors import pose_array
from pathspace_graph.factors.se2 import (
    compose,
    inverse,
    left_of,
    move_points,
    relative,
    rotation,
    se2_exp,
    to_map,
    to_vehicle,
    wrap_angle,
)


@pytest.mark.parametrize("turn", [0.0, 1e-12, 1e-6, 0.1, 3.0, -3.0])
def test_exponential_is_gtsams_also_without_a_turn(turn: float) -> None:
    tangent = np.array([1.5, -0.4, turn])
    np.testing.assert_allclose(se2_exp(tangent[None])[0], pose_array(gtsam.Pose2.Expmap(tangent)), atol=1e-11)


def test_compose_is_gtsams_and_turns_accumulate() -> None:
    a, b = np.array([1.0, -2.0, 2.5]), np.array([0.3, 0.8, 2.0])
    expected = gtsam.Pose2(*a).compose(gtsam.Pose2(*b))
    np.testing.assert_allclose(compose(a, b)[:2], pose_array(expected)[:2], atol=1e-12)
    assert compose(a, b)[2] == 4.5


def test_wrap_angle_is_half_open() -> None:
    angles = np.array([np.pi, -np.pi, 3.0 * np.pi, 0.0, 2.0 * np.pi + 0.1, -0.1])
    np.testing.assert_allclose(wrap_angle(angles), [np.pi, np.pi, np.pi, 0.0, 0.1, -0.1], atol=1e-12)


def test_to_map_is_the_rigid_transform() -> None:
    points = to_map(np.array([[1.0, 2.0], [1.0, 0.0]]), np.array([[3.0, 4.0, np.pi / 2], [0.0, 0.0, np.pi]]))
    np.testing.assert_allclose(points, [[1.0, 5.0], [-1.0, 0.0]], atol=1e-12)


def test_the_vehicle_frame_is_the_inverse_of_the_map_frame() -> None:
    rng = np.random.default_rng(1)
    points, poses = rng.normal(size=(9, 2)), rng.normal(size=(9, 3)) * 5.0
    np.testing.assert_allclose(to_vehicle(to_map(points, poses), poses), points, atol=1e-12)
    quarter = to_vehicle(np.array([[1.0, 5.0]]), np.array([[3.0, 4.0, np.pi / 2]]))
    np.testing.assert_allclose(quarter, [[1.0, 2.0]], atol=1e-12)


def test_poses_are_composed_row_by_row() -> None:
    rng = np.random.default_rng(0)
    poses, deltas = rng.normal(size=(5, 3)), rng.normal(size=(5, 3))
    found = compose(poses, deltas)
    for k in range(5):
        np.testing.assert_allclose(found[k], compose(poses[k], deltas[k]), atol=1e-15)
    np.testing.assert_array_equal(compose(poses, deltas[0])[2], compose(poses[2], deltas[0]))


def test_a_quarter_turn_leads_from_ahead_to_the_left() -> None:
    np.testing.assert_allclose(rotation(np.pi / 2.0) @ [2.0, 0.0], [0.0, 2.0], atol=1e-15)


def test_an_inverse_undoes_a_motion_of_poses_and_of_points() -> None:
    """The heading is not wrapped; a pose seen from another is composed with the other's inverse."""
    pose, other = np.array([3.0, -2.0, 7.5]), np.array([-1.0, 4.0, 0.3])
    np.testing.assert_allclose(compose(pose, inverse(pose)), 0.0, atol=1e-14)
    np.testing.assert_allclose(compose(inverse(pose), other), relative(pose, other), atol=1e-14)
    points = np.array([[1.0, 2.0], [-5.0, 0.5]])
    np.testing.assert_allclose(move_points(inverse(pose), move_points(pose, points)), points, atol=1e-14)
    np.testing.assert_allclose(move_points(pose, points)[0], compose(pose, np.append(points[0], 0.0))[:2])


def test_a_quarter_turn_to_the_left_is_the_rotation_by_a_right_angle() -> None:
    vectors = np.array([[1.0, 0.0], [0.0, 2.0], [-3.0, 0.5]])
    np.testing.assert_allclose(left_of(vectors), vectors @ rotation(np.pi / 2).T, atol=1e-12)
