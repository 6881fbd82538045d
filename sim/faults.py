"""The faults of a real car that white noise does not have, each of them off by default."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from pathspace_graph.errors import SettingsError, check_numbers


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
