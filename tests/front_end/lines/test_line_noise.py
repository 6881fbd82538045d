"""Noise and constant errors of a sensor of lines that are measured without a map, where both are known."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from pathspace_graph.factors.noise import KnownNoise, MeasuredNoise
from pathspace_graph.front_end.front_end import FrontEnd, measure_log
from pathspace_graph.io.log import Log
from pathspace_graph.run import split_odometry
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.sim.faults import Faults, SensorFaults
from pathspace_graph.sim.sensor import LineSettings
from pathspace_graph.sim.simulate import SimulationSettings, preset, simulate
from pathspace_graph.sim.track_generator import generate_track

SETTINGS = MapperSettings(kind="line")
ERRORS = SensorFaults(latency=0.1, yaw=0.03, lateral=0.05, range_scale=0.05, range_bias=-0.1)
BEND = -0.004
SENSOR = replace(
    preset({"sensor": "line"}).sensor,
    range_max=30.0,
    range_sigma=0.03,
    range_sigma_growth=0.02,
    bearing_sigma=0.006,
    range_bend=BEND,
    range_bend_from=8.0,
)


@cache
def drive() -> Log:
    """A lap with points that are too far apart to be merged, so that their noise is that of the sensor."""
    settings = SimulationSettings(
        laps=1, sensor=SENSOR, line=LineSettings(spacing=2.0), faults=Faults(sensor=ERRORS)
    )
    return simulate(generate_track(np.random.default_rng(3)), settings, 3)


@cache
def measured() -> MeasuredNoise:
    found = measure_log(drive(), SETTINGS)
    assert found is not None
    return found


def test_constant_errors_are_measured_across_lines() -> None:
    found = measured()
    truth = np.array([ERRORS.yaw, ERRORS.lateral, ERRORS.latency, ERRORS.range_scale, ERRORS.range_bias])
    assert (np.abs(found.sensor - truth) < 4.0 * found.sensor_sigma).all()
    assert (found.sensor_sigma < [0.006, 0.08, 0.01, 0.012, 0.04]).all()


def test_ranges_that_bend_are_measured_across_lines() -> None:
    assert measured().range_bend == pytest.approx(BEND, rel=0.25)


@pytest.mark.parametrize(
    ("axis", "sigma", "share"), [("along", 0.03 + 0.02 * 12.0, 0.1), ("across", 0.006 * 12.0, 0.25)]
)
def test_noise_is_measured_by_the_angle_of_the_ray(axis: str, sigma: float, share: float) -> None:
    found = getattr(measured(), axis).sigmas(np.array([12.0]))
    assert found == pytest.approx(sigma, rel=share)


def test_too_few_points_of_a_line_tell_nothing() -> None:
    found = measure_log(replace(drive(), cycles=drive().cycles[:10]), SETTINGS)
    assert found is not None
    assert found.along is None
    assert not found.sensor.any()


def test_a_drive_measures_its_lines_as_it_goes_on() -> None:
    front_end = FrontEnd(SETTINGS, KnownNoise(drive().odometry_sigma, detections_stated=False))
    for odometry, detections in list(split_odometry(drive()))[:150]:
        reading = front_end.update(odometry, detections)
    found = front_end.noise_used.measured
    assert found is not None
    assert found.sensor[0] == pytest.approx(ERRORS.yaw, abs=0.012)
    given = found.covariances(reading.stated[0].points_vehicle, inflated=True)
    assert np.array_equal(reading.detections.covariances, given)
