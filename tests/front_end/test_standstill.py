"""Standing still: false travel is not believed, a rest measures the bias, and driving is no standstill."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.baselines.landmark_graph import LandmarkFixedLag
from pathspace_graph.factors.noise import TwistNoise
from pathspace_graph.front_end.front_end import judge_log
from pathspace_graph.front_end.log_odometry import half_square, mean_bias
from pathspace_graph.front_end.motion import MATCHING, MotionCheck
from pathspace_graph.graph.variables import CALIBRATION_KEY
from pathspace_graph.io.log import Detections, Log, Odometry
from pathspace_graph.labels import LEFT
from pathspace_graph.mapping.motion import BiasMeasurement, MeasuredMotion, integrated_again
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.run import run_online, split_odometry
from pathspace_graph.settings.mapper import MapperSettings, MotionSettings
from pathspace_graph.sim.faults import Faults, OdometryFaults
from pathspace_graph.sim.sensor import OdometryNoise
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.vehicle import VehicleSettings

from ..scenes.drives import bean_track

Array = NDArray[np.float64]
PERIOD = 0.1
"""Time between two cycles, s."""
TWIST_SIGMA = np.array([0.05, 0.03, 0.01])
SEEDS = range(4)


def ray_noise(ranges: Array) -> tuple[Array, Array]:
    """Standard deviations (m,) along and across the ray, m: those of a camera, which grow with the range."""
    return 0.03 + 0.03 * ranges, 0.02 + 0.008 * ranges


def see(t: float, points: Array, rng: np.random.Generator) -> Detections:
    """Detections of points (m, 2), vehicle frame, with their noise stated."""
    ranges = np.hypot(*points.T)
    ray = points / ranges[:, None]
    left = np.column_stack([-ray[:, 1], ray[:, 0]])
    along, across = ray_noise(ranges)
    noise = rng.standard_normal((2, len(points)))
    measured = points + (along * noise[0])[:, None] * ray + (across * noise[1])[:, None] * left
    covariances = np.einsum("m,mi,mj->mij", along**2, ray, ray) + np.einsum(
        "m,mi,mj->mij", across**2, left, left
    )
    return Detections(t, measured, covariances, np.full(len(points), LEFT))


def rows(rng: np.random.Generator, spacing: float = 4.0) -> Array:
    """Cones (n, 2) of both rows of a straight road along x, beside their regular places."""
    x = np.arange(-4.0, 60.0, spacing)
    cones = np.concatenate([np.column_stack([x, np.full(len(x), side)]) for side in (-1.8, 1.8)])
    return cones + rng.uniform(-0.5, 0.5, cones.shape)


def motions(
    true: Array,
    told: Array,
    seed: int,
    cones: Array | None = None,
    nearest: float = 1.0,
    farthest: float = 15.0,
    check: MotionCheck | None = None,
) -> list[MeasuredMotion]:
    """Motions of a drive along x by true and told speeds (k,), one a cycle; a tenth of the cones is lost."""
    rng = np.random.default_rng(seed)
    cones = rows(rng) if cones is None else cones
    check = check or MotionCheck(TwistNoise(TWIST_SIGMA), MotionSettings())
    found, place = [], 0.0
    for k, (speed, reading) in enumerate(zip(true, told, strict=True)):
        t = PERIOD * (k + 1)
        place += PERIOD * speed
        points = cones - [place, 0.0]
        ranges = np.hypot(*points.T)
        seen = (
            (points[:, 0] > 0.0) & (ranges > nearest) & (ranges < farthest) & (rng.random(len(points)) < 0.9)
        )
        stamps = t - PERIOD + 0.02 * np.arange(5)
        twists = np.array([reading, 0.0, 0.0]) + TWIST_SIGMA * rng.standard_normal((5, 3))
        found.append(check.update(Odometry(stamps, twists), see(t, points[seen], rng)))
    return found


def is_rest(motion: MeasuredMotion) -> bool:
    return motion.doubted and motion.rests


def travelled(found: list[MeasuredMotion]) -> float:
    return float(sum(motion.odometry.delta[0] for motion in found))


BRAKES = np.concatenate([np.full(20, 3.0), np.linspace(2.7, 0.3, 9)])
"""Speeds of a vehicle that drives for 2 s and brakes, m/s."""


@pytest.mark.parametrize("creep", [0.4, 0.8, 1.3])
def test_false_travel_of_three_seconds_is_hardly_believed(creep: float) -> None:
    stands = np.zeros(30)
    for seed in SEEDS:
        true = np.concatenate([BRAKES, stands])
        found = motions(true, np.concatenate([BRAKES, stands + creep]), seed)
        off = travelled(found) - PERIOD * true.sum()
        assert abs(off) < 0.3, f"seed {seed}: {off:.2f} m"
        last = found[-10:]
        assert sum(is_rest(motion) for motion in last) >= 8
        assert all(
            motion.fault == "the detections contradict the odometry" for motion in last if is_rest(motion)
        )
        assert last[-1].odometry.covariance[0, 0] < 0.05**2


def test_a_rest_that_the_odometry_measures_is_no_fault() -> None:
    for seed in SEEDS:
        true = np.concatenate([BRAKES, np.zeros(30)])
        assert not any(motion.fault for motion in motions(true, true, seed))


@pytest.mark.parametrize("speed", [0.3, 1.0])
@pytest.mark.parametrize(("nearest", "farthest"), [(1.0, 15.0), (10.0, 15.0), (1.0, 6.0)])
def test_slow_driving_is_no_rest(speed: float, nearest: float, farthest: float) -> None:
    """Also where only far cones are seen, or few: two or three of them within 6 m."""
    for seed in SEEDS:
        true = np.full(40, speed)
        found = motions(true, true, seed, nearest=nearest, farthest=farthest)
        assert not any(is_rest(motion) for motion in found)
        assert travelled(found) == pytest.approx(PERIOD * true.sum(), abs=0.3)


@pytest.mark.parametrize("slip", [1.5, 2.5])
def test_wheels_that_slip_are_no_rest(slip: float) -> None:
    for seed in SEEDS:
        true = np.full(40, 1.0)
        assert not any(is_rest(motion) for motion in motions(true, slip * true, seed))


def test_a_vehicle_that_leaves_during_false_travel_is_believed_at_once() -> None:
    for seed in SEEDS:
        true = np.concatenate([BRAKES, np.zeros(15), np.full(10, 2.0)])
        found = motions(true, np.concatenate([BRAKES, np.full(15, 0.8), np.full(10, 2.0)]), seed)
        assert is_rest(found[-11])
        assert not any(is_rest(motion) for motion in found[-8:])
        assert travelled(found[-10:]) == pytest.approx(2.0, abs=0.5)


def test_cones_on_the_next_ones_of_their_row_are_no_rest() -> None:
    """Each cycle moves a vehicle by the spacing of the cones; its odometry is 4 % too fast."""
    cones = rows(np.random.default_rng(0), spacing=0.8)
    cones[:, 0] = np.round(cones[:, 0] / 0.8) * 0.8
    true = np.full(30, 8.0)
    assert not any(is_rest(motion) for motion in motions(true, 1.04 * true, 0, cones))


def test_between_walls_there_is_no_decision() -> None:
    """Points of two straight walls, at other places in each cycle, show nothing of a motion along them."""
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        check = MotionCheck(TwistNoise(TWIST_SIGMA), MotionSettings())
        found = []
        for k in range(40):
            t = PERIOD * (k + 1)
            points = np.column_stack([rng.uniform(1.0, 12.0, 60), rng.choice([-1.8, 1.8], 60)])
            twists = np.array([1.3, 0.0, 0.0]) + TWIST_SIGMA * rng.standard_normal((5, 3))
            found.append(
                check.update(Odometry(t - PERIOD + 0.02 * np.arange(5), twists), see(t, points, rng))
            )
        assert not any(is_rest(motion) for motion in found)


def test_two_cones_decide_nothing() -> None:
    true, cones = np.zeros(30), np.array([[5.0, 1.8], [8.0, -1.8]])
    for seed in SEEDS:
        assert not any(is_rest(motion) for motion in motions(true, true + 0.4, seed, cones))


def test_detections_before_other_noise_are_not_compared() -> None:
    """With the noise, the corrections of the detections change, here by a scale of 10 %."""
    for seed in SEEDS:
        check = MotionCheck(TwistNoise(TWIST_SIGMA), MotionSettings())
        cones, true = rows(np.random.default_rng(seed)), np.full(20, 0.5)
        motions(true, true, seed, cones, check=check)
        check.set_noise(TwistNoise(TWIST_SIGMA))
        later = motions(true, true, seed + 100, 1.1 * cones, check=check)
        assert not any(is_rest(motion) for motion in later)


class Exact(MotionSettings):
    """A vehicle that hardly accelerates, so that no latency of the sensor explains a difference."""

    accelerations: ClassVar = (1e-3, 1e-3, 1e-3)


def stands(cycles: list[Array], speed: float, limit: float, variance: float = 1e-4) -> bool:
    """Whether a vehicle stands that sees some points (m, 2) in each cycle, half a second apart.

    By its odometry it drives ahead at a speed (m/s); the limit is in sigmas.
    """
    check = MotionCheck(TwistNoise(np.full(3, 1e-3)), Exact(doubt=limit))
    for k, points in enumerate(cycles):
        odometry = Odometry(np.array([0.5 * k - 0.5])[: k > 0], np.array([[speed, 0.0, 0.0]])[: k > 0])
        covariances = np.tile(variance * np.eye(2), (len(points), 1, 1))
        motion = check.update(odometry, Detections(0.5 * k, points, covariances, np.full(len(points), LEFT)))
    return is_rest(motion)


def likelier(cycles: list[Array], speed: float, variance: float = 1e-4) -> float:
    """Twice the log-likelihood ratio of standstill to the odometry, by the formula, over all cycles.

    The gain of a detection with the nearest one of an earlier cycle is `max(0, 9 - d^2)`, if that cycle could
    see it by odometry.
    """
    total, precision = 0.0, 1.0 / (2.0 * variance + MATCHING.sigma_cone**2)
    for k, points in enumerate(cycles):
        for j, earlier in enumerate(cycles[:k]):
            way = 0.5 * speed * (k - j)
            in_view = np.hypot(*points.T) <= np.hypot(*earlier.T).max() - way
            for sign, moved in ((1.0, earlier), (-1.0, earlier - [way, 0.0])):
                squares = precision * ((points[:, None] - moved) ** 2).sum(axis=2).min(axis=1)
                total += sign * (in_view * np.maximum(MATCHING.most_misfit - squares, 0.0)).sum()
    return 2.0 / len(cycles) * total


PLACES = np.column_stack([np.linspace(1.0, 6.0, 10), np.tile([-1.8, 1.8], 5)])
"""Ten cones, none of which a motion of 0.7 or 1.4 m along x, or a part of it, moves onto another one."""


def test_three_cycles_count_as_two_thirds_of_their_three_pairs() -> None:
    """Ten cones match exactly in three pairs of cycles, where by odometry none of them does."""
    cycles = 3 * [np.concatenate([PLACES, [[30.0, 0.0]]])]  # the last one, so that the others are in view
    twice = 2.0 / 3.0 * 3.0 * 10.0 * MATCHING.most_misfit
    assert likelier(cycles, 2.6) == pytest.approx(twice)
    assert stands(cycles, 2.6, np.sqrt(0.98 * twice))
    assert not stands(cycles, 2.6, np.sqrt(1.02 * twice))


def test_only_what_the_other_cycle_could_see_says_that_the_vehicle_stands() -> None:
    """By an odometry of 1.3 m a cycle, the last cones were beyond the view of one or two cycles before."""
    cycles = 3 * [PLACES]
    assert likelier(cycles, 2.6) < 0.9 * likelier(3 * [np.concatenate([PLACES, [[30.0, 0.0]]])], 2.6)
    assert not stands(cycles, 2.6, np.sqrt(1.02 * likelier(cycles, 2.6)))


@pytest.mark.parametrize("seed", range(4))
def test_the_likelihood_of_a_standstill_is_that_of_the_nearest_detections(seed: int) -> None:
    """Twelve cones at random places, seen with 5 cm of noise."""
    rng = np.random.default_rng(seed)
    cones = np.column_stack([rng.uniform(0.5, 9.0, 12), rng.uniform(-4.0, 4.0, 12)])
    far = np.array([[0.0, 30.0]])
    cycles = [np.concatenate([cones + 0.05 * rng.standard_normal(cones.shape), far]) for _ in range(3)]
    twice = likelier(cycles, 2.9, 0.0025)
    assert stands(cycles, 2.9, np.sqrt(0.99 * twice), 0.0025)
    assert not stands(cycles, 2.9, np.sqrt(1.01 * twice), 0.0025)


def test_an_odometry_that_is_always_believed_is_believed_here() -> None:
    true, check = np.zeros(20), MotionCheck(TwistNoise(TWIST_SIGMA), MotionSettings(doubt=np.inf))
    assert not any(motion.fault for motion in motions(true, true + 1.3, 0, check=check))


@pytest.mark.parametrize(("speed", "is_compared"), [(2.0, True), (4.0, False)])
def test_wheels_that_turn_faster_than_a_creep_are_not_compared_with_earlier_cycles(
    speed: float, is_compared: bool
) -> None:
    """The same cones are seen for a second, during which odometry tells a speed in the last cycle alone."""
    points, check = rows(np.random.default_rng(0)), MotionCheck(TwistNoise(TWIST_SIGMA), MotionSettings())
    for k in range(11):
        twists = np.array([[speed if k == 10 else 0.0, 0.0, 0.0]])
        covariances = np.tile(0.01 * np.eye(2), (len(points), 1, 1))
        cycle = Detections(PERIOD * k, points, covariances, np.full(len(points), LEFT))
        motion = check.update(Odometry(np.array([PERIOD * (k - 1)]), twists), cycle)
    assert is_rest(motion) is is_compared


# --- by the twists ------------------------------------------------------------------------------------------

BIAS = 0.02
REST = 8.0
SIGMA = np.array([0.25, 0.12, 0.035])


@pytest.fixture(scope="module")
def log() -> Log:
    """A vehicle stands for 8 s and drives 4 s then; its yaw rate is 0.02 rad/s too high."""
    settings = SimulationSettings(
        laps=1,
        vehicle=VehicleSettings(rest=REST),
        odometry=OdometryNoise(scale=0.0, gyro_bias=0.0),
        faults=Faults(odometry=OdometryFaults(yaw_rate_bias=BIAS)),
    )
    whole = simulate(bean_track(), settings, seed=2)
    return replace(whole, cycles=tuple(c for c in whole.cycles if c.t < REST + 4.0))


def test_the_bias_is_measured_and_the_vehicle_does_not_move(log: Log) -> None:
    check = MotionCheck(TwistNoise(log.odometry_sigma), MotionSettings())
    motions = [check.update(odometry, cycle) for odometry, cycle in split_odometry(log)]
    measured = mean_bias([motion.bias for motion in motions if motion.bias])
    assert measured is not None
    assert measured.sigma == pytest.approx(0.035 / np.sqrt(50.0 * REST), rel=0.2)
    assert measured.value == pytest.approx(BIAS, abs=3.0 * measured.sigma)
    standing = [m for m, c in zip(motions, log.cycles, strict=True) if 1.2 < c.t < REST - 0.01]
    for motion in standing:
        np.testing.assert_array_equal(motion.odometry.delta, 0.0)
    stamps = np.array([c.t for m, c in zip(motions, log.cycles, strict=True) if m.bias])
    assert len(stamps) == REST and (np.diff(stamps) > 0.99).all()  # each is of a second's readings
    late = [m for m, c in zip(motions, log.cycles, strict=True) if c.t > REST + 1.0]
    assert not any(motion.bias for motion in late)
    assert all(motion.odometry.delta[0] > 0.1 for motion in late)


def test_a_bias_is_as_uncertain_as_noise_and_drift_of_its_second(log: Log) -> None:
    """The first twist of a cycle repeats one, so that 40 count."""
    check = MotionCheck(TwistNoise(log.odometry_sigma, np.full(3, 0.01)), MotionSettings())
    motions = (check.update(odometry, cycle) for odometry, cycle in split_odometry(log))
    bias = next(motion.bias for motion in motions if motion.bias is not None)
    assert bias.sigma == pytest.approx(np.hypot(0.035 / np.sqrt(40.0), 0.01), rel=1e-3)


@pytest.mark.parametrize("make", [FixedLagMapper, LandmarkFixedLag])
def test_an_estimator_knows_the_bias_when_it_leaves(log: Log, make: type) -> None:
    standing = replace(log, cycles=tuple(c for c in log.cycles if c.t < REST))
    estimator = make(MapperSettings(), log.odometry_sigma)
    run = run_online(standing, estimator)
    assert run.vehicle is not None
    bias, sigma = run.vehicle.calibration[1], np.sqrt(run.vehicle.covariance[4, 4])
    assert sigma < 0.0025
    assert bias == pytest.approx(BIAS, abs=3.0 * sigma)
    assert np.abs(run.trajectory[-1]).max() < 0.15


def test_a_log_has_the_mean_of_all_that_was_measured_at_rest(log: Log) -> None:
    chain = judge_log(log, log.noise, MapperSettings()).chain
    assert chain.bias is not None
    off = np.array([0.0, chain.bias.value + chain.bias.sigma])
    at_mean = half_square(chain.priors(chain.first, np.array([0.0, chain.bias.value])))
    prior = 0.5 * (off[1] ** 2 - chain.bias.value**2) / chain.calibration_sigma[1] ** 2
    assert half_square(chain.priors(chain.first, off)) - at_mean == pytest.approx(0.5 + prior)
    *_, measured = chain.priors(chain.first, off)
    assert measured.keys[0, 0] == CALIBRATION_KEY
    np.testing.assert_allclose(measured.residual, [1.0])


def test_means_are_weighted_by_information() -> None:
    mean = mean_bias([BiasMeasurement(1.0, 1.0), BiasMeasurement(4.0, 0.5)])
    assert mean is not None
    assert mean.value == pytest.approx((1.0 + 4.0 * 4.0) / 5.0)
    assert mean.sigma == pytest.approx(5.0**-0.5)
    assert mean_bias([]) is None


def test_the_motion_in_which_a_rest_ends_may_have_missed_the_start(log: Log) -> None:
    check = MotionCheck(TwistNoise(log.odometry_sigma), MotionSettings())
    motions = [check.update(odometry, cycle) for odometry, cycle in split_odometry(log)]
    sigmas = np.array([np.sqrt(np.diag(motion.odometry.covariance)) for motion in motions])
    starts = np.flatnonzero(sigmas[:, 0] > 0.2)
    assert len(starts) == 1, "one rest ends"
    assert log.cycles[int(starts[0])].t == pytest.approx(REST, abs=0.5)
    np.testing.assert_allclose(sigmas[starts[0]], np.hypot([0.3, 0.05, 0.0], sigmas[starts[0] + 1]), rtol=0.1)
    again = integrated_again(motions, TwistNoise(2.0 * log.odometry_sigma))[int(starts[0])]
    assert again.covariance[0, 0] > 0.3**2, "measured noise does not forget it"


def test_a_vehicle_that_creeps_is_not_at_rest() -> None:
    """Its detections agree with a rest, too, as 3 cm a cycle are below their noise."""
    rng, told = np.random.default_rng(0), list[bool]()
    cones, check = rows(rng), MotionCheck(TwistNoise(SIGMA), MotionSettings())
    for k in range(40):
        stamps = 0.1 * k + 0.02 * np.arange(5)
        twist = np.array([0.3, 0.0, 0.0]) + SIGMA * rng.standard_normal((5, 3))
        seen = cones[(cones[:, 0] > 1.0 + 0.03 * k) & (cones[:, 0] < 12.0)] - [0.03 * k, 0.0]
        told.append(check.update(Odometry(stamps, twist), see(0.1 * (k + 1), seen, rng)).rests)
    assert not any(told[12:])


def test_detections_that_move_past_deny_a_rest(log: Log) -> None:
    """The wheels are locked and the yaw rate is right, while the vehicle slides on."""
    settings = SimulationSettings(laps=1, vehicle=VehicleSettings(speed_start=6.0))
    sliding = simulate(bean_track(), settings, seed=0)
    twist = sliding.odometry.twist.copy()
    rng = np.random.default_rng(1)
    twist[:] = SIGMA * rng.standard_normal(twist.shape)
    check = MotionCheck(TwistNoise(sliding.odometry_sigma), MotionSettings())
    wrong = replace(sliding, odometry=Odometry(sliding.odometry.t, twist))
    motions = [check.update(odometry, cycle) for odometry, cycle in split_odometry(wrong)]
    assert not any(motion.bias for motion in motions)
