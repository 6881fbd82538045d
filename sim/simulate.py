"""A drive on a track: track, vehicle and sensors give a log with truth; and sensors of a real car by name."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from operator import attrgetter
from typing import Any, Final

import numpy as np
from numpy.random import Generator

from pathspace_graph.errors import SettingsError, check_name
from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.sensor import SENSOR
from pathspace_graph.io.log import (
    SIGMA_DETECTIONS,
    SIGMA_ODOMETRY,
    Detections,
    Log,
    SensorInfo,
    Truth,
    ray_covariances,
)
from pathspace_graph.labels import BOUNDARIES, LEFT, NAMES, RIGHT, UNKNOWN
from pathspace_graph.lengths import scaled
from pathspace_graph.settings.checked import Checked, leaves

from .cameras import CAMERA, CAMERA_FAULTS, INS, INS_RATE, draw_car
from .faults import (
    Faults,
    OdometryFaults,
    SensorFaults,
    measure_odometry,
    put_down,
    time_at,
    turned_round,
)
from .sensor import (
    FALSE_POSITIVE,
    LINE,
    ConeSensor,
    LineSensor,
    LineSettings,
    OdometryNoise,
    SensorSettings,
    as_lines,
)
from .track import Track, to_map_frame
from .vehicle import Trajectory, VehicleSettings, displacements, drive


@dataclass(frozen=True)
class SimulationSettings(Checked, group=""):
    """A simulated drive."""

    laps: int = 5
    """Laps on a closed track; an open one is driven once."""
    vehicle: VehicleSettings = field(default_factory=VehicleSettings)
    odometry: OdometryNoise = field(default_factory=OdometryNoise)
    sensor: SensorSettings = field(default_factory=SensorSettings)
    line: LineSettings = field(default_factory=LineSettings)
    faults: Faults = field(default_factory=Faults)
    scale: float = 1.0
    """Factor of all lengths and speeds: 0.1 for a model car of 1:10, 3 for a road."""

    draw: bool = False
    """Whether sensor, odometry, their faults and the vehicle are drawn by the seed (`sim.cameras:draw_car`).
    The log states nothing of their noise. Of those only the vehicle's overrun can be set beside it."""

    def __post_init__(self) -> None:
        super().__post_init__()
        overrun = self.vehicle.overrun
        drawn = {  # groups that are drawn, each with its default and its presets
            "sensor": (SensorSettings(), CAMERA, LINE),
            "odometry": (OdometryNoise(), INS),
            "vehicle": (VehicleSettings(overrun=overrun), VehicleSettings(overrun=overrun, rate=INS_RATE)),
            "faults.sensor": (SensorFaults(), CAMERA_FAULTS),
            "faults.odometry": (OdometryFaults(),),
        }
        for group, values in drawn.items() if self.draw else ():
            if attrgetter(group)(self) not in values:
                raise SettingsError(f"draw: expected no setting of {group} beside it, since it is drawn")
        if self.faults.odometry.false_travel and not self.vehicle.stand:
            raise SettingsError("faults.odometry.false_travel: expected vehicle.stand above 0, found 0")


