"""Odometry between cycles: against GTSAM's Pose2, Monte Carlo, and numeric derivatives."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pathspace_graph.factors._kernels import odometry_residuals
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.odometry import MIN_SIGMA, integrate_poses, integrate_twists
from pathspace_graph.factors.se2 import compose, se2_exp

from ..scenes.jacobians import assert_jacobians

SIGMA = np.array([0.25, 0.12, 0.035])


def as_array(pose: gtsam.Pose2) -> Array:
    return np.array([pose.x(), pose.y(), pose.theta()])


def random_twists(rng: np.random.Generator, count: int) -> tuple[Array, Array]:
    """Uneven durations (s) and twists of a racing car, sliding and turning hard."""
    twists = rng.normal(size=(count, 3)) * [2.0, 0.5, 0.6] + [8.0, 0.0, 0.3]
    return rng.uniform(0.005, 0.04, count), twists


def gtsam_composition(durations: Array, twists: Array) -> gtsam.Pose2:
    pose = gtsam.Pose2()
    for dt, twist in zip(durations, twists, strict=True):
        pose = pose.compose(gtsam.Pose2.Expmap(twist * dt))
    return pose


@pytest.mark.parametrize("seed", range(4))
def test_integration_is_gtsams_composition(seed: int) -> None:
    durations, twists = random_twists(np.random.default_rng(seed), 12)
    delta = integrate_twists(durations, twists, SIGMA).delta
    np.testing.assert_allclose(delta, as_array(gtsam_composition(durations, twists)), atol=1e-12)
    for k, pose in enumerate(integrate_poses(durations, twists), start=1):
        np.testing.assert_allclose(pose, as_array(gtsam_composition(durations[:k], twists[:k])), atol=1e-12)


def test_covariance_against_monte_carlo() -> None:
    """The standard error of a sample covariance is sqrt((S_ii S_jj + S_ij^2) / n); five are allowed."""
    rng = np.random.default_rng(7)
    durations, twists = random_twists(rng, 10)
    odometry = integrate_twists(durations, twists, SIGMA)
    count = 20_000
    end = np.zeros((count, 3))
    for dt, twist in zip(durations, twists, strict=True):
        step = se2_exp((twist + rng.normal(size=(count, 3)) * SIGMA) * dt)
        c, s = np.cos(end[:, 2]), np.sin(end[:, 2])
        end[:, 0] += c * step[:, 0] - s * step[:, 1]
        end[:, 1] += s * step[:, 0] + c * step[:, 1]
        end[:, 2] += step[:, 2]
    errors, _, _ = odometry_residuals(np.zeros((count, 3)), end, np.tile(odometry.delta, (count, 1)))
    S = odometry.covariance
    standard_error = np.sqrt((np.outer(np.diag(S), np.diag(S)) + S**2) / count)
    assert (np.abs(np.cov(errors.T) - S) < 5.0 * standard_error).all()
    assert (np.abs(errors.mean(axis=0)) < 5.0 * np.sqrt(np.diag(S) / count) + 1e-4).all()


def test_covariance_of_a_straight_run_by_hand() -> None:
    """Ten steps of 0.1 s at 5 m/s: a yaw error in the middle of a step turns the rest of the path."""
    odometry = integrate_twists(np.full(10, 0.1), np.tile([5.0, 0.0, 0.0], (10, 1)), SIGMA)
    left = 5.0 * (1.0 - 0.1 * (np.arange(10) + 0.5))
    yaw = (0.1 * SIGMA[2]) ** 2
    expected = np.diag(
        [10 * (0.1 * SIGMA[0]) ** 2, 10 * (0.1 * SIGMA[1]) ** 2 + yaw * np.sum(left**2), 10 * yaw]
    )
    expected[1, 2] = expected[2, 1] = yaw * np.sum(left)
    np.testing.assert_allclose(odometry.covariance, expected, rtol=1e-10, atol=1e-15)


@pytest.mark.parametrize("seed", range(3))
def test_calibration_jacobian(seed: int) -> None:
    """It is the derivative of the end by errors of the samples, up to the midpoint rule's (w dt)^2 / 24."""
    durations, twists = random_twists(np.random.default_rng(seed), 8)
    nominal = integrate_twists(durations, twists, SIGMA)

    def misread(calibration: Array) -> tuple[Array, Array]:
        read = twists * [1.0 + calibration[0], 1.0 + calibration[0], 1.0] + [0.0, 0.0, calibration[1]]
        delta = integrate_twists(durations, read, SIGMA).delta
        error = odometry_residuals(np.zeros((1, 3)), delta[None], nominal.delta[None])[0]
        return error[0], nominal.calibration_jacobian

    truncation = np.max(np.abs(twists[:, 2]) * durations) ** 2 / 24.0
    assert truncation < 1e-4
    assert_jacobians(misread, [np.zeros(2)], tolerance=max(truncation, 1e-6))


