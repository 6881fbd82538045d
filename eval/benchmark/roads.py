"""Roads and drives to measure time by: more and more cones or detections, lap after lap, and dense lines."""

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.random import Generator

from pathspace_graph.eval.metrics.summary import lap_times
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.io.log import Log
from pathspace_graph.settings.evaluation import ScalingSettings
from pathspace_graph.sim.curves import along_polyline, arc_lengths, left_normals, unit
from pathspace_graph.sim.lines import LINE, LineSettings
from pathspace_graph.sim.sensor import SensorSettings
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track import Track
from pathspace_graph.sim.vehicle import VehicleSettings

GAP, DENSE_GAP, DENSE_RANGE = 5.0, 1.0, 30.0  # distances of cones in a row, and dense with its range (m)
LINE_POINTS: Final = 300  # points of both lines in a cycle, in the mean
LINE_SPACING: Final = 0.2  # distance of a cycle's points along each line, which gives that many (m)
WIDTH: Final = 4.0  # distance of the rows (m)
SWING, WAVELENGTH = 0.9, 300.0  # largest turn from a road's direction (rad), and length of a swing (m)
DENT, DENTS = 0.12, 3  # share of the radius by which a closed road leaves its circle, and how often it does
SPEED, LATERAL = 20.0, 9.0  # speed of the vehicle (m/s) and its largest lateral acceleration (m/s^2)
STEP: Final = 0.25  # distance of the samples of a road's middle (m)
SPARE: Final = 1.1  # cones of an open road by those to be seen, since some are never detected


QUICK: Final = ScalingSettings(  # takes less than a minute; its slopes mean little
    cones_max=200.0,
    bins=8,
    fit_from=50.0,
    readings=(2, 8, 20),
    readings_cones=160,
    warm_up=20,
    laps=4,
    laps_cones=60,
    budget=0.1,
)


@dataclass(frozen=True, eq=False)
class Drives:
    """Logs of the sweeps."""

    cones: Log  # long road up to the last cone asked for
    seen: Array  # (n,) number of cones seen by the end of each cycle
    readings: dict[int, Log]  # a short dense road, by the number of detections in a cycle
    laps: Log  # closed road
    lap_ends: Array  # (m,) stamps at which its laps end (s)
    line: Log  # two laps of the closed road between dense lines

    @property
    def by_sweep(self) -> dict[str, list[Log]]:
        """Return the logs of each sweep, which are driven in turn."""
        return {
            "cones": [self.cones],
            "readings": [*self.readings.values()],
            "laps": [self.laps],
            "line": [self.line],
        }

    @property
    def cycles(self) -> int:
        """Return the number of cycles of all sweeps together."""
        return sum(max(len(log.cycles) for log in logs) for logs in self.by_sweep.values())


def make_drives(settings: ScalingSettings) -> Drives:
    seed = settings.seed
    long = drive_log(open_road(int(settings.cones_max), GAP), seed)
    seen = cones_seen(long)
    count = int(np.searchsorted(seen, settings.cones_max)) + 1
    dense_road, far = open_road(settings.readings_cones, DENSE_GAP), SensorSettings(range_max=DENSE_RANGE)
    dense = drive_log(dense_road, seed, sensor=far)
    rng = np.random.default_rng(seed)
    readings = {k: thinned(dense, k, rng) for k in settings.readings}
    closed, sensor = closed_road(settings.laps_cones), replace(LINE, range_max=DENSE_RANGE)
    laps = drive_log(closed, seed, settings.laps)
    line = drive_log(closed, seed, 2, sensor=sensor, line=LineSettings(LINE_SPACING))
    cones = first_cycles(long, count)
    return Drives(cones, seen[:count].astype(float), readings, laps, lap_times(laps), line)


def open_road(cones: int, gap: float) -> Track:
    """Return a winding road that never comes near itself, on which at least `cones` cones can be seen.

    Its heading is `SWING * sin(2 pi s / WAVELENGTH)` at the length s along it; cones are `gap` (m) apart.
    """
    length = SPARE * cones / 2 * gap
    s = np.arange(0.0, length, STEP)
    heading = SWING * np.sin(2 * np.pi * s / WAVELENGTH)
    middle = STEP * np.cumsum(np.column_stack([np.cos(heading), np.sin(heading)]), axis=0)
    return _with_rows(middle, gap, closed=False)


def closed_road(cones: int) -> Track:
    """Return a dented circle with about `cones` cones: `r = 1 + DENT cos(DENTS phi)`, scaled."""
    phi = np.linspace(0.0, 2 * np.pi, max(int(cones * GAP / STEP), 100))
    r = 1.0 + DENT * np.cos(DENTS * phi)
    unscaled = r[:, None] * np.column_stack([np.cos(phi), np.sin(phi)])
    middle = unscaled * (cones / 2 * GAP / arc_lengths(unscaled)[-1])
    return _with_rows(middle, GAP, closed=True)


def _with_rows(middle: Array, gap: float, closed: bool) -> Track:
    """Return the road with cones on both sides of its middle (n, 2), `gap` (m) apart."""
    tangents = unit(np.gradient(middle, axis=0))
    rows = []
    for side in (0.5, -0.5):
        row = middle + side * WIDTH * left_normals(tangents)
        s = arc_lengths(row)
        at = np.linspace(0.0, s[-1], max(round(s[-1] / gap), 2), endpoint=not closed)
        rows.append(along_polyline(at, s, row))
    start = np.append(middle[0], np.arctan2(tangents[0, 1], tangents[0, 0]))
    return Track(rows[0], rows[1], np.zeros((0, 2)), closed, start, "road")


def drive_log(track: Track, seed: int, laps: int = 1, **sensing: Any) -> Log:
    """Simulate a drive along a road at full speed from the start on; `sensing` sets sensor and line."""
    vehicle = VehicleSettings(speed_max=SPEED, speed_start=SPEED, acceleration_lateral=LATERAL)
    return simulate(track, SimulationSettings(laps=laps, vehicle=vehicle, **sensing), seed)


def cones_seen(log: Log) -> IntArray:
    """Return the number of true cones that had been detected by the end of each cycle (n,)."""
    assert log.truth is not None
    assert log.truth.associations is not None
    ends = np.cumsum([len(cycle.labels) for cycle in log.cycles])
    seen, first = np.unique(log.truth.associations, return_index=True)
    return np.searchsorted(np.sort(first[seen >= 0]), ends, side="left")


def first_cycles(log: Log, count: int) -> Log:
    """Return the first `count` cycles of a log, without truth."""
    return replace(log, cycles=log.cycles[:count], truth=None)


def thinned(log: Log, count: int, rng: Generator) -> Log:
    """Return the drive with `count` detections a cycle, chosen at random, or all where there are fewer."""

    def chosen(size: int) -> BoolArray:
        return np.isin(np.arange(size), rng.choice(size, min(count, size), replace=False))

    cycles = tuple(cycle.where(chosen(len(cycle.labels))) for cycle in log.cycles)
    return replace(log, cycles=cycles, truth=None)
