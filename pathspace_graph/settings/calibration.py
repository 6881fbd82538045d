"""Settings of self-calibration: the constant errors of the sensor that are estimated along with the map."""

from __future__ import annotations

from dataclasses import dataclass

from .checked import Positive


@dataclass(frozen=True)
class CalibrationSettings(Positive):
    """Describes how well the sensor's mounting, stamps and ranges are known before the drive.

    What a drive does not show stays at zero, with the standard deviation given here.
    """

    sensor: bool = True
    """The sensor's constant errors are estimated along with the map."""
    sigma_yaw: float = 0.01
    """This is the standard deviation of the sensor's yaw (rad)."""
    sigma_lateral: float = 0.05
    """This is the standard deviation of the sensor's lateral offset (m)."""
    sigma_latency: float = 0.02
    """This is the standard deviation of the age of detections at their stamps (s)."""
    sigma_range_scale: float = 0.01
    """This is the standard deviation of the scale error of the ranges (-)."""
    sigma_range_bias: float = 0.1
    """This is the standard deviation of the bias of the ranges (m)."""

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
