"""Settings of the monitor of an online estimate."""

from dataclasses import dataclass

from .checked import Positive


@dataclass(frozen=True)
class HealthSettings(Positive):
    """When an estimate is good, degraded or lost.

    The share of detections that the map explains is taken over the newest `window`. A coloured detection in
    the view of the curves is explained if it is in use, or if it lies on a closed curve of its colour farther
    along: in a hairpin the sensor sees the next stretch across the infield.
    """

    window: float = 1.0
    """Detections that are at most this old are judged together (s)."""
    min_offered: int = 12
    """At least this number of detections is judged; where the window holds fewer, older ones count as
    well."""
    blind: float = 2.0
    """The estimate is degraded once no detection has come for this time (s)."""
    share_degraded: float = 0.8
    """On a closed map, the estimate is degraded where a smaller share of the detections is explained."""
    share_lost: float = 0.55
    """On a closed map, the vehicle is lost where a smaller share of the detections is explained."""
    open_degraded: float = 0.35
    """While the loop is open, the estimate is degraded below this share. It is low, since detections of
    stretches that are not mapped yet lie beside the curves."""
    innovation: float = 1.2
    """The estimate is degraded where the mean squared distance of detections in use from their curve, before
    the update and in units of its variance, is larger than this, and by one sigma of the mean over the cones
    in view; it is about 1 if the model is right."""
    sigma_degraded: float = 1.0
    """The estimate is degraded where the standard deviation of the position on a closed map is larger than
    this in its worst direction (m)."""
    sigma_lost: float = 5.0
    """The vehicle is lost where that standard deviation is larger than this (m)."""
