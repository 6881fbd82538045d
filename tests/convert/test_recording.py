"""A record in the frame of a sensor becomes a log in that of the vehicle."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pathspace_graph.convert.messages import Points
from pathspace_graph.convert.recording import (
    Recording,
    positive_definite,
    to_log,
    twists_between,
    twists_of,
)
from pathspace_graph.convert.settings import Frames, NoiseSettings
from pathspace_graph.errors import InputError
from pathspace_graph.factors.se2 import compose, se2_exp
from pathspace_graph.io.log import ray_covariances

FILE = Path("drive")


def record(points: Points, t: float = 0.5) -> Recording:
    twists = np.array([[1.0, 0.2, 0.3], [1.0, 0.2, 0.3]])
    return Recording(np.array([0.0, 1.0]), twists, np.array([t]), [points], {})


def one(x: float, y: float, covariance: object = np.nan) -> Points:
    return Points(np.array([[x, y]]), np.broadcast_to(covariance, (1, 2, 2)).astype(float), np.zeros(1, int))


def test_points_and_covariances_go_to_the_vehicle_frame() -> None:
    """The sensor is turned to the left by 0.3 rad: its long axis, which leads to the cone, turns with it."""
    c, s, ray = np.cos(0.3), np.sin(0.3), np.array([0.8, 0.6])
    turned = np.array([0.8 * c - 0.6 * s, 0.8 * s + 0.6 * c])
    covariance = 4.0 * np.outer(ray, ray) + 0.01 * np.eye(2)
    log = to_log(record(one(4.0, 3.0, covariance)), Frames((1.0, 0.5, 0.3)), NoiseSettings(), FILE)
    np.testing.assert_allclose(log.cycles[0].points_vehicle, [[1.0, 0.5] + 5.0 * turned], atol=1e-12)
    expected = 4.0 * np.outer(turned, turned) + 0.01 * np.eye(2)
    np.testing.assert_allclose(log.cycles[0].covariances[0], expected, atol=1e-12)


def test_the_sensor_is_flipped_before_it_is_mounted() -> None:
    """What is at (4, 3) with y to the right is at (4, -3) before the sensor's turn by 0.3 rad."""
    c, s, ray = np.cos(0.3), np.sin(0.3), np.array([0.8, 0.6])
    turned = np.array([0.8 * c + 0.6 * s, 0.8 * s - 0.6 * c])
    covariance = 4.0 * np.outer(ray, ray) + 0.01 * np.eye(2)
    frames = Frames((1.0, 0.5, 0.3), y="right", y_odometry="left")
    log = to_log(record(one(4.0, 3.0, covariance)), frames, NoiseSettings(), FILE)
    np.testing.assert_allclose(log.cycles[0].points_vehicle, [[1.0, 0.5] + 5.0 * turned], atol=1e-12)
    expected = 4.0 * np.outer(turned, turned) + 0.01 * np.eye(2)
    np.testing.assert_allclose(log.cycles[0].covariances[0], expected, atol=1e-12)
    np.testing.assert_array_equal(log.odometry.twist[0], [1.0, 0.2, 0.3])


def test_a_covariance_that_is_missing_is_made_at_the_sensor() -> None:
    noise = NoiseSettings(sigma_range=0.1, sigma_range_growth=0.02, sigma_bearing=0.03)
    covariance = ray_covariances(np.array([[0.0, 5.0]]), noise.sigmas)[0]
    np.testing.assert_allclose(covariance, [[(5 * 0.03) ** 2, 0.0], [0.0, 0.2**2]], atol=1e-15)
    mounted = to_log(record(one(0.0, 5.0)), Frames((3.0, 0.0, 0.3)), noise, FILE)
    ray = np.array([-np.sin(0.3), np.cos(0.3)])
    expected = 0.2**2 * np.outer(ray, ray) + (5 * 0.03) ** 2 * (np.eye(2) - np.outer(ray, ray))
    np.testing.assert_allclose(mounted.cycles[0].covariances[0], expected, atol=1e-15)
    assert positive_definite(ray_covariances(np.zeros((1, 2)), noise.sigmas)).all()


@pytest.mark.parametrize(
    "covariance",
    [np.nan, 0, [[1, 2], [2, 1]], [[1.0, 0.5], [0, 1]], [[np.inf, 0], [0, 1]], [[1e308, 0], [0, 1e308]]],
)  # fmt: skip
def test_a_covariance_that_cannot_be_used_is_replaced_and_counted(covariance: object) -> None:
    source = record(one(2.0, 1.0, covariance))
    log = to_log(source, Frames(), NoiseSettings(), FILE)
    assert positive_definite(log.cycles[0].covariances).all()
    assert source.notes["detections had no covariance that can be used, and were given one"] == 1


def test_what_states_its_noise_keeps_it_unless_another_is_given() -> None:
    source = record(one(2.0, 1.0))
    stated = Recording(**{**vars(source), "odometry_sigma": np.array([0.1, 0.2, 0.3])})
    assert to_log(source, Frames(), NoiseSettings(), FILE).odometry_sigma.tolist() == [0.25, 0.12, 0.035]
    assert to_log(stated, Frames(), NoiseSettings(), FILE).odometry_sigma.tolist() == [0.1, 0.2, 0.3]
    given = NoiseSettings(sigma_odometry=(1.0, 2.0, 3.0))
    assert to_log(stated, Frames(), given, FILE).odometry_sigma.tolist() == [1.0, 2.0, 3.0]


@pytest.mark.parametrize("points", [one(np.nan, 1.0), one(2e4, 1.0), one(1e308, 1e308)])
def test_a_record_without_a_usable_detection_is_refused(points: Points) -> None:
    with pytest.raises(
        InputError, match="expected detections that can be used, found 1 messages without any"
    ):
        to_log(record(points), Frames(), NoiseSettings(), FILE)


def test_twists_lead_from_pose_to_pose() -> None:
    rng = np.random.default_rng(0)
    t, twists = np.cumsum(rng.uniform(0.1, 0.5, 20)), rng.normal(size=(19, 3))
    poses = [np.zeros(3)]
    for move in se2_exp(twists * np.diff(t)[:, None]):
        poses.append(compose(poses[-1], move))
    np.testing.assert_allclose(twists_between(t, np.array(poses)), twists, atol=1e-9)
    np.testing.assert_allclose(twists_of(se2_exp(twists)), twists, atol=1e-9)
