"""Simulated cars on generated tracks, as the studies of known and joint maps drive them."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import numpy as np
import pandas as pd
from joblib import Parallel, delayed

from pathspace_graph.sim.simulate import SimulationSettings
from pathspace_graph.sim.track import Track
from pathspace_graph.sim.track_generator import generate_track

from .experiment.run import OnCell, workers

CARS: Final[Mapping[str, SimulationSettings]] = {
    "plain": SimulationSettings(laps=2),
    "drawn": SimulationSettings(laps=2, draw=True),
}
"""Cars with white noise, and others, each drawn with errors of its own."""


def generated(number: int) -> Track:
    """Return the generated track of a seed."""
    return generate_track(np.random.default_rng(number))


def on_tracks(
    rows_of: Callable[[str, int], list[dict[str, Any]]],
    cars: Sequence[str],
    tracks: Sequence[int],
    jobs: int,
    on_cell: OnCell | None = None,
) -> pd.DataFrame:
    """Return the rows of each car on each track, in no order; `on_cell` counts these pairs."""
    cells, rows = [(car, track) for track in tracks for car in cars], list[dict[str, Any]]()
    with workers(jobs, None):
        running = Parallel(return_as="generator_unordered")(delayed(rows_of)(*cell) for cell in cells)
        for done, found in enumerate(running, start=1):
            rows += found
            if on_cell is not None:
                on_cell(done, len(cells))
    return pd.DataFrame(rows)
