"""What a calibration says in words, where its prior did not expect it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pathspace_graph.factors.noise import MeasuredNoise, RayNoise
from pathspace_graph.factors.odometry import CALIBRATION
from pathspace_graph.factors.sensor import SENSOR
from pathspace_graph.io.results import RunNoise, VehicleState
from pathspace_graph.plausibility.diagnosis import (
    CALIBRATION_CAUSES,
    by_prior,
    diagnose,
    measured_line,
    noise_lines,
)

SETTINGS = {
    "odometry": {"sigma_scale": 0.005, "sigma_bias": 0.002},
    "calibration": {
        "sigma_yaw": 0.01,
        "sigma_lateral": 0.05,
        "sigma_latency": 0.01,
        "sigma_range_scale": 0.01,
        "sigma_range_bias": 0.1,
    },
}


def state(**values: float) -> VehicleState:
    """Returns a state with some calibrations, each known to a tenth of a thousandth."""
    names = [*CALIBRATION, *SENSOR]
    all_values = np.array([values.get(name, 0.0) for name in names])
    return VehicleState.split(np.zeros(3), all_values, 1e-8 * np.eye(10))


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("latency", 0.048, "detections are 48 ms older than their stamps"),
        ("latency", -0.048, "detections are 48 ms newer than their stamps"),
        ("yaw", -0.0349, "the sensor is turned by 2.0 degrees to the right"),
        ("lateral", 0.2, "the sensor sits 0.20 m too far to the left"),
        ("range_scale", 0.04, "ranges are 4.0 % too long"),
        ("range_bias", -0.4, "ranges are 0.40 m too short"),
        ("scale", 0.03, "speeds are 3.0 % too high"),
        ("bias", -0.02, "the yaw rate is 0.0200 rad/s too low"),
    ],
)
def test_the_likely_cause_is_said_in_words(name: str, value: float, words: str) -> None:
    (line,) = diagnose(state(**{name: value}), SETTINGS)
    assert line.startswith(words)


def test_what_the_prior_expects_is_not_worth_a_line() -> None:
    assert diagnose(state(yaw=0.029, latency=-0.029, bias=0.0059), SETTINGS) == []
    assert diagnose(state(yaw=1.0), {}) == []  # settings of another estimator


@pytest.mark.parametrize(("sigma", "words"), [(0.09, "(certain)"), (0.11, "(uncertain)")])
def test_the_line_says_whether_it_is_certain(sigma: float, words: str) -> None:
    """A calibration of four of its own standard deviations is certain, however far its prior is."""
    known = state(range_bias=0.4)
    (line,) = diagnose(replace(known, sensor_covariance=sigma**2 * np.eye(5)), SETTINGS)
    assert line == f"ranges are 0.40 m too long {words}"


def test_calibrations_are_counted_in_the_sigmas_of_their_priors() -> None:
    found = by_prior(state(yaw=0.02, bias=-0.001), SETTINGS)
    assert found["yaw"] == pytest.approx(2.0)
    assert found["bias"] == pytest.approx(-0.5)
    assert set(found) == {*CALIBRATION, *SENSOR} == set(CALIBRATION_CAUSES)


# --- measured noise --------------------------------------------------------------------------------------

ALONE = MeasuredNoise(np.array([0.0087, 0.0031, 0.0027]), np.full(3, 0.01), 0.025)
MEASURED = MeasuredNoise(
    ALONE.odometry,
    ALONE.drift,
    ALONE.interval,
    along=RayNoise(np.array([0.07, 0.03]), 0.5, 2.0),
    across=RayNoise(np.array([0.0, 0.014]), 0.8, 8.0),
    sensor=np.array([-0.0227, 0.08, -0.115, 0.1, -0.31]),
    sensor_sigma=np.array([0.005, 0.04, 0.006, 0.003, 0.03]),
)


def test_what_was_measured_is_a_line() -> None:
    assert measured_line(ALONE) == (
        "measured: odometry 0.0087 m/s, 0.0031 m/s, 0.0027 rad/s from sample to sample"
    )
    assert measured_line(MEASURED).split("; ")[1:] == [
        "detections 0.37 m along and 0.14 m across the ray at 10 m, of which 50 % and 80 % of the variance "
        "stay with a cone for 2 s and 8 s",
        "the sensor is turned by 1.3 degrees to the right, detections are 115 ms newer than their stamps, "
        "ranges are 10.0 % too long, ranges are 0.31 m too short",
    ]


def test_errors_of_the_sensor_that_are_not_clear_are_not_told() -> None:
    unclear = replace(MEASURED, sensor_sigma=np.abs(MEASURED.sensor) / 3.9)
    assert measured_line(unclear).endswith("for 2 s and 8 s")
    small = replace(MEASURED, sensor=np.full(5, 1e-3), sensor_sigma=np.full(5, 1e-5))
    assert measured_line(small) == measured_line(unclear)


def test_a_run_says_what_sets_the_size_of_its_map() -> None:
    run = RunNoise("measured", "measured", MEASURED, "odometry")
    assert noise_lines(run)[1] == (
        "ranges and speeds disagree by 10 %: the map's size is the odometry's (--calibration.trust ranges "
        "reverses that)"
    )
    assert "the ranges' (--calibration.trust odometry" in noise_lines(replace(run, size="ranges"))[1]
    assert len(noise_lines(replace(run, size=None))) == 1
    assert noise_lines(None) == noise_lines(RunNoise("stated", "stated", MEASURED)) == []
