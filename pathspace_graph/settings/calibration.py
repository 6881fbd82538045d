"""Settings of self-calibration: the constant errors of the sensor that are estimated along with the map."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf
from typing import Literal

from .checked import Positive


@dataclass(frozen=True)
class CalibrationSettings(Positive):
    """Describes how well the sensor's mounting, stamps and ranges are known before the drive.

    The priors are those of a sensor that was calibrated. Where the drive contradicts one of them, they become
    wide: then the sensor is not what it was said to be. What a drive does not show stays at zero.
    """

    UNLIMITED = ("doubt",)
    SIGNED = ("yaw", "lateral", "latency", "range_scale", "range_bias")

    sensor: bool = True
    """The sensor's constant errors are estimated along with the map."""
    sigma_yaw: float = 0.001
    """This is the standard deviation of the sensor's yaw (rad)."""
    sigma_lateral: float = 0.005
    """This is the standard deviation of the sensor's lateral offset (m)."""
    sigma_latency: float = 0.001
    """This is the standard deviation of the age of detections at their stamps (s)."""
    sigma_range_scale: float = 0.0005
    """This is the standard deviation of the scale error of the ranges (-)."""
    sigma_range_bias: float = 0.005
    """This is the standard deviation of the bias of the ranges (m)."""
    yaw: float = 0.0
    """Known yaw of the sensor, positive to the left (rad): the mean of its prior."""
    lateral: float = 0.0
    """Known lateral offset of the sensor, positive to the left (m)."""
    latency: float = 0.0
    """Known age of detections at their stamps (s); negative where they are newer."""
    range_scale: float = 0.0
    """Known scale error of the ranges (-)."""
    range_bias: float = 0.0
    """Known bias of the ranges (m)."""
    trust: Literal["odometry", "ranges"] | None = None
    """Which of the two sets the size of the map where ranges and speeds disagree: only their ratio can be
    seen. By default the smoother one."""
    doubt: float = 4.0
    """The drive contradicts a prior by this number of standard deviations. It is infinite where the priors
    always hold."""
    wide: float = 20.0
    """The wide priors have this number of times the standard deviations."""

    @property
    def sigmas(self) -> tuple[float, ...]:
        """Returns the standard deviations (5,) in the order of `factors.sensor:SENSOR`, or none."""
        own = (
            self.sigma_yaw,
            self.sigma_lateral,
            self.sigma_latency,
            self.sigma_range_scale,
            self.sigma_range_bias,
        )
        return own if self.sensor else ()

    @property
    def means(self) -> tuple[float, ...]:
        """Returns the known errors (5,) in the order of `factors.sensor:SENSOR`, or none."""
        own = (self.yaw, self.lateral, self.latency, self.range_scale, self.range_bias)
        return own if self.sensor else ()

    def widened(self) -> CalibrationSettings:
        """Returns the settings of wide priors, which are not doubted again.

        The scale of the ranges stays as it is known: it cannot be told from the scale of the speeds, and the
        size of the map would rest on the wheels alone.
        """
        return replace(
            self,
            doubt=inf,
            sigma_yaw=self.wide * self.sigma_yaw,
            sigma_lateral=self.wide * self.sigma_lateral,
            sigma_latency=self.wide * self.sigma_latency,
            sigma_range_bias=self.wide * self.sigma_range_bias,
        )
