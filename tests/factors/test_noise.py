"""Noise: whitening, Huber's loss, and what was measured of a drive."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.noise import (
    MeasuredNoise,
    RayNoise,
    TwistNoise,
    huber_loss,
    huber_roots,
    huber_weights,
    whiteners,
)
from pathspace_graph.factors.odometry import integrate_twists
from pathspace_graph.factors.se2 import rotation


def test_huber_weights_bound_the_pull_of_a_row() -> None:
    """Weight times residual is the derivative of Huber's loss: the residual itself, then the threshold."""
    z = np.array([-50.0, -1.5, -0.2, 0.0, 1.0, 1.5, 2.0, 1e6])
    np.testing.assert_allclose(huber_weights(z, 1.5) * z, np.clip(z, -1.5, 1.5), rtol=1e-15)
    np.testing.assert_array_equal(huber_weights(z, np.inf), 1.0)


def test_hubers_loss_by_hand() -> None:
    """With threshold 2: z^2 / 2 up to 2, and 2 (|z| - 1) beyond."""
    z = np.array([0.0, 1.0, -2.0, 5.0, -101.0])
    np.testing.assert_allclose(huber_loss(z, 2.0), [0.0, 0.5, 2.0, 8.0, 200.0], rtol=1e-15)
    np.testing.assert_allclose(huber_loss(z, np.inf), 0.5 * z**2, rtol=1e-15)


@pytest.mark.parametrize("threshold", [1.5, np.inf])
def test_huber_roots_have_the_loss_as_half_their_squares(threshold: float) -> None:
    z = np.array([-4.0, -1.0, 0.0, 1.5, 100.0])
    roots = huber_roots(z, threshold)
    np.testing.assert_allclose(0.5 * roots**2, huber_loss(z, threshold), rtol=1e-14)
    np.testing.assert_array_equal(np.sign(roots), np.sign(z))


def test_whitened_rows_are_independent_and_of_unit_variance() -> None:
    rng = np.random.default_rng(2)
    roots = rng.normal(0.0, 1.0, (50, 2, 2)) + np.eye(2)
    covariances = roots @ np.swapaxes(roots, 1, 2)
    w = whiteners(covariances)
    whitened = w @ covariances @ np.swapaxes(w, 1, 2)
    np.testing.assert_allclose(whitened, np.tile(np.eye(2), (50, 1, 1)), atol=1e-8)


ALONG = RayNoise(np.array([0.05, 0.03]), 0.8, 2.0)
ACROSS = RayNoise(np.array([0.01, 0.005]), 0.4, 0.5)


def measured_noise(**fields: object) -> MeasuredNoise:
    """Returns noise of which only some fields matter."""
    return MeasuredNoise(np.array([0.1, 0.05, 0.01]), np.array([0.02, 0.01, 0.003]), 0.04, **fields)  # type: ignore[arg-type]


def gauss_markov(count: int, sequences: int, step: float) -> Array:
    """Returns stationary sequences (sequences, count) of unit variance that correlate by `exp(-step)`."""
    rng, rho = np.random.default_rng(0), np.exp(-step)
    values = [rng.normal(size=sequences)]
    for _ in range(count - 1):
        values.append(rho * values[-1] + np.sqrt(1.0 - rho**2) * rng.normal(size=sequences))
    return np.array(values).T


@pytest.mark.parametrize(("share", "time", "count"), [(0.8, 2.0, 12), (0.3, 0.4, 30), (1.0, 50.0, 5)])
def test_inflation_is_that_of_the_mean_of_errors_that_partly_stay(
    share: float, time: float, count: int
) -> None:
    """30000 sequences, whose variance is known to `sqrt(2 / 30000)`, 0.8 percent."""
    period, sequences = 0.15, 30000
    stays = gauss_markov(count, sequences, period / time)
    white = np.random.default_rng(1).normal(size=(sequences, count))
    errors = np.sqrt(share) * stays + np.sqrt(1.0 - share) * white
    by_hand = count * float((errors.mean(axis=1) ** 2).mean())
    found = RayNoise(np.array([0.1, 0.0]), share, time).inflation(count, period)
    assert found == pytest.approx(by_hand, rel=0.03)


def test_inflation_by_hand() -> None:
    """One error is itself; of two with correlation c the mean has the variance `(1 + c) / 2`."""
    assert ALONG.inflation(1, 0.1) == ALONG.inflation(0, 0.1) == 1.0
    assert RayNoise(np.zeros(2)).inflation(40, 0.1) == 1.0
    assert ALONG.inflation(2, 0.1) == pytest.approx(1.0 + 0.8 * np.exp(-0.05), rel=1e-12)
    assert RayNoise(np.zeros(2), 1.0, 1e9).inflation(7, 0.1) == pytest.approx(7.0, rel=1e-6)


