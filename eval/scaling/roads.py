"""Drives to measure time by: ever more cones along a road, ever more detections, and lap after lap."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from pathspace_graph.eval.metrics.summary import lap_times
from pathspace_graph.io.log import Detections, Log
from pathspace_graph.sim.geometry import along_polyline, arc_lengths, left_normals, unit
from pathspace_graph.sim.sensor import SensorSettings
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track import Track
from pathspace_graph.sim.vehicle import VehicleSettings

from .settings import RoadSettings, ScalingSettings

Array = NDArray[np.float64]
IntArray = NDArray[np.int_]

STEP: Final = 0.25
"""The samples of a road's middle are this far apart (m)."""
SPARE: Final = 1.1
"""An open road has this many times the cones that are to be seen, since some are never detected."""


@dataclass(frozen=True, eq=False)
class Drives:
    """Holds the logs of the three sweeps."""

    cones: Log
    """This is a long road, up to the cycle in which the last cone asked for is seen."""
    seen: Array
    """This is the number of cones seen by the end of each cycle of that log (n,)."""
    readings: dict[int, Log]
    """This is a short dense road, by the number of detections in a cycle."""
    laps: Log
    """These are the laps of a closed road."""
    lap_ends: Array
    """The laps end at these stamps (m,), s."""

    @property
    def cycles(self) -> int:
        """Returns the number of cycles of all three sweeps together."""
        dense = max(len(log.cycles) for log in self.readings.values())
        return len(self.cones.cycles) + dense + len(self.laps.cycles)


def make_drives(settings: ScalingSettings) -> Drives:
    """Simulates the drives that the estimators are to be timed on."""
    road, seed = settings.road, settings.seed
    long = drive_log(open_road(int(settings.cones_max), road.gap, road), road, seed)
    seen = cones_seen(long)
    count = int(np.searchsorted(seen, settings.cones_max)) + 1
    dense = drive_log(open_road(settings.readings_cones, road.dense_gap, road), road, seed, dense=True)
    rng = np.random.default_rng(seed)
    laps = drive_log(closed_road(settings.laps_cones, road), road, seed, settings.laps)
    return Drives(
        cones=first_cycles(long, count),
        seen=seen[:count].astype(float),
        readings={k: thinned(dense, k, rng) for k in settings.readings},
        laps=laps,
        lap_ends=lap_times(laps),
    )


# --- roads -----------------------------------------------------------------------------------------------


def open_road(cones: int, gap: float, settings: RoadSettings) -> Track:
    """Returns a winding road that never comes near itself, on which at least `cones` cones can be seen.

    Its heading is `swing * sin(2 pi s / wavelength)` at the length s along it; cones are `gap` (m) apart.
    """
    length = SPARE * cones / 2 * gap
    s = np.arange(0.0, length, STEP)
    heading = settings.swing * np.sin(2 * np.pi * s / settings.wavelength)
    middle = STEP * np.cumsum(np.column_stack([np.cos(heading), np.sin(heading)]), axis=0)
    return _with_rows(middle, gap, settings, closed=False)


def closed_road(cones: int, settings: RoadSettings) -> Track:
    """Returns a dented circle with about `cones` cones: `r = 1 + dent cos(dents phi)`, scaled."""
    phi = np.linspace(0.0, 2 * np.pi, max(int(cones * settings.gap / STEP), 100))
    r = 1.0 + settings.dent * np.cos(settings.dents * phi)
    unscaled = r[:, None] * np.column_stack([np.cos(phi), np.sin(phi)])
    middle = unscaled * (cones / 2 * settings.gap / arc_lengths(unscaled)[-1])
    return _with_rows(middle, settings.gap, settings, closed=True)


def _with_rows(middle: Array, gap: float, settings: RoadSettings, closed: bool) -> Track:
    """Returns the road with cones on both sides of its middle (n, 2), `gap` (m) apart."""
    tangents = unit(np.gradient(middle, axis=0))
    rows = []
    for side in (0.5, -0.5):
        row = middle + side * settings.width * left_normals(tangents)
        s = arc_lengths(row)
        at = np.linspace(0.0, s[-1], max(round(s[-1] / gap), 2), endpoint=not closed)
        rows.append(along_polyline(at, s, row))
    start = np.append(middle[0], np.arctan2(tangents[0, 1], tangents[0, 0]))
    return Track(rows[0], rows[1], np.zeros((0, 2)), closed, start, "road")


# --- logs ------------------------------------------------------------------------------------------------


def drive_log(track: Track, settings: RoadSettings, seed: int, laps: int = 1, dense: bool = False) -> Log:
    """Simulates a drive along a road at full speed from the start on."""
    vehicle = VehicleSettings(
        speed_max=settings.speed,
        speed_start=settings.speed,
        acceleration_lateral=settings.acceleration_lateral,
    )
    sensor = SensorSettings(range_max=settings.dense_range) if dense else SensorSettings()
    return simulate(track, SimulationSettings(laps=laps, vehicle=vehicle, sensor=sensor), seed)


def cones_seen(log: Log) -> IntArray:
    """Returns the number of true cones that had been detected by the end of each cycle (n,)."""
    assert log.truth is not None
    assert log.truth.associations is not None
    ends = np.cumsum([len(cycle.labels) for cycle in log.cycles])
    seen, first = np.unique(log.truth.associations, return_index=True)
    return np.searchsorted(np.sort(first[seen >= 0]), ends, side="left")


def first_cycles(log: Log, count: int) -> Log:
    """Returns the first `count` cycles of a log, without truth."""
    return replace(log, cycles=log.cycles[:count], truth=None)


def thinned(log: Log, count: int, rng: Generator) -> Log:
    """Returns the drive with `count` detections a cycle, chosen at random, or all where there are fewer."""
    return replace(log, cycles=tuple(_chosen(cycle, count, rng) for cycle in log.cycles), truth=None)


def _chosen(cycle: Detections, count: int, rng: Generator) -> Detections:
    size = len(cycle.labels)
    kept = np.sort(rng.choice(size, min(count, size), replace=False))
    return Detections(cycle.t, cycle.points_vehicle[kept], cycle.covariances[kept], cycle.labels[kept])
