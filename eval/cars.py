"""Simulated cars on generated tracks, as the studies of known and joint maps drive them."""

from collections.abc import Mapping
from typing import Final

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
