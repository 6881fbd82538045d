"""Settings of the estimators that the spline graph is compared with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from .checked import Positive
from .knots import Knots


@dataclass(frozen=True)
class CkfSettings(Positive):
    """Describes the paper's filters."""

    ridge: float = 0.05
    """This is lambda of the ridge regression, which says how strongly control points are held at their places
    (paper: Update)."""
    penalty: Literal["solution", "cost"] = "solution"
    """L stands in the normal equations as in the paper's solution, or squared as its cost implies."""
    prediction: Literal["fitted", "direct"] = "fitted"
    """S_z is compared with the same fit of the curve's own points, or directly with the control points."""
    sigma_kept: float = 0.05
    """Where `prediction` is direct, this standard deviation (m) is added to each control point of S_z;
    without it, a control point that no detection reaches would be known exactly."""
    least_basis: float = 1e-3
    """A control point is updated where its basis values at the detections add up to at least this (-)."""
    sigma_model: float = 0.25
    """This is the standard deviation (m) of a cone's distance from a smooth curve; its square is added to the
    covariance of each detection."""
    sigma_along: float = 1.0
    """This is the standard deviation (m) of the distance along the curve between a cone and its foot point;
    its square is added to the covariance of each detection."""
    reach: float = 9.0
    """A curve is extended up to this far ahead of the vehicle (m along the predicted path)."""
    threshold: float = 4.0
    """A detection nearer to the end than this growth threshold (m) updates the curve instead of extending
    it."""
    separation: float = 4.0
    """An extension keeps at least this distance from the second-to-last control point (m)."""
    stretch: float = 12.0
    """An extension is at most this long (m), so a longer one takes several."""
    sigma_carry: float = 1.0
    """This is the standard deviation (m) of the control point that carries on a stranded end along the
    path."""
    sigma_start: float = 0.3
    """This standard deviation (m) is added to each control point of a new curve, beyond the uncertainty of
    its first detections."""
    sigma_bend: float = 0.5
    """This is the standard deviation of the second difference of the control points that an extension moves
    or adds, as a share of their spacing. The bending of the end is known from the detections on it only, and
    without a prior its uncertainty multiplies with each extension. A large value gives the filter as it is
    published."""
    knots: Knots = "curvature"
    """The knots of a closed boundary follow its curvature as in the paper, or its cones as in the spline
    graph."""
    sigma_tie: float = 0.15
    """This is the standard deviation (m) of the distance between the end of a curve and its beginning where
    the loop closes."""
    sigma_match: float = 0.6
    """This is the standard deviation (m) of a detection in the registration with the early segment. It is
    larger than `closing.sigma_reading`, since the filter's early segment is worse."""
    patience: float = 30.0
    """Once this length of the beginning has been driven again (m), `sigma_patience` replaces
    `closing.sigma_max`."""
    sigma_patience: float = 1000.0
    """After `patience`, the standard deviation of the registered position must be below this (m). A large
    value lets the length that is driven again close the loop, however uncertain the position is."""
    tie_reach: float = 1.0
    """Points of the end that the registration leaves farther from the beginning than this (m) are not used as
    correspondences."""
    sightings: int = 3
    """A landmark of the baseline filter is made by this number of detections; 1 takes every detection, as the
    description of the baseline does."""


@dataclass(frozen=True)
class LandmarkSettings(Positive):
    """Describes the Hungarian landmark graph."""

    match: float = 0.95
    """The gate inside which a detection may be of a landmark has this probability."""
    create: float = 0.99
    """A detection may be of a new landmark if it lies outside the gate of this probability of every landmark
    of its colour."""
    rough: float = 5.0
    """A landmark farther from every detection of a cycle than this (m) is not tested at all."""
    max_rounds: int = 10
    """The batch associates all detections anew at most this number of times."""
    settled: float = 1e-3
    """The batch ends when at most this share of the detections changed its landmark in a round."""
    tolerance: float = 1e-6
    """A round's optimization ends where |cost_before - cost_after| <= tolerance * cost_before."""
    sigma_merge: float = 0.1
    """This is the standard deviation (m) of the distance between two landmarks of one cone, beyond their
    covariance."""
    unseen: float = 40.0
    """A landmark that was not detected along this length of the driven path (m) belongs to an earlier
    stretch. Until the loop has closed, no detection near the start is associated with it."""
    min_pairs: int = 4
    """At least this number of landmarks must be recognized together to close the loop, a third of them of
    each colour."""
    min_lead: float = 2.0
    """The recognized pairs must score this much better than any other set, where each landmark counts as one
    gate (landmarks)."""


@dataclass(frozen=True)
class CenterlineSettings(Positive):
    """Describes the estimators that map a track as one centre line with a width."""

    spacing: float = 3.0
    """The knots of the centre line are about this far apart (m)."""
    sigma_width: float = 0.3
    """This is the standard deviation (m) of the second difference of the half widths at neighbouring control
    points."""
    room: float = 4.0
    """Foot points are searched for within this distance (m along the line) of where they are expected."""
    rounds: int = 2
    """The batch holds the control points beside the poses anew, and is optimized again, in each round."""
    max_iterations: int = 15
    """Each round takes at most this number of iterations."""
    tolerance: float = 1e-5
    """A round ends where an iteration lowers the error by less than this share."""
