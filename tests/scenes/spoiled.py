"""A short drive whose log can be spoiled: an exact course with bends, and a simulated lap."""

from __future__ import annotations

from functools import cache

import numpy as np

from pathspace_graph.io.log import Log
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track_generator import TrackGeneratorSettings, generate_track

SHORT = TrackGeneratorSettings(lap_length=(100.0, 160.0), corners=(3, 4), hairpins=(0, 0), cones=90)
"""A track of this kind is driven in twenty seconds."""


@cache
def short_drive(seed: int = 4) -> Log:
    """The log of one lap of a short generated track, with the simulator's noise."""
    track = generate_track(np.random.default_rng(seed), SHORT)
    return simulate(track, SimulationSettings(laps=1), seed)
