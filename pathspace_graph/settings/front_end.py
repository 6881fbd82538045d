"""Settings of the front end, which judges the readings before an estimator takes them."""

from dataclasses import dataclass

from .checked import Positive


@dataclass(frozen=True)
class LimitSettings(Positive, group="limits"):
    """What a vehicle and its sensors can do at most, at scale 1.

    A cycle beyond that is refused; a single detection beyond the range is dropped instead.
    """

    UNLIMITED = ("silence",)

    speed: float = 100.0
    """Largest speed ahead or to a side, m/s."""
    yaw_rate: float = 10.0
    """Largest yaw rate, rad/s."""
    silence: float = 30.0
    """Longest time without a twist or a cycle, s. A vehicle may be anywhere after a longer one: one cycle is
    refused then, and the next that agrees with it is used."""
    range_max: float = 300.0
    """Largest distance of a detection from the vehicle, m."""


@dataclass(frozen=True)
class MotionSettings(Positive):
    """The check of the odometry against the detections of the newest cycles.

    Where they contradict it, the wheels slip or the readings fail, and their motion takes its place.
    """

    UNLIMITED = ("doubt",)

    doubt: float = 5.0
    """Contradiction from which the odometry is not believed, standard deviations; `inf` to believe it."""
    acceleration: float = 5.0
    """Growth of the speeds' uncertainty where a twist is held for longer than usual, m/s^2."""
    angular_acceleration: float = 1.5
    """Growth of the yaw rate's uncertainty there, rad/s^2."""

    @property
    def accelerations(self) -> tuple[float, float, float]:
        """How fast the twist of a vehicle changes (m/s^2, m/s^2, rad/s^2)."""
        return self.acceleration, self.acceleration, self.angular_acceleration


@dataclass(frozen=True)
class SidesSettings(Positive):
    """How the side of a cone is told from the way driven."""

    min_votes: int = 3
    """Least number of cones on the side of the other colour from which the colours are swapped."""
    colourless: float = 0.7
    """Share of detections without a colour from which sides are told from the rows of cones; at 1, they
    never are."""
