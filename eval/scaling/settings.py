"""Settings of what is measured of how time scales, and of the roads that it is measured on."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

from pathspace_graph.errors import SettingsError
from pathspace_graph.settings.checked import Positive


@dataclass(frozen=True)
class RoadSettings(Positive):
    """Describes the roads and the drives on them."""

    gap: float = 5.0
    """The cones of a row are this far apart (m)."""
    dense_gap: float = 1.0
    """The cones of a row are this far apart on the dense road, where detections are counted (m)."""
    dense_range: float = 30.0
    """The sensor has this range on the dense road (m)."""
    width: float = 4.0
    """The rows are this far apart (m)."""
    swing: float = 0.9
    """An open road turns by at most this angle from its general direction (rad)."""
    wavelength: float = 300.0
    """The swings of an open road are this far apart along it (m)."""
    dent: float = 0.12
    """A closed road leaves its circle by this share of the radius."""
    dents: int = 3
    """A closed road has this many dents."""
    speed: float = 20.0
    """The vehicle drives at this speed (m/s)."""
    acceleration_lateral: float = 9.0
    """The lateral acceleration in corners is at most this (m/s^2)."""


@dataclass(frozen=True)
class ScalingSettings(Positive):
    """Describes what is measured of how time scales."""

    cones_min: float = 50.0
    """A point of the sweep over cones has at least this many cones seen."""
    cones_max: float = 2000.0
    """The sweep over cones ends when this many cones have been seen."""
    bins: int = 16
    """The sweep over cones has this many points, evenly spaced on a logarithmic axis."""
    fit_from: float = 200.0
    """The slope against cones is fitted from this number of cones on."""
    readings: tuple[int, ...] = (2, 4, 8, 14, 20, 28, 40)
    """Updates with each of these numbers of detections are timed."""
    readings_cones: int = 300
    """The dense road, where these updates are timed, has this many cones."""
    warm_up: int = 30
    """This many cycles at the beginning of the dense road are not counted."""
    laps: int = 20
    """The closed road is driven for this many laps."""
    laps_cones: int = 100
    """The closed road has this many cones."""
    budget: float = 0.5
    """An estimator is stopped where a mean update takes longer than this (s)."""
    seed: int = 1
    """The drives and the choice of detections have this seed."""
    road: RoadSettings = field(default_factory=RoadSettings)
    """These settings describe the roads and the drives on them."""

    def __post_init__(self) -> None:
        """Raises SettingsError as well where a range is empty."""
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
"""This preset takes less than a minute and shows that everything works; its slopes mean little."""
