"""Settings of the paper's filters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from .knots import Knots
from .positive import Positive


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