@pytest.mark.parametrize("bearing", [0.0, 0.3, -2.5])
@pytest.mark.parametrize("inflated", [False, True])
def test_covariances_are_along_the_ray_and_across_it(bearing: float, inflated: bool) -> None:
    """At 10 m: 0.35 m along and 0.06 m across, turned with the ray; inflated, each by its own factor."""
    noise = measured_noise(along=ALONG, across=ACROSS, count=20, period=0.1)
    points = np.array([[10.0, 0.0], [4.0, 0.0]]) @ rotation(bearing).T
    along, across = (one.inflation(20, 0.1) if inflated else 1.0 for one in (ALONG, ACROSS))
    assert not inflated or along > 10.0 > across > 3.0
    found = noise.covariances(points, inflated=inflated)
    assert found is not None
    turn = rotation(bearing)
    for covariance, (a, b) in zip(found, [(0.35, 0.06), (0.17, 0.03)], strict=True):
        expected = turn @ np.diag([along * a**2, across * b**2]) @ turn.T
        np.testing.assert_allclose(covariance, expected, atol=1e-14)


def test_a_detection_at_the_sensor_itself_has_a_covariance_and_unknown_noise_has_none() -> None:
    noise = measured_noise(along=ALONG, across=ACROSS)
    at_sensor = noise.covariances(np.zeros((1, 2)), inflated=False)
    assert at_sensor is not None
    np.testing.assert_allclose(at_sensor, [0.01**2 * np.eye(2)], atol=1e-15)
    assert measured_noise().covariances(np.ones((3, 2)), inflated=True) is None
    empty = noise.covariances(np.zeros((0, 2)), inflated=True)
    assert empty is not None and empty.shape == (0, 2, 2)


def test_a_twist_with_the_noise_of_both_parts_drifts_like_them_together() -> None:
    """At rest, 250 twists of 0.04 s: `T (sigma^2 dt + drift^2)` in each direction."""
    noise = measured_noise()
    durations, expected = np.full(250, 0.04), 10.0 * np.array([0.02, 0.01, 0.003]) ** 2
    expected += 10.0 * np.array([0.1, 0.05, 0.01]) ** 2 * 0.04
    walked = integrate_twists(durations, np.zeros((250, 3)), noise.twist.sigmas(durations)).covariance
    np.testing.assert_allclose(np.diag(walked), expected, rtol=1e-9)


def test_the_drift_of_a_twist_depends_on_time_and_not_on_the_rate() -> None:
    noise = TwistNoise(np.zeros(3), np.array([0.02, 0.01, 0.003]))
    for durations in (np.full(5, 0.2), np.full(50, 0.02), np.array([0.0, 0.1, 0.9])):
        twists = np.zeros((len(durations), 3))
        walked = integrate_twists(durations, twists, noise.sigmas(durations)).covariance
        np.testing.assert_allclose(np.diag(walked), noise.drift**2, rtol=1e-6)


def test_detections_without_the_constant_errors_of_the_sensor_by_hand() -> None:
    """Turned by 0.02 rad, 0.1 m to the left, 0.05 s old, 10 % and 0.2 m too long."""
    noise = measured_noise(sensor=np.array([0.02, 0.1, 0.05, 0.1, 0.2]))
    points, twist = np.array([[10.0, 0.0], [0.0, -5.0]]), np.array([8.0, 0.0, 0.4])
    expected = [
        [10.0 - 0.05 * 8.0 - 1.0 - 0.2, 0.2 + 0.1 - 0.05 * 4.0],
        [0.1 - 0.05 * (8.0 + 2.0), -5.0 + 0.1 + 0.5 + 0.2],
    ]
    np.testing.assert_allclose(noise.corrected(points, twist), expected, atol=1e-12)


@pytest.mark.parametrize(("share", "time"), [(0.0, 1.0), (0.5, 0.4), (0.8, 3.0)])
def test_the_inflation_of_a_slope_is_that_of_drawn_errors(share: float, time: float) -> None:
    count, period, rng = 12, 0.2, np.random.default_rng(0)
    lag = period * np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
    correlation = share * np.exp(-lag / time) + (1.0 - share) * np.eye(count)
    errors = rng.multivariate_normal(np.zeros(count), correlation, 40_000)
    variance = np.polyfit(period * np.arange(count), errors.T, 1)[0].var()
    independent = 1.0 / (period**2 * count * (count**2 - 1) / 12)
    found = RayNoise(np.array([0.1, 0.0]), share, time).inflation_of_slope(count, period)
    assert found == pytest.approx(variance / independent, rel=0.03)


def test_stated_covariances_grow_along_and_across_the_ray_where_errors_stay() -> None:
    """At a point on the diagonal, with errors across the ray that stay for ever and others that do not."""
    points, stated = np.array([[5.0, 5.0]]), np.array([[[0.04, 0.01], [0.01, 0.09]]])
    stays = RayNoise(np.array([0.0, 0.01]), 1.0, 1e9)
    noise = MeasuredNoise(
        np.ones(3), np.ones(3), 0.02, along=RayNoise(np.array([0.1, 0.0])), across=stays, count=4
    )
    turn = np.array([[1.0, -1.0], [1.0, 1.0]]) / np.sqrt(2.0)
    expected = turn @ np.diag([1.0, 2.0]) @ turn.T @ stated[0] @ turn @ np.diag([1.0, 2.0]) @ turn.T
    np.testing.assert_allclose(noise.inflated(points, stated)[0], expected, atol=1e-12)
    white = replace(noise, across=noise.along)
    assert white.inflated(points, stated) is stated
    assert replace(noise, along=None).inflated(points, stated) is stated
