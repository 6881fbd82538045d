"""Noise that is learned in a drive: never read ahead, only where nobody has stated it, and what it is for."""

from __future__ import annotations

from dataclasses import replace
from math import inf

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.factors.noise import ASSUMED_DRIFT, KnownNoise, MeasuredNoise, RayNoise
from pathspace_graph.front_end import noise as noise_module
from pathspace_graph.front_end.front_end import FrontEnd, judge_log, measure_log
from pathspace_graph.front_end.noise import NoiseLearner
from pathspace_graph.io.log import Log
from pathspace_graph.run import split_odometry
from pathspace_graph.settings.mapper import CalibrationSettings, MapperSettings, OdometrySettings

from ..scenes.drives import detections, short_drive

Array = NDArray[np.float64]

STATED = np.array([0.25, 0.12, 0.035])
SETTINGS = MapperSettings()
SIGMA = np.array([0.001, 0.01, 0.002, 0.002, 0.01])
"""Of the measured errors of the sensor."""


def noise(sensor: Array | None = None, odometry: float = 0.02, **fields: object) -> MeasuredNoise:
    """Returns measured noise, of the sensor's errors as well."""
    return MeasuredNoise(
        np.array([odometry, 0.02, 0.003]),
        np.array([0.012, 0.006, 0.0017]),
        0.02,
        along=RayNoise(np.array([0.1, 0.02]), 0.5, 2.0),
        across=RayNoise(np.array([0.0, 0.01]), 0.8, 1.0),
        count=20,
        sensor=np.zeros(5) if sensor is None else sensor,
        sensor_sigma=SIGMA,
        **fields,  # type: ignore[arg-type]
    )


def learner(
    measured: MeasuredNoise | None, odometry: bool = False, cones: bool = False, use: str | None = None
) -> NoiseLearner:
    """Returns a learner that knows what was measured, and whether noise of odometry and cones was stated."""
    return NoiseLearner(KnownNoise(STATED, odometry, cones, measured), use)


# --- what is used ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("odometry", "cones", "use", "measured"),
    [
        (True, True, None, (False, False)),
        (False, True, None, (True, False)),
        (True, False, None, (False, True)),
        (False, False, None, (True, True)),
        (True, True, "measured", (True, True)),
        (False, False, "stated", (False, False)),
    ],
)
def test_noise_is_measured_where_nobody_has_stated_it_or_where_that_is_asked_for(
    odometry: bool, cones: bool, use: str | None, measured: tuple[bool, bool]
) -> None:
    known = learner(noise(), odometry, cones, use)
    assert (known.of_odometry, known.of_detections) == measured
    np.testing.assert_array_equal(known.twist.white, noise().odometry if measured[0] else STATED)
    drift = noise().drift if measured[0] else ASSUMED_DRIFT if odometry else np.zeros(3)
    np.testing.assert_array_equal(known.twist.drift, drift)
    seen = detections(0.0, np.array([[10.0, 2.0]]), np.zeros(1, np.intp))
    expected = noise().covariances(seen.points_vehicle, inflated=True)
    if use == "stated":
        expected = seen.covariances
    elif not measured[1]:  # it is stated for single detections
        expected = noise().inflated(seen.points_vehicle, seen.covariances)
    assert expected is not None
    found = known.for_map(seen)
    np.testing.assert_array_equal(found.covariances, expected)
    np.testing.assert_array_equal(found.points_vehicle, seen.points_vehicle)
    assert not known.is_learning  # it was measured before
    assert known.is_settled


def test_detections_lose_the_bend_of_their_ranges() -> None:
    """One at 18 m by a bend of 0.01 per m, `10^2 0.01` m too far, for the map and for comparisons."""
    seen = detections(0.0, np.array([[0.0, 18.0], [5.0, 0.0]]), np.zeros(2, np.intp))
    known = learner(replace(noise(), range_bend=0.01))
    for found in (known.for_map(seen), known.for_check(seen, np.zeros(3))):
        np.testing.assert_allclose(found.points_vehicle, [[0.0, 17.0], [5.0, 0.0]], atol=1e-12)


