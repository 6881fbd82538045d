"""What odometry and detections alone show of noise and constant errors, on drives where both are known."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2

from pathspace_graph.factors._kernels import by_constants
from pathspace_graph.factors.noise import MeasuredNoise, RayNoise
from pathspace_graph.factors.se2 import to_map, to_vehicle
from pathspace_graph.factors.sensor import BENDS_FROM, by_sensor
from pathspace_graph.front_end import measurement
from pathspace_graph.front_end.front_end import measure_log
from pathspace_graph.front_end.measurement import (
    FOLLOW_RANGE,
    MIN_ROWS,
    MIN_TWISTS,
    MODEL_ERROR,
    MOST_TWISTS,
    OF_BEND,
    PASSES,
    PRIOR,
    ROUNDS,
    SeenCycle,
    Sightings,
    dead_reckoned,
    twist_noise,
    without_repeats,
)
from pathspace_graph.front_end.noise import begun, measure_noise
from pathspace_graph.io.log import Detections, Log, Odometry
from pathspace_graph.labels import LEFT
from pathspace_graph.sim.simulate import SimulationSettings, preset, simulate
from pathspace_graph.sim.track_generator import generate_track
from pathspace_graph.sim.vehicle import integrate

from ..scenes.drives import detections
from .scenes import WHITE as SCENE_WHITE
from .scenes import Camera

Array = NDArray[np.float64]

NO_ERRORS = MeasuredNoise(np.ones(3), np.ones(3), 0.02)
PERIOD = 0.1
WHITE = np.array([0.06, 0.03, 0.004])


# --- twists ----------------------------------------------------------------------------------------------


def white(t: Array, twists: Array) -> tuple[Array, float] | None:
    """White noise and interval of twists that come some for each cycle."""
    parts = [Odometry(t[begin : begin + 7], twists[begin : begin + 7]) for begin in range(0, len(t), 7)]
    found = twist_noise(*parts)
    return None if found is None else (found[0].min(axis=0), found[1])


def noisy_twists(rate: float, count: int, seed: int) -> tuple[Array, Array]:
    """Returns stamps and twists of a car that speeds up and down and weaves, with white noise."""
    t = np.arange(count) / rate
    smooth = [10.0 + 4.0 * np.sin(t / 1.5), 0.2 * np.sin(t / 1.1), 0.5 * np.sin(t / 0.9)]
    return t, np.column_stack(smooth) + WHITE * np.random.default_rng(seed).normal(size=(count, 3))


@pytest.mark.parametrize("rate", [10.0, 40.0, 100.0])
@pytest.mark.parametrize("seed", [0, 1])
def test_white_noise_is_told_from_the_motion_at_any_rate(rate: float, seed: int) -> None:
    found = white(*noisy_twists(rate, 4000, seed))
    assert found is not None
    np.testing.assert_allclose(found[0], WHITE, rtol=0.1)
    assert found[1] == pytest.approx(1.0 / rate, rel=1e-9)


def test_a_twist_that_is_only_held_is_no_measurement() -> None:
    """Each is repeated twice at three times the rate: noise and interval are those of the measured ones."""
    t, twists = noisy_twists(20.0, 600, 2)
    expected = white(t, twists)
    held = white(np.arange(1800) / 60.0, np.repeat(twists, 3, axis=0))
    assert expected is not None and held is not None
    np.testing.assert_array_equal(held[0], expected[0])
    assert held[1] == pytest.approx(0.05, rel=1e-9)


def test_a_twist_that_a_cycle_hands_on_from_the_one_before_counts_once() -> None:
    """The first twist of a cycle is the one in force when it began, at a stamp that may be in the past."""
    t, twists = noisy_twists(20.0, 200, 3)
    parts = [slice(max(begin - 1, 0), begin + 5) for begin in range(0, 200, 5)]
    found = without_repeats([Odometry(t[part], twists[part]) for part in parts])
    np.testing.assert_array_equal(found.t, t)
    np.testing.assert_array_equal(found.twist, twists)


def test_a_stop_says_nothing_of_the_noise_in_motion() -> None:
    t, twists = noisy_twists(40.0, 3000, 4)
    stands = (t > 20.0) & (t < 40.0)
    twists[stands] = 1e-4 * np.random.default_rng(5).normal(size=(int(stands.sum()), 3))
    found = white(t, twists)
    assert found is not None
    np.testing.assert_allclose(found[0], WHITE, rtol=0.15)


def test_few_twists_say_nothing() -> None:
    t, twists = noisy_twists(40.0, MIN_TWISTS, 0)
    assert white(t[:-1], twists[:-1]) is None
    assert white(t, twists) is not None
    assert white(t, np.tile(twists[0], (len(t), 1))) is None


def test_the_order_of_least_noise_counts_where_the_motion_is_fast() -> None:
    """Second differences of a sine of 0.3 rad a sample are ten times the noise, fourth ones are below it."""
    twists = 0.5 * np.sin(0.3 * np.arange(2000))[:, None] + [8.0, 0.0, 0.0]
    twists += 0.002 * np.random.default_rng(0).normal(size=(2000, 3))
    found = twist_noise(Odometry(np.arange(2000) / 40.0, twists))
    assert found is not None
    assert (found[0][0] > 4.0 * found[0][2]).all()
    np.testing.assert_allclose(found[0].min(axis=0), 0.002, rtol=0.25)


def test_a_long_drive_keeps_the_newest_twists_alone() -> None:
    count = 2 * MOST_TWISTS
    t, twists = noisy_twists(40.0, count, 6)
    twists[: count // 2] += np.random.default_rng(7).normal(size=(count // 2, 3))  # a rough road before
    assert len(without_repeats([Odometry(t, twists)]).t) == MOST_TWISTS
    found = white(t, twists)
    assert found is not None
    np.testing.assert_allclose(found[0], WHITE, rtol=0.15)


# --- dead reckoning --------------------------------------------------------------------------------------


def test_a_pose_between_two_twists_is_on_the_arc_of_the_first_one() -> None:
    """A quarter of a circle of radius 5 m in 1 s, then straight ahead; nothing moves before the first."""
    turn = 0.5 * np.pi
    odometry = Odometry(np.array([10.0, 11.0]), np.array([[5.0 * turn, 0.0, turn], [4.0, 0.0, 0.0]]))
    found = dead_reckoned(odometry, np.array([9.0, 10.5, 11.0, 12.5]))
    half = np.sqrt(0.5)
    expected = [[0, 0, 0], [5 * half, 5 - 5 * half, turn / 2], [5, 5, turn], [5, 11, turn]]
    np.testing.assert_allclose(found, expected, atol=1e-12)


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


# --- measured noise and errors --------------------------------------------------------------------------

SEEDS = range(6)
ERRORS = np.array([0.02, 0.1, 0.06, 0.05, 0.1])
RANGES = np.array([8.0, 12.0, 18.0])
CAMERAS = {
    "white": Camera(RayNoise(np.array([0.1, 0.02])), RayNoise(np.array([0.0, 0.012]))),
    "white, errors": Camera(RayNoise(np.array([0.1, 0.02])), RayNoise(np.array([0.0, 0.012])), ERRORS),
    "staying, errors": Camera(
        RayNoise(np.array([0.1, 0.02]), 0.5, 2.0), RayNoise(np.array([0.0, 0.012]), 0.8, 2.0), ERRORS
    ),
}


@cache
def found(name: str) -> list[MeasuredNoise]:
    """Returns what is measured on drives of a minute."""
    return [CAMERAS[name].found(seed) for seed in SEEDS]


def ratios(name: str, axis: str) -> Array:
    """Returns the measured noise by the true one, at ranges, mean over all drives."""
    true = getattr(CAMERAS[name], axis).sigmas(RANGES)
    return np.asarray(np.mean([getattr(one, axis).sigmas(RANGES) / true for one in found(name)], axis=0))


@pytest.mark.parametrize("name", CAMERAS)
def test_constant_errors_are_found_within_their_own_sigmas(name: str) -> None:
    """No single error is off by more than four sigmas, and all together are as a chi-square says."""
    off = np.array([(one.sensor - CAMERAS[name].errors) / one.sensor_sigma for one in found(name)])
    assert np.abs(off).max() < 4.0, np.sqrt((off**2).mean(axis=0))
    assert (off**2).sum() < chi2.ppf(0.999, off.size), np.sqrt((off**2).mean(axis=0))


@pytest.mark.parametrize("name", CAMERAS)
def test_errors_scatter_from_drive_to_drive_as_their_sigmas_say(name: str) -> None:
    """The geometric mean of all five is right to a factor of two, and none claims a third of its scatter."""
    scatter = np.std([one.sensor for one in found(name)], axis=0, ddof=1)
    model = MODEL_ERROR * np.abs([one.sensor for one in found(name)])
    claimed = np.sqrt(np.mean(np.square([one.sensor_sigma for one in found(name)]) - model**2, axis=0))
    assert 0.5 < np.exp(np.log(claimed / scatter).mean()) < 2.0
    assert (claimed > scatter / 3.0).all()


@pytest.mark.parametrize("axis", ["along", "across"])
@pytest.mark.parametrize("name", CAMERAS)
def test_noise_is_measured_by_range(name: str, axis: str) -> None:
    np.testing.assert_allclose(ratios(name, axis), 1.0, atol=0.25)


@pytest.mark.parametrize("axis", ["along", "across"])
def test_errors_that_stay_with_a_cone_are_told_from_white_ones(axis: str) -> None:
    shares = {name: np.mean([getattr(one, axis).share for one in found(name)]) for name in CAMERAS}
    assert shares["white"] < 0.25 and shares["white, errors"] < 0.25
    assert shares["staying, errors"] > 0.3


BENT = Camera(RayNoise(np.array([0.05, 0.01])), RayNoise(np.array([0.0, 0.012])), ERRORS, bend=-0.005)


def test_ranges_that_bend_do_not_spoil_the_other_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    """Yaw and scale are right in the mean of the drives; where no bend is allowed, the scale is not."""
    bent = [BENT.found(seed) for seed in SEEDS]
    yaw, _, _, scale, _ = np.mean([one.sensor for one in bent], axis=0)
    assert yaw == pytest.approx(0.02, abs=0.0015)
    assert scale == pytest.approx(0.05, abs=0.01)
    assert np.mean([one.range_bend for one in bent]) == pytest.approx(-0.005, abs=0.001)
    monkeypatch.setattr(measurement, "PRIOR", np.where(np.arange(7) == OF_BEND, 1e-9, PRIOR))
    straight = BENT.found(0)
    assert abs(straight.sensor[3] - 0.05) > 0.02
    assert straight.range_bend == 0.0


def test_a_bend_is_used_only_where_it_is_beyond_doubt() -> None:
    assert [one.range_bend for one in found("white")] == [0.0] * len(SEEDS)


def test_columns_are_derivatives_in_the_map_of_corrected_detections() -> None:
    """By the five errors and the bend."""
    rng = np.random.default_rng(0)
    seen, (poses, twists) = rng.normal(scale=12.0, size=(9, 2)), rng.normal(size=(2, 9, 3))
    columns = by_constants(seen, twists, poses, np.zeros((9, 3)), np.zeros(9, np.intp), BENDS_FROM)
    for k, step in enumerate(1e-6 * np.eye(6)):
        known = MeasuredNoise(np.ones(3), np.ones(3), 0.02, sensor=step[:5], range_bend=step[5])
        moved = to_map(known.corrected(seen, twists), poses) - to_map(seen, poses)
        np.testing.assert_allclose(columns[:, :, k], moved / 1e-6, atol=1e-6)


def test_the_drive_itself_is_told_too() -> None:
    for one in found("white"):
        np.testing.assert_allclose(one.odometry, SCENE_WHITE, rtol=0.15)
        assert one.interval == pytest.approx(0.02) and one.period == pytest.approx(0.1)
        assert 55.0 < one.seconds <= 60.0
        assert one.count >= 5 and one.per_cycle > 5.0


def test_too_few_cones_say_nothing_of_the_sensor() -> None:
    cycles, odometry = CAMERAS["white"].drive(0)
    some = measure_noise(cycles[:8], odometry)
    assert some is not None and some.along is None and some.across is None
    assert np.isinf(some.sensor_sigma).all()
    assert len(cycles[0].detections.labels) < MIN_ROWS
    assert measure_noise(cycles, Odometry(np.zeros(0), np.zeros((0, 3)))) is None


# --- simulated logs --------------------------------------------------------------------------------------


@cache
def simulated(kind: str, seed: int) -> tuple[Log, MeasuredNoise]:
    settings = SimulationSettings(laps=1)
    if kind == "camera":
        settings = preset({"sensor": "camera", "odometry": "ins"})
    log = simulate(generate_track(np.random.default_rng(seed)), settings, seed)
    measured = measure_log(log)
    assert measured is not None and measured.along is not None
    return log, measured


@pytest.mark.parametrize("seed", [0, 1])
def test_a_plain_sensor_has_no_errors_and_the_noise_that_is_stated(seed: int) -> None:
    log, measured = simulated("plain", seed)
    assert (np.abs(measured.sensor) < 4.0 * np.hypot(measured.sensor_sigma, 0.005)).all()
    np.testing.assert_allclose(measured.odometry, log.odometry_sigma, rtol=0.15)
    points = np.concatenate([cycle.points_vehicle for cycle in log.cycles])
    stated = np.concatenate([cycle.covariances for cycle in log.cycles])
    ours = measured.covariances(points, inflated=False)
    assert ours is not None
    ray = points / np.hypot(*points.T)[:, None]
    for direction in (ray, np.column_stack([-ray[:, 1], ray[:, 0]])):
        sigmas = [np.sqrt(np.einsum("mi,mij,mj->m", direction, one, direction)) for one in (ours, stated)]
        assert np.median(sigmas[0] / sigmas[1]) == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize("seed", [0, 1])
def test_the_errors_of_a_simulated_camera_are_found(seed: int) -> None:
    """Errors of ranges are those beside the scale of the speeds, which cannot be told from theirs.

    A range that reads `(1 + a) r + b` is corrected by `z a / (1 + a) + b / (1 + a)`.
    """
    log, measured = simulated("camera", seed)
    assert log.truth is not None and log.truth.sensor is not None and log.truth.calibration is not None
    true = log.truth.sensor.copy()
    true[3:] /= 1.0 + true[3]
    true[3] -= log.truth.calibration[0]
    assert (np.abs(measured.sensor - true) < 4.0 * measured.sensor_sigma).all()
    assert measured.across is not None and measured.across.share > 0.25


@pytest.mark.parametrize("bias", [-0.02, 0.02])
def test_a_biased_yaw_rate_is_not_taken_for_a_turned_sensor(bias: float) -> None:
    """Over a view of 2 s both look alike but for the curvature: derivatives with noise in them hide that."""
    log, measured = simulated("plain", 0)
    turned = replace(log.odometry, twist=log.odometry.twist + np.array([0.0, 0.0, bias]))
    found = measure_log(replace(log, odometry=turned))
    assert found is not None
    assert abs(found.sensor[0] - measured.sensor[0]) < 0.2 * abs(bias)


@pytest.mark.parametrize("seconds", [8.0, 30.0])
def test_a_measurement_has_short_steps_and_few_of_them_where_it_is_small(seconds: float) -> None:
    """The first one has a step for each round; of more sightings, constants and noise are two."""
    cycles, odometry = CAMERAS["white"].drive(0)
    cycles = [cycle for cycle in cycles if cycle.detections.t <= seconds]
    steps = begun(cycles, [odometry], None, of_lines=False)
    assert steps is not None
    *before, last = steps
    assert before == [None] * len(before) and last is not None and last.along is not None
    rounds, is_small = ROUNDS[0] + (PASSES - 1) * ROUNDS[1], seconds == 8.0
    assert len(before) + 1 == (PASSES + rounds if is_small else 2 * (PASSES + rounds) + 1)
