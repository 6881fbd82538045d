"""Settings of growth: how the open ends of the curves grow."""

from dataclasses import dataclass

from .checked import Positive


@dataclass(frozen=True)
class GrowthSettings(Positive):
    """How the open end of a curve grows, and what a tentative track is."""

    UNLIMITED = ("forget_after",)

    reach: float = 7.0
    """Farthest ahead of the vehicle that a boundary is extended (m along the predicted path)."""
    sightings: int = 3
    """Detections within `merge_radius` that confirm a tentative track."""
    sigma: float = 0.4
    """Standard deviation in every direction (m) to which a track must be known before a curve is extended
    through it: a far, uncertain one waits until it was seen near."""
    merge_radius: float = 1.0
    """Distance within which detections of one label belong to one tentative track (m)."""
    forget_after: float = 6.0
    """Time without a detection after which a tentative track is dropped (s)."""
    threshold: float = 0.7
    """A tentative track nearer to the end of the curve than this (m) does not extend it."""
    max_lateral: float = 10.0
    """A boundary begins with tentative tracks nearer to the driven path than this (m); circuits are up to 15
    m wide."""
    max_size: float = 5000.0
    """Number of control points from which on an open curve grows no further."""
    max_unseen: float = 500.0
    """Longest stretch of an open curve without any cone (m): it is not carried on any farther behind the
    vehicle, and not led on to a cone beyond that."""