def test_for_comparisons_detections_are_single_and_without_constant_errors() -> None:
    errors, twist = np.array([0.02, 0.1, 0.05, 0.1, 0.2]), np.array([8.0, 0.0, 0.4])
    seen = detections(0.0, np.array([[10.0, 0.0]]), np.zeros(1, np.intp))
    found = learner(noise(errors)).for_check(seen, twist)
    expected = noise().covariances(seen.points_vehicle, inflated=False)
    assert expected is not None
    np.testing.assert_allclose(found.points_vehicle, [[8.4, 0.1]], atol=1e-12)
    np.testing.assert_array_equal(found.covariances, expected)
    stated = learner(noise(errors), cones=True).for_check(seen, twist)
    np.testing.assert_array_equal(stated.points_vehicle, found.points_vehicle)
    assert stated.covariances is seen.covariances
    assert learner(noise(errors), cones=True, use="stated").for_check(seen, twist) is seen
    unsure = learner(noise(3.9 * SIGMA)).for_check(seen, twist)
    np.testing.assert_array_equal(unsure.points_vehicle, seen.points_vehicle)
    assert learner(None).for_check(seen, twist) is seen


def test_what_is_not_measured_yet_is_assumed() -> None:
    known = learner(None)
    assert known.is_learning and not known.is_settled
    np.testing.assert_array_equal(known.twist.white, STATED)
    seen = detections(0.0, np.array([[10.0, 2.0]]), np.zeros(1, np.intp))
    assert known.for_map(seen) is seen
    assert known.calibrated(SETTINGS) is SETTINGS
    odometry_only = learner(MeasuredNoise(np.full(3, 0.1), np.full(3, 0.01), 0.02))
    assert not odometry_only.is_settled
    assert odometry_only.for_map(seen).covariances is seen.covariances
    assert odometry_only.calibrated(SETTINGS) is SETTINGS


