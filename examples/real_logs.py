"""Map logs of a real car, and compare the maps, the last poses and the measured noise in tables.

Each folder has odometry.csv (t, vx, vy, wz) and detections.csv (t, range, bearing, colour), y to the right.
docs/real.md names the recordings and explains the tables.

    python examples/real_logs.py FOLDER [FOLDER ...] --out DIR [--page docs/real.md]
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.stats import t as student

from pathspace_graph import Log, MapperSettings, RunResult, run_online, write_log, write_result
from pathspace_graph.commands.convert import with_measured_noise
from pathspace_graph.convert.recording import to_log
from pathspace_graph.convert.settings import Frames, LabelRule, NoiseSettings
from pathspace_graph.convert.text_files import Columns, Units, read_csv
from pathspace_graph.estimators import DEFAULT, DEFAULT_BATCH, make_batch, make_online
from pathspace_graph.eval.metrics.accuracy import crossings
from pathspace_graph.eval.metrics.reference import aligned_distance
from pathspace_graph.eval.metrics.summary import summarize
from pathspace_graph.factors.noise import MeasuredNoise
from pathspace_graph.factors.se2 import compose, move_points, to_map, to_vehicle, wrap_angle
from pathspace_graph.factors.sensor import SENSOR, by_sensor
from pathspace_graph.front_end.front_end import seen_cycles
from pathspace_graph.front_end.sightings import SeenCycle, Sightings, follow
from pathspace_graph.labels import BOUNDARIES

Array = NDArray[np.float64]

BEGIN, MARK = "<!-- real:begin -->", "<!-- real:end -->"
"""Lines around the tables of a page."""
LANDMARKS = "landmark-fixed-lag"
"""Graph of landmarks, whose run stands beside those of the curves."""
FIRST, LAST = 25.0, 14.0
"""Length of the end of a drive, and of its beginning on which it is registered (m)."""
NEAR = 15.0
"""Range of the sightings that count there (m)."""
GATES = (2.0, 1.5, 1.0, 1.0, 0.7, 0.7)
"""Distance within which a cone is the nearest one of its colour, from step to step (m)."""
LEAST = 6
"""Least number of cones of a registration."""
SAME = 1.0
"""Distance of two maps of the same cones (m)."""
TOLD = {
    "latency": ("latency [ms]", 1e3),
    "yaw": ("yaw [degrees]", 180.0 / np.pi),
    "range_scale": ("scale [%]", 100.0),
}
"""Errors of the sensor in the table, in these units."""


@dataclass(frozen=True, eq=False)
class Drive:
    """A log, its runs, and what they are held against."""

    name: str
    log: Log
    runs: dict[str, RunResult]
    """Results by the name of the command."""
    dead_reckoned: Array
    """Last pose (3,) by odometry alone."""
    registered: Array | None
    """Last pose (3,) by registration, where the drive comes back to its beginning."""


def convert(folder: Path) -> Log:
    """Read a folder as `convert --from csv --columns label=colour --labels left=1 right=0 --y right`."""
    files = folder / "odometry.csv", folder / "detections.csv"
    record = read_csv(*files, Columns(("label=colour",)), Units(()), LabelRule(("left=1", "right=0")))
    log = to_log(record, Frames(y_odometry="right", y_detections="right"), NoiseSettings(), folder)
    return with_measured_noise(log)


# --- the pose at the end ---------------------------------------------------------------------------------


def cones(cycles: Sequence[SeenCycle], label: int, noise: MeasuredNoise, frame: Array) -> Array:
    """Return the cones (k, 2) of a label in the frame of a pose (3,), each the mean of its sightings."""
    own = []
    for cycle in cycles:
        seen = cycle.detections
        chosen = (seen.labels == label) & (np.hypot(*seen.points_vehicle.T) < NEAR)
        own.append(replace(cycle, detections=seen.where(chosen)))
    table: Sightings = follow(own, noise)
    corrected = table.point + by_sensor(table.point, table.twist) @ noise.sensor
    points = to_vehicle(to_map(corrected, table.pose), np.tile(frame, (len(table.t), 1)))
    weights = 1.0 / np.maximum(np.hypot(*table.point.T), 1.0) ** 2
    again = [rows for cone in np.unique(table.cone) if (rows := table.cone == cone).sum() > 1]
    means = [np.average(points[rows], axis=0, weights=weights[rows]) for rows in again]
    return np.array(means).reshape(-1, 2)


def end_by_registration(cycles: Sequence[SeenCycle], noise: MeasuredNoise) -> Array | None:
    """Return the last pose (3,) of a drive, by the cones of its end laid on those of its beginning.

    The closest points of the same colour are paired, from starts around dead reckoning. Both stretches are
    short enough for odometry, and the constant errors of the sensor are taken out.
    """
    poses = np.array([cycle.pose for cycle in cycles])
    path = np.append(0.0, np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T)))
    if path[-1] < FIRST + LAST:
        return None
    first = [cycle for cycle, s in zip(cycles, path, strict=True) if s <= FIRST]
    last = [cycle for cycle, s in zip(cycles, path, strict=True) if s >= path[-1] - LAST]
    start = [cones(first, label, noise, np.zeros(3)) for label in BOUNDARIES]
    end = [cones(last, label, noise, poses[-1]) for label in BOUNDARIES]
    tries = [
        registered(start, end, compose(poses[-1], np.array([ahead, left, turn])))
        for ahead in (-4.0, -2.0, 0.0, 2.0, 4.0)
        for left in (-2.0, 0.0, 2.0)
        for turn in (-0.1, 0.0, 0.1)
    ]
    count, _, pose = max(tries, key=lambda one: one[:2])
    return pose if count >= LEAST else None


def registered(start: list[Array], end: list[Array], pose: Array) -> tuple[int, float, Array]:
    """Return the number of paired cones, minus their mean distance, and the pose (3,) for it."""
    count, distance = 0, np.inf
    for gate in GATES:
        pairs = []
        for known, seen in zip(start, end, strict=True):
            if len(known) and len(seen):
                away, nearest = KDTree(known).query(move_points(pose, seen))
                near = away < gate
                pairs.append((seen[near], known[np.asarray(nearest)[near]]))
        points, targets = (np.concatenate([np.zeros((0, 2)), *side]) for side in zip(*pairs, strict=True))
        count = len(points)
        if count < LEAST:
            return 0, -np.inf, pose
        centre, target = points.mean(axis=0), targets.mean(axis=0)
        cross = (points - centre).T @ (targets - target)
        turn = np.arctan2(cross[0, 1] - cross[1, 0], np.trace(cross))
        moved = move_points(np.array([0.0, 0.0, turn]), centre[None])[0]
        pose = np.append(target - moved, turn)
        distance = float(np.hypot(*(move_points(pose, points) - targets).T).mean())
    return count, -distance, pose


# --- runs ------------------------------------------------------------------------------------------------


def drive(folder: Path, out: Path) -> Drive:
    """Convert a folder, maps it online and as a batch, and writes log and maps."""
    log = convert(folder)
    write_log(log, out / "logs" / folder.name)
    settings = MapperSettings()
    runs: dict[str, RunResult] = {
        "online": run_online(log, make_online(DEFAULT, settings, log)),
        "batch": make_batch(DEFAULT_BATCH, settings, log).solve(log),
        "landmarks": run_online(log, make_online(LANDMARKS, settings, log)),
    }
    for name, result in runs.items():
        write_result(out / name / folder.name, result, summarize(result, log))
    cycles, _ = seen_cycles(log)
    end = None if log.measured is None else end_by_registration(cycles, log.measured)
    return Drive(folder.name, log, runs, cycles[-1].pose, end)


# --- tables ----------------------------------------------------------------------------------------------


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    rule = ["---", *["---:"] * (len(header) - 1)]
    return "\n".join("| " + " | ".join(row) + " |" for row in (header, rule, *rows)) + "\n"


def off(pose: Array, drive: Drive) -> str:
    """Return how far a pose (3,) is from that by registration."""
    if drive.registered is None:
        return ""
    distance = np.hypot(*(pose[:2] - drive.registered[:2]))
    turn = float(wrap_angle(np.array(pose[2] - drive.registered[2])))
    return f"{distance:.2f} m, {np.rad2deg(turn):+.1f}°"


def runs_table(drives: Sequence[Drive]) -> str:
    """Return a row for each run."""
    header = ["log", "run", "closed", "end off by", "dead reckoning's", "crossings, own"]
    header += ["degraded [%]", "lost [%]", "ms"]
    rows = []
    for one in drives:
        for name, result in one.runs.items():
            health = [record.health for record in result.cycles]
            shares = [f"{100.0 * health.count(word) / len(health):.1f}" for word in ("degraded", "lost")]
            ms = 1e3 * np.mean([record.seconds for record in result.cycles])
            row = [one.name, name, "yes" if result.map.closed else "no", off(result.trajectory[-1], one)]
            row.append(off(one.dead_reckoned, one) if name == "online" else "")
            row.append("{}, {}".format(*crossings(result.map)) if name != "landmarks" else "")
            row += shares if any(health) else ["", ""]
            rows.append([*row, f"{ms:.1f}" if name != "batch" else ""])
    return table(header, rows)


def maps_table(drives: Sequence[Drive]) -> str:
    """Return the distance between the maps of each two drives around the same cones."""
    rows = []
    for k, first in enumerate(drives):
        for second in drives[k + 1 :]:
            both = zip(first.runs.values(), second.runs.values(), strict=True)
            apart = [aligned_distance(one.map, other.map) for one, other in both]
            if min(apart) < SAME:
                rows.append((f"{first.name}, {second.name}", *(f"{value:.2f}" for value in apart)))
    return table(("maps", *(f"{name} [m]" for name in drives[0].runs)), rows) if rows else ""


def measured_table(drives: Sequence[Drive]) -> str:
    """Return what was measured on each drive, and over all of them the mean with its interval."""
    header = ["log", "odometry [m/s, m/s, rad/s]", "along, across at 10 m [m]", "stays [%]"]
    rows, values = [], []
    at = np.array([10.0])
    for one in drives:
        found = one.log.measured
        if found is None or found.along is None or found.across is None:
            continue
        odometry = ", ".join(f"{value:.2g}" for value in found.odometry)
        rays = ", ".join(f"{float(ray.sigmas(at)[0]):.2f}" for ray in (found.along, found.across))
        shares = ", ".join(f"{100.0 * ray.share:.0f}" for ray in (found.along, found.across))
        places = [SENSOR.index(name) for name in TOLD]
        units = [unit for _, unit in TOLD.values()]
        values.append(found.sensor[places] * units)
        sigmas = found.sensor_sigma[places] * units
        texts = [f"{value:.1f} ± {1.96 * sigma:.1f}" for value, sigma in zip(values[-1], sigmas, strict=True)]
        rows.append((one.name, odometry, rays, shares, *texts))
    if len(values) > 1:
        spread = np.std(values, axis=0, ddof=1) / np.sqrt(len(values)) * student.ppf(0.975, len(values) - 1)
        texts = [f"{value:.1f} ± {s:.1f}" for value, s in zip(np.mean(values, axis=0), spread, strict=True)]
        rows.append(("all drives", "", "", "", *texts))
    return table([*header, *(name for name, _ in TOLD.values())], rows)


def main(folders: Sequence[Path], out: Path, page: Path | None = None) -> str:
    """Map the recordings, writes logs, maps and `real.md` to a folder, and returns the tables.

    Where a page is given, its tables between the marks are replaced.
    """
    drives = [drive(folder, out) for folder in folders]
    text = "\n".join(filter(None, (make(drives) for make in (runs_table, maps_table, measured_table))))
    (out / "real.md").write_text(text, encoding="utf-8")
    if page is not None:
        before, _, rest = page.read_text(encoding="utf-8").partition(BEGIN)
        _, _, after = rest.partition(MARK)
        page.write_text(f"{before}{BEGIN}\n\n{text}\n{MARK}{after}", encoding="utf-8")
    return text


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--out", required=True, type=Path)
    parser.add_argument("--page", type=Path)
    given = parser.parse_args()
    print(main(given.folders, given.out, given.page))
