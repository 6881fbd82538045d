"""What the check of the odometry learns of the sensor's yaw and latency."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pathspace_graph.factors.noise import TwistNoise
from pathspace_graph.front_end.front_end import FrontEnd, judge_log
from pathspace_graph.front_end.motion import MotionCheck
from pathspace_graph.io.log import Log
from pathspace_graph.run import split_odometry
from pathspace_graph.settings.mapper import CalibrationSettings, MapperSettings, MotionSettings
from pathspace_graph.sim.faults import Faults, SensorFaults
from pathspace_graph.sim.sensor import OdometryNoise
from pathspace_graph.sim.simulate import SimulationSettings, simulate

from ..scenes.drives import bean_track

SETTINGS = MotionSettings()


def drive(**faults: float) -> Log:
    odometry = OdometryNoise(scale=0.0, gyro_bias=0.0)
    settings = SimulationSettings(laps=2, odometry=odometry, faults=Faults(sensor=SensorFaults(**faults)))
    return simulate(bean_track(), settings, seed=1)


@pytest.mark.parametrize(
    ("faults", "expected"),
    [({}, (0.0, 0.0)), ({"yaw": -0.03}, (-0.03, 0.0)), ({"latency": 0.06}, (0.0, 0.06))],
    ids=["none", "yaw", "latency"],
)
def test_a_drive_shows_the_errors_of_its_sensor(
    faults: dict[str, float], expected: tuple[float, float]
) -> None:
    log = drive(**faults)
    check = MotionCheck(TwistNoise(log.odometry_sigma), SETTINGS)
    first = check.errors.covariance.diagonal()
    for odometry, cycle in split_odometry(log):
        check.update(odometry, cycle)
    assert (check.errors.covariance.diagonal() < 0.2**2 * first).all()
    assert (np.abs(check.errors.mean - expected) < (0.003, 0.006)).all()
    assert check.errors.contradict(CalibrationSettings()) == bool(faults)


def test_priors_of_a_turned_sensor_lie_about_its_yaw_from_the_cycle_on_that_shows_it() -> None:
    """A recorded car's sensor is turned by 6.5 degrees, of which a prior about zero would hide the most."""
    log, settings = drive(yaw=0.1134), MapperSettings()
    front_end = FrontEnd(settings, log.noise)
    readings = (front_end.update(*cycle) for cycle in split_odometry(log))
    first = next(reading for reading in readings if reading.sensor_doubted)
    assert first.measured is not None
    found = first.measured.calibration
    assert found.sigma_yaw == found.yaw > settings.calibration.widened().sigma_yaw
    assert found.yaw == pytest.approx(0.1134, abs=1.5 * found.sigma_yaw)
    assert first.measured.odometry == settings.odometry


def test_the_prior_of_a_sensor_becomes_wide_for_a_batch_where_the_drive_contradicts_it() -> None:
    turned, settings = drive(yaw=-0.03), MapperSettings(noise="stated")
    judged = judge_log(turned, turned.noise, settings)
    assert judged.settings.calibration == settings.calibration.widened()
    sure = replace(settings, calibration=CalibrationSettings(doubt=np.inf))
    assert judge_log(turned, turned.noise, sure).settings == sure
    none = replace(settings, calibration=CalibrationSettings(sensor=False))
    assert judge_log(turned, turned.noise, none).settings == none
    measured = judge_log(turned, turned.noise, MapperSettings()).settings.calibration
    assert measured.yaw == pytest.approx(-0.03, abs=4.0 * measured.sigma_yaw)
    assert measured.sigma_yaw < settings.calibration.widened().sigma_yaw
