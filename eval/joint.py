"""What several drives of a track are worth as one batch: the error of the map by their number."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import pandas as pd

from pathspace_graph.batch.joint_mapper import join
from pathspace_graph.batch.mapper import BatchResult
from pathspace_graph.estimators import DEFAULT_BATCH, make_batch
from pathspace_graph.factors.se2 import inverse
from pathspace_graph.io.log import Log
from pathspace_graph.io.moved import moved_run
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.sim.simulate import SimulationSettings, simulate

from .cars import CARS, generated, on_tracks
from .experiment.rows import rows_of
from .experiment.tables import Quantity, Table
from .metrics.alignment import shape_rmse
from .metrics.consistency import consistency_at_cones, map_nees
from .metrics.reference import truth_of
from .metrics.trajectory import position_rms, trajectory_errors

COLUMNS: Final = {  # of the table: title, digits, factor
    "shape": ("rmse of the shape [m]", 3, 1.0),
    "ratio": ("by half as many", 2, 1.0),
    "nees": ("NEES", 2, 1.0),
    "inside": ("within 2σ [%]", 1, 100.0),
    "ate": ("trajectory error [m]", 3, 1.0),
}


@dataclass(frozen=True, kw_only=True)
class JointStudy:
    """Drives of generated tracks, mapped alone, and in groups of 2, 4 and so on."""

    tracks: tuple[int, ...] = (50, 51, 52)  # seeds
    drives: int = 8  # number of drives of each track, a power of two
    cars: Mapping[str, SimulationSettings] = field(default_factory=lambda: CARS)

    def measure(self, **how: Any) -> pd.DataFrame:
        """Return a row for each map: car, track, drives in it, `COLUMNS`; `how` is that of `rows_of`."""
        return rows_of(of_track, on_tracks(self.tracks, self.cars, drives=self.drives), **how)


def of_track(car: str, track: int, settings: SimulationSettings, drives: int) -> list[dict[str, Any]]:
    """Return the rows of one track, each drive of which is solved alone once."""
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
        own = {name: moved_run(drive, inverse(joint.frames[name])) for name, drive in mapped.items()}
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
    """Return a row for each kind of car and number of drives, over tracks: the maps of one are no sample."""
    rows = []
    for car, of_car in frame.groupby("car", sort=False):
        means = of_car.groupby(["drives", "track"])[["shape", "nees", "inside", "ate"]].mean()
        for count in sorted(of_car["drives"].unique()):
            own = means.loc[count]
            before = means.loc[count // 2]["shape"] if count > 1 else np.nan
            values = own.assign(ratio=own["shape"] / before)
            figures = (Quantity.of(values[key], digits, f) for key, (_, digits, f) in COLUMNS.items())
            rows.append((f"{car}, {count} drive{'s' if count > 1 else ''}", *figures))
    return Table(("cars, drives of a track", *(title for title, _, _ in COLUMNS.values())), tuple(rows))
