"""Settings of the estimators that the spline graph is compared with."""

from dataclasses import dataclass

from .checked import Positive
from .knots import Knots


@dataclass(frozen=True)
class CkfSettings(Positive):
    """The paper's filters."""

    ridge: float = 0.05
    """Lambda of the ridge regression, which holds control points at their places (paper: Update)."""
    sigma_model: float = 0.25
    """Standard deviation (m) of a cone's distance from a smooth curve; its square is added to the covariance
    of each detection."""
    sigma_along: float = 1.0
    """Standard deviation (m) of the distance along the curve between a cone and its foot point; its square is
    added to the covariance of each detection."""
    threshold: float = 4.0
    """Growth threshold (m): a detection nearer to the end updates the curve instead of extending it."""
    separation: float = 4.0
    """Least distance of an extension from the second-to-last control point (m)."""
    sigma_bend: float = 0.5
    """Standard deviation of the second difference of the control points that an extension moves or adds, as a
    share of their spacing. The bending of the end is known from the detections on it only, and without a
    prior its uncertainty multiplies with each extension. A large value gives the filter as it is
    published."""
    knots: Knots = "curvature"
    """What the knots of a closed boundary follow: curvature, as in the paper, or cones."""
    sightings: int = 3
    """Detections that make a landmark of the baseline filter; 1, as it is described, takes every one."""


@dataclass(frozen=True)
class LandmarkSettings(Positive):
    """The Hungarian landmark graph."""

    match: float = 0.95
    """Probability of the gate inside which a detection may be of a landmark."""
    create: float = 0.99
    """Probability of the gates of all landmarks of its colour outside of which a detection may be new."""


@dataclass(frozen=True)
class CenterlineSettings(Positive):
    """The estimators that map a track as one centre line with a width."""

    spacing: float = 3.0
    """Distance of the knots of the centre line (m)."""
    sigma_width: float = 0.3
    """Standard deviation (m) of the second difference of the half widths at neighbouring control points."""
    room: float = 4.0
    """Distance from where they are expected within which foot points are searched for (m along the line)."""
    rounds: int = 2
    """Rounds of the batch, each of which holds the control points beside the poses anew."""
    max_iterations: int = 15
    """Most iterations of a round."""
    tolerance: float = 1e-5
    """Share by which an iteration must lower the error for a round to go on."""
