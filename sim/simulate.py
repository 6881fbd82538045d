"""A drive on a track: track, vehicle and sensors give a log with truth."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from pathspace_graph.errors import SettingsError
from pathspace_graph.io.log import Detections, Log, Odometry, SensorInfo, Truth

from .sensor import ConeSensor, OdometryNoise, SensorSettings, measure_twists
from .track import Track, to_map_frame
from .vehicle import Drive, VehicleSettings, drive, integrate

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int_]


@dataclass(frozen=True)
class SimulationSettings:
    """Describes a simulated drive."""

    laps: int = 5
    """A closed track is driven for this number of laps, an open one once."""
    vehicle: VehicleSettings = field(default_factory=VehicleSettings)
    """These settings describe how the vehicle drives."""
    odometry: OdometryNoise = field(default_factory=OdometryNoise)
    """These settings describe the errors of the measured twist."""
    sensor: SensorSettings = field(default_factory=SensorSettings)
    """These settings describe what the cone detector sees, and its errors."""

    def __post_init__(self) -> None:
        if self.laps < 1:
            raise SettingsError(f"laps: expected at least 1, found {self.laps}")


def simulate(track: Track, settings: SimulationSettings, seed: int) -> Log:
    """Returns the log of a drive; a seed gives the same log to the byte.

    Wander, odometry and sensor have random streams of their own, so that a setting of one does not shift the
    others. A cycle in which nothing is detected is not in the log, since the file format has no row for it.
    """
    if seed < 0:
        raise SettingsError(f"seed: expected at least 0, found {seed}")
    wander_rng, odometry_rng, sensor_rng = np.random.default_rng(seed).spawn(3)
    track = to_map_frame(track)
    driven = drive(track, settings.laps, settings.vehicle, wander_rng)
    twists, calibration = measure_twists(driven.twists, settings.odometry, odometry_rng)
    cycles, associations = _perceive(track, driven, settings.sensor, sensor_rng)
    truth = replace(_truth(track, driven, cycles, associations), calibration=calibration)
    return Log(
        odometry=Odometry(driven.t, twists),
        cycles=tuple(cycles),
        odometry_sigma=np.array(settings.odometry.white),
        sensor=SensorInfo(settings.sensor.range_max, settings.sensor.fov, settings.sensor.rate),
        source={"track": track.name, "seed": str(seed), "settings": repr(settings)},
        truth=truth,
    )


def _perceive(
    track: Track, driven: Drive, settings: SensorSettings, rng: Generator
) -> tuple[list[Detections], IntArray]:
    sensor = ConeSensor(track.cones, track.cone_labels, settings, rng)
    stamps = np.arange(int(driven.t[-1] * settings.rate) + 1) / settings.rate
    cycles: list[Detections] = []
    associations: list[IntArray] = []
    for t, pose in zip(stamps.tolist(), _poses_at(driven, stamps), strict=True):
        detections, cones = sensor.detect(t, pose)
        if len(cones):
            cycles.append(detections)
            associations.append(cones)
    return cycles, np.concatenate([np.zeros(0, dtype=int), *associations])


def _poses_at(driven: Drive, stamps: FloatArray) -> FloatArray:
    """Returns true poses (n, 3) at any stamps within the drive; the twist before each is held until then."""
    index = np.searchsorted(driven.t, stamps, side="right") - 1
    since = stamps - driven.t[index]
    poses = driven.poses[index].copy()
    for k in np.flatnonzero(since):
        x, y, turn = integrate(driven.twists[index[k], None], float(since[k]))[1]
        cos, sin = np.cos(poses[k, 2]), np.sin(poses[k, 2])
        poses[k] += (cos * x - sin * y, sin * x + cos * y, turn)
    return poses


def _truth(track: Track, driven: Drive, cycles: list[Detections], associations: IntArray) -> Truth:
    stamps = np.union1d(driven.t, [cycle.t for cycle in cycles])
    poses = _poses_at(driven, stamps)
    poses[:, 2] = np.pi - (np.pi - poses[:, 2]) % (2 * np.pi)
    return Truth(stamps, poses, track.cones, track.cone_labels, associations)
