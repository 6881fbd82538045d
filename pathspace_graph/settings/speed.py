"""Settings of a speed profile: what a vehicle can do on its tyres."""

from __future__ import annotations

from dataclasses import dataclass

from .checked import Positive


@dataclass(frozen=True)
class SpeedSettings(Positive, group="speed"):
    """Describes how fast a vehicle may be; the defaults are those of a careful Formula Student car."""

    UNLIMITED = ("top",)

    lateral: float = 10.0
    """This is the largest lateral acceleration (m/s^2), the friction coefficient times gravity."""
    forward: float = 5.0
    """This is the largest acceleration on a straight (m/s^2)."""
    braking: float = 8.0
    """This is the largest deceleration on a straight (m/s^2)."""
    top: float = 30.0
    """The vehicle is never faster than this (m/s)."""
