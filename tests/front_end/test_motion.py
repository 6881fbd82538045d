"""The check of the odometry: slip, zeros and gaps are told from the detections, and nothing else is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.factors.noise import TwistNoise
from pathspace_graph.factors.se2 import relative
from pathspace_graph.front_end.motion import MATCHING, Matching, MotionCheck
from pathspace_graph.io.log import Detections, Log, Odometry
from pathspace_graph.mapping.motion import MeasuredMotion, integrated_again
from pathspace_graph.run import split_odometry
from pathspace_graph.settings.mapper import MotionSettings
from pathspace_graph.sim.sensor import OdometryNoise
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.vehicle import VehicleSettings

from ..scenes.drives import bean_track

Array = NDArray[np.float64]
WINDOW = 5.0, 6.0
"""The fault lasts from and to these stamps (s)."""


@pytest.fixture(scope="module")
def log() -> Log:
    """A drive of one noisy lap, with the simulator's noise."""
    odometry = OdometryNoise(scale=0.0, gyro_bias=0.0)
    settings = SimulationSettings(laps=1, vehicle=VehicleSettings(speed_start=8.0), odometry=odometry)
    return simulate(bean_track(), settings, seed=3)


def checked(
    log: Log, settings: MotionSettings | None = None, matching: Matching = MATCHING
) -> list[MeasuredMotion]:
    check = MotionCheck(TwistNoise(log.odometry_sigma), settings or MotionSettings(), matching)
    return [check.update(odometry, cycle) for odometry, cycle in split_odometry(log)]


def errors(log: Log, motions: list[MeasuredMotion]) -> Array:
    """The errors (k, 3) of the motions from cycle to cycle, in the frame of the earlier pose."""
    truth = log.truth
    assert truth is not None
    at = np.searchsorted(truth.pose_t, [cycle.t for cycle in log.cycles])
    steps = [relative(truth.poses[a], truth.poses[b]) for a, b in pairwise(at)]
    off = np.array([m.odometry.delta for m in motions[1:]]) - np.array(steps)
    off[:, 2] = np.arctan2(np.sin(off[:, 2]), np.cos(off[:, 2]))
    return off


def faulty(log: Log, change: Callable[[Array], Array]) -> Log:
    twist, (begin, end) = log.odometry.twist.copy(), WINDOW
    inside = (log.odometry.t >= begin) & (log.odometry.t < end)
    twist[inside] = change(twist[inside])
    return replace(log, odometry=Odometry(log.odometry.t, twist))


def without_readings(log: Log) -> Log:
    begin, end = WINDOW
    kept = (log.odometry.t < begin) | (log.odometry.t >= end)
    return replace(log, odometry=Odometry(log.odometry.t[kept], log.odometry.twist[kept]))


def told(log: Log, motions: list[MeasuredMotion]) -> Array:
    """The stamps of the cycles where something is wrong with the odometry."""
    return np.array([cycle.t for cycle, m in zip(log.cycles, motions, strict=True) if m.fault])


def test_a_right_odometry_is_left_as_it_is(log: Log) -> None:
    motions, unchecked = checked(log), checked(log, MotionSettings(doubt=np.inf))
    assert not any(motion.fault for motion in motions)
    for motion, own in zip(motions, unchecked, strict=True):
        np.testing.assert_array_equal(motion.odometry.delta, own.odometry.delta)
        np.testing.assert_array_equal(motion.odometry.covariance, own.odometry.covariance)


def test_detections_that_are_worse_than_they_claim_do_not_deny_the_odometry(log: Log) -> None:
    """They have twice the standard deviation that they claim, and deny it unless their excess counts."""
    cycles = tuple(replace(c, covariances=c.covariances / 4.0) for c in log.cycles)
    overconfident = replace(log, cycles=cycles)
    motions = checked(overconfident)
    assert not any(motion.fault for motion in motions)
    assert np.abs(errors(log, motions).cumsum(axis=0)).max() < 0.2
    believed = checked(overconfident, matching=replace(MATCHING, large_misfit=1e9))
    assert any(motion.doubted for motion in believed)


@pytest.mark.parametrize(
    "change",
    [lambda twist: 0.0 * twist, lambda twist: twist * [1.5, 1.5, 1.0], lambda twist: twist * [0.3, 0.3, 1.0]],
    ids=["zero", "slip", "locked"],
)
def test_a_second_of_wrong_readings_is_told_and_replaced(log: Log, change: Callable[[Array], Array]) -> None:
    wrong = faulty(log, change)
    motions, unchecked = checked(wrong), checked(wrong, MotionSettings(doubt=np.inf))
    at = told(wrong, motions)
    assert len(at) >= 6
    assert at.min() >= WINDOW[0]
    assert at.max() <= WINDOW[1] + 0.6  # what was not noticed at once is made good afterwards
    lost, kept = (np.abs(errors(log, m).cumsum(axis=0)).max(axis=0)[:2].max() for m in (unchecked, motions))
    assert kept < 0.7
    assert lost > 3.0 * kept


