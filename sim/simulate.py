"""A drive on a track: track, vehicle and sensors give a log with truth; and sensors of a real car by name."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import radians
from operator import attrgetter
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.random import Generator

from pathspace_graph.errors import SettingsError, check_name
from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.sensor import SENSOR
from pathspace_graph.io import log as logs
from pathspace_graph.io.log import Detections, Log, SensorInfo, Truth
from pathspace_graph.io.parsing import parse_toml, read_text
from pathspace_graph.labels import BOUNDARIES, LEFT, NAMES, RIGHT, UNKNOWN
from pathspace_graph.lengths import scaled
from pathspace_graph.settings.checked import Checked, flatten, leaves, override

from .faults import Faults, OdometryFaults, SensorFaults, measure_odometry, put_down, time_at, turned_round
from .sensor import ConeSensor, LineSensor, LineSettings, OdometryNoise, SensorSettings, as_lines
from .track import Track, to_map_frame
from .vehicle import Trajectory, VehicleSettings, displacements, drive

# --- a drive -----------------------------------------------------------------------------------------------


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
    """Whether sensor, odometry, their faults and the vehicle are drawn by the seed (`sim.simulate:draw_car`).
    The log states nothing of their noise. Of those only the vehicle's overrun can be set beside it."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.draw:
            usual = replace(self.vehicle, overrun=VehicleSettings().overrun)
            own = replace(self, draw=False, vehicle=usual)
            known = [preset({group: name}) for group, named in PRESETS.items() for name in named]
            for name, group in ((name, attrgetter(name)) for name in DRAWN):
                if group(own) not in map(group, known):
                    raise SettingsError(f"draw: expected no setting of {name} beside it, since it is drawn")
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
        drawn = draw_car(car_rng, settings)
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
    assumed = log.with_covariances(lambda points: logs.ray_covariances(points, logs.SIGMA_DETECTIONS))
    return replace(
        assumed,
        odometry_sigma=np.array(logs.SIGMA_ODOMETRY),
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
            kept &= ~np.isin(cones, unseen) | (cones < 0)
        if kept.any():
            cycles.append(detections.where(kept))
            associations.append(cones[kept])
    return cycles, np.concatenate(associations)


def _poses_at(driven: Trajectory, stamps: Array) -> Array:
    """True poses (n, 3) at any stamps within the drive; the twist before each is held until then."""
    index = np.searchsorted(driven.t, stamps, side="right") - 1
    poses = driven.poses[index]
    return poses + displacements(poses[:, 2], driven.twists[index], stamps - driven.t[index])


# --- presets, and cars that are drawn --------------------------------------------------------------------

PLAIN: Final = "plain"  # name of the preset that changes nothing
DRAWN: Final = ("sensor", "odometry", "vehicle", "faults.sensor", "faults.odometry")  # groups of a drawn car
_FILE: Final = Path(__file__).with_name("presets.toml")
PRESETS: Final[dict[str, dict[str, Any]]] = parse_toml(read_text(_FILE), _FILE)
"""Settings that differ from the defaults, by group and name of the preset."""


def preset(names: Mapping[str, str]) -> SimulationSettings:
    """Defaults of a simulation with named presets for some groups."""
    settings = SimulationSettings()
    for group, name in names.items():
        check_name(name, PRESETS[group], f"{group}: expected a known preset")
        settings = override(settings, flatten(PRESETS[group][name]), f"{group}.{name}")
    return settings


def draw_car(rng: Generator, settings: SimulationSettings) -> SimulationSettings:
    """Draw sensor, odometry, their faults and the vehicle, so that nothing can be tuned to one car.

    The distributions are wider than what the few known cars show. Half of the cars have a fault that not
    every car has. Laps, overrun, scale and what else happens to the vehicle are those of `settings`.
    """

    def log_uniform(low: float, high: float) -> float:  # a size that isn't known has an even logarithm
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    # how it drives; it stands still before and after
    vehicle = VehicleSettings(
        # a driverless car's first laps have 4 m/s, its best ones 12
        speed_max=rng.uniform(4.0, 12.0),
        # the log begins before the car does, and ends after it
        rest=rng.uniform(0.0, 3.0),
        stand=rng.uniform(5.0, 8.0),
        # of the odometry: wheel speeds on a bus at 25 Hz, inertial units at 100
        rate=rng.uniform(25.0, 100.0),
        overrun=settings.vehicle.overrun,
    )
    # its detector of cones
    begin = radians(rng.uniform(0.0, 10.0))
    sensor = SensorSettings(
        # front ends run at 10 to 15 Hz; three cameras that share a processor at 5
        rate=rng.uniform(5.0, 15.0),
        # one camera sees 10 to 20 m over 90 to 120 degrees, three cameras 40 m over 130
        range_max=rng.uniform(12.0, 40.0),
        fov=radians(rng.uniform(90.0, 140.0)),
        # the scatter grows to 0.1 m beyond 8 m where depth is measured, to 0.5 m where it is learned
        range_sigma=rng.uniform(0.01, 0.05),
        range_sigma_growth=log_uniform(0.01, 0.05),
        # from a few pixels of a narrow image to boxes that jump by a tenth of their width
        bearing_sigma=log_uniform(0.004, 0.016),
        # 1 % less by each metre is typical; the recorded car loses 2.2
        detection_probability=rng.uniform(0.92, 1.0),
        detection_falloff=rng.uniform(0.008, 0.022),
        # cones that lie, or that are covered
        blind_fraction=rng.uniform(0.0, 0.03),
        # 0.1 % in sunshine as recorded, 3 % of colours that glare or are trained badly
        wrong_colour=log_uniform(0.001, 0.03),
        false_positives=log_uniform(0.02, 0.3),
        # a network errs alike on like images: most of a bearing's error stays while a cone is passed
        slow_range=rng.uniform(0.05, 0.5),
        slow_bearing=rng.uniform(0.3, 0.8),
        slow_time=log_uniform(0.5, 8.0),
        # two cameras with an overlap, or one
        duplicates=rng.uniform(0.2, 0.9) * (rng.random() < 0.5),
        overlap=(begin, begin + radians(rng.uniform(5.0, 15.0))),
        # cycles that were not ready in time
        dropped_cycles=rng.uniform(0.0, 0.02),
        # detectors have a bias of 0.34 m beyond 8 m in the median, of one sign on one car: a focal length or
        # a size of cones that is wrong bends as the depth's error does, by its square
        range_bend=rng.uniform(-0.005, 0.005),
        range_bend_from=rng.uniform(6.0, 12.0),
        # nobody has measured the scale of its ranges
        sigma_range_scale=0.0,
    )
    # constant errors of the detector against the odometry
    # the sensor of one in four is mounted badly
    yaw = radians(rng.uniform(3.0, 7.0)) if rng.random() < 0.25 else radians(rng.uniform(0.0, 1.5))
    sensor_faults = SensorFaults(
        # stamps of the exposure and of the odometry's receipt make early ones, those of the result late ones
        latency=rng.uniform(-0.15, 0.15),
        # a plate that is mounted by eye is off by a degree; one recorded car's sensor is turned by 6.5
        yaw=yaw * float(rng.choice([-1.0, 1.0])),
        lateral=rng.normal(0.0, 0.03),
        # the recorded car has about 8 % and -0.19 m, which the odometry doesn't share
        range_scale=rng.uniform(-0.08, 0.08),
        range_bias=rng.uniform(-0.2, 0.2),
        # boxes too small for a colour
        colourless=rng.uniform(0.0, 0.05),
    )
    # an odometry between a good INS and wheels with a cheap gyro
    ins, share = preset({"odometry": "ins"}).odometry, rng.random()
    white = np.array(ins.white) ** (1.0 - share) * np.array(OdometryNoise().white) ** share
    slow = np.array(ins.slow) * rng.uniform(0.5, 1.5)
    # scale and bias are those of the faults, so that the log says what was drawn
    odometry = OdometryNoise(
        white=(float(white[0]), float(white[1]), float(white[2])),
        scale=0.0,
        gyro_bias=0.0,
        slow=(float(slow[0]), float(slow[1]), float(slow[2])),
        slow_time=rng.uniform(2.0, 8.0),
    )
    # constant errors of the odometry, and false travel of some
    odometry_faults = OdometryFaults(
        # of a wheel's radius, and of a gyro that was averaged at rest for seconds
        speed_scale=rng.normal(0.0, 0.005),
        yaw_rate_bias=rng.normal(0.0, 0.0015),
        # recorded laps went on for 0.5 to 4 m, one of them at 1.3 m/s for 3 s
        false_travel=rng.uniform(0.3, 1.5) * (rng.random() < 0.5),
        false_travel_time=rng.uniform(1.0, 4.0),
    )
    faults = replace(settings.faults, sensor=sensor_faults, odometry=odometry_faults)
    return replace(settings, draw=False, vehicle=vehicle, sensor=sensor, odometry=odometry, faults=faults)
