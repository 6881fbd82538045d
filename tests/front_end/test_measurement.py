"""Noise and constant errors of a sensor that are measured without a map, on drives where both are known."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2

from pathspace_graph.factors._kernels import by_constants
from pathspace_graph.factors.noise import MeasuredNoise, RayNoise
from pathspace_graph.factors.se2 import to_map
from pathspace_graph.factors.sensor import BENDS_FROM
from pathspace_graph.front_end import measurement
from pathspace_graph.front_end.front_end import measure_log
from pathspace_graph.front_end.measurement import (
    MIN_ROWS,
    MODEL_ERROR,
    OF_BEND,
    PASSES,
    PRIOR,
    ROUNDS_AGAIN,
    ROUNDS_FIRST,
    TwistRecord,
)
from pathspace_graph.front_end.noise import begun, measure_noise
from pathspace_graph.io.log import Log
from pathspace_graph.sim.simulate import SimulationSettings, preset, simulate
from pathspace_graph.sim.track_generator import generate_track

from .scenes import WHITE, Camera

Array = NDArray[np.float64]

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
        np.testing.assert_allclose(one.odometry, WHITE, rtol=0.15)
        assert one.interval == pytest.approx(0.02) and one.period == pytest.approx(0.1)
        assert 55.0 < one.seconds <= 60.0
        assert one.count >= 5 and one.per_cycle > 5.0


def test_too_few_cones_say_nothing_of_the_sensor() -> None:
    cycles, twists = CAMERAS["white"].drive(0)
    some = measure_noise(cycles[:8], twists)
    assert some is not None and some.along is None and some.across is None
    assert np.isinf(some.sensor_sigma).all()
    assert len(cycles[0].detections.labels) < MIN_ROWS
    assert measure_noise(cycles, TwistRecord()) is None


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


def test_in_steps_it_is_the_same_and_none_is_long() -> None:
    cycles, twists = CAMERAS["white"].drive(0)
    whole = measure_noise(cycles, twists)
    steps, parts = 0, begun(cycles, twists, None, of_lines=False)
    assert parts is not None and whole is not None
    while (found := parts.advance()) is None:
        steps += 1
    np.testing.assert_array_equal(found.sensor, whole.sensor)
    assert steps + 1 == PASSES + ROUNDS_FIRST + (PASSES - 1) * ROUNDS_AGAIN
