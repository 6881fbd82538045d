"""Settings of the Hungarian landmark graph."""

from __future__ import annotations

from dataclasses import dataclass

from .positive import Positive


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
