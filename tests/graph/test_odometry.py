"""The chain of odometry: its rows, its calibration and its prediction, by hand and by numeric derivatives."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.factors.odometry import IntegratedOdometry, integrate_twists, odometry_residuals
from pathspace_graph.factors.se2 import compose
from pathspace_graph.graph.keys import CALIBRATION_KEY, POSE, pose_key, pose_keys
from pathspace_graph.graph.odometry import (
    OdometryChain,
    calibrated_delta,
    odometry_factor,
    odometry_rows,
    through_odometry,
)
from pathspace_graph.graph.variables import Variables

from ..scenes.jacobians import assert_jacobians

Array = NDArray[np.float64]

SIGMA = np.array([0.25, 0.12, 0.035])


def random_interval(rng: np.random.Generator) -> IntegratedOdometry:
    """Returns half a second of a racing car that slides and turns hard."""
    twists = rng.normal(size=(10, POSE)) * [2.0, 0.5, 0.6] + [8.0, 0.0, 0.3]
    return integrate_twists(np.full(10, 0.05), twists, SIGMA)


def straight(length: float) -> IntegratedOdometry:
    """Returns one second straight ahead."""
    return integrate_twists(np.ones(1), np.array([[length, 0.0, 0.0]]), SIGMA)


def scene(seed: int, count: int = 4, first_cycle: int = 7) -> tuple[OdometryChain, Variables]:
    """Returns a chain of random intervals, and poses far from where it leads."""
    rng = np.random.default_rng(seed)
    variables = Variables()
    variables.insert(np.array([CALIBRATION_KEY]), rng.normal(0.0, 0.1, 2))
    variables.insert(pose_keys(first_cycle + np.arange(count + 1)), rng.normal(0.0, 3.0, POSE * (count + 1)))
    variables.first_cycle = first_cycle
    return OdometryChain([random_interval(rng) for _ in range(count)]), variables


def test_intervals_come_in_at_the_end_and_leave_at_the_beginning() -> None:
    rng = np.random.default_rng(0)
    intervals = [random_interval(rng) for _ in range(4)]
    chain = OdometryChain(intervals[:2])
    for interval in intervals[2:]:
        chain.append(interval)
    chain.drop_first()
    assert len(chain) == 3
    for found, expected in zip(chain.intervals, intervals[1:], strict=True):
        np.testing.assert_array_equal(found.delta, expected.delta)
        np.testing.assert_array_equal(found.whitener, expected.whitener)
        np.testing.assert_array_equal(found.calibration_jacobian, expected.calibration_jacobian)
        np.testing.assert_allclose(found.covariance, expected.covariance, rtol=1e-5, atol=1e-9)


def test_a_chain_of_nothing_has_no_rows() -> None:
    _, variables = scene(0, count=0)
    chain = OdometryChain()
    assert len(chain) == 0
    assert chain.intervals == []
    assert chain.rows(variables, np.array([7])) == []


@pytest.mark.parametrize("seed", range(3))
def test_terms_are_the_whitened_residuals_with_the_calibrations_share(seed: int) -> None:
    chain, variables = scene(seed)
    poses, calibration = variables.poses, variables.calibration
    residual, _ = chain.terms(slice(None), poses, calibration)
    for k, interval in enumerate(chain.intervals):
        off, _, _ = odometry_residuals(poses[k : k + 1], poses[k + 1 : k + 2], interval.delta[None])
        expected = interval.whitener @ (off[0] + interval.calibration_jacobian @ calibration)
        np.testing.assert_allclose(residual[k], expected, rtol=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_derivatives_of_the_terms_far_from_zero(seed: int) -> None:
    chain, variables = scene(seed, count=1)

    def function(calibration: Array, pose: Array, following: Array) -> tuple[Array, ...]:
        residual, jacobian = chain.terms(slice(None), np.stack([pose, following]), calibration)
        by_calibration, by_pose, by_following = np.split(jacobian[0], [2, 2 + POSE], axis=1)
        return residual[0], by_calibration, by_pose, by_following

    assert_jacobians(function, [variables.calibration.copy(), *variables.poses.copy()])


def test_rows_are_of_the_cycles_that_are_asked_for_and_the_newest_pose_has_none() -> None:
    chain, variables = scene(1)
    (rows,) = chain.rows(variables, np.array([8, 10, 11]))
    np.testing.assert_array_equal(rows.owner, np.repeat([8, 10], POSE))
    expected = [[CALIBRATION_KEY, pose_key(cycle), pose_key(cycle + 1)] for cycle in (8, 10)]
    np.testing.assert_array_equal(rows.keys, np.repeat(expected, POSE, axis=0))
    terms = chain.terms(np.array([1, 3]), variables.poses, variables.calibration)
    np.testing.assert_array_equal(rows.residual, terms[0].ravel())
    np.testing.assert_array_equal(rows.jacobian, terms[1].reshape(2 * POSE, -1))
    assert chain.rows(variables, np.array([11])) == []


def test_rows_of_terms_belong_to_the_owners_that_are_given() -> None:
    chain, variables = scene(2)
    terms = chain.terms(slice(None), variables.poses, variables.calibration)
    rows = odometry_rows(np.arange(7, 11), terms, np.array([0, 0, 1, 1]))
    np.testing.assert_array_equal(rows.owner, np.repeat([0, 1], 2 * POSE))
    np.testing.assert_array_equal(rows.keys[::POSE, 1], pose_keys(np.arange(7, 11)))


def test_a_scale_error_shortens_the_distance() -> None:
    """The odometry measured 10 m where it reads 10 % too much, so to first order the car drove 9 m."""
    np.testing.assert_allclose(calibrated_delta(straight(10.0), np.array([0.1, 0.0])), [9.0, 0.0, 0.0])


def test_a_bias_of_the_yaw_rate_turns_the_end_back_about_the_start() -> None:
    """After one second straight ahead: 0.02 rad less, and half of it times 10 m to the right."""
    found = calibrated_delta(straight(10.0), np.array([0.0, 0.02]))
    np.testing.assert_allclose(found, [10.0, -0.1, -0.02], atol=1e-12)


def test_the_correction_is_in_the_frame_of_the_end() -> None:
    """The end looks to the left, so its own error ahead is an error to the left of the start."""
    odometry = IntegratedOdometry(
        np.array([3.0, 4.0, np.pi / 2.0]),
        np.eye(3),
        np.array([[1.0, 0.0], [0.0, 0.0], [0.0, 0.0]]),
        np.eye(3),
    )
    found = calibrated_delta(odometry, np.array([0.5, 9.0]))
    np.testing.assert_allclose(found, [3.0, 3.5, np.pi / 2.0], atol=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_the_calibrated_pose_has_no_residual_to_first_order(seed: int) -> None:
    chain, variables = scene(seed, count=1)
    for size in (1e-3, 1e-4):
        calibration = size * np.array([1.0, -0.5])
        start = variables.poses[0]
        end = compose(start, calibrated_delta(chain.intervals[0], calibration))
        residual, _ = chain.terms(slice(None), np.stack([start, end]), calibration)
        assert np.abs(np.linalg.solve(chain.whiteners[0], residual[0])).max() < 100.0 * size**2


@pytest.mark.parametrize("seed", range(3))
def test_a_row_on_the_predicted_pose_reaches_what_it_is_predicted_from(seed: int) -> None:
    """Numerically, through `pose * delta * (w - G b)` with w the odometry's noise."""
    chain, _ = scene(seed, count=2)
    rng = np.random.default_rng(seed)
    start, g = rng.normal(size=POSE), rng.normal(size=(5, POSE))
    delta, G = chain.deltas[-1], chain.by_calibration[-1]
    poses = np.stack([start, compose(start, delta)])
    by_older, by_calibration, noise = through_odometry(g, poses, chain)
    by_noise = noise @ chain.whiteners[-1]  # noise is per unit variance

    def function(older: Array, calibration: Array, error: Array) -> tuple[Array, ...]:
        end = compose(compose(older, delta), error - G @ calibration)
        return g @ end, by_older, by_calibration, by_noise

    assert_jacobians(function, [start, np.zeros(2), np.zeros(POSE)])
    covariance = np.linalg.inv(chain.whiteners[-1].T @ chain.whiteners[-1])
    np.testing.assert_allclose(noise @ noise.T, by_noise @ covariance @ by_noise.T, rtol=1e-9, atol=1e-12)


def test_the_factor_is_on_both_poses_and_the_calibration() -> None:
    factor = odometry_factor(3, straight(10.0))
    assert list(factor.keys()) == [pose_key(3), pose_key(4), CALIBRATION_KEY]
