"""What once no test noticed: Huber weights of lines, and the sigmas of the first measurement."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from pathspace_graph.factors.noise import RayNoise
from pathspace_graph.front_end.front_end import measure_log
from pathspace_graph.front_end.noise import FIRST
from pathspace_graph.io.log import Detections
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.sim.sensor import LineSettings
from pathspace_graph.sim.simulate import SimulationSettings, preset, simulate
from pathspace_graph.sim.track_generator import generate_track

from .scenes import Camera

SENSOR = np.array([0.02, 0.1, 0.06, 0.05, 0.1])
BEND = -0.004


def test_points_of_no_line_hardly_change_the_constants_of_the_sensor() -> None:
    """One in twenty is off by about 2 m; plain least squares would shift scale and lateral offset."""
    sensor = preset({"sensor": "line"}).sensor
    sensor = replace(sensor, range_max=30.0, range_sigma=0.03, range_sigma_growth=0.02, bearing_sigma=0.006)
    sensor = replace(sensor, range_bend=BEND, range_bend_from=8.0)
    settings = SimulationSettings(laps=1, sensor=sensor, line=LineSettings(spacing=2.0))
    log, rng = simulate(generate_track(np.random.default_rng(3)), settings, 3), np.random.default_rng(0)
    cycles = list[Detections]()
    for cycle in log.cycles:
        off = 2.0 * rng.normal(size=cycle.points_vehicle.shape)
        off *= rng.uniform(size=(len(off), 1)) < 0.05
        cycles.append(replace(cycle, points_vehicle=cycle.points_vehicle + off))
    clean, found = (
        measure_log(one, MapperSettings(kind="line")) for one in (log, replace(log, cycles=tuple(cycles)))
    )
    assert clean is not None and found is not None
    assert (np.abs(found.sensor - clean.sensor) < 3.0 * clean.sensor_sigma).all()
    assert found.range_bend == pytest.approx(BEND, rel=0.25)


def test_errors_are_within_their_sigmas_in_the_first_measurement_too() -> None:
    """It has a few stretches alone, whose scatter tells little, and errors that stay with each cone."""
    along, across = RayNoise(np.array([0.1, 0.02]), 0.5, 2.0), RayNoise(np.array([0.0, 0.012]), 0.8, 2.0)
    camera = Camera(along, across, SENSOR, seconds=FIRST)
    off = np.array([(one.sensor - SENSOR) / one.sensor_sigma for one in map(camera.found, range(30))])
    assert (off**2).sum() < chi2.ppf(0.999, off.size), np.sqrt((off**2).mean(axis=0))
