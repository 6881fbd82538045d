"""Logs of a real car without truth, mapped in three ways and compared with each other (docs/real.md)."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Final

import numpy as np

from pathspace_graph import estimators as registry
from pathspace_graph.batch.joint_mapper import join
from pathspace_graph.batch.mapper import BatchResult
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.se2 import compose, inverse, wrap_angle
from pathspace_graph.factors.sensor import SENSOR
from pathspace_graph.front_end.front_end import seen_cycles
from pathspace_graph.io.log import Log
from pathspace_graph.io.results import RunResult, write_result
from pathspace_graph.plausibility.judge import read_plausible_log
from pathspace_graph.settings.mapper import MapperSettings

from .experiment.cells import run_estimator
from .experiment.tables import Quantity, Table
from .metrics.accuracy import crossings
from .metrics.alignment import aligned_distance, maps_apart
from .metrics.registration import end_by_registration
from .metrics.summary import summarize

RUNS: Final = {  # estimator of each run
    "online": registry.DEFAULT_ONLINE,
    "batch": registry.DEFAULT_BATCH,
    "landmarks": "landmark-fixed-lag",
}
ERRORS: Final = {  # errors of the sensor in the table, with titles and units
    "latency": ("latency [ms]", 1e3),
    "yaw": ("yaw [°]", 180.0 / np.pi),
    "range_scale": ("scale [%]", 100.0),
}


@dataclass(frozen=True, eq=False)
class RealDrive:
    """A log, its runs, and their references."""

    name: str
    log: Log
    runs: dict[str, RunResult]
    dead_reckoned: Array  # last pose (3,) by odometry alone
    registered: Array | None  # last pose (3,) by registration, where the drive comes back to its beginning

    def off(self, pose: Array) -> tuple[float, float]:
        """Return how far (m) and by what angle (degrees) a last pose (3,) is from that by registration."""
        if self.registered is None:
            return np.nan, np.nan
        turn = float(wrap_angle(np.array(pose[2] - self.registered[2])))
        return float(np.hypot(*(pose[:2] - self.registered[:2]))), float(np.rad2deg(turn))


def map_real_log(folder: Path, out: Path) -> RealDrive:
    """Map a log that `convert` has written by all estimators of `RUNS`, and write the maps to `out`."""
    settings, runs = MapperSettings(), {}
    log, hints = read_plausible_log(folder, settings.limits)
    for name, estimator in RUNS.items():
        runs[name] = run_estimator(estimator, settings, log)
        write_result(out / folder.name / name, runs[name], summarize(runs[name], log, hints))
    cycles, _ = seen_cycles(log)
    end = None if log.measured is None else end_by_registration(cycles, log.measured)
    return RealDrive(folder.name, log, runs, cycles[-1].pose, end)


def runs_table(drives: Sequence[RealDrive]) -> Table:
    """Return a row for each run."""
    header = (
        *("log, run", "closed [%]", "end off by [m]", "turned by [°]"),
        *("dead reckoning off by [m]", "dead reckoning turned by [°]", "crossings", "own crossings"),
        *("degraded [%]", "lost [%]", "update [ms]"),
    )
    rows = []
    for drive in drives:
        for name, run in drive.runs.items():
            health = [record.health for record in run.cycles]
            shares = [100.0 * health.count(word) / len(health) for word in ("degraded", "lost")]
            reckoned = drive.off(drive.dead_reckoned) if name == "online" else (np.nan, np.nan)
            crossed = (np.nan, np.nan) if name == "landmarks" else crossings(run.map)
            ms = np.nan if name == "batch" else 1e3 * float(np.mean([r.seconds for r in run.cycles]))
            values = [100.0 * run.map.closed, *drive.off(run.trajectory[-1]), *reckoned, *crossed]
            values += [*(shares if any(health) else (np.nan, np.nan)), ms]
            rows.append((f"{drive.name}, {name}", *Quantity.row(values, 0, 2, 1, 2, 1, 0, 0, 1, 1, 1)))
    return Table(header, tuple(rows))


def maps_table(drives: Sequence[RealDrive]) -> Table:
    """Return the distance between the maps of each two drives around the same cones: under a metre."""
    rows = []
    for first, second in combinations(drives, 2):
        both = zip(first.runs.values(), second.runs.values(), strict=True)
        apart = [aligned_distance(one.map, other.map) for one, other in both]
        if min(apart) < 1.0:
            rows.append((f"{first.name}, {second.name}", *Quantity.row(apart, 2)))
    return Table(("maps", *(f"{name} [m]" for name in RUNS)), tuple(rows))


def joint_table(drives: Sequence[RealDrive]) -> Table:
    """Return how far each drive's own batch is from that of all drives, and both from the last pose."""
    alone = {drive.name: run for drive in drives if isinstance(run := drive.runs["batch"], BatchResult)}
    joint, rows = join(alone), []
    for drive in drives:
        if drive.name not in joint.drives:
            continue
        own = joint.drives[drive.name]
        apart = maps_apart(alone[drive.name].map, own.map).statistics()["both"]
        pose = compose(inverse(joint.frames[drive.name]), own.trajectory[-1])
        ends = drive.off(alone[drive.name].trajectory[-1])[0], drive.off(pose)[0]
        values = [apart["mean"], apart["rms"], apart["p95"], apart["max"], *ends]
        rows.append((drive.name, *Quantity.row(values, 2)))
    apart_by = ("map apart, mean [m]", "rms [m]", "p95 [m]", "largest [m]")
    return Table(("drive", *apart_by, "end off by, alone [m]", "together [m]"), tuple(rows))


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
        pairs = zip(errors[-1].tolist(), halves.tolist(), strict=True)
        found_errors = (Quantity(v, h, 1) for v, h in pairs)
        rows.append((drive.name, *Quantity.row(values, 4, 4, 4, 2, 2, 0, 0), *found_errors))
    if len(errors) > 1:
        means = (Quantity.of(column, 1) for column in np.transpose(errors))
        rows.append(("all drives", *[Quantity(None)] * 7, *means))
    return Table(header, tuple(rows))
