"""Priors of the constant errors of odometry and sensor, which become wide where a drive contradicts them."""

from dataclasses import dataclass, replace
from math import inf
from typing import ClassVar, Final, Literal, Self

from .checked import Positive

WIDE_ODOMETRY: Final = 10.0  # standard deviations of the odometry's wide priors by those of a calibrated one
WIDE_SENSOR: Final = 20.0  # standard deviations of the sensor's wide priors by those of a calibrated one


@dataclass(frozen=True)
class OdometrySettings(Positive):
    """Priors of the odometry's constant errors."""

    UNLIMITED = ("doubt",)
    SIGNED = ("scale", "bias")

    sigmas_start: ClassVar = (1e-4, 1e-4, 1e-5)
    """Standard deviations (m, m, rad) of the first pose: zero by definition, but that has no information."""

    scale: float = 0.0
    """Known scale error of the speeds (-): mean of its prior."""
    bias: float = 0.0
    """Known bias of the yaw rate, rad/s."""
    sigma_scale: float = 0.005
    """Standard deviation of the scale error (-)."""
    sigma_bias: float = 0.002
    """Standard deviation of the bias, rad/s."""
    doubt: float = 4.0
    """Contradiction from which both priors become wide, standard deviations; `inf` to hold them always."""
    hold_scale: bool = False
    """Whether the prior of the scale never becomes wide, since the speeds set the size of the map."""

    def widened(self) -> Self:
        """Return the settings of wide priors, which are not doubted again."""
        scale = self.sigma_scale if self.hold_scale else WIDE_ODOMETRY * self.sigma_scale
        return replace(self, doubt=inf, sigma_scale=scale, sigma_bias=WIDE_ODOMETRY * self.sigma_bias)

    @property
    def sigmas_calibration(self) -> tuple[float, float]:
        """Standard deviations of the scale error (-) and of the yaw-rate bias (rad/s)."""
        return self.sigma_scale, self.sigma_bias

    @property
    def calibration(self) -> tuple[float, float]:
        """Known scale error (-) and yaw-rate bias (rad/s)."""
        return self.scale, self.bias


@dataclass(frozen=True)
class CalibrationSettings(Positive):
    """Priors of the sensor's mounting, stamps and ranges."""

    UNLIMITED = ("doubt",)
    SIGNED = ("yaw", "lateral", "latency", "range_scale", "range_bias")

    sensor: bool = True
    """Whether the sensor's constant errors are estimated along with the map."""
    sigma_yaw: float = 0.001
    """Standard deviation of the yaw, rad."""
    sigma_lateral: float = 0.005
    """Standard deviation of the lateral offset, m."""
    sigma_latency: float = 0.001
    """Standard deviation of the latency, s."""
    sigma_range_scale: float = 0.0005
    """Standard deviation of the scale error of the ranges (-)."""
    sigma_range_bias: float = 0.005
    """Standard deviation of the bias of the ranges, m."""
    yaw: float = 0.0
    """Known yaw of the sensor, positive to the left, rad: mean of its prior."""
    lateral: float = 0.0
    """Known lateral offset of the sensor, positive to the left, m."""
    latency: float = 0.0
    """Known age of detections at their stamps, s; negative where they are newer."""
    range_scale: float = 0.0
    """Known scale error of the ranges (-)."""
    range_bias: float = 0.0
    """Known bias of the ranges, m."""
    trust: Literal["odometry", "ranges"] | None = None
    """Which of the two sets the size of the map where ranges and speeds disagree: only their ratio can be
    seen. By default the smoother one."""
    doubt: float = 4.0
    """Contradiction from which the priors become wide, standard deviations; `inf` to hold them always."""

    @property
    def sigmas(self) -> tuple[float, ...]:
        """Standard deviations (5,) in the order of `factors.sensor:SENSOR`, or none."""
        return tuple(getattr(self, f"sigma_{name}") for name in self.SIGNED if self.sensor)

    @property
    def means(self) -> tuple[float, ...]:
        """Known errors (5,) in the order of `factors.sensor:SENSOR`, or none."""
        return tuple(getattr(self, name) for name in self.SIGNED if self.sensor)

    def widened(self) -> Self:
        """Return the settings of wide priors, which are not doubted again.

        The scale of the ranges keeps its own, or the size of the map would rest on the wheels alone.
        """
        names = (f"sigma_{name}" for name in self.SIGNED if name != "range_scale")
        return replace(self, doubt=inf, **{name: WIDE_SENSOR * getattr(self, name) for name in names})
