"""Whole drives with a sensor that is not what it was said to be, and with one that is."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from pathspace_graph.estimators import make_online
from pathspace_graph.eval.metrics.accuracy import lap_metrics
from pathspace_graph.factors.sensor import SENSOR
from pathspace_graph.io.log import Log
from pathspace_graph.io.results import RunResult, VehicleState
from pathspace_graph.run import run_online
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.sim.faults import Faults, SensorFaults
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track_generator import generate_track

from ..scenes.drives import SHORT

SETTINGS = MapperSettings()
KNOWN = replace(SETTINGS, calibration=replace(SETTINGS.calibration, sensor=False))


@cache
def driven(name: str = "", value: float = 0.0) -> Log:
    """Returns a lap and the first metres of the next one, by a sensor that has one error."""
    faults = Faults(sensor=SensorFaults(**({name: value} if name else {})))
    settings = SimulationSettings(laps=1, faults=faults)
    return simulate(generate_track(np.random.default_rng(3), SHORT), settings, 3)


@cache
def mapped(
    name: str, value: float, settings: MapperSettings, estimator: str
) -> tuple[RunResult, VehicleState]:
    """Returns what an estimator made of a drive, and what it knows of the vehicle at its end."""
    log = driven(name, value)
    mapper = make_online(estimator, settings, log)
    return run_online(log, mapper), mapper.vehicle_state()  # type: ignore[attr-defined]


def rmse_of(name: str = "", value: float = 0.0, settings: MapperSettings = SETTINGS) -> float:
    truth = driven(name, value).truth
    assert truth is not None
    return lap_metrics(mapped(name, value, settings, "fixed-lag")[0].map, truth, 1).rmse


@pytest.mark.parametrize(("name", "value"), [("yaw", 0.035), ("latency", 0.05), ("range_bias", 0.4)])
def test_the_error_of_a_sensor_is_found_within_its_claimed_uncertainty(name: str, value: float) -> None:
    _, state = mapped(name, value, SETTINGS, "fixed-lag")
    entry = SENSOR.index(name)
    sigma = float(np.sqrt(state.sensor_covariance[entry, entry]))
    assert abs(state.sensor[entry] - value) < 3.0 * sigma + 0.01 * value
    assert sigma < 0.2 * value


@pytest.mark.parametrize("estimator", ["fixed-lag", "landmark-fixed-lag", "ckf", "landmark-ckf"])
def test_every_estimator_finds_a_sensor_that_is_turned(estimator: str) -> None:
    _, state = mapped("yaw", 0.035, SETTINGS, estimator)
    assert state.sensor[0] == pytest.approx(0.035, abs=0.012)


def test_a_calibration_that_is_learned_is_a_notice_and_no_reason_for_doubt() -> None:
    cycles = mapped("yaw", 0.035, SETTINGS, "fixed-lag")[0].cycles
    noticed = [cycle for cycle in cycles if "calibration" in cycle.notice]
    assert len(noticed) == 1 and not noticed[0].closed
    assert not any("calibration" in cycle.reason for cycle in cycles)


def test_a_sensor_that_is_what_it_was_said_to_be_is_not_doubted() -> None:
    _, state = mapped("", 0.0, SETTINGS, "fixed-lag")
    assert (np.abs(state.sensor) < 3.0 * np.array(SETTINGS.calibration.sigmas)).all()
    assert rmse_of() < 1.1 * rmse_of(settings=KNOWN)


def test_the_map_of_a_late_sensor_is_better_if_its_latency_is_estimated() -> None:
    assert rmse_of("latency", 0.1) < 0.2 * rmse_of("latency", 0.1, KNOWN)
