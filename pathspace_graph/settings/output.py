"""Settings of a speed profile."""

from dataclasses import dataclass

from .checked import Checked, Unlimited


@dataclass(frozen=True)
class SpeedSettings(Checked):
    """How fast a vehicle may be on its tyres; the defaults are those of a careful Formula Student car."""

    lateral: float = 10.0
    """Largest lateral acceleration, m/s^2: the friction coefficient times gravity."""
    forward: float = 5.0
    """Largest acceleration on a straight, m/s^2."""
    braking: float = 8.0
    """Largest deceleration on a straight, m/s^2."""
    top: Unlimited = 30.0
    """Largest speed, m/s."""
