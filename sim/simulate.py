"""A drive on a track: track, vehicle and sensors give a log with truth; and sensors of a real car by name."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, Final

import numpy as np
from numpy.random import Generator

from pathspace_graph.errors import SettingsError, check_name
from pathspace_graph.io.log import SENSOR, Detections, Log, SensorInfo, Truth
from pathspace_graph.labels import NAMES, UNKNOWN
from pathspace_graph.lengths import scaled

from .curves import FloatArray, IntArray
from .faults import Faults, SensorFaults, colours, measure_odometry, put_down, time_at, turned_round
from .sensor import FALSE_POSITIVE, ConeSensor, OdometryNoise, SensorSettings
from .track import Track, to_map_frame
from .vehicle import Drive, VehicleSettings, displacements, drive


@dataclass(frozen=True)
class SimulationSettings:
    """A simulated drive."""

    laps: int = 5
    """Laps on a closed track; an open one is driven once."""
    vehicle: VehicleSettings = field(default_factory=VehicleSettings)
    odometry: OdometryNoise = field(default_factory=OdometryNoise)
    sensor: SensorSettings = field(default_factory=SensorSettings)
    faults: Faults = field(default_factory=Faults, repr=False)
    scale: float = field(default=1.0, repr=False)
    """Factor of all lengths and speeds: 0.1 for a model car of 1:10, 3 for a road."""

    def __post_init__(self) -> None:
        if self.laps < 1:
            raise SettingsError(f"laps: expected at least 1, found {self.laps}")
        if not 0.0 < self.scale < np.inf:
            raise SettingsError(f"scale: expected a positive number, found {self.scale}")


def simulate(track: Track, settings: SimulationSettings, seed: int) -> Log:
    """Return the log of a drive; a seed gives the same log to the byte.

    Wander, odometry, sensor and lost colours have random streams of their own, so that a setting of one does
    not shift the others. A cycle in which nothing is detected is not in the log.
    """
    if seed < 0:
        raise SettingsError(f"seed: expected at least 0, found {seed}")
    wander_rng, odometry_rng, *sensor_rngs = np.random.default_rng(seed).spawn(4)
    faults = settings.faults
    track = to_map_frame(turned_round(track) if faults.vehicle.wrong_way else track)
    lap = track.centre_line.length
    driven = put_down(drive(track, settings.laps, settings.vehicle, wander_rng), lap, faults.vehicle)
    odometry, calibration = measure_odometry(driven, lap, settings.odometry, faults.odometry, odometry_rng)
    cycles, associations = _perceive(track, driven, settings, *sensor_rngs)
    stamps = np.union1d(driven.t, [cycle.t for cycle in cycles])
    poses = _poses_at(driven, stamps)
    poses[:, 2] = np.pi - (np.pi - poses[:, 2]) % (2 * np.pi)
    errors = np.array([getattr(faults.sensor, name) for name in SENSOR])
    truth = Truth(
        *(stamps, poses, track.cones, track.cone_labels, associations),
        calibration=calibration,
        sensor=errors if errors.any() else None,
        noise=_noise(settings),
    )
    log = Log(
        odometry=odometry,
        cycles=tuple(cycles),
        odometry_sigma=np.hypot(settings.odometry.white, settings.odometry.slow),
        sensor=SensorInfo(settings.sensor.range_max, settings.sensor.fov, settings.sensor.rate),
        source=_source(track, settings, seed),
        truth=truth,
    )
    return scaled(log, settings.scale)


def _noise(settings: SimulationSettings) -> FloatArray | None:
    """Return the noise (6,) in the order of `io.log:NOISE`, or None where all of it is white."""
    odometry, sensor = settings.odometry, settings.sensor
    if not (any(odometry.slow) or sensor.slow_range or sensor.slow_bearing):
        return None
    drift = odometry.drift_sigmas(1.0 / settings.vehicle.rate)
    return np.array([*drift, sensor.slow_range, sensor.slow_bearing, sensor.slow_time])


def _source(track: Track, settings: SimulationSettings, seed: int) -> dict[str, str]:
    source = {"track": track.name, "seed": str(seed), "settings": repr(settings)}
    source |= {"scale": str(settings.scale)} if settings.scale != 1.0 else {}
    for group in ("odometry", "sensor"):
        part = getattr(settings, group)
        changed = [entry.name for entry in fields(part) if not entry.repr]
        changed = [name for name in changed if getattr(part, name) != getattr(type(part)(), name)]
        source |= {f"{group}.{name}": str(getattr(part, name)) for name in changed}
    return source if settings.faults == Faults() else source | {"faults": repr(settings.faults)}


def _perceive(
    track: Track, driven: Drive, settings: SimulationSettings, sensor_rng: Generator, colour_rng: Generator
) -> tuple[list[Detections], IntArray]:
    """Return the cycles of a sensor that is mounted badly and fails at times, and their associations."""
    faults, rate, lap = settings.faults.sensor, settings.sensor.rate, track.centre_line.length
    labels = colours(track, settings.faults.vehicle.wrong_way)
    sensor = ConeSensor(track.cones, labels, settings.sensor, sensor_rng)
    stamps = np.arange(int(driven.t[-1] * rate) + 1) / rate
    stamps = stamps[stamps - faults.latency <= driven.t[-1]]
    poses = _poses_at(driven, np.maximum(stamps - faults.latency, 0.0))
    sine, cosine = np.sin(poses[:, 2]), np.cos(poses[:, 2])
    poses += np.column_stack(
        [-sine * faults.lateral, cosine * faults.lateral, np.full(len(poses), faults.yaw)]
    )
    dropout, begin = time_at(driven, faults.dropout_at * lap), faults.blind_at * lap
    blind = time_at(driven, begin), time_at(driven, begin + faults.blind)
    unseen = np.flatnonzero(track.cone_labels == NAMES.index(faults.blind_side))
    cycles, associations = [], [np.zeros(0, dtype=int)]
    for t, pose in zip(stamps.tolist(), poses, strict=True):
        detections, cones = sensor.detect(t, pose, faults.range_scale, faults.range_bias)
        lost = colour_rng.random(len(cones)) < faults.colourless
        detections = replace(detections, labels=np.where(lost, UNKNOWN, detections.labels))
        kept = np.full(len(cones), not dropout <= t < dropout + faults.dropout)
        if blind[0] <= t < blind[1]:
            kept &= ~np.isin(cones, unseen) | (cones == FALSE_POSITIVE)
        if kept.any():
            cycles.append(detections.where(kept))
            associations.append(cones[kept])
    return cycles, np.concatenate(associations)


def _poses_at(driven: Drive, stamps: FloatArray) -> FloatArray:
    """Return true poses (n, 3) at any stamps within the drive; the twist before each is held until then."""
    index = np.searchsorted(driven.t, stamps, side="right") - 1
    poses = driven.poses[index]
    return poses + displacements(poses[:, 2], driven.twists[index], stamps - driven.t[index])


CAMERA: Final = SensorSettings(
    rate=5.0,
    range_max=40.0,
    fov=float(np.deg2rad(130.0)),
    range_sigma=0.03,
    range_sigma_growth=0.05,
    bearing_sigma=0.0125,
    detection_probability=1.0,
    detection_falloff=0.022,
    blind_fraction=0.0,
    wrong_colour=0.001,
    false_positives=0.05,
    slow_range=0.08,
    slow_bearing=0.8,
    slow_time=8.0,
    duplicates=0.9,
    overlap=(float(np.deg2rad(5.0)), float(np.deg2rad(17.0))),
    dropped_cycles=0.005,
)
"""Three cameras of a Formula Student car, as its recordings of three laps show them.

