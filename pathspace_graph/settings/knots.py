"""Settings of knots: what they follow, and how a curve is fitted on them."""

from dataclasses import dataclass
from typing import Literal

from pathspace_graph.errors import SettingsError

Knots = Literal["cones", "curvature"]
"""What the knots of a closed boundary follow: its cones or its curvature."""


@dataclass(frozen=True)
class BreakSettings:
    """How a curve's knots follow its curvature (paper: Simplification)."""

    baseline: float = 0.5
    """Share in [0, 1] of the knots that is spread evenly, so that straights keep their minimum."""
    curvature_max: float = 0.7
    """Curvature that larger ones count as (1/m), that of the inside of a tight hairpin, so that a kink does
    not attract all knots."""

    def __post_init__(self) -> None:
        if not 0.0 <= self.baseline <= 1.0:
            raise SettingsError(f"baseline: expected a share in [0, 1], found {self.baseline}")
        if not self.curvature_max > 0.0:
            raise SettingsError(f"curvature_max: expected a positive number, found {self.curvature_max}")


@dataclass(frozen=True)
class FitSettings:
    """How a spline is fitted to ordered points."""

    degree: int = 3
    """Degree p of the curve."""
    smoothness: float = 1e-3
    """Weight (m^3) of the bending integral of |S''|^2 beside the sum of squared distances."""
    rounds: int = 4
    """Times that the knots are placed anew by curvature, after a first fit on evenly spaced ones."""
    refits: int = 4
    """Least-squares fits on each set of knots, with refreshed foot points."""
    breaks: BreakSettings = BreakSettings()
