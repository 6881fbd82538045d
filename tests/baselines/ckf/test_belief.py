"""The filters' state: prediction, update, new points, changes of basis, by Monte Carlo and by algebra."""

from __future__ import annotations

import numpy as np

from pathspace_graph.baselines.ckf import HEAD, Belief, point_columns, to_map_rows
from pathspace_graph.factors.odometry import IntegratedOdometry, integrate_twists
from pathspace_graph.factors.se2 import compose


def belief_with_points(seed: int = 0) -> Belief:
    """Returns a pose, three points and a calibration, all correlated."""
    rng = np.random.default_rng(seed)
    calibration = np.array([0.05, 0.04])
    belief = Belief(np.array([1.0, -2.0, 0.4]), np.diag([0.2, 0.1, 0.03]) ** 2, calibration)
    belief.add_points(rng.normal(scale=5.0, size=(3, 2)), np.tile(0.04 * np.eye(2), (3, 1, 1)))
    return belief


def half_a_second() -> IntegratedOdometry:
    return integrate_twists(np.full(25, 0.02), np.tile([6.0, 0.1, 0.8], (25, 1)), np.array([0.5, 0.3, 0.2]))


def test_prediction_has_the_moments_of_a_sample() -> None:
    belief, odometry, rng = belief_with_points(), half_a_second(), np.random.default_rng(1)
    sample = rng.multivariate_normal(belief.mean, belief.covariance, 200_000)
    noise = rng.multivariate_normal(np.zeros(3), odometry.covariance, 200_000)
    moved = sample.copy()
    error = noise - sample[:, 3:5] @ odometry.calibration_jacobian.T
    moved[:, :3] = compose(compose(sample[:, :3], odometry.delta), error)
    belief.predict(odometry)
    np.testing.assert_allclose(belief.mean, moved.mean(axis=0), atol=3e-3)
    np.testing.assert_allclose(belief.covariance, np.cov(moved.T), atol=1e-3)


def test_new_points_have_the_uncertainty_of_pose_and_detection() -> None:
    pose, covariance = np.array([1.0, -2.0, 0.4]), np.diag([0.2, 0.1, 0.03]) ** 2
    belief, reading = Belief(pose, covariance), np.array([[8.0, 1.0]])
    belief.add_points(reading, 0.04 * np.eye(2)[None])
    rng = np.random.default_rng(2)
    poses = rng.multivariate_normal(pose, covariance, 200_000)
    placed = to_map_rows(poses, rng.multivariate_normal(reading[0], 0.04 * np.eye(2), 200_000))
    calibrations = np.arange(3, HEAD)
    uncalibrated = np.delete(np.delete(belief.covariance, calibrations, 0), calibrations, 1)
    np.testing.assert_allclose(uncalibrated, np.cov(np.hstack([poses, placed]).T), atol=2e-3)


def test_a_linear_update_is_the_kalman_filter() -> None:
    """The covariance is P - P H' (H P H' + R)^-1 H P."""
    belief, rng = belief_with_points(), np.random.default_rng(4)
    columns, matrix, noise = point_columns(np.array([0, 2])), rng.normal(size=(3, 4)), 0.01 * np.eye(3)
    full = np.zeros((3, len(belief.mean)))
    full[:, columns] = matrix
    mean, covariance, measured = belief.mean.copy(), belief.covariance.copy(), rng.normal(size=3)
    gain = covariance @ full.T @ np.linalg.inv(full @ covariance @ full.T + noise)
    belief.update(columns, lambda x: x @ matrix.T, measured, noise)
    np.testing.assert_allclose(belief.mean, mean + gain @ (measured - full @ mean), atol=1e-9)
    np.testing.assert_allclose(belief.covariance, covariance - gain @ full @ covariance, atol=1e-9)


def test_transformed_points_are_exact_and_the_others_stay() -> None:
    belief = belief_with_points()
    before, covariance = belief.mean.copy(), belief.covariance.copy()
    matrix = np.array([[0.5, 0.5], [0.0, 1.0], [1.5, -0.5]])
    belief.transform_points(0, 2, matrix, np.zeros(3))
    full = np.zeros((HEAD + 8, HEAD + 6))
    full[:HEAD, :HEAD], full[HEAD + 6 :, HEAD + 4 :] = np.eye(HEAD), np.eye(2)
    full[HEAD : HEAD + 6, HEAD : HEAD + 4] = np.kron(matrix, np.eye(2))
    np.testing.assert_allclose(belief.mean, full @ before, atol=1e-12)
    np.testing.assert_allclose(belief.covariance, full @ covariance @ full.T, atol=1e-12)


def test_reordering_keeps_each_point_with_its_covariance() -> None:
    belief = belief_with_points()
    point, block = belief.points[2].copy(), belief.covariance[HEAD + 4 : HEAD + 6, :3].copy()
    belief.reorder(np.array([2, 0]))
    assert belief.points.shape == (2, 2)
    np.testing.assert_array_equal(belief.points[0], point)
    np.testing.assert_array_equal(belief.covariance[HEAD : HEAD + 2, :3], block)
