"""Settings of the estimators that the spline graph is compared with."""

from dataclasses import dataclass

from .checked import Positive
from .knots import Knots


@dataclass(frozen=True)
class CkfSettings(Positive):
    """The paper's filters."""

    ridge: float = 0.05
    """Lambda of the ridge regression: how strongly control points are held at their places (paper:
    Update)."""
    sigma_model: float = 0.25
    """Standard deviation (m) of a cone's distance from a smooth curve; its square is added to the covariance
    of each detection."""
    sigma_along: float = 1.0
    """Standard deviation (m) of the distance along the curve between a cone and its foot point; its square is
    added to the covariance of each detection."""
    threshold: float = 4.0
    """A detection nearer to the end than this growth threshold (m) updates the curve instead of extending
    it."""
    separation: float = 4.0
    """Least distance of an extension from the second-to-last control point (m)."""
    sigma_bend: float = 0.5
    """Standard deviation of the second difference of the control points that an extension moves or adds, as a
    share of their spacing. The bending of the end is known from the detections on it only, and without a
    prior its uncertainty multiplies with each extension. A large value gives the filter as it is
    published."""
    knots: Knots = "curvature"
    """The knots of a closed boundary follow its curvature as in the paper, or its cones as in the spline
    graph."""
    sightings: int = 3
    """A landmark of the baseline filter is made by this number of detections; 1 takes every detection, as the
    description of the baseline does."""


@dataclass(frozen=True)
class LandmarkSettings(Positive):
    """The Hungarian landmark graph."""

    match: float = 0.95
    """Probability of the gate inside which a detection may be of a landmark."""
    create: float = 0.99
    """A detection may be of a new landmark if it lies outside the gate of this probability of every landmark
    of its colour."""


@dataclass(frozen=True)
class CenterlineSettings(Positive):
    """The estimators that map a track as one centre line with a width."""

    spacing: float = 3.0
    """Distance of the knots of the centre line (m)."""
    sigma_width: float = 0.3
    """Standard deviation (m) of the second difference of the half widths at neighbouring control points."""
