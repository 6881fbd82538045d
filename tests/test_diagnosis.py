"""What a calibration says in words, where its prior did not expect it."""

from __future__ import annotations

import numpy as np
import pytest

from pathspace_graph.diagnosis import CAUSES, by_prior, diagnose
from pathspace_graph.factors.sensor import SENSOR
from pathspace_graph.io.log import CALIBRATION
from pathspace_graph.io.results import VehicleState

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


def test_the_line_says_how_far_off_it_is() -> None:
    (line,) = diagnose(state(range_bias=0.4), SETTINGS)
    assert line.endswith("(4.0 sigmas of its prior)")


def test_calibrations_are_counted_in_the_sigmas_of_their_priors() -> None:
    found = by_prior(state(yaw=0.02, bias=-0.001), SETTINGS)
    assert found["yaw"] == pytest.approx(2.0)
    assert found["bias"] == pytest.approx(-0.5)
    assert set(found) == {*CALIBRATION, *SENSOR}


def test_settings_of_another_estimator_give_no_line() -> None:
    assert diagnose(state(yaw=1.0), {}) == []


def test_every_calibration_has_a_cause() -> None:
    assert set(CAUSES) == {*CALIBRATION, *SENSOR}
