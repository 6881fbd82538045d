"""`python -m pathspace_graph.eval.hints` measures of how many spoiled logs the cause is named.

Good logs of all kinds are judged: what is unusual about them is no mistake, and none may be accused.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final, Never

import numpy as np
import pandas as pd
from scipy.stats import binomtest
from threadpoolctl import threadpool_limits

from pathspace_graph.console import note, progress, say
from pathspace_graph.errors import PathspaceError, SolveError, check_name
from pathspace_graph.estimators import DEFAULT_ONLINE, make_online
from pathspace_graph.eval.experiment.drives import load_tracks
from pathspace_graph.eval.experiment.frame import write_csv
from pathspace_graph.eval.experiment.run import OnCell, WorkerDiedError, run_cells
from pathspace_graph.eval.experiment.tables import TextTable
from pathspace_graph.eval.metrics.accuracy import lap_metrics
from pathspace_graph.io.files import atomic_folder, check_target, write_text
from pathspace_graph.io.log import Detections, Log, Odometry, write_log
from pathspace_graph.io.overrides import Overrides, override
from pathspace_graph.labels import LEFT
from pathspace_graph.options.help import read_options
from pathspace_graph.plausibility.judge import hints, read_plausible_log
from pathspace_graph.run import run_online
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.settings.online import LimitSettings
from pathspace_graph.sim.mistakes import MISTAKES
from pathspace_graph.sim.sensor import OdometryNoise, SensorSettings
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track import Track

Row = dict[str, Any]

MARKER: Final = "hints.csv"  # file of the results, by which their folder is recognized
AS_SIMULATED: Final = "as simulated"  # kind of good logs with nothing unusual
CONFIDENCE: Final = 0.95
_SELF_NAMED: Final = (
    "positions",
    "speeds",
    "yaw rate",
    "y to the right",
    "stamps",
    "odometry",
    "covariances",
)
CAUSES: Final[dict[str, tuple[str, ...]]] = {  # that tell a mistake, by the longest beginning of its name
    **{name: (name,) for name in _SELF_NAMED},
    "all lengths": ("positions", "speeds"),
    "bearings": ("unexplained",),
    "sensor frame": ("sensor frame", "mounting"),
    "speeds in the map frame": ("odometry",),
    "detections in the map frame": ("map frame",),
    "detections 1 s late": ("clocks",),
    "all labels": ("labels",),
}


# --- good logs -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Good:
    """A kind of good log: overrides of its simulation, a change of its track, and one of the log."""

    overrides: Overrides = field(default_factory=dict)
    road: Callable[[Track], Track] = lambda track: track
    edit: Callable[[Log], Log] = lambda log: log

    def log(self, track: Track, seed: int, laps: int) -> Log:
        settings = override(SimulationSettings(laps=laps), self.overrides, "")
        return self.edit(simulate(self.road(track), settings, seed))


def open_road(track: Track) -> Track:
    """Return the first half of a track."""
    left, right = track.left[: len(track.left) // 2], track.right[: len(track.right) // 2]
    return replace(track, left=left, right=right, closed=False)


def one_boundary(log: Log) -> Log:
    """Return the log with the detections of the left boundary only."""
    return _kept(log, lambda cycle: cycle.labels == LEFT)


def few_cones(log: Log) -> Log:
    """Return the log with the three nearest detections of each cycle."""
    return _kept(log, lambda cycle: np.argsort(np.argsort(np.hypot(*cycle.points_vehicle.T))) < 3)


def _kept(log: Log, chosen: Callable[[Detections], np.ndarray]) -> Log:
    kept = (cycle.where(chosen(cycle)) for cycle in log.cycles)
    return replace(log, cycles=tuple(cycle for cycle in kept if len(cycle.labels)), truth=None)


def stands_first(log: Log) -> Log:
    """Return the log of a vehicle that stands for ten seconds first, with fresh noise in each detection."""
    rng, odometry, first = np.random.default_rng(0), log.odometry, log.cycles[0]
    before = np.arange(0.0, 10.0, 0.02)
    twists = rng.normal(0.0, log.odometry_sigma, (len(before), 3))
    roots, points, standing = np.linalg.cholesky(first.covariances), first.points_vehicle, []
    for t in np.arange(0.0, 10.0, 0.1).tolist():
        noise = np.einsum("mij,mj->mi", roots, rng.normal(size=points.shape))
        standing.append(replace(first, t=t, points_vehicle=points + noise))
    driving = [replace(cycle, t=cycle.t + 10.0) for cycle in log.cycles]
    stamps = np.append(before, odometry.t - odometry.t[0] + 10.0)
    whole = Odometry(stamps, np.vstack([twists, odometry.twist]))
    return replace(log, odometry=whole, cycles=(*standing, *driving), truth=None)


def backs_up(log: Log) -> Log:
    """Return the log of a vehicle that goes the same way backward: time runs the other way."""
    end = float(log.odometry.t[-1])
    odometry = Odometry(end - log.odometry.t[::-1], -log.odometry.twist[::-1])
    cycles = [replace(cycle, t=end - cycle.t) for cycle in log.cycles[::-1] if cycle.t <= end]
    return replace(log, odometry=odometry, cycles=tuple(cycles), truth=None)


def in_unix_time(log: Log) -> Log:
    odometry = replace(log.odometry, t=log.odometry.t + 1.7e9)
    cycles = tuple(replace(cycle, t=cycle.t + 1.7e9) for cycle in log.cycles)
    return replace(log, odometry=odometry, cycles=cycles, truth=None)


_SENSOR, _ODOMETRY = SensorSettings(), OdometryNoise()
GOOD: Final = {
    AS_SIMULATED: Good(),
    "field of view of 180 degrees": Good({"sensor.fov": np.pi}),
    "field of view of 360 degrees": Good({"sensor.fov": 2.0 * np.pi}),
    **{f"range of {metres:g} m": Good({"sensor.range_max": metres}) for metres in (5.0, 8.0, 20.0)},
    "noise times 3": Good(
        {
            "sensor.range_sigma": 3.0 * _SENSOR.range_sigma,
            "sensor.range_sigma_growth": 3.0 * _SENSOR.range_sigma_growth,
            "sensor.bearing_sigma": 3.0 * _SENSOR.bearing_sigma,
            "odometry.white": tuple(3.0 * sigma for sigma in _ODOMETRY.white),
            "odometry.scale": 3.0 * _ODOMETRY.scale,
            "odometry.gyro_bias": 3.0 * _ODOMETRY.gyro_bias,
        }
    ),
    **{f"{rate:g} cycles per second": Good({"sensor.rate": rate}) for rate in (2.0, 5.0, 20.0)},
    "30 % of the cones missed": Good({"sensor.detection_probability": 0.7, "sensor.blind_fraction": 0.15}),
    "5 false positives in a cycle": Good({"sensor.false_positives": 5.0}),
    "30 % wrong colours": Good({"sensor.wrong_colour": 0.3}),
    "without colours": Good({"faults.sensor.colourless": 1.0}),
    "yaw-rate bias of 0.02 rad/s": Good({"faults.odometry.yaw_rate_bias": 0.02}),
    "wheel slip of 50 %": Good({"faults.odometry.slip": 0.5}),
    "latency of 100 ms": Good({"faults.sensor.latency": 0.1}),
    "sensor turned by 2 degrees": Good({"faults.sensor.yaw": 0.0349}),
    "sensor 0.2 m to the left": Good({"faults.sensor.lateral": 0.2}),
    "ranges 4 % too long": Good({"faults.sensor.range_scale": 0.04}),
    "odometry missing for 2 s": Good({"faults.odometry.gap": 2.0}),
    "no detections for 5 s": Good({"faults.sensor.dropout": 5.0}),
    "driven the other way round": Good({"faults.vehicle.wrong_way": True}),
    "one boundary": Good(edit=one_boundary),
    "three cones in a cycle": Good(edit=few_cones),
    "stands for 10 s first": Good(edit=stands_first),
    "backs up": Good(edit=backs_up),
    "odometry at 10 Hz": Good(
        edit=lambda log: replace(log, odometry=Odometry(log.odometry.t[::5], log.odometry.twist[::5]))
    ),
    "stamps since 1970": Good(edit=in_unix_time),
    "open road": Good(road=open_road),
}


# --- the measurement -------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class HintStudy:
    """Spoil simulated logs by each mistake, and vary good ones; say how many are named and accused."""

    out: Path
    """Folder for the results; earlier ones there are kept as a numbered backup."""
    tracks: tuple[str, ...] = ("0", "1")
    """Track files, folders of them, or seeds of generated tracks."""
    seeds: tuple[int, ...] = (0, 1)
    """Seeds of the drives on each track."""
    laps: int = 1
    """Laps of each drive."""
    good: bool = True
    """Judge good logs of all kinds as well."""
    mistakes: tuple[str, ...] = tuple(MISTAKES)
    """Mistakes by which logs are spoiled."""
    kinds: tuple[str, ...] = (AS_SIMULATED,)
    """Kinds of good logs that are spoiled."""
    maps: bool = False
    """Measure what becomes of the map of each spoiled log, too, which takes long."""
    jobs: int = 1
    """Number of processes at a time, -1 for one on each core."""

    def measure(self, on_cell: OnCell | None = None) -> pd.DataFrame:
        """Judge every log, and return a row for each."""
        for name in self.mistakes:
            check_name(name, MISTAKES, "--mistakes: expected a known mistake")
        for name in self.kinds:
            check_name(name, GOOD, "--kinds: expected a known kind of good log")
        kinds = tuple(kind for kind in GOOD if self.good or kind in self.kinds)
        tracks = load_tracks([int(one) if one.isdigit() else Path(one) for one in self.tracks])
        cells = [*product([self], tracks, self.seeds, kinds)]
        rows = run_cells(cells, judge, lost, jobs=self.jobs, on_cell=on_cell)
        return pd.DataFrame([row for of in rows for row in of])

    def run(self) -> TextTable:
        check_target(self.out, MARKER)
        with progress("judging") as advance:
            frame = self.measure(advance)
        table = summary(frame)
        with atomic_folder(self.out, MARKER) as folder:
            write_csv(folder / MARKER, frame)
            write_text(folder / "hints.md", table.markdown())
        return table


HintCell = tuple[HintStudy, Track, int, str]  # study, track, seed and kind of good log


def judge(cell: HintCell) -> list[Row]:
    """Return a row for the good log of a cell, and for each of those that are spoiled."""
    study, track, seed, kind = cell
    spoil = kind in study.kinds
    log = GOOD[kind].log(track, seed, study.laps)
    good: Row = {"kind": "good", "name": kind, "of": kind}
    rows = [good | judged(log)] if study.good else []
    clean = mapped(log) if study.maps and spoil else {}
    for name in study.mistakes if spoil else ():
        spoiled = MISTAKES[name](log)
        row = {"of": kind, "kind": "spoiled", "name": name, **judged(spoiled, causes_of(name))}
        rows.append(row | (outcome(mapped(spoiled), clean) if study.maps else {}))
    return [{"track": track.name, "seed": seed} | row for row in rows]


def lost(cell: HintCell, error: WorkerDiedError) -> Never:
    _, track, _, kind = cell
    raise SolveError(f"{kind} on {track.name}: {error}")


def causes_of(mistake: str) -> tuple[str, ...]:
    """Return the causes of which one must be named."""
    return CAUSES[max((begin for begin in CAUSES if mistake.startswith(begin)), key=len)]


def judged(log: Log, causes: Sequence[str] = ()) -> Row:
    """Return what is said of a log, and whether one of the causes is named."""
    begin = time.perf_counter()
    with threadpool_limits(limits=1):
        said = hints(log)
    seconds, found = time.perf_counter() - begin, [hint.cause for hint in said]
    return {
        "accused": bool(said),
        "named": any(cause in found for cause in causes),
        "causes": "; ".join(found),
        "seconds": seconds,
        "text": " | ".join(hint.line for hint in said),
    }


def mapped(log: Log) -> Row:
    """Return what the default estimator makes of a log in files: a refusal, or the errors of its map."""
    with TemporaryDirectory() as folder, threadpool_limits(limits=1):
        write_log(log, Path(folder) / "log")
        try:
            usable, _ = read_plausible_log(Path(folder) / "log", LimitSettings())
            result = run_online(usable, make_online(DEFAULT_ONLINE, MapperSettings(), usable))
        except PathspaceError as error:
            return {"refusal": str(error).replace(str(folder), "")}
    if log.truth is None or not result.map.boundaries:
        return {"boundaries": len(result.map.boundaries)}
    errors = lap_metrics(result.map, log.truth, result.laps)
    return {"boundaries": len(result.map.boundaries), "rmse": errors.rmse, "missed": errors.missed}


def outcome(found: Row, clean: Row) -> Row:
    """Return what became of the map: it is refused, empty, bad or good.

    It is bad where it misses 5 % more of the cones than that of the good log, or has twice its rmse.
    """
    if "refusal" in found:
        return {**found, "map": "refused"}
    if found["boundaries"] == 0:
        return {**found, "map": "empty"}
    worse = found["missed"] > 0.05 + clean["missed"] or not found["rmse"] <= 2.0 * clean["rmse"]
    return {**found, "map": "bad" if worse or found["boundaries"] < clean["boundaries"] else "good"}


def summary(rows: pd.DataFrame) -> TextTable:
    """Return the table: for each kind of log how many were named or accused, with exact intervals."""
    lines, groups = list[tuple[str, ...]](), list[int]()
    for kind, column in (("spoiled", "named"), ("good", "accused")):
        of_kind = rows[rows["kind"] == kind]
        groups += [len(lines)] if len(of_kind) else []
        by_name = (*of_kind.groupby("name", sort=False), ("all", of_kind)) if len(of_kind) else ()
        lines += [_line(f"{column}: {name}", logs, column) for name, logs in by_name]
    title = (
        "Spoiled logs whose cause is named, and good logs that are accused of anything, with the "
        f"{100.0 * CONFIDENCE:.0f} % interval of Clopper and Pearson."
    )
    header = ("logs", "number", "of", "share [%]", "interval [%]", "maps", "seconds")
    return TextTable(title, header, tuple(lines), groups=tuple(groups[1:]))


def _line(name: str, logs: pd.DataFrame, column: str) -> tuple[str, ...]:
    count, total = int(logs[column].sum()), len(logs)
    interval = binomtest(count, total).proportion_ci(CONFIDENCE)
    maps = logs["map"].value_counts().to_dict() if "map" in logs and column == "named" else {}
    return (
        name,
        str(count),
        str(total),
        f"{100.0 * count / total:.1f}",
        f"{100.0 * interval.low:.1f} to {100.0 * interval.high:.1f}",
        ", ".join(f"{number} {what}" for what, number in maps.items()),
        f"{np.median(logs['seconds']):.2f}",
    )


def main() -> None:
    """Run the script; the exit code is 2 on bad input."""
    try:
        study = read_options(HintStudy, "pathspace_graph.eval.hints")
        table = study.run()
    except PathspaceError as error:
        note(f"hints: {error}")
        raise SystemExit(2) from error
    say(table.title, table.text(), f"written to {study.out}")


if __name__ == "__main__":
    main()
