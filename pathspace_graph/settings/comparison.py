"""Settings of the estimators that the spline graph is compared with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from .checked import Positive
from .knots import Knots


@dataclass(frozen=True)
class CkfSettings(Positive):
    """The paper's filters."""

    ridge: float = 0.05
    """lambda of the ridge regression: how strongly control points are held where they are (paper: Update)."""
    penalty: Literal["solution", "cost"] = "solution"
    """Whether L stands in the normal equations as the paper's solution has it, or squared as its cost has."""
    prediction: Literal["fitted", "direct"] = "fitted"
    """What S_z is held against: the same fit of the curve's own points, or the control points as they are."""
    sigma_kept: float = 0.05
    """Added to each control point of S_z (m, one sigma) where `prediction` is direct: without it, one that no
    reading reaches would be known exactly."""
    least_basis: float = 1e-3
    """A control point is updated where the basis of the readings adds up to this at least (-)."""
    sigma_model: float = 0.25
    """How far cones stand off a smooth curve (m, one sigma): added to each reading."""
    sigma_along: float = 1.0
    """How far along the curve from its foot point a cone may stand (m, one sigma): added to the reading."""
    reach: float = 9.0
    """How far ahead of the vehicle along its path (m) a curve is led."""
    threshold: float = 4.0
    """Growth threshold (m): a reading nearer to the end than this updates the curve instead."""
    separation: float = 4.0
    """An extension keeps this distance from the last control point but one (m)."""
    stretch: float = 12.0
    """Longest extension at once (m): a farther one takes several."""
    sigma_carry: float = 1.0
    """Of the control point that carries a stranded end on beside the way (m, one sigma)."""
    sigma_start: float = 0.3
    """Of each control point of a new curve beside what the first readings say (m, one sigma)."""
    sigma_bend: float = 0.5
    """Second difference of the control points that an extension moves or adds, as a share of their spacing
    (one sigma): the end's bending is known from the readings on it only, and multiplies with each extension
    where nothing holds it. Large: as written."""
    knots: Knots = "curvature"
    """Knots of a closed boundary: by curvature as in the paper, or where cones ask for them as in ours."""
    sigma_tie: float = 0.15
    """How far apart the end of a curve and its beginning may be where the loop closes (m, one sigma)."""
    sigma_match: float = 0.6
    """Deviation (m) of a reading from the early segment that it is associated with: more than in the mapper's
    own closing, since the filter's early segment is the worse, ..."""
    patience: float = 30.0
    """... so that a stretch driven again (m), rather than certainty of the place, closes the loop, ..."""
    sigma_patience: float = 1000.0
    """... however uncertain that is then (m)."""
    tie_reach: float = 1.0
    """Points of the end that the registration leaves farther from the beginning (m) aren't tied to it."""
    sightings: int = 3
    """Readings that make a landmark of the baseline; 1 takes every reading, as its description does."""


@dataclass(frozen=True)
class LandmarkSettings(Positive):
    """The Hungarian landmark graph."""

    match: float = 0.95
    """Probability of the gate inside which a reading may be of a landmark."""
    create: float = 0.99
    """Probability of the gate outside which, from every landmark of its colour, it may be of a new one."""
    rough: float = 5.0
    """A landmark farther from every reading of a cycle than this (m) isn't tested at all."""
    max_rounds: int = 10
    """Times that the batch associates anew, ..."""
    settled: float = 1e-3
    """... or until no more than this share of the readings is of another landmark then."""
    tolerance: float = 1e-6
    """A round's optimization ends where |cost_before - cost_after| <= tolerance * cost_before."""
    sigma_merge: float = 0.1
    """Two landmarks of one cone may be so far apart (m, one sigma) beyond what their covariance says."""
    unseen: float = 40.0
    """A landmark not seen for so long (m, path driven) belongs to an earlier stretch: near the start, until
    the loop has closed, no reading is of it."""
    min_pairs: int = 4
    """Fewest landmarks that must be recognized together to close the loop, a third of them of each colour."""
    min_lead: float = 2.0
    """They must explain so many landmarks more than any other set does (landmarks, each worth a gate)."""