def test_a_yaw_rate_is_not_believed_beside_speeds_that_are_contradicted_if_it_is_wrong_too(log: Log) -> None:
    """It is 0.5 rad/s too high for a second."""
    motions = checked(faulty(log, lambda twist: twist * [1.5, 1.5, 1.0] + [0.0, 0.0, 0.5]))
    assert sum(motion.doubted for motion in motions) >= 6
    assert np.abs(errors(log, motions).cumsum(axis=0))[:, 2].max() < 0.1


def test_a_gap_is_filled_by_the_detections(log: Log) -> None:
    motions = checked(without_readings(log))
    at = told(log, motions)
    assert len(at) >= 7
    assert at.min() > WINDOW[0]
    assert at.max() <= WINDOW[1] + 0.1
    assert np.abs(errors(log, motions).cumsum(axis=0)).max() < 0.7
    assert {motion.fault for motion in motions} == {"", "there is no odometry"}


def test_a_gap_without_detections_is_as_uncertain_as_it_is_long() -> None:
    """A straight drive with odometry until 1 s and none afterwards: it is held, and its variance grows."""
    check = MotionCheck(TwistNoise(np.array([0.1, 0.1, 0.01])), MotionSettings())
    nothing = np.zeros((0, 2))
    spreads, held = [], np.zeros(3)
    for k in range(20):
        t, start = 0.1 * (k + 1), 0.1 * k
        stamps = start + 0.01 * np.arange(10) if k < 10 else np.array([start])
        speeds = 5.0 + 0.1 * np.sin(np.arange(len(stamps)))
        twist = np.column_stack([speeds, np.zeros((len(stamps), 2))])
        twist = twist if k < 10 else held[None]
        held = twist[-1]
        motion = check.update(Odometry(stamps, twist), _cycle(t, nothing))
        spreads.append(float(np.sqrt(motion.odometry.covariance[0, 0])))
        if k >= 12:
            assert motion.missing
            assert motion.odometry.delta[0] == pytest.approx(0.1 * 5.0, abs=0.02)
    assert spreads[-1] > 10 * spreads[5]


def test_what_twists_lack_is_how_much_longer_they_are_held_than_usual() -> None:
    """Measured every 0.1 s and held from 0.3 s on at a cost; the first row repeats one from 0.2 s before."""
    stamps, until, nothing = np.array([1.0, 1.05, 1.15, 1.7]), 1.9, np.zeros((0, 2))
    twists = np.array([[5.0, 0.0, 0.0], [5.0, 0.0, 0.0], [4.0, 0.0, 0.0], [3.0, 0.0, 1.0]])
    noise = TwistNoise(np.array([0.1, 0.1, 0.01]), np.array([0.05, 0.05, 0.002]))

    def held(count: int, until: float) -> MeasuredMotion:
        check = MotionCheck(noise, MotionSettings())
        check.update(Odometry(np.array([0.8]), twists[:1]), _cycle(1.0, nothing))
        return check.update(Odometry(stamps[:count], twists[:count]), _cycle(until, nothing))

    motion, measured, ends = held(4, until), np.array([0.8, *stamps[1:]]), np.array([*stamps[1:], until])
    assert motion.durations is not None
    np.testing.assert_allclose(motion.durations, np.diff(np.append(stamps, until)))
    longer = np.maximum(ends - measured - 3.0 * np.diff(measured).min(), 0.0)
    np.testing.assert_allclose(motion.excess, longer[:, None] * MotionSettings.accelerations)
    assert (motion.excess[:, 0] > 0.0).tolist() == [False, False, True, False]
    assert not (motion.missing or motion.stuck)
    empty = MeasuredMotion(motion.odometry, motion.twists)  # of detections, not of twists
    for again in integrated_again([motion, empty, motion], noise):
        np.testing.assert_array_equal(again.covariance, motion.odometry.covariance)
    np.testing.assert_array_equal(held(3, 1.2).excess, 0.0)
    assert held(4, 2.3).missing


def test_readings_that_never_change_are_believed_if_the_detections_agree() -> None:
    """An exact drive at constant speed has the same twist in each row."""
    cones = np.array([[x, side] for x in np.arange(0.0, 60.0, 4.0) for side in (-2.0, 2.0)])
    check, twist = (
        MotionCheck(TwistNoise(np.array([0.1, 0.1, 0.01])), MotionSettings()),
        np.tile([5.0, 0.0, 0.0], (10, 1)),
    )
    for k in range(40):
        t = 0.1 * (k + 1)
        seen = cones - [5.0 * t, 0.0]
        seen = seen[(seen[:, 0] > 0.0) & (seen[:, 0] < 15.0)]
        motion = check.update(Odometry(t - 0.1 + 0.01 * np.arange(10), twist), _cycle(t, seen))
        assert not motion.fault
        np.testing.assert_allclose(motion.odometry.delta, [0.5, 0.0, 0.0], atol=1e-12)


