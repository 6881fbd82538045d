"""What is measured of how time scales."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

from pathspace_graph.errors import SettingsError
from pathspace_graph.settings.checked import Positive

from .roads import RoadSettings


@dataclass(frozen=True)
class ScalingSettings(Positive):
    """What is measured."""

    cones_min: float = 50.0
    """Fewest cones seen that a point is made of."""
    cones_max: float = 2000.0
    """Most cones, where the road ends."""
    bins: int = 16
    """Points from the fewest to the most cones, evenly spaced on a logarithmic axis."""
    fit_from: float = 200.0
    """The slope against cones is fitted from so many cones on."""
    readings: tuple[int, ...] = (2, 4, 8, 14, 20, 28, 40)
    """Readings of an update."""
    readings_cones: int = 300
    """Cones of the dense road that those are taken on."""
    warm_up: int = 30
    """Cycles that aren't counted there."""
    laps: int = 20
    """Laps of the closed road."""
    laps_cones: int = 100
    """Cones of the closed road."""
    budget: float = 0.5
    """An estimator is stopped where a mean update takes longer than this, s."""
    seed: int = 1
    """Of the drives and of the readings drawn."""
    road: RoadSettings = field(default_factory=RoadSettings)
    """The roads and the drives on them."""

    def __post_init__(self) -> None:
        """SettingsError as well where a range is none."""
        super().__post_init__()
        if self.cones_min >= self.cones_max:
            raise SettingsError(f"cones_min: expected less than cones_max, found {self.cones_min:g}")
        if not self.readings or min(self.readings) < 1:
            raise SettingsError(f"readings: expected numbers of at least 1, found {self.readings}")


QUICK: Final = ScalingSettings(
    cones_max=200.0,
    bins=8,
    fit_from=50.0,
    readings=(2, 8, 20),
    readings_cones=160,
    warm_up=20,
    laps=4,
    laps_cones=60,
    budget=0.1,
)
"""A preset of less than a minute, to see that everything works; its slopes mean little."""