def simulate(track: Track, settings: SimulationSettings, seed: int) -> Log:
    """Simulate a drive; a seed gives the same log to the byte.

    Wander, odometry, sensor, lost colours and a drawn car have random streams of their own, so that a setting
    of one does not shift the others. A cycle in which nothing is detected is not in the log.
    """
    if seed < 0:
        raise SettingsError(f"seed: expected at least 0, found {seed}")
    wander_rng, odometry_rng, *sensor_rngs, car_rng = np.random.default_rng(seed).spawn(5)
    if settings.draw:
        car = draw_car(car_rng)
        wrong = replace(settings.faults, sensor=car.sensor_faults, odometry=car.odometry_faults)
        vehicle = replace(car.vehicle, overrun=settings.vehicle.overrun)
        changed = replace(settings, draw=False, vehicle=vehicle, faults=wrong)
        drawn = replace(changed, sensor=car.sensor, odometry=car.odometry)
        return _as_recorded(simulate(track, drawn, seed), drawn)
    faults, sensor = settings.faults, settings.sensor
    track = to_map_frame(turned_round(track) if faults.vehicle.wrong_way else track)
    lap = track.centre_line.length
    driven = put_down(drive(track, settings.laps, settings.vehicle, wander_rng), lap, faults.vehicle)
    odometry, calibration = measure_odometry(driven, lap, settings.odometry, faults.odometry, odometry_rng)
    seen = as_lines(track) if settings.line.spacing else track
    cycles, associations = _perceive(seen, lap, driven, settings, *sensor_rngs)
    stamps = np.union1d(driven.t, [cycle.t for cycle in cycles])
    poses = _poses_at(driven, stamps)
    poses[:, 2] = np.pi - (np.pi - poses[:, 2]) % (2 * np.pi)
    errors = np.array([getattr(faults.sensor, name) for name in SENSOR])
    noise, slow = None, [sensor.slow_range, sensor.slow_bearing, sensor.slow_time]
    if any(settings.odometry.slow) or any(slow[:2]):  # else all of it is white
        noise = np.array([*settings.odometry.drift_sigmas(1.0 / settings.vehicle.rate), *slow])
    truth = Truth(
        *(stamps, poses, seen.cones, seen.cone_labels),
        associations=None if settings.line.spacing else associations,
        calibration=calibration,
        sensor=errors if errors.any() else None,
        noise=noise,
        bend=np.array([sensor.range_bend, sensor.range_bend_from]) if sensor.range_bend else None,
    )
    defaults = leaves(SimulationSettings())
    stated = {name: str(value) for name, value in leaves(settings).items() if value != defaults[name]}
    log = Log(
        odometry=odometry,
        cycles=tuple(cycles),
        odometry_sigma=np.array(settings.odometry.white),
        odometry_drift=settings.odometry.drift(1.0 / settings.vehicle.rate),
        sensor=SensorInfo(
            *(sensor.range_max, sensor.fov, sensor.rate),
            kind="line" if settings.line.spacing else None,
            sigma_range_scale=sensor.sigma_range_scale or None,
        ),
        source={"track": track.name, "seed": str(seed), **stated},
        truth=truth,
    )
    return scaled(log, settings.scale)


def _as_recorded(log: Log, settings: SimulationSettings) -> Log:
    """Remove the stated noise from a log of these settings; its truth has it instead."""
    sensor = settings.sensor
    sigmas = [sensor.range_sigma * settings.scale, sensor.range_sigma_growth, sensor.bearing_sigma]
    truth = log.truth and replace(log.truth, rays=np.array(sigmas))
    cycles = (
        replace(cycle, covariances=ray_covariances(cycle.points_vehicle, SIGMA_DETECTIONS))
        for cycle in log.cycles
    )
    return replace(
        log,
        cycles=tuple(cycles),
        odometry_sigma=np.array(SIGMA_ODOMETRY),
        sensor=SensorInfo(kind=log.sensor.kind),
        source={**log.source, "draw": "True"},
        odometry_stated=False,
        detections_stated=False,
        odometry_drift=None,
        truth=truth,
    )


def _perceive(
    track: Track,
    lap: float,
    driven: Trajectory,
    settings: SimulationSettings,
    sensor_rng: Generator,
    colour_rng: Generator,
) -> tuple[list[Detections], IntArray]:
    """Detect the cycles of a faulty sensor, and their associations.

    A lap is `lap` m long.
    """
    faults, rate = settings.faults.sensor, settings.sensor.rate
    labels = track.cone_labels
    if settings.faults.vehicle.wrong_way:  # cones keep their colour, which is the other side's then
        labels = np.where(np.isin(labels, BOUNDARIES), LEFT + RIGHT - labels, labels)
    sensor = (
        LineSensor(track, labels, settings.sensor, settings.line, sensor_rng)
        if settings.line.spacing
        else ConeSensor(track.cones, labels, settings.sensor, sensor_rng)
    )
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


def _poses_at(driven: Trajectory, stamps: Array) -> Array:
    """True poses (n, 3) at any stamps within the drive; the twist before each is held until then."""
    index = np.searchsorted(driven.t, stamps, side="right") - 1
    poses = driven.poses[index]
    return poses + displacements(poses[:, 2], driven.twists[index], stamps - driven.t[index])


PLAIN: Final = "plain"  # name of the preset that changes nothing
PRESETS: Final[dict[str, dict[str, dict[str, Any]]]] = {
    "sensor": {
        PLAIN: {},
        "camera": {"sensor": CAMERA, "faults": Faults(sensor=CAMERA_FAULTS)},
        "line": {"sensor": LINE, "line": LineSettings(spacing=1.0)},
    },
    "odometry": {PLAIN: {}, "ins": {"odometry": INS, "vehicle": VehicleSettings(rate=INS_RATE)}},
}
"""Settings that differ from the defaults, by group and name of the preset."""


def preset(names: Mapping[str, str]) -> SimulationSettings:
    """Defaults of a simulation with named presets for some groups."""
    settings = SimulationSettings()
    for group, name in names.items():
        check_name(name, PRESETS[group], f"{group}: expected a known preset")
        settings = replace(settings, **PRESETS[group][name])
    return settings
