"""The map of `online --on`: one of ours, a track file, or an event of the rules."""

from pathlib import Path
from typing import Final

import numpy as np

from pathspace_graph.errors import InputError
from pathspace_graph.factors.arrays import Array
from pathspace_graph.io.map import MAP_FILE, Map, read_map
from pathspace_graph.batch.known_map import map_of_cones
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.sim.track import EVENTS
from pathspace_graph.sim.track_files import read_track

MAP_SIGMA: Final = 0.15  # standard deviation of the cones of a track file (m)


def read_known_map(path: Path, sigma: float, settings: MapperSettings) -> tuple[Map, Array | None]:
    """Return a map, and the pose (3,) at which a drive on it begins, or None where it may be anywhere.

    Cones of a track file or of an event are known with a standard deviation `sigma` (m).
    """
    if path.is_dir() or path.name == MAP_FILE:
        track = read_map(path)
        return track, None if track.closed else np.zeros(3)
    if not path.exists() and str(path) in EVENTS:
        drawn = EVENTS[str(path)]()
    elif path.exists():
        drawn = read_track(path)
    else:
        events = " or ".join(EVENTS)
        raise InputError(path, f"expected a map's folder, a track file, {events}, found none")
    track = map_of_cones(*drawn.rows, drawn.closed, sigma, settings)
    return track, None if drawn.closed else drawn.start
