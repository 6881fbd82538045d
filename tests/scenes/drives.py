"""Drives without noise, in which what is seen is exactly what is there, and a short one with noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.se2 import compose
from pathspace_graph.io.log import Detections, Log, Odometry, Truth
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.run import CycleResult, split_odometry
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track import Track, to_map_frame
from pathspace_graph.sim.track_generator import TrackGeneratorSettings, generate_track
from pathspace_graph.sim.vehicle import VehicleSettings, drive, integrate

from ..shared.copied import copied

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]

DT = 0.02
"""Odometry at 50 Hz, s."""
CYCLE = 5
"""Odometry readings for each perception cycle: 10 Hz."""
ODOMETRY_SIGMA = np.array([0.25, 0.12, 0.035])
"""What the mapper is told of the odometry, m/s, m/s, rad/s."""
READING_SIGMA = 0.1
"""What it is told of each reading, m."""
RANGE_MAX = 15.0
"""The sensor's range, m."""
FOV = np.deg2rad(110.0)
"""Its field of view, the whole angle, rad."""


def see(t: float, pose: Array, cones: Array, labels: IntArray) -> Detections:
    """Exact readings of the cones in the field of view of a pose (3,)."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    local = (cones - pose[:2]) @ np.array([[c, -s], [s, c]])
    seen = np.hypot(*local.T) < RANGE_MAX
    seen &= np.abs(np.arctan2(local[:, 1], local[:, 0])) < FOV / 2
    return detections(t, local[seen], labels[seen])


def detections(t: float, points_vehicle: Array, labels: IntArray) -> Detections:
    """Readings of the standard covariance."""
    covariances = np.tile(READING_SIGMA**2 * np.eye(2), (len(labels), 1, 1))
    return Detections(t, points_vehicle, covariances, labels)


def exact_log(twists: Array, cones: Array, labels: IntArray) -> Log:
    """The log of a drive with body twists (N, 3), each held for DT."""
    t = DT * np.arange(len(twists))
    poses = integrate(twists[:-1], DT)
    cycles = tuple(see(float(t[k]), poses[k], cones, labels) for k in range(0, len(t), CYCLE))
    truth = Truth(t, poses, cones, labels)
    return Log(Odometry(t, twists), cycles, ODOMETRY_SIGMA, odometry_drift=np.zeros(3), truth=truth)


def corridor(length: float, gap: float = 4.0, half_width: float = 2.0) -> tuple[Array, IntArray]:
    """Cones (M, 2) and labels (M,) of a straight track along x."""
    x = np.arange(0.0, length, gap)
    rows = [np.column_stack([x, np.full(len(x), y)]) for y in (half_width, -half_width)]
    return np.concatenate(rows), np.repeat([LEFT, RIGHT], len(x)).astype(np.intp)


def ahead(speed: float, seconds: float) -> Array:
    """Twists (N, 3) of a drive straight on."""
    return np.tile([speed, 0.0, 0.0], (round(seconds / DT), 1))


def bean_track(radius: float = 16.0, dent: float = 0.25, half_width: float = 1.8, gap: float = 3.0) -> Track:
    """A closed track of about 105 m around `r(phi) = radius (1 + dent cos 2 phi)`, counterclockwise."""
    phi = np.linspace(0.0, 2 * np.pi, 2000)
    r = radius * (1.0 + dent * np.cos(2 * phi))
    middle = r[:, None] * np.column_stack([np.cos(phi), np.sin(phi)])
    tangent = np.gradient(middle, phi, axis=0)
    tangent /= np.hypot(*tangent.T)[:, None]
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
    s = np.append(0.0, np.cumsum(np.hypot(*np.diff(middle, axis=0).T)))
    at = np.linspace(0.0, s[-1], round(s[-1] / gap), endpoint=False)
    rows = [
        np.column_stack([np.interp(at, s, (middle + side * half_width * normal)[:, k]) for k in range(2)])
        for side in (1.0, -1.0)
    ]
    start = np.array([*middle[0], np.arctan2(tangent[0, 1], tangent[0, 0])])
    return Track(rows[0], rows[1], np.zeros((0, 2)), True, start, "bean")


def path_of(step: float, *pieces: tuple[float, float]) -> Array:
    """Return poses (n, 3) a step (m) apart on pieces of a path, each a length (m) and a curvature (1/m)."""
    poses = [np.zeros(3)]
    for length, curvature in pieces:
        for _ in range(round(length / step)):
            poses.append(compose(poses[-1], np.array([step, 0.0, step * curvature])))
    return np.array(poses)


def lap_log(track: Track, overrun: float = 10.0) -> Log:
    """One exact lap of a track and `overrun` metres more."""
    settings = VehicleSettings(speed_max=8.0, speed_start=6.0, wander=0.2, overrun=overrun)
    track = to_map_frame(track)
    driven = drive(track, 1, settings, np.random.default_rng(0))
    return exact_log(driven.twists, track.cones, track.cone_labels.astype(np.intp))


def beginning(log: Log, cycles: int) -> Log:
    """The first cycles of a simulated log, with their true associations."""
    assert log.truth is not None and log.truth.associations is not None
    kept = log.cycles[:cycles]
    associations = log.truth.associations[: sum(len(cycle.labels) for cycle in kept)]
    return replace(log, cycles=kept, truth=replace(log.truth, associations=associations))


def noisy(log: Log, seed: int, sigma: float = 0.1) -> Log:
    """Returns the log with noise on its detections."""
    rng = np.random.default_rng(seed)
    cycles = tuple(
        replace(c, points_vehicle=c.points_vehicle + rng.normal(0.0, sigma, c.points_vehicle.shape))
        for c in log.cycles
    )
    return replace(log, cycles=cycles)


@cache
def exact_lap() -> Log:
    """A lap and 45 m of the small track, in which the loop closes."""
    return lap_log(bean_track(), overrun=45.0)


@cache
def noisy_lap() -> Log:
    """A lap and 40 m of the small track with noise on the detections."""
    return noisy(lap_log(bean_track(), overrun=40.0), seed=3)


Mapped = tuple[FixedLagMapper, list[CycleResult]]
"""A mapper, and what it said after each cycle."""


def map_log(log: Log, mapper: FixedLagMapper | None = None, known: Sequence[CycleResult] = ()) -> Mapped:
    """A mapper after the log, which has said what is known of its first cycles already."""
    mapper = mapper or FixedLagMapper(odometry_sigma=log.noise)
    rest = islice(split_odometry(log), len(known), None)
    return mapper, [*known, *(replay(mapper, *cycle) for cycle in rest)]


@cache
def _beginning_of(log: Log, cycles: int, settings: MapperSettings | None) -> Mapped:
    mapper = FixedLagMapper(settings, log.noise)
    return map_log(replace(log, cycles=log.cycles[:cycles]), mapper)


def map_beginning(log: Log, cycles: int, settings: MapperSettings | None = None) -> Mapped:
    """A copy of a mapper after the first cycles of a log that a scene keeps, which is mapped once."""
    mapper, results = _beginning_of(log, cycles, settings)
    return copied(mapper), [*results]


def mapped(log: Log) -> Mapped:
    """A copy of a mapper after a log that a scene keeps, and what it said."""
    return map_beginning(log, len(log.cycles))


def replay(mapper: FixedLagMapper, odometry: Odometry, detections: Detections) -> CycleResult:
    """The next update, after a batch that is due was waited for: how fast the machine is does not matter."""
    mapper.wait()
    return mapper.update(odometry, detections)


def true_poses(log: Log) -> Array:
    """Poses (n, 3) at the cycles of an exact log."""
    assert log.truth is not None
    return log.truth.poses[np.searchsorted(log.truth.pose_t, [c.t - 1e-9 for c in log.cycles])]


SHORT = TrackGeneratorSettings(lap_length=(100.0, 160.0), corners=(3, 4), hairpins=(0, 0), cones=90)
"""A track of this kind is driven in twenty seconds."""


@cache
def short_drive(seed: int = 4) -> Log:
    """The log of one lap of a short generated track, with the simulator's noise."""
    track = generate_track(np.random.default_rng(seed), SHORT)
    return simulate(track, SimulationSettings(laps=1), seed)
