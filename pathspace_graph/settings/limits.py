"""Settings of the gate: what a perception cycle may hold that is handed to an online estimator."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from .checked import Positive


@dataclass(frozen=True)
class LimitSettings(Positive, group="limits"):
    """Describes what a vehicle and its sensors can do at most; a cycle beyond that is refused.

    A single detection beyond what a sensor can see is dropped instead.
    """

    UNLIMITED = ("silence",)
    LENGTHS: ClassVar = {"speed": 1, "range_min": 1, "range_max": 1, "sigma_min": 1, "sigma_max": 1}

    speed: float = 100.0
    """No vehicle is faster than this, ahead or to a side (m/s)."""
    yaw_rate: float = 10.0
    """No vehicle turns faster than this (rad/s)."""
    stamp: float = 1e11
    """No stamp is larger than this (s), which is some three thousand years. Stamps in nanoseconds are."""
    interval: float = 1e-3
    """A cycle is at least this much later than the one before (s). Between cycles that are nearer, the
    odometry is so certain that the system loses its digits."""
    silence: float = 30.0
    """There is a twist or a cycle at least once in this time (s). A vehicle may be anywhere after a longer
    one: one cycle is refused then, and the next that agrees with it is used."""
    twists: int = 100_000
    """A cycle has at most this number of twists."""
    detections: int = 500
    """A cycle has at most this number of detections."""
    range_min: float = 0.01
    """A detection is at least this far from the vehicle (m)."""
    range_max: float = 300.0
    """A detection is at most this far from the vehicle (m)."""
    sigma_min: float = 1e-6
    """A detection has at least this standard deviation in every direction (m)."""
    sigma_max: float = 100.0
    """A detection has at most this standard deviation in every direction (m)."""
