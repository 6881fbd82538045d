"""The sensor's constant errors: corrections by hand, derivatives against numeric ones, and no shrinking."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pathspace_graph.factors import _kernels as kernels
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.noise import MeasuredNoise
from pathspace_graph.factors.se2 import compose, in_vehicle, inverse, rotation, se2_exp, to_map
from pathspace_graph.factors.sensor import SENSOR, by_bend, by_sensor, restored

TWIST = np.array([[10.0, 0.5, 0.4]])
"""The vehicle moves with this twist (m/s, m/s, rad/s)."""


def measured(point: Array, sensor: Array, twist: Array) -> Array:
    """Returns where a sensor with these errors (5,) says that a point (2,), vehicle frame, is."""
    yaw, lateral, latency, scale, bias = sensor
    seen_then = se2_exp(latency * twist[None])[0]  # the vehicle was this motion behind
    seen = rotation(seen_then[2]) @ point + seen_then[:2] - [0.0, lateral]
    distance = float(np.hypot(*seen))
    return np.asarray(rotation(-yaw) @ seen * ((1.0 + scale) * distance + bias) / distance)


@pytest.mark.parametrize(
    ("name", "value", "seen"),
    [
        ("yaw", 0.01, [10.02, 1.9]),
        ("lateral", 0.1, [10.0, 1.9]),
        ("latency", 0.05, [10.5, 2.0]),
        ("range_scale", 0.02, [10.2, 2.04]),
        ("range_bias", 0.5, [10.0 + 0.5 * 10.0 / np.sqrt(104.0), 2.0 + 0.5 * 2.0 / np.sqrt(104.0)]),
    ],
)
def test_each_error_is_corrected_by_hand(name: str, value: float, seen: list[float]) -> None:
    """A cone at (10, 2) m is seen elsewhere by a sensor with one error, at 10 m/s straight on."""
    sensor = np.zeros(5)
    sensor[SENSOR.index(name)] = value
    C = by_sensor(np.array([seen]), np.array([[10.0, 0.0, 0.0]]))
    np.testing.assert_allclose(np.array(seen) + C[0] @ sensor, [10.0, 2.0], atol=5e-3)  # to first order


def test_ranges_bend_beyond_eight_metres() -> None:
    """By 0.01 per m, a cone at 18 m is seen at 19 m: `10^2 0.01` too far."""
    near, far = np.array([[4.8, 6.4], [-1.0, 2.0]]), np.array([[10.8, 14.4]])
    np.testing.assert_array_equal(by_bend(near), 0.0)
    np.testing.assert_allclose(far * (1.0 + 0.01 * by_bend(far)[:, None]), [[11.4, 15.2]])
    unbent = MeasuredNoise(np.ones(3), np.ones(3), 0.02, range_bend=0.01).unbent(np.array([[18.0, 0.0]]))
    np.testing.assert_allclose(unbent, [[17.0, 0.0]])


@given(st.integers(0, 10**6))
def test_a_correction_is_exact_to_second_order(seed: int) -> None:
    rng = np.random.default_rng(seed)
    point, sensor = rng.uniform([3.0, -6.0], [15.0, 6.0]), rng.normal(0.0, 1e-4, 5)
    seen = measured(point, sensor, TWIST[0])
    corrected = seen + by_sensor(seen[None], TWIST)[0] @ sensor
    np.testing.assert_allclose(corrected, point, atol=3e-6)


def rows_at(sensor: Array, pose: Array, seen: Array, direction: Array, base: Array) -> tuple[float, Array]:
    """Returns the multiplied distance past `base` (2,) along a direction, and its derivatives (5,)."""
    corrected = seen + by_sensor(seen[None], TWIST)[0] @ sensor
    residual = direction @ (to_map(corrected[None], pose[None])[0] - base)
    terms = terms_of(corrected[None], pose[None], direction[None], np.array([residual]), seen[None], sensor)
    return float(terms[0][0]), terms[1][0, 3:8]


def terms_of(
    corrected: Array, poses: Array, directions: Array, residuals: Array, seen: Array, sensor: Array
) -> tuple[Array, Array]:
    """Returns residuals (m,) of corrected detections along directions (m, 2), and their derivatives."""
    count = len(seen)
    residual, _, jacobian = kernels.detection_rows(
        to_map(corrected, poses),
        np.tile(np.eye(2), (count, 1, 1)),
        poses,
        directions,
        residuals,
        np.ones((count, 1)),
        seen,
        np.tile(TWIST, (count, 1)),
        sensor,
        0.0,
    )
    return residual, jacobian


@given(st.integers(0, 10**6))
def test_derivatives_are_those_of_the_multiplied_residual(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pose, seen, base = rng.normal(0.0, 3.0, 3), rng.uniform([3.0, -6.0], [15.0, 6.0]), rng.normal(0.0, 5.0, 2)
    angle, sensor = rng.uniform(-3.0, 3.0), rng.normal(0.0, 0.02, 5)
    direction = np.array([np.cos(angle), np.sin(angle)])
    _, jacobian = rows_at(sensor, pose, seen, direction, base)
    for k, step in enumerate(1e-5 * np.eye(5)):
        ahead, _ = rows_at(sensor + step, pose, seen, direction, base)
        behind, _ = rows_at(sensor - step, pose, seen, direction, base)
        np.testing.assert_allclose(jacobian[k], (ahead - behind) / 2e-5, rtol=1e-6, atol=1e-6)


def test_without_a_calibration_residuals_are_as_they_are() -> None:
    seen, directions = np.ones((2, 2)), np.eye(2)
    residual, jacobian = terms_of(seen, np.zeros((2, 3)), directions, np.array([2.0, 3.0]), seen, np.zeros(0))
    np.testing.assert_array_equal(residual, [2.0, 3.0])
    np.testing.assert_array_equal(jacobian[:, :2], directions)
    assert jacobian.shape == (2, 3 + 2)


def test_a_smaller_world_fits_no_better() -> None:
    """Detections of cones, with noise, and the cones shrink together: the multiplied residuals do not."""
    rng = np.random.default_rng(0)
    cones, noise = rng.uniform([3.0, -6.0], [15.0, 6.0], (200, 2)), rng.normal(0.0, 0.1, (200, 2))
    seen, still = cones + noise, np.zeros((200, 3))
    for k, error in ((3, 0.05), (4, 0.3)):
        sensor = np.zeros(5)
        sensor[k] = error
        corrected = seen + by_sensor(seen, still) @ sensor
        world = cones + by_sensor(cones, still) @ sensor
        inverse, _ = restored(corrected - world, seen, still, sensor)
        residual = np.einsum("mij,mj->mi", inverse, corrected - world)
        before, after = (noise**2).sum(), (residual**2).sum()
        assert abs(after / before - 1.0) < (1e-9 if k == 3 else 0.01)
        assert ((corrected - world) ** 2).sum() / before < 1.0 - 0.5 * error * (2.0 if k == 3 else 0.05)


def test_a_direction_in_the_vehicle_is_turned_back() -> None:
    pose = np.array([[3.0, -2.0, 0.7]])
    direction = rotation(0.7) @ [0.6, 0.8]
    np.testing.assert_allclose(in_vehicle(direction[None], pose), [[0.6, 0.8]])


def test_the_motion_since_the_cone_was_seen_is_taken_back() -> None:
    """The vehicle turns while it drives: the point is where the inverse motion puts it, to first order."""
    latency, seen = 1e-3, np.array([8.0, -3.0])
    moved = compose(inverse(se2_exp(latency * TWIST)[0]), np.append(seen, 0.0))
    shift = by_sensor(seen[None], TWIST)[0, :, 2] * latency
    np.testing.assert_allclose(seen + shift, moved[:2], atol=1e-5)


@given(st.integers(0, 10**6))
def test_restored_residuals_have_their_derivatives(seed: int) -> None:
    rng = np.random.default_rng(seed)
    seen, expected = rng.uniform([3.0, -6.0], [15.0, 6.0], (4, 2)), rng.normal(0.0, 5.0, (4, 2))
    twists, sensor = np.tile(TWIST, (4, 1)), rng.normal(0.0, 0.02, 5)

    def residual(b: Array) -> tuple[Array, Array]:
        corrected = seen + by_sensor(seen, twists) @ b
        inverse, jacobian = restored(expected - corrected, seen, twists, b)
        return np.einsum("mij,mj->mi", inverse, expected - corrected), jacobian

    _, jacobian = residual(sensor)
    for k, step in enumerate(1e-5 * np.eye(5)):
        numeric = (residual(sensor + step)[0] - residual(sensor - step)[0]) / 2e-5
        np.testing.assert_allclose(jacobian[:, :, k], numeric, rtol=1e-6, atol=1e-6)


def test_residuals_of_a_known_sensor_are_as_they_are() -> None:
    inverse, jacobian = restored(np.ones((3, 2)), np.ones((3, 2)), np.zeros((3, 3)), np.zeros(0))
    np.testing.assert_array_equal(inverse, np.tile(np.eye(2), (3, 1, 1)))
    assert jacobian.shape == (3, 2, 0)
