"""Logs of a real car without truth, mapped in three ways and compared with each other (docs/real.md)."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, groupby
from pathlib import Path
from typing import Any, Final

import numpy as np

from pathspace_graph import estimators as registry
from pathspace_graph.batch.joint import join
from pathspace_graph.errors import SolveError
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.se2 import compose, inverse, wrap_angle
from pathspace_graph.factors.sensor import SENSOR
from pathspace_graph.front_end.front_end import seen_cycles
from pathspace_graph.io.log import Log
from pathspace_graph.io.map import Map, read_map
from pathspace_graph.io.results import TRAJECTORY_FILE
from pathspace_graph.io.tables import read_trajectory

from .cars import solve_alone
from .experiment.run import make_plan, run_folder, run_records
from .experiment.statistics import estimate
from .experiment.study import Study
from .experiment.tables import Table
from .metrics.accuracy import crossings
from .metrics.alignment import aligned_distance, end_by_registration, maps_apart
from .metrics.measures import UNKNOWN, figure, figures

RUNS: Final = {  # estimator of each run
    "online": registry.DEFAULT_ONLINE,
    "batch": registry.DEFAULT_BATCH,
    "landmarks": "landmark-fixed-lag",
}
UNMEASURED: Final = "the noise of the log was not measured"  # why there is no reference
ERRORS: Final = {  # errors of the sensor in the table, with titles and units
    "latency": ("latency [ms]", 1e3),
    "yaw": ("yaw [°]", 180.0 / np.pi),
    "range_scale": ("scale [%]", 100.0),
}


@dataclass(frozen=True, eq=False)
class RealDrive:
    """A log, its runs by their names in `RUNS`, and their references."""

    name: str
    log: Log
    maps: dict[str, Map]
    ends: dict[str, Array]  # last pose (3,) of each run
    rows: dict[str, dict[str, Any]]  # metrics of each run
    dead_reckoned: Array  # last pose (3,) by odometry alone
    registered: Array | str  # last pose (3,) by registration, or why there is none

    def off(self, pose: Array) -> tuple[float, float]:
        """Return how far (m) and by what angle (degrees) a last pose (3,) is from that by registration."""
        if isinstance(self.registered, str):
            return np.nan, np.nan
        turn = float(wrap_angle(np.array(pose[2] - self.registered[2])))
        return float(np.hypot(*(pose[:2] - self.registered[:2]))), float(np.rad2deg(turn))


def map_real_logs(logs: Sequence[Path], out: Path, **how: Any) -> list[RealDrive]:
    """Map logs that `convert` has written by all estimators of `RUNS`; `how` is that of `run_records`.

    SolveError where one has failed.
    """
    folders = {folder.name: (folder,) for folder in logs}
    plan = make_plan(Study(name="real", logs=folders, estimators=tuple(RUNS.values())), keep=True)
    records, drives = run_records(plan, out, **how), list[RealDrive]()
    for drive, group in groupby(plan.cells, key=lambda cell: cell.drive):
        cells = dict(zip(RUNS, group, strict=True))
        if failed := [one for cell in cells.values() if (one := records[cell.id]["failure"])]:
            raise SolveError(f"{drive.source}: {failed[0]}")
        runs = {name: run_folder(out, cell) for name, cell in cells.items()}
        log, _ = drive.load()
        seen, _ = seen_cycles(log)
        real = RealDrive(
            drive.source,
            log,
            {name: read_map(folder) for name, folder in runs.items()},
            {name: read_trajectory(folder / TRAJECTORY_FILE)[1][-1] for name, folder in runs.items()},
            {name: records[cell.id]["rows"][-1] for name, cell in cells.items()},
            seen[-1].pose,
            UNMEASURED if log.measured is None else end_by_registration(seen, log.measured),
        )
        drives.append(real)
    return drives


def runs_table(drives: Sequence[RealDrive]) -> Table:
    """Return a row for each run; the name of one without a reference says why."""
    header = (
        *("log, run", "closed [%]", "end off by [m]", "turned by [°]"),
        *("dead reckoning off by [m]", "dead reckoning turned by [°]", "crossings", "own crossings"),
        *("degraded [%]", "lost [%]", "update [ms]"),
    )
    rows = []
    for drive in drives:
        for name, row in drive.rows.items():
            reckoned = drive.off(drive.dead_reckoned) if name == "online" else (np.nan, np.nan)
            crossed = (np.nan, np.nan) if name == "landmarks" else crossings(drive.maps[name])
            values = [100.0 * row["closed_at_end"], *drive.off(drive.ends[name]), *reckoned, *crossed]
            values += [100.0 * row.get(f"reported_{word}", np.nan) for word in ("degraded", "lost")]
            values.append(row.get("ms_processor", np.nan))
            why = f" (no reference: {drive.registered})" if isinstance(drive.registered, str) else ""
            rows.append((f"{drive.name}, {name}{why}", *figures(values, 0, 2, 1, 2, 1, 0, 0, 1, 1, 1)))
    return Table.of(header, rows)


def maps_table(drives: Sequence[RealDrive]) -> Table:
    """Return the distance between the maps of each two drives around the same cones: under a metre."""
    rows = []
    for first, second in combinations(drives, 2):
        apart = [aligned_distance(first.maps[name], second.maps[name]) for name in RUNS]
        if min(apart) < 1.0:
            rows.append((f"{first.name}, {second.name}", *figures(apart, 2)))
    return Table.of(("maps", *(f"{name} [m]" for name in RUNS)), rows)


def joint_table(drives: Sequence[RealDrive]) -> Table:
    """Return how far each drive's own batch is from that of all drives, and both from the last pose."""
    alone = {drive.name: solve_alone(drive.log) for drive in drives}
    joint, rows = join(alone), []
    for drive in (drive for drive in drives if drive.name in joint.drives):
        own = joint.drives[drive.name]
        apart = maps_apart(alone[drive.name].map, own.map).statistics()["both"]
        pose = compose(inverse(joint.frames[drive.name]), own.trajectory[-1])
        ends = drive.off(alone[drive.name].trajectory[-1])[0], drive.off(pose)[0]
        rows.append((drive.name, *figures([*apart.values(), *ends], 2)))
    apart_by = ("map apart, mean [m]", "rms [m]", "p95 [m]", "largest [m]")
    return Table.of(("drive", *apart_by, "end off by, alone [m]", "together [m]"), rows)


