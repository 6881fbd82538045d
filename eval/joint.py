"""What several drives of a track are worth as one batch: the error of the map by their number."""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import pandas as pd

from pathspace_graph.batch.joint_mapper import join
from pathspace_graph.batch.mapper import BatchResult
from pathspace_graph.estimators import DEFAULT_BATCH, make_batch
from pathspace_graph.factors.se2 import inverse
from pathspace_graph.io.log import Log
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.sim.simulate import SimulationSettings, simulate

from .cars import Columns, generated, over_tracks
from .experiment.tables import Table
from .metrics.alignment import shape_rmse
from .metrics.consistency import consistency_at_cones, map_nees
from .metrics.reference import truth_of
from .metrics.trajectory import position_rms, trajectory_errors

COLUMNS: Final[Columns] = {
    "shape": ("rmse of the shape [m]", 3, 1.0),
    "ratio": ("by half as many", 2, 1.0),
    "nees": ("NEES", 2, 1.0),
    "inside": ("within 2σ [%]", 1, 100.0),
    "ate": ("trajectory error [m]", 3, 1.0),
}


def of_track(car: str, track: int, settings: SimulationSettings, drives: int) -> list[dict[str, Any]]:
    """Return a row for each map of 1, 2, 4 and so on drives of a track, each solved alone once."""
    logs = {str(seed): simulate(generated(track), settings, seed) for seed in range(drives)}
    alone = {name: solve_alone(log) for name, log in logs.items()}
    names, rows, count = [*logs], list[dict[str, Any]](), 1
    while count <= drives:
        for begin in range(0, drives, count):
            group = {name: logs[name] for name in names[begin : begin + count]}
            rows.append({"car": car, "track": track, "drives": count} | metrics_of_group(group, alone))
        count *= 2
    return rows


def solve_alone(log: Log) -> BatchResult:
    """Return the default batch of a log."""
    result = make_batch(DEFAULT_BATCH, MapperSettings(), log).solve(log)
    assert isinstance(result, BatchResult)
    return result


def metrics_of_group(logs: Mapping[str, Log], alone: Mapping[str, BatchResult]) -> dict[str, Any]:
    """Return the metrics of the map of some drives, in the frame of the first, and of their trajectories."""
    first, mapped = next(iter(logs)), {name: alone[name] for name in logs}
    own = mapped
    if len(logs) > 1:
        joint = join(mapped)
        first, mapped = next(iter(joint.drives)), joint.drives
        own = {name: drive.moved(inverse(joint.frames[name])) for name, drive in mapped.items()}
    track, truths = mapped[first].map, {name: truth_of(logs[name]) for name in mapped}
    errors = [trajectory_errors(own[name].trajectory_t, own[name].trajectory, truths[name]) for name in own]
    return {
        "shape": shape_rmse(track, truths[first]),
        "nees": map_nees(track, truths[first]).ratio,
        "inside": consistency_at_cones(track, truths[first])["inside"],
        "ate": float(np.mean([position_rms(one) for one in errors])),
        "mapped": len(own),
    }


def joint_table(frame: pd.DataFrame) -> Table:
    """Return a row for each kind of car and number of drives, with the shape by that of half as many."""
    shape = frame.groupby(["car", "track", "drives"])["shape"].mean()
    parts = {}
    for (car, count), part in frame.groupby(["car", "drives"], sort=False):
        half = [shape.get((car, track, count // 2), np.nan) for track in part["track"]]
        parts[f"{car}, {count} drive{'s' if count > 1 else ''}"] = part.assign(ratio=part["shape"] / half)
    return over_tracks("cars, drives of a track", parts, COLUMNS)
