"""Simulated cars on generated tracks, as the studies of known and joint maps drive them, and their table."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
import pandas as pd

from pathspace_graph.sim.simulate import SimulationSettings
from pathspace_graph.sim.track import Track
from pathspace_graph.sim.track_generator import generate_track

from .experiment.statistics import estimate
from .experiment.tables import Table

Columns = Mapping[str, tuple[str, int, float]]  # of a table, by their key: heading, digits, factor

CARS: Final[Mapping[str, SimulationSettings]] = {
    "plain": SimulationSettings(laps=2),
    "drawn": SimulationSettings(laps=2, draw=True),
}
"""Cars with white noise, and others, each drawn with errors of its own."""


def generated(number: int) -> Track:
    """Return the generated track of a seed."""
    return generate_track(np.random.default_rng(number))


def on_tracks(tracks: Sequence[int], **same: Any) -> list[dict[str, Any]]:
    """Return the arguments of a function of each car on each track, with the same others."""
    return [
        {"car": car, "track": track, "settings": settings, **same}
        for track in tracks
        for car, settings in CARS.items()
    ]


def over_tracks(title: str, parts: Mapping[str, pd.DataFrame], columns: Columns) -> Table:
    """Return a row for each part, over tracks: the drives of one are no sample."""
    rows = []
    for label, part in parts.items():
        means = part.groupby("track")[[*columns]].mean()
        texts = (estimate(means[key]).text(digits, factor) for key, (_, digits, factor) in columns.items())
        rows.append((label, *texts))
    return Table.of((title, *(heading for heading, _, _ in columns.values())), rows)
