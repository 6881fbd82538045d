"""Settings of the online mapper: growth of open ends, closing, the front end, and constant errors."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from math import inf
from typing import ClassVar, Final, Literal, Self

from .checked import Checked, Signed, Unlimited


@dataclass(frozen=True)
class GrowthSettings(Checked):
    """How the open end of a curve grows, and what a tentative track is."""

    sightings: int = 3
    """Detections within `merge_radius` that confirm a tentative track."""
    merge_radius: float = 1.0
    """Distance within which detections of one label belong to one tentative track (m)."""

    max_unseen: ClassVar[float] = 500.0  # longest stretch of an open curve without any cone, m
    threshold: ClassVar[float] = 0.7  # m from a curve's end below which a tentative track does not extend it
    max_lateral: ClassVar[float] = 10.0  # m from the path at which tracks begin a boundary: half a wide road


@dataclass(frozen=True)
class ClosingSettings(Checked):
    """When the loop may close."""

    gauge_laps: Unlimited = 4.0
    """Laps on the closed map after which its position and heading as a whole are fixed; `inf` for never."""

    min_path: ClassVar[float] = 60.0  # least length of a lap, m
    check_interval: ClassVar[float] = 2.0  # m along the path, from one attempt to close the loop to the next
    radius: ClassVar[float] = 8.0  # m from the first stretch of the drive, within which the loop may close
    drift: ClassVar[float] = 0.03  # growth of `radius` with the path driven (m/m)
    iterations: ClassVar[int] = 2  # Gauss-Newton steps after the loop is found, and after simplification

    def radius_after(self, length: float) -> float:
        """Distance from the first stretch within which the loop may close after a length (m)."""
        return self.radius + self.drift * length


@dataclass(frozen=True)
class LimitSettings(Checked, group="limits"):
    """What a vehicle and its sensors can do at most.

    A cycle beyond that is refused; a single detection beyond the range is dropped instead.
    """

    speed: float = 100.0
    """Largest speed ahead or to a side, m/s."""
    yaw_rate: float = 10.0
    """Largest yaw rate, rad/s."""
    silence: Unlimited = 30.0
    """Longest time without a twist or a cycle, s. After a longer one a cycle is refused, and the next that
    agrees with it is used."""
    range_max: float = 300.0
    """Largest distance of a detection from the vehicle, m."""


@dataclass(frozen=True)
class MotionSettings(Checked):
    """The check of the odometry against the detections; where they contradict it, their motion is used."""

    doubt: Unlimited = 5.0
    """Contradiction from which the odometry is distrusted, standard deviations; `inf` to trust it always."""

    accelerations: ClassVar = (5.0, 5.0, 1.5)
    """Growth of the twist's uncertainty where one is held for longer than usual (m/s^2, m/s^2, rad/s^2)."""


@dataclass(frozen=True)
class SidesSettings(Checked):
    """How the side of a cone is found from the driven path."""

    colourless: float = 0.7
    """Share of detections without a colour from which rows of cones give the sides; 1 for never."""


# --- priors of constant errors, which become wide where a drive contradicts them -------------------------

WIDE_ODOMETRY: Final = 10.0  # standard deviations of the odometry's wide priors by those of a calibrated one
HELD: Final = 0.02  # standard deviation of a fixed scale, by its own
WIDE_SENSOR: Final = 20.0  # standard deviations of the sensor's wide priors by those of a calibrated one


class _Priors(Checked):
    """Priors of constant errors: a known value and a standard deviation of each."""

    ERRORS: ClassVar[tuple[str, ...]]  # names of the errors in order
    sensor = True  # whether the errors are estimated

    @property
    def means(self) -> tuple[float, ...]:
        """Known errors, (2,) of odometry or (5,) in the order of `factors.sensor:SENSOR`, or none."""
        return tuple(getattr(self, name) for name in self.ERRORS if self.sensor)

    @property
    def sigmas(self) -> tuple[float, ...]:
        """Standard deviations in the same order, or none."""
        return tuple(getattr(self, f"sigma_{name}") for name in self.ERRORS if self.sensor)

    def about(self, errors: Iterable[float]) -> Self:
        """Replace the means: errors in the order of `means`, or none."""
        return replace(self, **dict(zip(self.ERRORS, errors, strict=False)))  # type: ignore[type-var]


@dataclass(frozen=True)
class OdometrySettings(_Priors):
    """Priors of the odometry's constant errors."""

    ERRORS = ("scale", "bias")

    sigmas_start: ClassVar = (1e-4, 1e-4, 1e-5)
    """Standard deviations (m, m, rad) of the first pose: zero by definition, but that has no information."""

    scale: Signed = 0.0
    """Known scale error of the speeds (-): mean of its prior."""
    bias: Signed = 0.0
    """Known bias of the yaw rate, rad/s."""
    sigma_scale: float = 0.005
    """Standard deviation of the scale error (-)."""
    sigma_bias: float = 0.002
    """Standard deviation of the bias, rad/s."""
    doubt: Unlimited = 4.0
    """Contradiction from which both priors become wide, standard deviations; `inf` for never."""
    hold_scale: bool = False
    """Whether the scale is fixed, since the speeds set the size of the map: a free one would shrink it to
    reduce its residuals. Its standard deviation is that of the size, in every covariance."""

    @property
    def sigmas(self) -> tuple[float, ...]:
        """Standard deviations of the priors; a fixed scale is nearly known."""
        return self.sigma_scale * (HELD if self.hold_scale else 1.0), self.sigma_bias

    @property
    def sigma_size(self) -> float:
        """Standard deviation of the size of the world, where it is no variable (-)."""
        return self.sigma_scale if self.hold_scale else 0.0

    def widened(self) -> Self:
        """Widen the priors, which are not doubted again."""
        scale = self.sigma_scale if self.hold_scale else WIDE_ODOMETRY * self.sigma_scale
        return replace(self, doubt=inf, sigma_scale=scale, sigma_bias=WIDE_ODOMETRY * self.sigma_bias)


@dataclass(frozen=True)
class CalibrationSettings(_Priors):
    """Priors of the sensor's mounting, stamps and ranges."""

    ERRORS = ("yaw", "lateral", "latency", "range_scale", "range_bias")

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
    yaw: Signed = 0.0
    """Known yaw of the sensor, positive to the left, rad: mean of its prior."""
    lateral: Signed = 0.0
    """Known lateral offset of the sensor, positive to the left, m."""
    latency: Signed = 0.0
    """Known age of detections at their stamps, s; negative where they are newer."""
    range_scale: Signed = 0.0
    """Known scale error of the ranges (-)."""
    range_bias: Signed = 0.0
    """Known bias of the ranges, m."""
    trust: Literal["odometry", "ranges"] | None = None
    """Which of the two sets the size of the map where ranges and speeds disagree: only their ratio can be
    seen. By default the odometry, unless ranges scatter by less than its scale is known."""
    doubt: Unlimited = 4.0
    """Contradiction from which the priors become wide, standard deviations; `inf` for never."""

    def widened(self) -> Self:
        """Widen the priors, which are not doubted again.

        The scale of the ranges keeps its own, or the size of the map would rest on the wheels alone.
        """
        names = (f"sigma_{name}" for name in self.ERRORS if name != "range_scale")
        return replace(self, doubt=inf, **{name: WIDE_SENSOR * getattr(self, name) for name in names})
