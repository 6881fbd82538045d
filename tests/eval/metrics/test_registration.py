"""The end of a drive by the cones that are seen standing, against the truth."""

from __future__ import annotations

import numpy as np
import pytest

from pathspace_graph.eval.metrics.alignment import NOT_STANDING, end_by_registration, standing
from pathspace_graph.front_end.front_end import measure_log, seen_cycles
from pathspace_graph.sim.faults import Faults, OdometryFaults
from pathspace_graph.sim.sensor import SensorSettings
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track_generator import generate_track
from pathspace_graph.sim.vehicle import VehicleSettings


def test_a_start_and_a_stop_that_the_odometry_misses_are_in_the_reference() -> None:
    """The odometry misses 0.4 m of the start and goes on for 3 m after the stop."""
    odometry = OdometryFaults(dead_band=1.5, false_travel=1.0, false_travel_time=3.0)
    vehicle = VehicleSettings(rest=3.0, stand=5.0, overrun=8.0)
    settings = SimulationSettings(
        laps=1, vehicle=vehicle, sensor=SensorSettings(range_max=25.0), faults=Faults(odometry=odometry)
    )
    log = simulate(generate_track(np.random.default_rng(21)), settings, seed=4)
    assert log.truth is not None
    cycles, _ = seen_cycles(log)
    noise = measure_log(log)
    assert noise is not None
    assert 20 < len(standing(cycles)) <= 55 and 20 < len(standing(cycles[::-1])) <= 35
    true = log.truth.poses[-1]
    reckoned = cycles[-1].pose
    assert np.hypot(*(reckoned[:2] - true[:2])) > 1.0
    found = end_by_registration(cycles, noise)
    assert not isinstance(found, str)
    np.testing.assert_allclose(found[:2], true[:2], atol=0.15)
    assert found[2] == pytest.approx(true[2], abs=0.02)
    moving = [one for one in cycles if one.detections.t > 4.0]
    assert end_by_registration(moving, noise) == NOT_STANDING.format("start")
    assert end_by_registration(cycles[:-60], noise) == NOT_STANDING.format("end")


def test_without_common_cones_there_is_no_reference() -> None:
    settings = SimulationSettings(laps=1, vehicle=VehicleSettings(rest=3.0, stand=5.0, overrun=-60.0))
    log = simulate(generate_track(np.random.default_rng(21)), settings, seed=4)
    noise = measure_log(log)
    assert noise is not None
    found = end_by_registration(seen_cycles(log)[0], noise)
    assert isinstance(found, str) and "fewer than" in found
