"""The map of `online --on`: one of ours, a track file, or an event of the rules."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pathspace_graph.batch.known_map import map_of_cones
from pathspace_graph.errors import InputError
from pathspace_graph.eval.metrics.alignment import MapDifference, differences
from pathspace_graph.factors.arrays import Array
from pathspace_graph.io.map import MAP_FILE, Map, read_map
from pathspace_graph.io.results import RunResult
from pathspace_graph.lengths import scaled
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.run import OnlineEstimator
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.sim.track import EVENTS
from pathspace_graph.sim.track_files import read_track


@dataclass(frozen=True, eq=False)
class KnownTrack:
    """A map that is known before the drive."""

    path: Path
    map: Map
    start: Array | None  # pose (3,) at the begin of an open one (m, m, rad), map frame; None of a closed one

    def found_at(self, estimator: OnlineEstimator) -> float | None:
        """Stamp (s) at which the vehicle was found on the map, if it was."""
        return estimator.placed_at if isinstance(estimator, FixedLagMapper) else None

    def differences(self, result: RunResult, estimator: OnlineEstimator) -> list[MapDifference]:
        """Changes of the track against the known map, once the vehicle was found on it."""
        if self.found_at(estimator) is None:
            return []
        found = differences(scaled(self.map, 1.0 / result.scale), result.at_scale_one().map)
        return [scaled(one, result.scale) for one in found]

    def summary(self, estimator: OnlineEstimator, differ: list[MapDifference]) -> dict[str, Any]:
        """Entries of `summary.json` about the map."""
        known = {"map": str(self.path), "found_at": self.found_at(estimator)}
        return {"known_map": known, "differences": [asdict(one) for one in differ]}


def read_known_map(path: Path, sigma: float, settings: MapperSettings) -> KnownTrack:
    """Read the map of a folder, of a track file, or of an event of the rules.

    Cones of a track file or of an event are known with a standard deviation `sigma` (m).
    """
    if path.is_dir() or path.name == MAP_FILE:
        track = read_map(path)
        return KnownTrack(path, track, None if track.closed else np.zeros(3))
    if not path.exists() and str(path) in EVENTS:
        drawn = EVENTS[str(path)]()
    elif path.exists():
        drawn = read_track(path)
    else:
        events = " or ".join(EVENTS)
        raise InputError(path, f"expected a map's folder, a track file, {events}, found none")
    track = map_of_cones(*drawn.rows, drawn.closed, sigma, settings)
    return KnownTrack(path, track, None if drawn.closed else drawn.start)
