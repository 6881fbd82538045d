"""Drives made to measure time by: ever more cones along one long road, ever more readings of a dense one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from pathspace_graph.io.log import Detections, Log
from pathspace_graph.settings.checked import Positive
from pathspace_graph.sim.geometry import along_polyline, arc_lengths, left_normals, unit
from pathspace_graph.sim.sensor import SensorSettings
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track import Track
from pathspace_graph.sim.vehicle import VehicleSettings

Array = NDArray[np.float64]
IntArray = NDArray[np.int_]

STEP: Final = 0.25
"""Spacing of the samples of a road's middle, m."""
SPARE: Final = 1.1
"""A road has so many times the cones that are to be seen, as some of them never are."""


@dataclass(frozen=True)
class RoadSettings(Positive):
    """The roads and the drives on them."""

    gap: float = 5.0
    """Between the cones of a row, m."""
    dense_gap: float = 1.0
    """The same on the road that readings are counted on, m."""
    dense_range: float = 30.0
    """Range of the sensor there, m."""
    width: float = 4.0
    """Between the rows, m."""
    swing: float = 0.9
    """Greatest angle between an open road and its general direction, rad."""
    wavelength: float = 300.0
    """Way along an open road from one swing to the next, m."""
    dent: float = 0.12
    """How far a closed road leaves its circle, as a share of the radius."""
    dents: int = 3
    """How often it does."""
    speed: float = 20.0
    """Of the vehicle, m/s."""
    acceleration_lateral: float = 9.0
    """Greatest in corners, m/s^2."""


def open_road(cones: int, gap: float, settings: RoadSettings) -> Track:
    """A long winding road with at least so many cones that can be seen; it never comes near itself."""
    length = SPARE * cones / 2 * gap
    s = np.arange(0.0, length, STEP)
    heading = settings.swing * np.sin(2 * np.pi * s / settings.wavelength)
    middle = STEP * np.cumsum(np.column_stack([np.cos(heading), np.sin(heading)]), axis=0)
    return _with_rows(middle, gap, settings, closed=False)


def closed_road(cones: int, settings: RoadSettings) -> Track:
    """A dented circle with about so many cones."""
    phi = np.linspace(0.0, 2 * np.pi, max(int(cones * settings.gap / STEP), 100))
    r = 1.0 + settings.dent * np.cos(settings.dents * phi)
    unscaled = r[:, None] * np.column_stack([np.cos(phi), np.sin(phi)])
    middle = unscaled * (cones / 2 * settings.gap / arc_lengths(unscaled)[-1])
    return _with_rows(middle, settings.gap, settings, closed=True)


def _with_rows(middle: Array, gap: float, settings: RoadSettings, closed: bool) -> Track:
    """The road with cones on both sides of its middle (n, 2)."""
    tangents = unit(np.gradient(middle, axis=0))
    rows = []
    for side in (0.5, -0.5):
        row = middle + side * settings.width * left_normals(tangents)
        s = arc_lengths(row)
        at = np.linspace(0.0, s[-1], max(round(s[-1] / gap), 2), endpoint=not closed)
        rows.append(along_polyline(at, s, row))
    start = np.append(middle[0], np.arctan2(tangents[0, 1], tangents[0, 0]))
    return Track(rows[0], rows[1], np.zeros((0, 2)), closed, start, "road")


def drive_log(track: Track, settings: RoadSettings, seed: int, laps: int = 1, dense: bool = False) -> Log:
    """What is recorded on a drive at speed from the start on."""
    vehicle = VehicleSettings(
        speed_max=settings.speed,
        speed_start=settings.speed,
        acceleration_lateral=settings.acceleration_lateral,
    )
    sensor = SensorSettings(range_max=settings.dense_range) if dense else SensorSettings()
    return simulate(track, SimulationSettings(laps=laps, vehicle=vehicle, sensor=sensor), seed)


def cones_seen(log: Log) -> IntArray:
    """How many true cones had been detected by the end of each cycle (n,)."""
    assert log.truth is not None
    assert log.truth.associations is not None
    ends = np.cumsum([len(cycle.labels) for cycle in log.cycles])
    seen, first = np.unique(log.truth.associations, return_index=True)
    return np.searchsorted(np.sort(first[seen >= 0]), ends, side="left")


def first_cycles(log: Log, count: int) -> Log:
    """The beginning of a log, without truth."""
    return replace(log, cycles=log.cycles[:count], truth=None)


def thinned(log: Log, readings: int, rng: Generator) -> Log:
    """The same drive with so many readings a cycle, drawn anew in each; fewer where there aren't as many."""
    return replace(log, cycles=tuple(_drawn(cycle, readings, rng) for cycle in log.cycles), truth=None)


def _drawn(cycle: Detections, readings: int, rng: Generator) -> Detections:
    size = len(cycle.labels)
    kept: Sequence[int] | IntArray = np.sort(rng.choice(size, min(readings, size), replace=False))
    return Detections(cycle.t, cycle.points_vehicle[kept], cycle.covariances[kept], cycle.labels[kept])
