"""The faults of a real car that white noise does not have, off by default, and what they do to a drive."""

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from pathspace_graph.errors import SettingsError, check_numbers
from pathspace_graph.io.log import Detections, Odometry
from pathspace_graph.labels import BOUNDARIES, LEFT, NAMES, RIGHT, UNKNOWN

from .curves import arc_lengths
from .sensor import FALSE_POSITIVE, ConeSensor, OdometryNoise, measure_twists
from .track import Track
from .vehicle import Drive

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int_]


@dataclass(frozen=True)
class SensorFaults:
    """Describes a cone detector that is late, badly mounted, badly scaled, colour-blind or out of order."""

    latency: float = 0.0
    """Each cycle shows the cones as they were seen this long before its stamp (s), or after it where this is
    negative."""
    yaw: float = 0.0
    """The sensor is turned to the left by this angle (rad), which its detections do not account for."""
    lateral: float = 0.0
    """The sensor sits this far to the left of where its detections assume it (m)."""
    range_scale: float = 0.0
    """Each range is too long by this share of it (-)."""
    range_bias: float = 0.0
    """Each range is too long by this (m)."""
    colourless: float = 0.0
    """This share of the detections, drawn one by one, has no colour, so their label is unknown."""
    dropout: float = 0.0
    """Nothing is detected for this time (s)."""
    dropout_at: float = 0.5
    """The dropout begins when this many laps have been driven."""
    blind: float = 0.0
    """The cones of one side are not detected while the vehicle drives this far (m)."""
    blind_at: float = 0.5
    """That stretch begins when this many laps have been driven."""
    blind_side: Literal["left", "right"] = "left"
    """The cones of this side are not detected there."""

    def __post_init__(self) -> None:
        at_least_0 = ("dropout", "dropout_at", "blind", "blind_at")
        check_numbers(self, "faults.sensor", at_least_0, "a number of at least 0")
        check_numbers(self, "faults.sensor", ("colourless",), "a number in [0, 1]")
        _check_finite(self, "faults.sensor", ("latency", "yaw", "lateral", "range_bias"))
        if not -1.0 < self.range_scale < np.inf:
            raise SettingsError(f"faults.sensor.range_scale: expected more than -1, found {self.range_scale}")


@dataclass(frozen=True)
class OdometryFaults:
    """Describes odometry with a biased yaw rate, slipping wheels, or readings that fail."""

    yaw_rate_bias: float = 0.0
    """Each measured yaw rate is too large by this (rad/s), in addition to the drawn bias."""
    slip: float = 0.0
    """While the wheels slip, the measured speeds are too large by this share of them (-)."""
    slip_time: float = 1.0
    """The wheels slip for this time (s)."""
    slip_every: float = 8.0
    """The wheels begin to slip after this time and each further one like it (s)."""
    zero: float = 0.0
    """The measured twists are zero for this time (s)."""
    zero_at: float = 0.5
    """The zeros begin when this many laps have been driven."""
    gap: float = 0.0
    """There is no measured twist for this time (s), so that the last one before is held."""
    gap_at: float = 0.5
    """The gap begins when this many laps have been driven."""

    def __post_init__(self) -> None:
        at_least_0 = ("slip_time", "zero", "zero_at", "gap", "gap_at")
        check_numbers(self, "faults.odometry", at_least_0, "a number of at least 0")
        check_numbers(self, "faults.odometry", ("slip_every",), "a positive number")
        _check_finite(self, "faults.odometry", ("yaw_rate_bias", "slip"))


@dataclass(frozen=True)
class VehicleFaults:
    """Describes a vehicle that is put down elsewhere, or that drives the other way round."""

    put_down: float = 0.0
    """The vehicle goes on this far farther along the track at once (m), of which the odometry knows
    nothing."""
    put_down_at: float = 1.5
    """The vehicle is put down there when this many laps have been driven."""
    wrong_way: bool = False
    """A closed track is driven the other way round, so that the blue cones are on the right. The truth
    calls the boundary on the left of the way driven the left one."""

    def __post_init__(self) -> None:
        check_numbers(self, "faults.vehicle", ("put_down", "put_down_at"), "a number of at least 0")


@dataclass(frozen=True)
class Faults:
    """Describes what is wrong with a drive; nothing is by default."""

    sensor: SensorFaults = field(default_factory=SensorFaults)
    """These faults are those of the cone detector."""
    odometry: OdometryFaults = field(default_factory=OdometryFaults)
    """These faults are those of the measured twist."""
    vehicle: VehicleFaults = field(default_factory=VehicleFaults)
    """These faults are those of the drive itself."""


def _check_finite(settings: object, group: str, names: tuple[str, ...]) -> None:
    for name in names:
        if not np.isfinite(getattr(settings, name)):
            raise SettingsError(f"{group}.{name}: expected a number, found {getattr(settings, name)}")


Window = tuple[float, float]
"""A window is a time from its beginning (s) to its end (s), which is no part of it."""


def time_at(driven: Drive, distance: float) -> float:
    """Returns the stamp (s) at which the vehicle has driven so far (m); it is infinite if it never has."""
    reached = np.flatnonzero(arc_lengths(driven.poses[:, :2]) >= distance)
    return float(driven.t[reached[0]]) if len(reached) else np.inf


def _is_inside(t: FloatArray, window: Window) -> NDArray[np.bool_]:
    return np.asarray((t >= window[0]) & (t < window[1]))


