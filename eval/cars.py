"""Simulated cars on generated tracks, as the studies of known and joint maps drive them."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from pathspace_graph.sim.simulate import SimulationSettings
from pathspace_graph.sim.track import Track
from pathspace_graph.sim.track_generator import generate_track

CARS: Final[Mapping[str, SimulationSettings]] = {
    "plain": SimulationSettings(laps=2),
    "drawn": SimulationSettings(laps=2, draw=True),
}
"""Cars with white noise, and others, each drawn with errors of its own."""


def generated(number: int) -> Track:
    """Return the generated track of a seed."""
    return generate_track(np.random.default_rng(number))


def on_tracks(
    tracks: Sequence[int], cars: Mapping[str, SimulationSettings], **same: Any
) -> list[dict[str, Any]]:
    """Return the arguments of a function of each car on each track, with the same others."""
    return [
        {"car": car, "track": track, "settings": settings, **same}
        for track in tracks
        for car, settings in cars.items()
    ]
