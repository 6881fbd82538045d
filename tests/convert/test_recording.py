"""A record in the frame of a sensor becomes a log in that of the vehicle."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from pathspace_graph.convert.messages import Points
from pathspace_graph.convert.recording import Recording, to_log, windowed
from pathspace_graph.convert.settings import Frames, NoiseSettings, Side, Window
from pathspace_graph.errors import InputError
from pathspace_graph.io.log import ray_covariances

FILE = Path("drive")


def record(points: Points, t: float = 0.5) -> Recording:
    twists = np.array([[1.0, 0.2, 0.3], [1.0, 0.2, 0.3]])
    return Recording(np.array([0.0, 1.0]), twists, np.array([t]), points, {}, np.array([1, 2]), "row")


def one(x: float, y: float, covariance: object = np.nan) -> Points:
    return Points.of([[x, y]], [0], np.broadcast_to(covariance, (1, 2, 2)))


@pytest.mark.parametrize(("y", "side"), [("left", 1.0), ("right", -1.0)])
def test_points_and_covariances_go_to_the_vehicle_frame(y: Side, side: float) -> None:
    """The sensor is turned by 0.3 rad, once y points to the left: its long axis, along the ray, with it."""
    c, s, ray = np.cos(0.3), np.sin(0.3), np.array([0.8, 0.6])
    turned = np.array([0.8 * c - side * 0.6 * s, 0.8 * s + side * 0.6 * c])
    covariance = 4.0 * np.outer(ray, ray) + 0.01 * np.eye(2)
    frames = Frames((1.0, 0.5, 0.3), y=y, y_odometry="left")
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
    at_sensor = to_log(record(one(0.0, 0.0)), Frames(), noise, FILE).cycles[0].covariances[0]
    assert np.linalg.eigvalsh(at_sensor).min() > 0.0


@pytest.mark.parametrize(
    "covariance",
    [np.nan, 0, [[1, 2], [2, 1]], [[1.0, 0.5], [0, 1]], [[np.inf, 0], [0, 1]], [[1e308, 0], [0, 1e308]]],
)  # fmt: skip
def test_a_covariance_that_cannot_be_used_is_replaced_and_counted(covariance: object) -> None:
    source = record(one(2.0, 1.0, covariance))
    log = to_log(source, Frames(), NoiseSettings(), FILE)
    np.testing.assert_allclose(
        log.cycles[0].covariances, ray_covariances(np.array([[2.0, 1.0]]), NoiseSettings().sigmas)
    )
    assert source.notes["detections had no covariance that can be used, and were given one"] == 1


def test_the_odometry_has_the_noise_that_is_given() -> None:
    source = record(one(2.0, 1.0))
    assumed = to_log(source, Frames(), NoiseSettings(), FILE)
    assert assumed.odometry_sigma.tolist() == [0.25, 0.12, 0.035] and not assumed.odometry_stated
    given = to_log(source, Frames(), NoiseSettings(sigma_odometry=(1.0, 2.0, 3.0)), FILE)
    assert given.odometry_sigma.tolist() == [1.0, 2.0, 3.0] and given.odometry_stated


@pytest.mark.parametrize("points", [one(np.nan, 1.0), one(2e4, 1.0), one(1e308, 1e308)])
def test_a_record_without_a_usable_detection_is_refused(points: Points) -> None:
    with pytest.raises(
        InputError, match="expected detections that can be used, found 1 messages without any"
    ):
        to_log(record(points), Frames(), NoiseSettings(), FILE)


# --- clocks ----------------------------------------------------------------------------------------------


def driven_at(t: np.ndarray, scan_t: np.ndarray) -> Recording:
    """A record with these stamps (s), whose k-th message has a speed of k and a cone at k + 2."""
    speeds = np.outer(np.arange(len(t)), [1.0, 0.0, 0.0])
    points = Points.joined([one(k + 2.0, 1.0) for k in range(len(scan_t))])
    return Recording(t, speeds, scan_t, points, {}, np.arange(len(t)) + 1, "row", is_held=True)


ONCE = np.arange(0.0, 24.01, 0.5)
SEEN = np.arange(0.25, 24.0, 0.5)


@pytest.mark.parametrize(
    ("t", "scan_t", "expected"),
    [
        (
            np.append(ONCE, ONCE),
            np.append(SEEN, SEEN),
            "odometry by one clock, found that the stamps fall back by 24 s at message 50, from 24 s to 0 s",
        ),
        (
            np.append(10.0 + ONCE, ONCE[:11]),
            SEEN,
            "odometry by one clock, found that the stamps fall back by 34 s at message 50, from 34 s to 0 s",
        ),
        (
            ONCE,
            np.append(SEEN[:20], SEEN[5:]),
            "detections by one clock, found that the stamps fall back by 7 s at message 21, from 9.75",
        ),
    ],
)
def test_a_clock_that_falls_back_is_refused_with_the_message(
    t: np.ndarray, scan_t: np.ndarray, expected: str
) -> None:
    with pytest.raises(InputError, match=re.escape(expected)) as error:
        windowed(driven_at(t, scan_t), Window(), FILE)
    assert "--start" in str(error.value) and "--end" in str(error.value) and "--received" in str(error.value)


def test_a_drive_before_a_clock_was_set_is_cut_off_by_its_stamps() -> None:
    source = driven_at(np.append(ONCE, 100.0 + ONCE), np.append(SEEN, 100.0 + SEEN))
    for window, begin in ((Window(end=50.0), 0.0), (Window(start=50.0), 100.0)):
        part = windowed(source, window, FILE)
        np.testing.assert_array_equal(part.t, begin + ONCE)
        np.testing.assert_array_equal(part.scan_t, begin + SEEN)


@pytest.mark.parametrize(
    ("t", "disordered"),
    [
        (ONCE[[*range(10), 13, 12, 11, 10, *range(14, 49)]], 3),  # by 1.5 s at the most
        (ONCE[::-1], 48),  # the newest first
        (np.insert(ONCE, 20, 30.0), 1),
        (np.insert(ONCE, 20, 0.1), 1),
    ],
)
def test_messages_that_are_out_of_order_are_sorted(t: np.ndarray, disordered: int) -> None:
    source = windowed(driven_at(t, SEEN), Window(), FILE)
    log = to_log(source, Frames(), NoiseSettings(), FILE)
    np.testing.assert_array_equal(log.odometry.t, np.sort(t))
    assert source.notes["odometry samples were out of order, and were sorted"] == disordered


def test_detections_at_most_a_millisecond_apart_are_one_cycle() -> None:
    """Three sensors: the third one is 1.2 ms late, and is a cycle of its own."""
    source = driven_at(ONCE, np.array([4.2, 4.2012, 4.2002, 4.2]))
    log = to_log(source, Frames(), NoiseSettings(), FILE)
    assert [cycle.t for cycle in log.cycles] == [4.2, 4.2012]
    assert [cycle.points_vehicle[:, 0].tolist() for cycle in log.cycles] == [[2.0, 5.0, 4.0], [3.0]]
    told = "messages with detections are at most 1 ms after another one, and are one cycle with it"
    assert source.notes[told] == 2