# --- the vehicle -----------------------------------------------------------------------------------------


def turned_round(track: Track) -> Track:
    """Returns a closed track as it is when it is driven the other way round: what was left is right."""
    if not track.closed:
        raise SettingsError("faults.vehicle.wrong_way: expected a closed track, found an open one")
    start = track.start + np.array([0.0, 0.0, np.pi])
    return replace(track, left=track.right[::-1], right=track.left[::-1], start=start)


def put_down(driven: Drive, lap: float, faults: VehicleFaults) -> Drive:
    """Returns the drive without the stretch that the vehicle is carried over; a lap is `lap` m long.

    From one stamp to the next the vehicle is `put_down` m farther along its path. Nothing else changes, so
    the twists do not integrate to the poses there.
    """
    if not faults.put_down:
        return driven
    s = arc_lengths(driven.poses[:, :2])
    begin = faults.put_down_at * lap
    kept = (s < begin) | (s >= begin + faults.put_down)
    count = int(kept.sum())
    return Drive(driven.t[:count], driven.poses[kept], driven.twists[kept])


# --- the odometry ----------------------------------------------------------------------------------------


def measure_odometry(
    driven: Drive, lap: float, noise: OdometryNoise, faults: OdometryFaults, rng: Generator
) -> tuple[Odometry, FloatArray]:
    """Returns the measured twists, and the scale error (-) and the bias (rad/s) that they have (2,)."""
    dt = float(driven.t[:2][-1])
    measured, calibration = measure_twists(_slipping(driven, faults), dt, noise, rng)
    bias = np.array([0.0, 0.0, faults.yaw_rate_bias])
    measured = measured + bias if faults.yaw_rate_bias else measured
    begin = time_at(driven, faults.zero_at * lap)
    measured[_is_inside(driven.t, (begin, begin + faults.zero))] = 0.0
    begin = time_at(driven, faults.gap_at * lap)
    kept = ~_is_inside(driven.t, (begin, begin + faults.gap))
    kept[0] = True  # the first stamp is the beginning of the log
    return Odometry(driven.t[kept], measured[kept]), calibration + bias[1:]


def _slipping(driven: Drive, faults: OdometryFaults) -> FloatArray:
    """Returns the twists (N, 3) of the wheels, which are those of the body except where they slip."""
    if not faults.slip:
        return driven.twists
    since = driven.t % faults.slip_every
    slips = (since < faults.slip_time) & (driven.t >= faults.slip_every)
    factors = 1.0 + faults.slip * slips[:, None] * np.array([1.0, 1.0, 0.0])
    return np.asarray(driven.twists * factors)


# --- the sensor ------------------------------------------------------------------------------------------


def colours(track: Track, wrong_way: bool) -> IntArray:
    """Returns the label that the colour of each cone stands for (M,), with the sides changed on a track that
    is driven the wrong way."""
    labels = track.cone_labels
    changed = wrong_way & np.isin(labels, BOUNDARIES)
    return np.where(changed, LEFT + RIGHT - labels, labels)


class FaultySensor:
    """Detects cones as a `ConeSensor` does that is mounted badly, and that fails at times."""

    def __init__(
        self,
        sensor: ConeSensor,
        sides: IntArray,
        driven: Drive,
        lap: float,
        faults: SensorFaults,
        rng: Generator,
    ) -> None:
        self._sensor, self._faults, self._rng = sensor, faults, rng
        begin = time_at(driven, faults.dropout_at * lap)
        self._dropout = (begin, begin + faults.dropout)
        begin = faults.blind_at * lap
        self._blind = (time_at(driven, begin), time_at(driven, begin + faults.blind))
        self._unseen = np.flatnonzero(sides == NAMES.index(faults.blind_side))

    def detect(self, t: float, pose: FloatArray) -> tuple[Detections, IntArray]:
        """Returns a perception cycle from a pose [x, y, theta], and the true cone of each detection (m,).

        The pose is the vehicle's at the time of the image, which a late sensor stamps with a later `t`.
        """
        faults = self._faults
        detections, cones = self._sensor.detect(
            t, mounted(pose, faults), faults.range_scale, faults.range_bias
        )
        detections = with_colours_lost(detections, faults, self._rng)
        kept = np.full(len(cones), not _is_inside(np.array(t), self._dropout))
        if _is_inside(np.array(t), self._blind):
            kept &= ~np.isin(cones, self._unseen) | (cones == FALSE_POSITIVE)
        return _only(detections, kept), cones[kept]


def mounted(pose: FloatArray, faults: SensorFaults) -> FloatArray:
    """Returns the pose (3,) of the sensor on a vehicle: `lateral` m to its left, and turned by `yaw`."""
    x, y, theta = pose
    return np.array(
        [x - np.sin(theta) * faults.lateral, y + np.cos(theta) * faults.lateral, theta + faults.yaw]
    )


def with_colours_lost(detections: Detections, faults: SensorFaults, rng: Generator) -> Detections:
    """Returns detections of which some have an unknown colour."""
    lost = rng.random(len(detections.labels)) < faults.colourless
    return replace(detections, labels=np.where(lost, UNKNOWN, detections.labels))


def _only(detections: Detections, kept: NDArray[np.bool_]) -> Detections:
    if kept.all():
        return detections
    return replace(
        detections,
        points_vehicle=detections.points_vehicle[kept],
        covariances=detections.covariances[kept],
        labels=detections.labels[kept],
    )
