"""Settings of the evaluation: extent of the timing."""

from dataclasses import dataclass

from pathspace_graph.errors import SettingsError

from .checked import Checked


@dataclass(frozen=True)
class ScalingSettings(Checked):
    """Extent of the timing."""

    cones_min: float = 50.0
    """Least number of cones seen of a point of the sweep over cones."""
    cones_max: float = 2000.0
    """Number of cones seen at which the sweep over cones ends."""
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
    seed: int = 1
    """Seed of the drives and of the choice of detections."""

    def __post_init__(self) -> None:
        """Raise SettingsError as well where a range is empty."""
        super().__post_init__()
        if self.cones_min >= self.cones_max:
            raise SettingsError(f"cones_min: expected less than cones_max, found {self.cones_min:g}")
        if not self.readings or min(self.readings) < 1:
            raise SettingsError(f"readings: expected numbers of at least 1, found {self.readings}")
