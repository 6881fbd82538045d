"""Curves of the filter's state: their blocks in x, extension, replacement, and the vehicle beside them."""

from __future__ import annotations

import numpy as np
import pytest

from pathspace_graph.baselines.ckf import HEAD, SIGMA_START, Belief, CurveState
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.settings.mapper import CkfSettings, MapperSettings
from pathspace_graph.spline.bspline import BSpline

from .scenes import COVARIANCE, around, begin, bend, straight_rows

UNBENT = CkfSettings(sigma_bend=1e9)
"""With these settings the expansion has no prior on the bending, as in the paper."""


def test_the_control_points_of_the_left_curve_come_first() -> None:
    state = straight_rows()
    assert state.offset(LEFT) == 0 and state.offset(RIGHT) == 4
    np.testing.assert_array_equal(state.columns(RIGHT, np.array([1])), HEAD + np.array([10, 11]))
    joined = np.concatenate([state.control_points(LEFT), state.control_points(RIGHT)])
    np.testing.assert_array_equal(joined, state.belief.points)
    entries = state.columns(RIGHT, np.arange(4))
    np.testing.assert_array_equal(state.covariance(RIGHT), state.belief.covariance[np.ix_(entries, entries)])


def test_a_new_curve_runs_along_its_detections() -> None:
    state = CurveState(Belief(np.zeros(3), np.zeros((3, 3))), MapperSettings())
    begin(state, LEFT, np.array([[2.0, 1.0], [8.0, 1.0], [8.0, 7.0]]))
    curve = state.spline(LEFT)
    assert curve.domain == (0.0, 12.0)
    np.testing.assert_allclose(curve.control_points, [[2, 1], [6, 1], [8, 3], [8, 7]], atol=1e-6)
    variances = np.diagonal(state.covariance(LEFT))
    np.testing.assert_allclose(variances[[0, 1, 6, 7]], 0.01 + SIGMA_START**2, atol=1e-9)
    interpolated = (2.0**2 + 4.0**2) / 6.0**2 * 0.01  # a third of the way between two detections
    np.testing.assert_allclose(variances[2:6], interpolated + SIGMA_START**2, atol=1e-9)


def test_an_extension_leaves_the_old_curve_as_it_was_and_ends_at_the_detection() -> None:
    state = bend(UNBENT)
    before = state.spline(LEFT)
    u = np.linspace(*before.domain, 200)
    state.extend(LEFT, np.array([17.0, 5.5]), COVARIANCE)
    after = state.spline(LEFT)
    np.testing.assert_allclose(after.evaluate(u), before.evaluate(u), atol=1e-12)
    assert after.size == before.size + 1
    np.testing.assert_allclose(after.evaluate(np.array([after.domain[1]]))[0], [17.0, 5.5], atol=1e-3)
    np.testing.assert_array_equal(after.knots[-4:], after.domain[1])


def test_an_extension_keeps_the_uncertainty_of_the_old_curve_and_adds_that_of_the_detection() -> None:
    state = bend(UNBENT)
    before, u = state.spline(LEFT), np.linspace(0.0, 8.0, 20)
    covariance = before.covariance_at(u, state.covariance(LEFT))
    state.extend(LEFT, np.array([17.0, 5.5]), COVARIANCE)
    after = state.spline(LEFT)
    np.testing.assert_allclose(after.covariance_at(u, state.covariance(LEFT)), covariance, atol=1e-9)
    end = after.covariance_at(np.array([after.domain[1]]), state.covariance(LEFT))[0]
    by_pose = 1e-4 * (np.eye(2) + np.outer([-5.5, 17.0], [-5.5, 17.0]))
    np.testing.assert_allclose(end, COVARIANCE + by_pose, atol=1e-4)


def test_the_prior_of_little_bending_bounds_extensions_without_detections_between() -> None:
    """In the paper's version, the uncertainty of the end's bending grows by 2 + sqrt 3 with each of them."""

    def largest(ckf: CkfSettings) -> float:
        state = bend(ckf)
        for k in range(8):
            state.extend(LEFT, np.array([17.0 + 5.0 * k, 3.4]), COVARIANCE)
        return float(np.sqrt(np.linalg.eigvalsh(state.belief.covariance)[-1]))

    assert largest(CkfSettings()) < 10.0
    assert largest(UNBENT) > 100.0


def test_a_replaced_curve_has_the_transformed_points_and_covariance() -> None:
    state, rng = straight_rows(), np.random.default_rng(5)
    matrix = rng.normal(size=(5, 4))
    points, covariance = state.control_points(RIGHT).copy(), state.covariance(RIGHT)
    left, cross = state.covariance(LEFT), state.belief.covariance[:3, state.columns(RIGHT, np.arange(4))]
    curve = BSpline.clamped_from(np.array([0.0, 4.0, 8.0]), np.zeros((5, 2)))
    state.replace(RIGHT, curve, matrix, 0.1)
    full = np.kron(matrix, np.eye(2))
    np.testing.assert_allclose(state.control_points(RIGHT), matrix @ points, atol=1e-12)
    np.testing.assert_allclose(
        state.covariance(RIGHT), full @ covariance @ full.T + 0.01 * np.eye(10), atol=1e-12
    )
    np.testing.assert_array_equal(state.covariance(LEFT), left)
    found = state.belief.covariance[:3, state.columns(RIGHT, np.arange(5))]
    np.testing.assert_allclose(found, cross @ full.T, atol=1e-12)


def test_the_vehicle_is_located_beside_the_curve_near_its_last_place() -> None:
    state = straight_rows()
    state.belief.mean[0] = 9.0
    state.pose_u[LEFT] = 2.0
    state.locate_vehicle()
    assert state.pose_u[LEFT] == pytest.approx(5.0, abs=1e-3)
    low, high = state.visible_range(LEFT, 2)
    np.testing.assert_allclose(low, state.pose_u[LEFT] - state.settings.gate.view_behind)
    np.testing.assert_allclose(high, state.pose_u[LEFT] + state.settings.gate.view_ahead)


def test_a_lost_vehicle_is_found_again_on_a_closed_curve() -> None:
    points = around(np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False), 10.0)
    state = CurveState(Belief(np.array([8.0, 0.0, np.pi / 2]), np.eye(3)), MapperSettings())
    state.belief.mean = np.concatenate([state.belief.mean, points.ravel()])
    state.belief.covariance = np.eye(len(state.belief.mean))
    state.curves[LEFT] = BSpline.periodic_from(np.linspace(0.0, 60.0, 13), points)
    expected = float(state.spline(LEFT).foot_points(np.array([[8.0, 0.0]])).u[0])
    state.pose_u[LEFT] = expected + 30.0
    state.locate_vehicle()
    assert state.pose_u[LEFT] % 60.0 == pytest.approx(expected % 60.0, abs=1e-3)