def measured_table(drives: Sequence[RealDrive]) -> Table:
    """Return what was measured on each drive, and over all of them the mean with its interval."""
    header = (
        *("log", "vx [m/s]", "vy [m/s]", "wz [rad/s]", "along at 10 m [m]", "across at 10 m [m]"),
        *("stays along [%]", "stays across [%]", *(title for title, _ in ERRORS.values())),
    )
    units, places = [unit for _, unit in ERRORS.values()], [SENSOR.index(name) for name in ERRORS]
    rows, errors, at = [], [], np.array([10.0])
    for drive in drives:
        found = drive.log.measured
        if found is None or found.along is None or found.across is None:
            continue
        rays = (found.along, found.across)
        values = [*found.odometry, *(ray.sigmas(at)[0] for ray in rays), *(100.0 * ray.share for ray in rays)]
        errors.append(found.sensor[places] * units)
        halves = 1.96 * found.sensor_sigma[places] * units
        texts = (figure(*pair, 1) for pair in zip(errors[-1].tolist(), halves.tolist(), strict=True))
        rows.append((drive.name, *figures(values, 4, 4, 4, 2, 2, 0, 0), *texts))
    if len(errors) > 1:
        means = (estimate(column).text(1) for column in np.transpose(errors))
        rows.append(("all drives", *[UNKNOWN] * 7, *means))
    return Table.of(header, rows)