Their fields span bearings of +-65 degrees. A smoothed map gave the errors of some 900 passes of cones. Those
along the ray grow to 0.5 m at 10 m and 1.2 m at 22 m, with hardly any correlation from cycle to cycle. Those
across are 0.007 rad about their mean over a pass, but 0.011 to 0.015 rad between two cameras that see the
same cone: most of the error stays with the cone. The correlation time gave these figures and those of lag 1
to 5 again in a simulated log. Of the cones in the overlaps, at bearings of 5 to 17 degrees on both sides, 75
to 100 % are seen twice. 0.5 % of the cycles are missing. A cone is detected with a probability of 0.97 below
6 m, 0.8 at 14 m, 0.5 at 22 m and 0.15 at 37 m. Of the detections within 12 m, 0.1 % have the other
boundary's colour and about 0.04 a cycle are of no cone.
"""
CAMERA_FAULTS: Final = SensorFaults(
    latency=-0.12, yaw=-0.0175, range_scale=0.08, range_bias=-0.19, colourless=0.01
)
"""Constant errors of these cameras against the odometry, which differ a little from lap to lap.

Fits on each lap gave stamps 0.108 to 0.131 s early, a yaw of 0.6 to 1.4 degrees to the right, and ranges
0.19 m too short and 7 to 9 % too long.
"""
INS: Final = OdometryNoise(
    white=(0.009, 0.003, 0.003), gyro_bias=0.0002, slow=(0.03, 0.03, 0.0005), slow_time=5.0
)
"""Inertial navigation of the same car.

Third differences of the readings gave the white noise. The slow errors and the bias are such that a lap of
240 m in 90 s ends 1 m and 0.02 rad off by dead reckoning: the three laps ended 0.8, 0.8 and 1.9 m, and 0.01
to 0.03 rad off. The correlation time is assumed.
"""
INS_RATE: Final = 40.0  # rate of the INS (Hz)

PLAIN: Final = "plain"  # name of the preset that changes nothing


PRESETS: Final[dict[str, dict[str, dict[str, Any]]]] = {
    "sensor": {PLAIN: {}, "camera": {"sensor": CAMERA, "faults": Faults(sensor=CAMERA_FAULTS)}},
    "odometry": {PLAIN: {}, "ins": {"odometry": INS, "vehicle": VehicleSettings(rate=INS_RATE)}},
}
"""Settings that differ from the defaults, by group and name of the preset."""


def preset(names: Mapping[str, str]) -> SimulationSettings:
    """Return the defaults of a simulation with named presets for some groups."""
    settings = SimulationSettings()
    for group, name in names.items():
        check_name(name, PRESETS[group], f"{group}: expected a known preset")
        settings = replace(settings, **PRESETS[group][name])
    return settings