def test_a_gap_of_five_seconds_is_one_second_of_driving(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first measurement begins after 8 s of driving, which the ninth of these cycles completes."""
    began, known, log = list[int](), learner(None), short_drive()
    monkeypatch.setattr(noise_module, "begun", lambda cycles, *_, **__: began.append(len(cycles)))
    motion = FrontEnd(SETTINGS, log.noise).update(*next(split_odometry(log))).motion
    twist = replace(motion.odometry, twist=np.array([5.0, 0.0, 0.0]))
    for k in range(9):
        seen = detections(5.0 * k, np.zeros((0, 2)), np.zeros(0, np.intp))
        known.observe(log.odometry, seen, replace(motion, odometry=twist), np.zeros(3))
        assert began == ([9] if k == 8 else [])


# --- calibrations ----------------------------------------------------------------------------------------

PRIORS = np.array(CalibrationSettings().sigmas)
PRIORS[3] = np.hypot(PRIORS[3], OdometrySettings().sigma_scale)
"""The scale of the ranges can only be seen beside that of the speeds."""
SMALL = 3.0 * np.hypot(SIGMA, PRIORS)
SMALL[3] *= 0.8
"""Three sigmas of measurement and prior together do not contradict the prior, and five do."""


@pytest.mark.parametrize("entry", range(5))
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_settings_stay_where_no_prior_is_contradicted(entry: int, sign: float) -> None:
    errors = np.zeros(5)
    errors[entry] = sign * SMALL[entry]
    assert learner(noise(errors), cones=True).calibrated(SETTINGS) is SETTINGS
    errors[entry] *= 5.0 / 3.0
    assert learner(noise(errors)).calibrated(SETTINGS) is not SETTINGS
    assert learner(noise(errors), cones=True).calibrated(SETTINGS) is not SETTINGS
    assert learner(noise(errors), cones=True, use="stated").calibrated(SETTINGS) is SETTINGS
    fixed = replace(SETTINGS, calibration=CalibrationSettings(sensor=False))
    assert learner(noise(errors)).calibrated(fixed) is fixed


def test_an_error_that_is_known_already_contradicts_nothing() -> None:
    known = CalibrationSettings(yaw=0.05, range_scale=0.08)
    settings = replace(SETTINGS, calibration=known)
    errors = np.array([0.05, 0.0, 0.0, 0.08, 0.0])
    assert learner(noise(errors), cones=True).calibrated(settings) is settings
    assert learner(noise(), cones=True).calibrated(settings) is not settings


@pytest.mark.parametrize(
    ("stated", "sigma", "errors", "bend", "known"),
    [
        (True, None, [0.05, 0.3, 0.1, 0.0, 0.0], 0.0, True),  # what is contradicted is the mounting
        (True, None, [0.0, 0.0, 0.0, 0.0, 0.2], 0.0, False),
        (True, 0.0005, [0.0, 0.0, 0.0, 0.0, 0.2], 0.0, True),
        (True, 0.0005, [0.05, 0.0, 0.0, 0.08, 0.0], 0.0, False),
        (True, 0.0005, [0.05, 0.0, 0.0, 0.0, 0.0], 0.004, False),
        (False, None, [0.0, 0.0, 0.0, 0.0, 0.0], 0.0, False),  # a sensor of which nobody knows anything
        (False, 0.0005, [0.05, 0.0, 0.0, 0.0, 0.0], 0.0, True),
    ],
)
def test_the_ranges_keep_their_scale_as_long_as_it_is_known(
    stated: bool, sigma: float | None, errors: list[float], bend: float, known: bool
) -> None:
    measured = replace(noise(np.array(errors)), range_bend=bend)
    own = learner(measured, cones=stated)
    own.known = replace(own.known, sigma_range_scale=sigma)
    found = own.calibrated(SETTINGS)
    assert found.odometry.hold_scale != known
    before = SETTINGS.calibration
    kept = (found.calibration.range_scale, found.calibration.sigma_range_scale)
    assert (kept == (before.range_scale, before.sigma_range_scale)) == known


@pytest.mark.parametrize(("yaw", "sigmas"), [(0.0, 3.2), (0.05, 2.0)])
def test_a_wrong_scale_is_likelier_of_a_sensor_with_another_error(yaw: float, sigmas: float) -> None:
    off = sigmas * np.hypot(SIGMA[3], PRIORS[3])
    for share, known in ((0.95, True), (1.05, False)):
        errors = np.array([yaw, 0.0, 0.0, share * off, 0.0])
        found = learner(noise(errors), cones=True).calibrated(SETTINGS)
        assert found.odometry.hold_scale != known


def test_a_stated_scale_of_the_ranges_is_the_prior_from_the_first_cycle() -> None:
    own = learner(None)
    own.known = replace(own.known, sigma_range_scale=0.01)
    assert own.calibrated(SETTINGS).calibration == replace(SETTINGS.calibration, sigma_range_scale=0.01)


ERRORS = np.array([0.05, -0.3, 0.1, 0.08, 0.2])


def test_where_the_odometry_is_trusted_the_ranges_take_the_whole_ratio() -> None:
    """The scale of the speeds is as good as known, and its uncertainty is that of the size."""
    settings = replace(SETTINGS, calibration=CalibrationSettings(trust="odometry"))
    found = learner(noise(ERRORS)).calibrated(settings)
    assert found.odometry == replace(settings.odometry, hold_scale=True)
    assert found.odometry.sigmas == (0.02 * settings.odometry.sigma_scale, settings.odometry.sigma_bias)
    assert found.odometry.sigma_size == settings.odometry.sigma_scale
    assert settings.odometry.sigma_size == 0.0
    doubted = found.odometry.widened()
    assert doubted.sigmas[0] == found.odometry.sigmas[0]  # never both free
    assert doubted.sigma_bias > settings.odometry.sigma_bias
    np.testing.assert_array_equal(found.calibration.means, ERRORS)
    expected = np.maximum(SIGMA, settings.calibration.sigmas)
    expected[3] = 0.02
    np.testing.assert_array_equal(found.calibration.sigmas, expected)
    assert found.calibration.doubt == inf
    assert replace(found, odometry=settings.odometry, calibration=settings.calibration) == settings


def test_the_trusted_scale_is_held_whatever_error_contradicts_its_prior() -> None:
    """Ranges that err far out alone look right near by: the scale of the speeds would take their errors."""
    yaw_only = np.array([0.2, 0.0, 0.0, 0.0, 0.0])
    settings = replace(SETTINGS, calibration=CalibrationSettings(trust="odometry"))
    found = learner(noise(yaw_only)).calibrated(settings)
    assert found.odometry == replace(settings.odometry, hold_scale=True)
    assert found.calibration.sigma_range_scale == 0.02
    np.testing.assert_array_equal(found.calibration.means, yaw_only)
    by_ranges = replace(SETTINGS, calibration=CalibrationSettings(trust="ranges"))
    found = learner(noise(yaw_only)).calibrated(by_ranges)
    assert found.odometry == SETTINGS.odometry
    assert found.calibration.range_scale == 0.0
    assert found.calibration.sigma_range_scale == SETTINGS.calibration.sigma_range_scale


def test_where_the_ranges_are_trusted_the_speeds_take_the_whole_ratio() -> None:
    """Ranges 8 % too long by true speeds are speeds that read `1 / 1.08` of what they should."""
    settings = replace(
        SETTINGS, calibration=CalibrationSettings(trust="ranges"), odometry=OdometrySettings(bias=0.01)
    )
    found = learner(noise(ERRORS)).calibrated(settings)
    assert found.odometry.scale == pytest.approx(1.0 / 1.08 - 1.0)
    assert found.odometry.bias == 0.01 and found.odometry.doubt == inf
    assert found.odometry.sigma_scale >= settings.odometry.sigma_scale
    expected = np.where(np.arange(5) == 3, 0.0, ERRORS)
    np.testing.assert_array_equal(found.calibration.means, expected)
    assert found.calibration.sigma_range_scale == settings.calibration.sigma_range_scale


@pytest.mark.parametrize("share", [0.5, 2.0])
def test_a_measured_error_is_no_more_certain_than_before_and_no_less_than_measured(share: float) -> None:
    """Sigmas of half the prior's give the prior's, and of twice the prior's themselves."""
    prior = np.array(SETTINGS.calibration.sigmas)
    measured = replace(noise(np.array([0.2, 0.0, 0.0, 0.0, 0.0])), sensor_sigma=share * prior)
    by_ranges = replace(SETTINGS, calibration=CalibrationSettings(trust="ranges"))
    found = np.array(learner(measured).calibrated(by_ranges).calibration.sigmas)
    expected = max(share, 1.0) * prior
    expected[3] = prior[3]  # what the ranges are trusted for
    np.testing.assert_allclose(found, expected)


def test_odometry_sets_the_size_of_the_map_where_a_range_is_known_worse_than_its_scale() -> None:
    """Half a per cent, of 10 m, are 5 cm."""
    sharp, rough = (
        learner(replace(noise(), along=RayNoise(np.array([sigma, 0.0]), 0.5, 2.0)))
        for sigma in (0.049, 0.051)
    )
    assert not sharp.trusts_odometry(SETTINGS)
    assert rough.trusts_odometry(SETTINGS)
    for trust, expected in (("odometry", True), ("ranges", False)):
        own = replace(SETTINGS, calibration=CalibrationSettings(trust=trust))  # type: ignore[arg-type]
        assert sharp.trusts_odometry(own) is expected
        assert rough.trusts_odometry(own) is expected


# --- learning --------------------------------------------------------------------------------------------


def unstated(log: Log) -> Log:
    return replace(log, odometry_stated=False, detections_stated=False)


def cut(log: Log, cycles: int) -> Log:
    """The log of its first cycles."""
    until = log.cycles[cycles - 1].t
    return replace(log, odometry=log.odometry.between(-inf, until), cycles=log.cycles[:cycles])


def test_a_learner_never_reads_ahead() -> None:
    """After each cycle of a log it knows the same as at the end of the log that ends there."""
    log = unstated(short_drive())
    front_end, fresh = FrontEnd(SETTINGS, log.noise), []
    for k, (odometry, cycle) in enumerate(split_odometry(log)):
        before = front_end.noise.measured
        front_end.update(odometry, cycle)
        if front_end.noise.measured is not before:
            fresh.append((k + 1, front_end.noise.measured))
    assert len(fresh) >= 2
    for count, expected in fresh:
        again = FrontEnd(SETTINGS, log.noise)
        for odometry, cycle in split_odometry(cut(log, count)):
            again.update(odometry, cycle)
        found = again.noise.measured
        assert found is not None and expected is not None
        np.testing.assert_array_equal(found.odometry, expected.odometry)
        np.testing.assert_array_equal(found.sensor, expected.sensor)


def test_a_copy_takes_the_steps_of_a_measurement_by_itself() -> None:
    """Copies from before and from within the first one know the same as the original after each cycle."""
    log = cut(unstated(short_drive()), 110)
    front_end, copies, known = FrontEnd(SETTINGS, log.noise), list[FrontEnd](), list[Array | None]()

    def sensor(one: FrontEnd) -> Array | None:
        return None if one.noise.measured is None else one.noise.measured.sensor

    for cycle in split_odometry(log):
        copies.append(front_end.copy())
        front_end.update(*cycle)
        known.append(sensor(front_end))
    assert known[80] is None and known[-1] is not None
    for k in (70, 84, 85, 90, 99):
        for expected, cycle in list(zip(known, split_odometry(log), strict=True))[k:]:
            copies[k].update(*cycle)
            np.testing.assert_array_equal(sensor(copies[k]), expected)


def test_noise_is_measured_after_8_s_of_driving_and_after_half_as_much_again_each_time() -> None:
    log, begins = unstated(short_drive()), list[float]()
    front_end = FrontEnd(SETTINGS, log.noise)
    for odometry, cycle in split_odometry(log):
        noise = front_end.noise
        before, idle = noise.measured, noise._steps is None
        front_end.update(odometry, cycle)
        if idle and noise._steps is not None:
            begins.append(cycle.t)
        if noise.measured is not before:
            assert noise.measured is not None
            assert noise.measured.seconds == pytest.approx(begins[-1], abs=0.7)
            np.testing.assert_array_equal(front_end._motion.noise.white, noise.measured.odometry)
    np.testing.assert_allclose(begins, [8.0, 12.0, 18.0], atol=0.5)


def test_stated_noise_stays_unless_errors_stay() -> None:
    """The mean of 20 detections is then more than 1.5 times as uncertain."""
    seen = detections(0.0, np.array([[10.0, 2.0]]), np.zeros(1, np.intp))
    for share, same in ((0.05, True), (0.5, False)):
        ray = RayNoise(np.array([0.1, 0.02]), share, 1.0)
        known = learner(replace(noise(), along=ray, across=ray), cones=True)
        assert (ray.inflation(20, 0.1) < 1.5**2) == same
        assert (known.for_map(seen).covariances is seen.covariances) == same


def test_a_whole_log_is_measured_before_it_is_judged() -> None:
    log = unstated(short_drive())
    measured = measure_log(log)
    assert measured is not None and measured.along is not None
    judged = judge_log(log, log.noise, SETTINGS)
    expected = measured.covariances(log.cycles[0].points_vehicle, inflated=True)
    np.testing.assert_array_equal(judged.cycles[0].covariances, expected)
    stated = judge_log(short_drive(), short_drive().noise, SETTINGS)
    np.testing.assert_array_equal(stated.cycles[0].covariances, log.cycles[0].covariances)
