"""A short drive with the errors of a real car, as the CSV files that its team would have."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from pathspace_graph.io.log import Log
from pathspace_graph.sim.simulate import preset, simulate
from pathspace_graph.sim.track_generator import generate_track

from ..scenes.drives import SHORT

COLOURS = (1, 0, 2)
"""Left, right and unknown cones have these."""


@cache
def camera_drive(seed: int = 4) -> Log:
    """One lap of a short track with the noise of cameras and of an INS."""
    settings = replace(preset({"sensor": "camera", "odometry": "ins"}), laps=1)
    return simulate(generate_track(np.random.default_rng(seed), SHORT), settings, seed)


def write_recorded(log: Log, folder: Path) -> Path:
    """Writes odometry.csv and detections.csv: range, bearing and colour, with y to the right."""
    folder.mkdir(parents=True)
    twists = log.odometry.twist * [1.0, -1.0, -1.0]
    _write(folder / "odometry.csv", "t,vx,vy,wz", np.column_stack([log.odometry.t, twists]))
    rows = [np.zeros((0, 4))]
    for cycle in log.cycles:
        x, y = cycle.points_vehicle.T
        columns = [
            np.full(len(x), cycle.t),
            np.hypot(x, y),
            -np.arctan2(y, x),
            np.take(COLOURS, cycle.labels),
        ]
        rows.append(np.column_stack(columns))
    _write(folder / "detections.csv", "t,range,bearing,colour", np.concatenate(rows))
    return folder


def _write(file: Path, header: str, rows: np.ndarray) -> None:
    np.savetxt(file, rows, fmt="%.9g", delimiter=",", header=header, comments="")
