"""The faults of a real car that white noise does not have, off by default, and what they do to a drive."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from pathspace_graph.errors import SettingsError
from pathspace_graph.factors.arrays import Array
from pathspace_graph.io.log import Odometry
from pathspace_graph.settings.checked import AtLeast0, Checked, Share, Signed

from .sensor import OdometryNoise, measure_twists
from .track import Track, arc_lengths
from .vehicle import Trajectory


@dataclass(frozen=True)
class SensorFaults(Checked, group="faults.sensor"):
    """A cone detector that is late, badly mounted, badly scaled, colour-blind or out of order."""

    latency: Signed = 0.0
    """Age of the detections at their stamps (s), negative where they are newer."""
    yaw: Signed = 0.0
    """Turn of the sensor to the left that its detections don't account for (rad)."""
    lateral: Signed = 0.0
    """Offset of the sensor to the left of where its detections assume it (m)."""
    range_scale: Signed = 0.0
    """Share by which each range is too long (-)."""
    range_bias: Signed = 0.0
    """Length by which each range is too long (m)."""
    colourless: Share = 0.0
    """Share of the detections without a colour, drawn one by one."""
    dropout: AtLeast0 = 0.0
    """Time for which nothing is detected (s)."""
    dropout_at: AtLeast0 = 0.5
    """Laps after which the dropout begins."""
    blind: AtLeast0 = 0.0
    """Length of the stretch on which the cones of one side aren't detected (m)."""
    blind_at: AtLeast0 = 0.5
    """Laps after which that stretch begins."""
    blind_side: Literal["left", "right"] = "left"
    """Side whose cones aren't detected there."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.range_scale <= -1.0:
            raise SettingsError(f"faults.sensor.range_scale: expected more than -1, found {self.range_scale}")


@dataclass(frozen=True)
class OdometryFaults(Checked, group="faults.odometry"):
    """Odometry with a biased yaw rate, slipping wheels, or readings that fail."""

    yaw_rate_bias: Signed = 0.0
    """Bias of the yaw rate beside the drawn one (rad/s)."""
    speed_scale: Signed = 0.0
    """Share by which the speeds are too large, beside the drawn scale (-)."""
    slip: Signed = 0.0
    """Share by which the speeds are too large while the wheels slip (-)."""
    slip_time: AtLeast0 = 1.0
    """Time for which the wheels slip (s)."""
    slip_every: float = 8.0
    """Time from one slip to the next, and to the first (s)."""
    zero: AtLeast0 = 0.0
    """Time for which the measured twists are zero (s)."""
    zero_at: AtLeast0 = 0.5
    """Laps after which the zeros begin."""
    gap: AtLeast0 = 0.0
    """Time without a measured twist, so that the last one before is held (s)."""
    gap_at: AtLeast0 = 0.5
    """Laps after which the gap begins."""
    dead_band: AtLeast0 = 0.0
    """Speed up to which the twists read zero after each standstill (m/s)."""
    false_travel: AtLeast0 = 0.0
    """Speed (m/s) below which the odometry doesn't fall while the vehicle brakes to its last stand."""
    false_travel_time: AtLeast0 = 3.0
    """Time for which this continues while the vehicle stands (s)."""


@dataclass(frozen=True)
class VehicleFaults(Checked, group="faults.vehicle"):
    """A vehicle that is put down elsewhere, or that drives the other way round."""

    put_down: AtLeast0 = 0.0
    """Distance along the track by which the vehicle is carried, unknown to the odometry (m)."""
    put_down_at: AtLeast0 = 1.5
    """Laps after which the vehicle is carried."""
    wrong_way: bool = False
    """Whether a closed track is driven the other way round, so that the blue cones are on the right. The
    left boundary of the truth is the one on the left of the vehicle."""


@dataclass(frozen=True)
class Faults:
    """What is wrong with a drive, by default nothing."""

    sensor: SensorFaults = SensorFaults()
    odometry: OdometryFaults = OdometryFaults()
    vehicle: VehicleFaults = VehicleFaults()


def time_at(driven: Trajectory, distance: float) -> float:
    reached = np.flatnonzero(arc_lengths(driven.poses[:, :2]) >= distance)
    return float(driven.t[reached[0]]) if len(reached) else np.inf


def _is_during(driven: Trajectory, distance: float, time: float) -> NDArray[np.bool_]:
    begin = time_at(driven, distance)
    return np.asarray((driven.t >= begin) & (driven.t < begin + time))


def turned_round(track: Track) -> Track:
    """Reverse the direction of a closed track, whose left cones are right ones then."""
    if not track.closed:
        raise SettingsError("faults.vehicle.wrong_way: expected a closed track, found an open one")
    start = track.start + np.array([0.0, 0.0, np.pi])
    return replace(track, left=track.right[::-1], right=track.left[::-1], start=start)


def put_down(driven: Trajectory, lap: float, faults: VehicleFaults) -> Trajectory:
    """Remove the stretch over which the vehicle is carried; a lap is `lap` m long."""
    if not faults.put_down:
        return driven
    s = arc_lengths(driven.poses[:, :2])
    begin = faults.put_down_at * lap
    kept = (s < begin) | (s >= begin + faults.put_down)
    count = int(kept.sum())
    return Trajectory(driven.t[:count], driven.poses[kept], driven.twists[kept])


def measure_odometry(
    driven: Trajectory, lap: float, noise: OdometryNoise, faults: OdometryFaults, rng: Generator
) -> tuple[Odometry, Array]:
    """Measure the twists; also return their scale error (-) and bias (rad/s) (2,)."""
    dt = float(driven.t[:2][-1])
    wheels = driven.twists.copy()  # which differ from the body's where they slip, miss a start or go on
    if faults.slip:
        since = driven.t % faults.slip_every
        slips = (since < faults.slip_time) & (driven.t >= faults.slip_every)
        wheels *= 1.0 + faults.slip * slips[:, None] * np.array([1.0, 1.0, 0.0])
    if faults.dead_band:
        true, row = driven.twists, np.arange(len(wheels))
        stood = np.maximum.accumulate(np.where(true.any(axis=1), -1, row))
        faster = np.hypot(true[:, 0], true[:, 1]) > faults.dead_band
        is_pulling_off = (stood >= 0) & (np.maximum.accumulate(np.where(faster, row, -1)) <= stood)
        wheels[is_pulling_off] = 0.0
    if faults.false_travel:
        stand = np.flatnonzero(driven.twists.any(axis=1))[-1] + 1
        slow = np.flatnonzero(driven.twists[:stand, 0] > faults.false_travel)[-1:] + 1
        end = stand + round(faults.false_travel_time / dt)
        wheels[int(np.append(slow, stand)[0]) : end, 0] = faults.false_travel
    measured, calibration = measure_twists(wheels, dt, noise, rng)
    constant = np.array([faults.speed_scale, faults.yaw_rate_bias])
    if constant.any():
        measured += wheels * [constant[0], constant[0], 0.0] + [0.0, 0.0, constant[1]]
    measured[_is_during(driven, faults.zero_at * lap, faults.zero)] = 0.0
    kept = ~_is_during(driven, faults.gap_at * lap, faults.gap)
    kept[0] = True  # the first stamp is the beginning of the log
    return Odometry(driven.t[kept], measured[kept]), calibration + constant
