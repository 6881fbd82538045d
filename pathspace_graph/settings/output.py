"""Settings of a speed profile and a recording for the live viewer."""

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


@dataclass(frozen=True)
class RecordingSettings(Checked):
    """The recording of a run for the live viewer."""

    band_every: int = 10
    """Cycles from one band to the next, since a band needs the joint covariance of the map; where the map is
    replaced, it has one too. The curves are shown in every cycle."""
    samples_per_span: int = 6
    """Lines in each span of a curve."""
