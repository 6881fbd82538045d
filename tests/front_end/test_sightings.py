"""Cones that are followed by dead reckoning, and the white noise of twists, each on hand-made drives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.factors.noise import MeasuredNoise
from pathspace_graph.factors.se2 import to_vehicle
from pathspace_graph.factors.sensor import by_sensor
from pathspace_graph.front_end.measurement import (
    FOLLOW_RANGE,
    MIN_TWISTS,
    MOST_PARTS,
    MOST_TWISTS,
    SeenCycle,
    Sightings,
    TwistRecord,
)
from pathspace_graph.io.log import Detections, Odometry
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.sim.vehicle import integrate

from ..scenes.drives import detections

Array = NDArray[np.float64]

NO_ERRORS = MeasuredNoise(np.ones(3), np.ones(3), 0.02)
PERIOD = 0.1
WHITE = np.array([0.06, 0.03, 0.004])


# --- twists ----------------------------------------------------------------------------------------------


def recorded(t: Array, twists: Array) -> TwistRecord:
    record = TwistRecord()
    for begin in range(0, len(t), 7):  # as they come, some for each cycle
        record.add(Odometry(t[begin : begin + 7], twists[begin : begin + 7]))
    return record


def noisy_twists(rate: float, count: int, seed: int) -> tuple[Array, Array]:
    """Returns stamps and twists of a car that speeds up and down and weaves, with white noise."""
    t = np.arange(count) / rate
    smooth = [10.0 + 4.0 * np.sin(t / 1.5), 0.2 * np.sin(t / 1.1), 0.5 * np.sin(t / 0.9)]
    return t, np.column_stack(smooth) + WHITE * np.random.default_rng(seed).normal(size=(count, 3))


@pytest.mark.parametrize("rate", [10.0, 40.0, 100.0])
@pytest.mark.parametrize("seed", [0, 1])
def test_white_noise_is_told_from_the_motion_at_any_rate(rate: float, seed: int) -> None:
    found = recorded(*noisy_twists(rate, 4000, seed)).white()
    assert found is not None
    np.testing.assert_allclose(found[0], WHITE, rtol=0.1)
    assert found[1] == pytest.approx(1.0 / rate, rel=1e-9)


def test_a_twist_that_is_only_held_is_no_measurement() -> None:
    """Each is repeated twice at three times the rate: noise and interval are those of the measured ones."""
    t, twists = noisy_twists(20.0, 600, 2)
    expected = recorded(t, twists).white()
    held = recorded(np.arange(1800) / 60.0, np.repeat(twists, 3, axis=0)).white()
    assert expected is not None and held is not None
    np.testing.assert_array_equal(held[0], expected[0])
    assert held[1] == pytest.approx(0.05, rel=1e-9)


def test_a_twist_that_a_cycle_hands_on_from_the_one_before_counts_once() -> None:
    """The first twist of a cycle is the one in force when it began, at a stamp that may be in the past."""
    t, twists = noisy_twists(20.0, 200, 3)
    record = TwistRecord()
    for begin in range(0, 200, 5):
        first = max(begin - 1, 0)
        record.add(Odometry(t[first : begin + 5], twists[first : begin + 5]))
    found, expected = record.white(), recorded(t, twists).white()
    assert found is not None and expected is not None
    np.testing.assert_array_equal(found[0], expected[0])


def test_a_stop_says_nothing_of_the_noise_in_motion() -> None:
    t, twists = noisy_twists(40.0, 3000, 4)
    stands = (t > 20.0) & (t < 40.0)
    twists[stands] = 1e-4 * np.random.default_rng(5).normal(size=(int(stands.sum()), 3))
    found = recorded(t, twists).white()
    assert found is not None
    np.testing.assert_allclose(found[0], WHITE, rtol=0.15)


def test_few_twists_say_nothing() -> None:
    t, twists = noisy_twists(40.0, MIN_TWISTS, 0)
    assert recorded(t[:-1], twists[:-1]).white() is None
    assert recorded(t, twists).white() is not None
    assert recorded(t, np.tile(twists[0], (len(t), 1))).white() is None


def test_the_order_of_least_noise_counts_where_the_motion_is_fast() -> None:
    """Second differences of a sine of 0.3 rad a sample are ten times the noise, fourth ones are below it."""
    twists = 0.5 * np.sin(0.3 * np.arange(2000))[:, None] + [8.0, 0.0, 0.0]
    twists += 0.002 * np.random.default_rng(0).normal(size=(2000, 3))
    record = recorded(np.arange(2000) / 40.0, twists)
    orders, found = record.orders(), record.white()
    assert orders is not None and found is not None
    assert (orders[0] > 4.0 * orders[2]).all()
    np.testing.assert_allclose(found[0], 0.002, rtol=0.25)


def test_a_long_drive_keeps_the_newest_twists_alone() -> None:
    count = 2 * MOST_TWISTS
    t, twists = noisy_twists(40.0, count, 6)
    twists[: count // 2] += np.random.default_rng(7).normal(size=(count // 2, 3))  # a rough road before
    record = TwistRecord()
    for begin in range(0, count, 20):
        record.add(Odometry(t[begin : begin + 20], twists[begin : begin + 20]))
    assert len(record._parts) <= MOST_PARTS
    assert sum(len(part.t) for part in record._parts) <= MOST_TWISTS + 20 * MOST_PARTS
    found = record.white()
    assert found is not None
    np.testing.assert_allclose(found[0], WHITE, rtol=0.15)


# --- cones that are followed -----------------------------------------------------------------------------


def follow(cycles: list[SeenCycle], known: MeasuredNoise) -> Sightings:
    return Sightings.of(cycles).tracked(known)


def drive(
    twist: tuple[float, float, float], cycles: int, cones: Array, labels: list[int] | None = None
) -> list[SeenCycle]:
    """Returns cycles of a drive with one twist from the origin that see all cones ahead exactly."""
    twists = np.tile(twist, (cycles, 1))
    poses = integrate(twists[:-1], PERIOD) if cycles > 1 else np.zeros((1, 3))
    found, names = [], np.array(labels or [LEFT] * len(cones), np.intp)
    for k, pose in enumerate(poses):
        points = to_vehicle(cones, np.tile(pose, (len(cones), 1)))
        ahead = points[:, 0] > 0.0
        found.append(SeenCycle(detections(PERIOD * k, points[ahead], names[ahead]), pose, twists[k]))
    return found


def counts(found: Sightings) -> list[int]:
    """Number of sightings of each cone."""
    return np.bincount(found.cone).tolist()


def test_one_cone_has_one_number_as_long_as_it_is_seen() -> None:
    cycles = drive((8.0, 0.0, 0.1), 24, np.array([[20.0, 2.0]]))
    found = follow(cycles, NO_ERRORS)
    assert counts(found) == [24]
    np.testing.assert_array_equal(found.t, [cycle.detections.t for cycle in cycles])
    np.testing.assert_array_equal(found.point, np.concatenate([c.detections.points_vehicle for c in cycles]))
    np.testing.assert_array_equal(found.pose, [cycle.pose for cycle in cycles])
    np.testing.assert_array_equal(found.twist, np.tile([8.0, 0.0, 0.1], (24, 1)))


@pytest.mark.parametrize("offset", [(2.0, 0.0), (0.0, 2.0), (1.4, -1.4)])
def test_two_cones_two_metres_apart_stay_two(offset: tuple[float, float]) -> None:
    """They are seen from 25 m on, where the gate is 1.5 m wide."""
    cones = np.array([[25.0, 2.0], [25.0 + offset[0], 2.0 + offset[1]]])
    found = follow(drive((8.0, 0.0, 0.0), 30, cones), NO_ERRORS)
    assert counts(found) == [30, 30]
    places = found.point + found.pose[:, :2]
    for cone in (0, 1):
        assert np.ptp(places[found.cone == cone], axis=0).max() < 1e-9


def test_cones_of_two_colours_at_one_place_are_two() -> None:
    cones = np.array([[15.0, 2.0], [15.1, 2.0]])
    assert counts(follow(drive((8.0, 0.0, 0.0), 10, cones, [LEFT, RIGHT]), NO_ERRORS)) == [10, 10]


def test_what_two_cameras_see_of_one_cone_all_counts() -> None:
    """The second one sees each cone 0.3 m farther away, and to leave one out would be to prefer a range."""
    cones = np.array([[12.0, 2.0], [16.0, 2.0]])
    cycles = drive((8.0, 0.0, 0.0), 10, cones)
    twice, farther = [], []
    for cycle in cycles:
        points = cycle.detections.points_vehicle
        farther.append(points * (1.0 + 0.3 / np.hypot(*points.T))[:, None])
        both = np.concatenate([farther[-1], points])
        labels = np.full(len(both), LEFT, np.intp)
        twice.append(SeenCycle(detections(cycle.detections.t, both, labels), cycle.pose, cycle.twist))
    found = follow(twice, NO_ERRORS)
    assert counts(found) == [10] * 4
    expected = np.concatenate([*farther, *(cycle.detections.points_vehicle for cycle in cycles)])
    np.testing.assert_array_equal(found.point[np.lexsort(found.point.T)], expected[np.lexsort(expected.T)])


def test_a_cone_that_was_long_out_of_sight_is_another_one() -> None:
    cycles = drive((1.0, 0.0, 0.0), 60, np.array([[20.0, 2.0]]))
    assert counts(follow([*cycles[:10], *cycles[35:]], NO_ERRORS)) == [35]
    assert counts(follow([*cycles[:10], *cycles[45:]], NO_ERRORS)) == [10, 15]


def with_errors(cycles: list[SeenCycle], errors: Array) -> list[SeenCycle]:
    """Returns the cycles as a sensor with constant errors sees them: what is corrected is where it was."""
    found = []
    for cycle in cycles:
        true = measured = cycle.detections.points_vehicle
        for _ in range(30):
            measured = true - by_sensor(measured, np.tile(cycle.twist, (len(true), 1))) @ errors
        seen = Detections(cycle.detections.t, measured, cycle.detections.covariances, cycle.detections.labels)
        found.append(SeenCycle(seen, cycle.pose, cycle.twist))
    return found


def test_with_known_errors_a_cone_keeps_its_number_from_afar_until_it_is_near() -> None:
    """Stamps are 0.3 s late and ranges 12 % long, in a bend; a row of cones is seen twice a second."""
    errors = np.array([0.03, 0.0, 0.3, 0.12, 0.0])
    angle = np.linspace(0.25, 1.1, 7)
    cones = np.column_stack([22.0 * np.sin(angle), 20.0 - 22.0 * np.cos(angle)])
    exact = drive((10.0, 0.0, 0.5), 22, cones)[::5]
    cycles = with_errors(exact, errors)
    found, expected = follow(cycles, replace(NO_ERRORS, sensor=errors)), follow(exact, NO_ERRORS)
    assert counts(found) == counts(expected)
    np.testing.assert_array_equal(found.cone, expected.cone)
    measured = np.concatenate([cycle.detections.points_vehicle for cycle in cycles])
    seen = measured[np.hypot(*measured.T) < FOLLOW_RANGE]
    np.testing.assert_array_equal(np.sort(found.point, axis=0), np.sort(seen, axis=0))


def test_the_derivative_by_the_bias_of_the_yaw_rate_is_the_numeric_one() -> None:
    """Poses by odometry whose yaw rate is corrected by a bias, at the cycles of a winding drive."""
    rng, n, h = np.random.default_rng(0), 80, 1e-4
    twists = np.column_stack(
        [8.0 + np.cumsum(rng.normal(size=n)) * 0.1, 0.2 * np.ones(n), np.sin(np.arange(n) / 9.0)]
    )

    def poses(bias: float) -> Array:
        # ten steps in each cycle: the cycles' own derivative is by the trapezium rule
        return integrate(np.repeat(twists - [0.0, 0.0, bias], 10, axis=0), PERIOD / 10)[::10]

    cones = np.array([[1.0, 0.5]])
    at = poses(0.0)[:n]
    seen = [SeenCycle(detections(PERIOD * k, cones, np.array([LEFT])), at[k], twists[k]) for k in range(n)]
    found = follow(seen, NO_ERRORS)
    assert len(found.t) == n
    numeric = (poses(h) - poses(-h))[:n] / (2.0 * h)
    np.testing.assert_allclose(found.by_bias[:, 2], numeric[:, 2], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(found.by_bias, numeric, atol=2e-3 * np.abs(numeric).max())
