"""Settings of the evaluation: extent of the timing."""

from dataclasses import dataclass
from typing import Final

from pathspace_graph.errors import SettingsError

from .checked import Checked

CONES_MIN: Final = 50.0  # number of cones seen at which the sweep over cones begins


@dataclass(frozen=True)
class ScalingSettings(Checked):
    """Extent of the timing."""

    cones_max: float = 2000.0
    """Number of cones seen at which the sweep over cones ends, which begins at 50."""
    bins: int = 16
    """Number of points of the sweep over cones, evenly spaced on a logarithmic axis."""
    fit_from: float = 200.0
    """Number of cones from which on the slope against cones is fitted."""
    readings: tuple[int, ...] = (2, 4, 8, 14, 20, 28, 40)
    """Numbers of detections of the updates that are timed."""
    readings_cones: int = 300
    """Number of cones of the dense road, where these updates are timed."""
    warm_up: int = 30
    """Cycles at the beginning of the dense road that are not counted."""
    laps: int = 20
    """Laps of the closed road."""
    laps_cones: int = 100
    """Cones of the closed road."""
    budget: float = 0.5
    """Mean update at which an estimator is stopped (s)."""

    def __post_init__(self) -> None:
        """Raise SettingsError as well where a range is empty."""
        super().__post_init__()
        if self.cones_max <= CONES_MIN:
            raise SettingsError(f"cones_max: expected more than {CONES_MIN:g}, found {self.cones_max:g}")
        if not self.readings or min(self.readings) < 1:
            raise SettingsError(f"readings: expected numbers of at least 1, found {self.readings}")