def past_cones(
    factors: Array,
    seed: int = 0,
    variance: float = 0.01,
    *,
    noisy: bool = False,
    matching: Matching = MATCHING,
) -> tuple[MotionCheck, list[MeasuredMotion], Array]:
    """A drive past cones whose odometry reads `factors` (k, 10) times the speed; with the true steps (k,), m.

    A variance (m^2) is claimed for the detections, which are exact or have it.
    """
    rng, place, motions = np.random.default_rng(seed), 0.0, []
    steps = 0.5 + 0.1 * np.sin(np.arange(len(factors)) / 2.0)
    cones = np.array([[x, side] for x in np.arange(0.0, steps.sum() + 15.0, 3.0) for side in (-2.0, 2.5)])
    cones += rng.uniform(-0.8, 0.8, cones.shape)
    check = MotionCheck(TwistNoise(np.array([0.1, 0.1, 0.01])), MotionSettings(), matching)
    for k, (step, factor) in enumerate(zip(steps, factors, strict=True)):
        place += step
        seen = cones - [place, 0.0]
        seen = seen[(seen[:, 0] > 0.0) & (seen[:, 0] < 12.0)]
        twists = np.column_stack([10.0 * step * factor + 1e-6 * np.arange(10), np.zeros((10, 2))])
        if noisy:
            seen += rng.normal(0.0, np.sqrt(variance), seen.shape)
            twists += rng.normal(0.0, [0.1, 0.1, 0.01], twists.shape)
        claimed = np.tile(variance * np.eye(2), (len(seen), 1, 1))
        cycle = replace(_cycle(0.1 * (k + 1), seen), covariances=claimed)
        motions.append(check.update(Odometry(0.1 * k + 0.01 * np.arange(10), twists), cycle))
    return check, motions, steps


def test_an_excess_of_four_is_that_of_covariances_four_times_as_large() -> None:
    """What is doubted, what takes its place, and what is learned of the sensor are the same."""
    plain = replace(MATCHING, sigma_cone=1e-6, huber=np.inf, misfit_gain=1e-9)
    slip = np.where((np.arange(40) >= 20) & (np.arange(40) < 25), 2.5, 1.0)[:, None] * np.ones(10)
    check, motions, _ = past_cones(slip, matching=replace(plain, large_misfit=0.25))
    other, wide, _ = past_cones(slip, variance=0.04, matching=plain)
    assert [motion.fault for motion in motions] == [motion.fault for motion in wide]
    assert any(motion.doubted for motion in motions)
    for motion, same in zip(motions, wide, strict=True):
        found, expected = motion.odometry, same.odometry
        np.testing.assert_allclose(found.delta, expected.delta, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(found.covariance, expected.covariance, rtol=1e-5, atol=1e-10)
    np.testing.assert_allclose(check.errors.covariance, other.errors.covariance, rtol=1e-5, atol=1e-10)


def with_slip(seed: int, begins: float) -> tuple[list[MeasuredMotion], Array]:
    """Returns the motions of a noisy drive that slips from a share of cycle 20 on, and true ones (k,), m."""
    slips = np.arange(24)[:, None] + np.arange(10) / 10.0 >= 20.0 + begins
    return past_cones(np.where(slips, 2.5, 1.0), seed, noisy=True)[1:]


def test_a_slip_that_begins_between_two_cycles_is_in_the_covariance_of_what_takes_its_place() -> None:
    """Cycle 20 slips in its last three tenths, which is too little to be seen; cycle 21 does throughout.

    The error of both together has the variance that they claim: the mean of 12 squares is below 1.75, the
    95th percentile of a twelfth of chi-square. It is 2.9 where the first one isn't thought of.
    """
    squares = []
    for seed in range(12):
        motions, true = with_slip(seed, begins=0.7)
        both = motions[20:22]
        assert both[1].doubted and not motions[19].doubted
        error = sum(float(motion.odometry.delta[0]) for motion in both) - true[20:22].sum()
        squares.append(error**2 / sum(float(motion.odometry.covariance[0, 0]) for motion in both))
    assert np.mean(squares) < 1.75


def test_a_motion_by_detections_has_sigmas_for_the_estimator_that_uses_them_again() -> None:
    """They are 1.5 times what the detections know: squares of errors across are 0.2 on average, not 0.5."""
    squares = []
    for seed in range(12):
        for motion in with_slip(seed, begins=0.0)[0][20:]:
            assert motion.doubted
            squares.append(float(motion.odometry.delta[1]) ** 2 / float(motion.odometry.covariance[1, 1]))
    assert 0.15 < np.mean(squares) < 0.35


@pytest.mark.parametrize(
    ("first", "later", "doubted"), [(2.5, 20, True), (2.5, 100, True), (2.5, 130, False), (1.0, 20, False)]
)
def test_an_odometry_that_was_contradicted_is_doubted_earlier_for_12_s(
    first: float, later: int, doubted: bool
) -> None:
    """Readings are 25 % too high so many cycles after half a second at `first` times."""
    k = np.arange(17 + later)
    factors = np.where((k >= 10) & (k < 15), first, np.where(k >= 15 + later, 1.25, 1.0))
    motions = past_cones(factors[:, None] * np.ones(10))[1]
    assert any(motion.doubted for motion in motions[15 + later :]) is doubted


def _cycle(t: float, points: Array) -> Detections:
    covariances = np.tile(0.01 * np.eye(2), (len(points), 1, 1))
    return Detections(t, points, covariances, np.full(len(points), 2))
