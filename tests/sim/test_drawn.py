"""Ranges that bend, scales, and false travel have their stated size; each seed draws another car."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from pathspace_graph.errors import SettingsError
from pathspace_graph.io.log import Log
from pathspace_graph.io.log_files import read_log, write_log
from pathspace_graph.sim.faults import Faults, OdometryFaults, SensorFaults, VehicleFaults
from pathspace_graph.sim.sensor import ConeSensor, OdometryNoise, SensorSettings
from pathspace_graph.sim.simulate import SimulationSettings, draw_car, preset, simulate
from pathspace_graph.sim.vehicle import VehicleSettings

from ..scenes.drives import bean_track

# --- single errors ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("bend", [0.004, -0.003])
@pytest.mark.parametrize("place", [6.0, 9.0, 20.0])
def test_ranges_bend_by_the_square_beyond_their_begin(bend: float, place: float) -> None:
    settings = SensorSettings(
        range_max=30.0, range_bend=bend, range_bend_from=9.0, blind_fraction=0.0, false_positives=0.0
    )
    cones = np.tile([[place, 0.0]], (4000, 1))
    sensor = ConeSensor(cones, np.zeros(4000, dtype=int), settings, np.random.default_rng(0))
    detections, _ = sensor.detect(0.0, np.zeros(3))
    errors = np.linalg.norm(detections.points_vehicle, axis=1) - place
    expected = bend * (20.0 - 9.0) ** 2 if place == 20.0 else 0.0
    assert errors.mean() == pytest.approx(expected, abs=4.0 * errors.std() / np.sqrt(len(errors)))


def test_a_bend_by_which_farther_cones_would_read_nearer_is_refused() -> None:
    SensorSettings(range_max=29.0, range_bend=-0.0249, range_bend_from=9.0)
    with pytest.raises(SettingsError, match=r"sensor\.range_bend: expected farther cones to read farther"):
        SensorSettings(range_max=29.0, range_bend=-0.0251, range_bend_from=9.0)
    with pytest.raises(SettingsError, match=r"sensor\.range_bend_from: expected a number of at least 0"):
        SensorSettings(range_bend_from=-1.0)


def test_false_travel_needs_a_vehicle_that_stands() -> None:
    with pytest.raises(SettingsError, match=r"false_travel: expected vehicle\.stand above 0, found 0"):
        SimulationSettings(faults=Faults(odometry=OdometryFaults(false_travel=1.0)))


# --- a drawn car -----------------------------------------------------------------------------------------


@cache
def drawn(seed: int) -> Log:
    return simulate(bean_track(), SimulationSettings(laps=1, draw=True), seed)


def test_a_seed_draws_the_same_log_to_the_byte_and_another_seed_another_car(tmp_path: Path) -> None:
    write_log(drawn(1), tmp_path / "one")
    write_log(simulate(bean_track(), SimulationSettings(laps=1, draw=True), 1), tmp_path / "two")
    for file in (tmp_path / "one").iterdir():
        assert file.read_bytes() == (tmp_path / "two" / file.name).read_bytes()
    one, other = drawn(1).source, drawn(2).source
    for name in ("sensor.fov", "faults.sensor.latency"):
        assert one[name] != other[name]
    assert one["draw"] == other["draw"] == "True"


def test_the_log_of_a_drawn_car_states_nothing_and_its_truth_has_all(tmp_path: Path) -> None:
    write_log(drawn(1), tmp_path / "log")
    log = read_log(tmp_path / "log")
    car = draw_car(np.random.default_rng(1).spawn(5)[4], SimulationSettings())
    assert not log.odometry_stated and not log.detections_stated and log.measured is None
    assert (log.sensor.rate, log.sensor.range_max, log.sensor.fov) == (None, None, None)
    np.testing.assert_array_equal(log.odometry_sigma, [0.25, 0.12, 0.035])
    x, y = log.cycles[0].points_vehicle[0]
    across = np.array([-y, x]) / np.hypot(x, y)
    sigma = np.sqrt(across @ log.cycles[0].covariances[0] @ across)
    assert sigma == pytest.approx(np.hypot(x, y) * np.pi / 200.0)
    truth, sensor, faults = log.truth, car.sensor, car.faults.sensor
    assert truth is not None and truth.noise is not None
    np.testing.assert_array_equal(truth.bend, [sensor.range_bend, sensor.range_bend_from])
    np.testing.assert_array_equal(
        truth.rays, [sensor.range_sigma, sensor.range_sigma_growth, sensor.bearing_sigma]
    )
    expected = [faults.yaw, faults.lateral, faults.latency, faults.range_scale, faults.range_bias]
    np.testing.assert_array_equal(truth.sensor, expected)
    np.testing.assert_array_equal(truth.noise[3:], [sensor.slow_range, sensor.slow_bearing, sensor.slow_time])
    errors = car.faults.odometry
    np.testing.assert_array_equal(truth.calibration, [errors.speed_scale, errors.yaw_rate_bias])
    assert log.source["sensor.range_bend"] == str(sensor.range_bend)
    assert log.source["faults.sensor.latency"] == str(faults.latency)


def test_the_log_of_a_drawn_car_says_whether_it_sees_cones_or_lines() -> None:
    """Taken for cones, points of lines meet no cone of an earlier pass, so that the loop stays open."""
    for sensor in ("camera", "line"):
        settings = replace(preset({"sensor": sensor}), laps=1)
        same, drawn_too = (simulate(bean_track(), one, 1) for one in (settings, replace(settings, draw=True)))
        assert drawn_too.sensor.kind == same.sensor.kind == (None if sensor == "camera" else "line")


def test_what_is_drawn_cannot_be_set_beside_it() -> None:
    camera = preset({"sensor": "camera", "odometry": "ins"})
    wrong_way = replace(camera.faults, vehicle=VehicleFaults(wrong_way=True))
    kept = replace(camera, vehicle=VehicleSettings(rate=40.0, overrun=-20.0), faults=wrong_way, draw=True)
    source = simulate(bean_track(), replace(kept, laps=1), 1).source
    assert (source["vehicle.overrun"], source["faults.vehicle.wrong_way"]) == ("-20.0", "True")
    names = ("sensor.fov", "faults.sensor.latency", "vehicle.rate")
    assert [source[name] for name in names] == [drawn(1).source[name] for name in names]
    for settings, group in (
        (SimulationSettings(sensor=SensorSettings(rate=3.0)), "sensor"),
        (SimulationSettings(odometry=OdometryNoise(scale=0.1)), "odometry"),
        (SimulationSettings(vehicle=VehicleSettings(rest=1.0)), "vehicle"),
        (SimulationSettings(faults=Faults(odometry=OdometryFaults(slip=0.1))), "faults.odometry"),
        (SimulationSettings(faults=Faults(SensorFaults(yaw=0.1))), "faults.sensor"),
    ):
        with pytest.raises(SettingsError, match=f"draw: expected no setting of {group} beside it"):
            replace(settings, draw=True)


@cache
def cars() -> list[SimulationSettings]:
    """Each of them is valid, or its settings would have been refused."""
    return [draw_car(rng, SimulationSettings()) for rng in np.random.default_rng(0).spawn(400)]


def test_drawn_cars_differ_in_everything_and_have_errors_of_either_sign() -> None:
    rates = np.array([car.sensor.rate for car in cars()])
    ranges = np.array([car.sensor.range_max for car in cars()])
    assert 5.0 <= rates.min() < 5.5 and 14.5 < rates.max() <= 15.0
    assert 12.0 <= ranges.min() < 13.0 and 39.0 < ranges.max() <= 40.0
    for signed in (
        [car.sensor.range_bend for car in cars()],
        *([getattr(car.faults.sensor, name) for car in cars()] for name in ("yaw", "latency", "range_scale")),
        [car.faults.odometry.speed_scale for car in cars()],
    ):
        assert len(set(signed)) == len(cars())
        assert np.mean(np.array(signed) > 0.0) == pytest.approx(0.5, abs=4 * 0.5 / 20.0)
    yaws = np.abs(np.rad2deg([car.faults.sensor.yaw for car in cars()]))
    assert np.mean(yaws > 2.9) == pytest.approx(0.25, abs=4 * 0.43 / 20.0) and yaws.max() < 7.0
    goes_on = [car.faults.odometry.false_travel > 0.0 for car in cars()]
    assert np.mean(goes_on) == pytest.approx(0.5, abs=4 * 0.5 / 20.0)
    assert all(car.vehicle.stand > car.faults.odometry.false_travel_time for car in cars())


def test_the_recorded_camera_lies_within_what_is_drawn() -> None:
    """A figure that no drawn car reaches would make the recorded one an outlier."""
    recorded = preset({"sensor": "camera", "odometry": "ins"})
    for name in ("rate", "range_max", "fov", "range_sigma", "bearing_sigma", "detection_falloff"):
        values = [getattr(car.sensor, name) for car in cars()]
        assert 0.97 * min(values) <= getattr(recorded.sensor, name) <= 1.03 * max(values)
    white = np.array([car.odometry.white for car in cars()])
    assert (white.min(axis=0) >= recorded.odometry.white).all() and (
        white.max(axis=0) <= OdometryNoise().white
    ).all()