@pytest.mark.parametrize(("durations", "twists"), [([], []), ([0.0], [[5.0, 0.0, 1.0]])])
def test_no_time_is_the_identity_with_a_finite_whitener(
    durations: list[float], twists: list[list[float]]
) -> None:
    odometry = integrate_twists(np.array(durations), np.array(twists).reshape(-1, 3), SIGMA)
    np.testing.assert_array_equal(odometry.delta, np.zeros(3))
    np.testing.assert_array_equal(odometry.covariance, np.zeros((3, 3)))
    np.testing.assert_allclose(odometry.whitener, np.eye(3) / MIN_SIGMA, rtol=1e-12)


def test_the_whitener_squared_is_the_information() -> None:
    odometry = integrate_twists(*random_twists(np.random.default_rng(9), 5), SIGMA)
    product = odometry.whitener.T @ odometry.whitener @ (odometry.covariance + MIN_SIGMA**2 * np.eye(3))
    np.testing.assert_allclose(product, np.eye(3), atol=1e-9)


def residual_function(delta: Array, calibration_jacobian: Array):
    """(start, end, calibration) -> residual of one calibrated factor, and its Jacobians."""

    def function(start: Array, end: Array, calibration: Array) -> tuple[Array, Array, Array, Array]:
        residual, by_start, by_end = odometry_residuals(start[None], end[None], delta[None])
        shifted = residual[0] + calibration_jacobian @ calibration
        return shifted, by_start[0], by_end[0], calibration_jacobian

    return function


@given(
    seed=st.integers(0, 2**32 - 1),
    offset=st.floats(0.0, 5.0),
    turn=st.sampled_from([0.0, 1e-9, 1e-4, 0.99e-3, 1.01e-3, 0.1, -1.5, 3.0, -3.1]),
)
def test_residual_jacobians_near_and_far(seed: int, offset: float, turn: float) -> None:
    """From the measured pose itself to residuals of metres and nearly half a turn."""
    rng = np.random.default_rng(seed)
    start = np.append(rng.uniform(-50.0, 50.0, 2), rng.uniform(-7.0, 7.0))
    delta = np.append(rng.normal(size=2), rng.uniform(-1.0, 1.0))
    end = compose(compose(start, delta), np.append(offset * rng.normal(size=2), turn))
    function = residual_function(delta, rng.normal(size=(3, 2)))
    assert_jacobians(function, [start, end, rng.normal(size=2) * 0.01])


@pytest.mark.parametrize("start", [[0.0, 0.0, 0.0], [1e-10, 0.0, -1e-10], [0.0, 0.0, np.pi]])
def test_residual_jacobians_at_degenerate_states(start: list[float]) -> None:
    """No motion at all, from the origin and from the seam of the angle."""
    function = residual_function(np.zeros(3), np.zeros((3, 2)))
    assert_jacobians(function, [np.array(start), np.array(start), np.zeros(2)])


@given(seed=st.integers(0, 2**32 - 1))
def test_residual_is_gtsams_between_factor(seed: int) -> None:
    rng = np.random.default_rng(seed)
    start, end, delta = (np.append(rng.normal(size=2) * 5.0, rng.uniform(-3.0, 3.0)) for _ in range(3))
    factor = gtsam.BetweenFactorPose2(0, 1, gtsam.Pose2(*delta), gtsam.noiseModel.Unit.Create(3))
    values = gtsam.Values()
    values.insert(0, gtsam.Pose2(*start))
    values.insert(1, gtsam.Pose2(*end))
    residual, _, _ = odometry_residuals(start[None], end[None], delta[None])
    np.testing.assert_allclose(residual[0], factor.unwhitenedError(values), atol=1e-9)


def test_the_series_meets_the_formula() -> None:
    """On either side of the switch to a series the Jacobians are the same to 1e-9."""
    end = np.array([[3.0, -2.0, 1e-3 * (1.0 - 1e-9)], [3.0, -2.0, 1e-3 * (1.0 + 1e-9)]])
    _, by_start, by_end = odometry_residuals(np.zeros((2, 3)), end, np.zeros((2, 3)))
    np.testing.assert_allclose(by_start[0], by_start[1], atol=1e-9)
    np.testing.assert_allclose(by_end[0], by_end[1], atol=1e-9)
