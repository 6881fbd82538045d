"""Settings of the monitor of an online estimate."""

from __future__ import annotations

from dataclasses import dataclass

from .checked import Positive


@dataclass(frozen=True)
class HealthSettings(Positive):
    """Limits of a good, a degraded and a lost estimate.

    The share of detections that the map explains is taken over the newest `window`. A coloured detection in
    the view of the curves is explained if it is in use, or if it lies on a closed curve of its colour farther
    along: in a hairpin the sensor sees the next stretch across the infield.
    """

    window: float = 1.0
    """Age up to which detections are judged together (s)."""
    min_offered: int = 12
    """Least number of detections that are judged; where the window holds fewer, older ones count as well."""
    blind: float = 2.0
    """Time without detections from which on the estimate is degraded (s)."""
    share_degraded: float = 0.8
    """Share of explained detections on a closed map below which the estimate is degraded."""
    share_lost: float = 0.55
    """Share of explained detections on a closed map below which the vehicle is lost."""
    open_degraded: float = 0.35
    """Share of explained detections below which the estimate is degraded while the loop is open. It is low,
    since detections of stretches that are not mapped yet lie beside the curves."""
    innovation: float = 1.2
    """Largest mean squared distance of detections in use from their curve in a good estimate, before the
    update and in units of its variance, to which one sigma of the mean over the cones in view is added; about
    1 if the model is right."""
    sigma_degraded: float = 1.0
    """Position's largest standard deviation on a closed map beyond which an estimate is degraded (m)."""
    sigma_lost: float = 5.0
    """The same standard deviation beyond which the vehicle is lost (m)."""
