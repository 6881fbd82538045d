"""Classification against numeric derivatives, and the one Kalman update against dense algebra."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.baselines import ckf
from pathspace_graph.baselines.ckf import RIDGE, SIGMA_ALONG, classify, on_curve, to_vehicle_rows, update
from pathspace_graph.labels import LEFT, RIGHT, UNKNOWN

from .scenes import COVARIANCE, bend, detections_of, straight_rows

Array = NDArray[np.float64]

POINTS = np.array([[6.0, 2.5], [7.0, 2.6], [9.5, 3.0]])


def test_the_gate_uses_the_joint_covariance_of_pose_and_curve() -> None:
    """The derivative of the signed distance by every entry of x is taken numerically."""
    state, detections = bend(pose_variance=1e-3), detections_of(POINTS)
    state.extend(LEFT, np.array([17.0, 5.5]), COVARIANCE)
    x = state.belief.mean.copy()

    def distances(values: Array) -> Array:
        state.belief.mean[:] = values
        c, s = np.cos(values[2]), np.sin(values[2])
        points = POINTS @ np.array([[c, s], [-s, c]]) + values[:2]
        return np.asarray(state.foot_points(LEFT, points, np.zeros(3), np.full(3, 12.0)).distance)

    steps = 1e-6 * np.eye(len(x))
    gradient = np.array([(distances(x + step) - distances(x - step)) / 2e-6 for step in steps]).T
    d, settings = distances(x), state.settings
    floor = settings.ckf.sigma_model**2 + settings.gate.sigma_floor**2
    variance = np.einsum("mi,ij,mj->m", gradient, state.belief.covariance, gradient) + 0.01 + floor
    found = on_curve(state, LEFT, detections)
    np.testing.assert_array_equal(found.rows, [0, 1, 2])
    np.testing.assert_allclose(found.distances, d**2 / variance, rtol=1e-5)


def test_detections_are_classified_by_label_gate_and_the_nearer_curve() -> None:
    state = straight_rows()
    points = np.array([[6.0, 2.1], [6.0, -2.1], [7.0, 1.8], [7.0, -1.8], [8.0, 3.9], [6.0, 2.0]])
    labels = np.array([LEFT, RIGHT, UNKNOWN, UNKNOWN, LEFT, RIGHT])
    found = classify(state, detections_of(points, labels))
    np.testing.assert_array_equal(found[LEFT].rows, [0, 2])
    np.testing.assert_array_equal(found[RIGHT].rows, [1, 3])


def test_a_detection_beyond_the_end_updates_no_curve() -> None:
    assert len(classify(straight_rows(), detections_of(np.array([[18.0, 2.0]])))[LEFT].rows) == 0


def test_the_basis_of_a_detection_is_that_of_its_foot_point() -> None:
    state = bend()
    found = classify(state, detections_of(POINTS))[LEFT]
    foot = state.foot_points(LEFT, POINTS, np.zeros(3), np.full(3, 12.0))
    np.testing.assert_allclose(found.basis @ state.control_points(LEFT), foot.position, atol=1e-9)
    np.testing.assert_allclose(found.tangents, foot.tangent_unit, atol=1e-9)


def test_the_update_is_the_kalman_filter_on_the_detections() -> None:
    """With a certain pose, `z_i = sum_j B_ij c_j` with noise `K + sigma_model^2 I + sigma_along^2 t t'`."""
    state, detections = bend(pose_variance=1e-14), detections_of(POINTS)
    found, settings = classify(state, detections), state.settings.ckf
    on = found[LEFT]
    H = np.kron(on.basis, np.eye(2))
    R = np.zeros((6, 6))
    for i, tangent in enumerate(on.tangents):
        along = SIGMA_ALONG**2 * np.outer(tangent, tangent)
        R[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = COVARIANCE + settings.sigma_model**2 * np.eye(2) + along
    mean, covariance = state.control_points(LEFT).ravel().copy(), state.covariance(LEFT)
    gain = covariance @ H.T @ np.linalg.inv(H @ covariance @ H.T + R)
    update(state, detections, found)
    expected = mean + gain @ (POINTS.ravel() - H @ mean)
    np.testing.assert_allclose(state.control_points(LEFT).ravel(), expected, atol=1e-6)
    np.testing.assert_allclose(state.covariance(LEFT), covariance - gain @ H @ covariance, atol=1e-6)


def test_the_ridge_makes_no_difference_to_the_update(monkeypatch: pytest.MonkeyPatch) -> None:
    """Both sides of the innovation go through one full-rank gain, which cancels."""
    results = []
    for ridge in (RIDGE, 2.0):
        monkeypatch.setattr(ckf, "RIDGE", ridge)
        state = bend()
        detections = detections_of(POINTS)
        update(state, detections, classify(state, detections))
        results.append((state.belief.mean, state.belief.covariance))
    np.testing.assert_allclose(results[0][0], results[1][0], atol=1e-6)
    np.testing.assert_allclose(results[0][1], results[1][1], atol=1e-6)


def test_both_curves_update_the_pose_together() -> None:
    """Both rows are detected 0.2 m too far to the left, so the vehicle stands farther to the right."""
    state = straight_rows()
    points = np.array([[5.0, 2.2], [9.0, 2.2], [5.0, -1.8], [9.0, -1.8]])
    detections = detections_of(points, np.array([LEFT, LEFT, RIGHT, RIGHT]))
    state.belief.covariance[1, 1] += 1.0
    update(state, detections, classify(state, detections))
    assert -0.2 < state.belief.pose[1] < -0.1
    seen = to_vehicle_rows(state.belief.pose[None], state.control_points(RIGHT).reshape(1, -1))[0, 1::2]
    assert np.abs(seen + 1.8).max() < 0.1


def test_control_points_out_of_reach_stay_uncertain() -> None:
    """If S_z were compared with the control points directly and without a floor, they would be known."""
    state = bend()
    for k in range(4):
        state.extend(LEFT, np.array([17.0 + 5.0 * k, 3.4]), COVARIANCE)
    last, detections = state.covariance(LEFT)[-4:, -4:], detections_of(POINTS[:1])
    update(state, detections, classify(state, detections))
    np.testing.assert_allclose(state.covariance(LEFT)[-4:, -4:], last, rtol=0.05)


def test_without_detections_nothing_changes() -> None:
    state, nothing = bend(), detections_of(np.zeros((0, 2)))
    before = state.belief.mean.copy()
    update(state, nothing, classify(state, nothing))
    np.testing.assert_array_equal(state.belief.mean, before)
