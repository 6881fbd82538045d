"""The measurement: each mistake on each drive is told or not, and each good log is accused or not."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Final

import numpy as np
import pandas as pd
import tyro
from rich.console import Console
from scipy.stats import binomtest
from threadpoolctl import threadpool_limits
from tyro.conf import arg

from pathspace_graph.errors import InputError, PathspaceError, check_name
from pathspace_graph.estimators import DEFAULT, make_online
from pathspace_graph.eval.harness.drives import NamedTrack, load_tracks
from pathspace_graph.eval.metrics.table1 import lap_metrics
from pathspace_graph.eval.metrics.text_table import TextTable
from pathspace_graph.io.files import atomic_folder, check_target
from pathspace_graph.io.log import Log, write_log
from pathspace_graph.plausibility.judge import hints
from pathspace_graph.plausibility.reading import read_plausible_log
from pathspace_graph.progress import progress
from pathspace_graph.run import run_online
from pathspace_graph.settings.front_end import LimitSettings
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.sim.mistakes import MISTAKES
from pathspace_graph.sim.simulate import simulate

from .good import GOOD, Good, half_of

Row = dict[str, Any]

BAD_INPUT: Final = 2
"""This is the exit code where a track can't be read or the output can't be written."""
MARKER: Final = "hints.csv"
"""The results are in this file; their folder is recognized by it."""
AS_SIMULATED: Final = "as simulated"
"""The good logs of this kind have nothing unusual."""
CONFIDENCE: Final = 0.95
"""The intervals have this confidence."""
MISSED: Final = 0.05
"""A map that misses a larger share of the cones is bad."""
WORSE: Final = 2.0
"""A map is bad if its rmse is larger by this factor than that of the good log."""
CAUSES: Final = {
    "positions": ("positions",),
    "speeds": ("speeds",),
    "all lengths": ("positions", "speeds"),
    "yaw rate": ("yaw rate",),
    "bearings": ("unexplained",),
    "y to the right": ("y to the right",),
    "stamps": ("stamps",),
    "sensor frame": ("sensor frame", "mounting"),
    "odometry": ("odometry",),
    "speeds in the map frame": ("odometry",),
    "detections in the map frame": ("map frame",),
    "detections 1 s late": ("clocks",),
    "covariances": ("covariances",),
    "all labels": ("labels",),
}
"""A mistake whose name begins so is told if one of these causes is named; the longest beginning counts."""


@dataclass(frozen=True, kw_only=True)
class HintStudy:
    """Spoils simulated logs by each mistake, and varies good ones; says how many are told and accused."""

    out: Path
    """The results are written to this folder; earlier ones there are kept as a numbered backup."""
    tracks: Annotated[tuple[str, ...], arg(metavar="TRACK...")] = ("0", "1")
    """The drives are on these tracks: files, folders of files, or seeds of generated tracks."""
    seeds: tuple[int, ...] = (0, 1)
    """Each track is driven with these seeds."""
    laps: int = 1
    """Each drive has this number of laps."""
    good: bool = True
    """Good logs of all kinds are judged as well."""
    mistakes: tuple[str, ...] = tuple(MISTAKES)
    """Logs are spoiled by these mistakes."""
    kinds: tuple[str, ...] = (AS_SIMULATED,)
    """Good logs of these kinds are spoiled."""
    maps: bool = False
    """What becomes of the map of each spoiled log is measured, too, which takes long."""

    def run(self) -> TextTable:
        """Judges every log, writes the results and returns the table."""
        for name in self.mistakes:
            check_name(name, MISTAKES, "--mistakes: expected a known mistake")
        for name in self.kinds:
            check_name(name, GOOD, "--kinds: expected a known kind of good log")
        check_target(self.out, MARKER)
        tracks = load_tracks([int(one) if one.isdigit() else Path(one) for one in self.tracks])
        rows: list[Row] = []
        with progress("judging", len(tracks) * len(self.seeds)) as advance:
            for track in tracks:
                for seed in self.seeds:
                    rows += self._drive(track, seed)
                    advance()
        table = summary(pd.DataFrame(rows))
        with atomic_folder(self.out, MARKER) as folder:
            pd.DataFrame(rows).to_csv(folder / MARKER, index=False, lineterminator="\n")
            (folder / "hints.md").write_text(table.markdown(), encoding="utf-8")
        return table

    def _drive(self, track: NamedTrack, seed: int) -> Iterator[Row]:
        """Yields a row for each log of a drive."""
        drive = {"track": track.name, "seed": seed}
        for name, kind in GOOD.items():
            if self.good or name in self.kinds:
                log = good_log(track, kind, seed, self.laps)
            if self.good:
                yield {**drive, "kind": "good", "name": name, "of": name, **judged(log)}
            if name in self.kinds:
                yield from ({**drive, "of": name, **row} for row in self._spoiled(log))

    def _spoiled(self, log: Log) -> Iterator[Row]:
        """Yields a row for each mistake in a good log."""
        clean = mapped(log) if self.maps else {}
        for name in self.mistakes:
            spoiled = MISTAKES[name](log)
            row = {"kind": "spoiled", "name": name, **judged(spoiled, causes_of(name))}
            yield row | (outcome(mapped(spoiled), clean) if self.maps else {})


def good_log(track: NamedTrack, kind: Good, seed: int, laps: int) -> Log:
    """Returns a good log of a kind."""
    cones = half_of(track.track) if kind.open_road else track.track
    log = simulate(cones, replace(kind.simulation, laps=laps), seed)
    return log if kind.edit is None else kind.edit(log)


def causes_of(mistake: str) -> tuple[str, ...]:
    """Returns the causes of which one must be named."""
    return CAUSES[max((begin for begin in CAUSES if mistake.startswith(begin)), key=len)]


def judged(log: Log, causes: Sequence[str] = ()) -> Row:
    """Returns what is said of a log, and whether one of the causes is named."""
    begin = time.perf_counter()
    with threadpool_limits(limits=1):
        found = hints(log)
    seconds = time.perf_counter() - begin
    named = [hint.cause for hint in found]
    return {
        "said": bool(found),
        "told": any(cause in named for cause in causes),
        "causes": "; ".join(named),
        "seconds": seconds,
        "text": " | ".join(hint.line for hint in found),
    }


# --- the maps --------------------------------------------------------------------------------------------


def mapped(log: Log) -> Row:
    """Returns what the default estimator makes of a log in files: a refusal, or the errors of its map."""
    with TemporaryDirectory() as folder, threadpool_limits(limits=1):
        write_log(log, Path(folder) / "log")
        try:
            usable, _ = read_plausible_log(Path(folder) / "log", LimitSettings())
        except InputError as error:
            return {"refusal": str(error).replace(str(folder), "")}
        try:
            result = run_online(usable, make_online(DEFAULT, MapperSettings(), usable))
        except PathspaceError as error:
            return {"refusal": str(error)}
    if log.truth is None or not result.map.boundaries:
        return {"boundaries": len(result.map.boundaries)}
    errors = lap_metrics(result.map, log.truth, result.laps)
    return {"boundaries": len(result.map.boundaries), "rmse": errors.rmse, "missed": errors.missed}


def outcome(found: Row, clean: Row) -> Row:
    """Returns what became of the map: it is refused, empty, bad or good."""
    if "refusal" in found:
        return {**found, "map": "refused"}
    if found["boundaries"] == 0:
        return {**found, "map": "empty"}
    worse = found["missed"] > MISSED + clean["missed"] or not found["rmse"] <= WORSE * clean["rmse"]
    return {**found, "map": "bad" if worse or found["boundaries"] < clean["boundaries"] else "good"}


# --- the table -------------------------------------------------------------------------------------------


def summary(rows: pd.DataFrame) -> TextTable:
    """Returns the table: for each kind of log how many were told or accused, with exact intervals."""
    lines: list[tuple[str, ...]] = []
    groups = []
    for kind, title in (("spoiled", "told"), ("good", "accused")):
        of_kind = rows[rows["kind"] == kind]
        if len(of_kind) == 0:
            continue
        groups.append(len(lines))
        column = "told" if kind == "spoiled" else "said"
        for name, logs in of_kind.groupby("name", sort=False):
            lines.append(_line(f"{title}: {name}", logs, column))
        lines.append(_line(f"{title}: all", of_kind, column))
    title = "Spoiled logs that are told by their cause, and good logs that are accused of anything, with the "
    title += f"{CONFIDENCE:.0%} interval of Clopper and Pearson.".replace("%", " %")
    header = ("logs", "number", "of", "share [%]", "interval [%]", "maps", "seconds")
    return TextTable(title, header, tuple(lines), groups=tuple(groups[1:]))


def _line(name: str, logs: pd.DataFrame, column: str) -> tuple[str, ...]:
    count, total = int(logs[column].sum()), len(logs)
    interval = binomtest(count, total).proportion_ci(CONFIDENCE)
    maps = logs["map"].value_counts().to_dict() if "map" in logs and column == "told" else {}
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
    """Runs the script; the exit code is 2 on bad input."""
    study = tyro.cli(HintStudy)
    try:
        table = study.run()
    except PathspaceError as error:
        Console(stderr=True, soft_wrap=True, highlight=False, markup=False).print(f"hints: {error}")
        raise SystemExit(BAD_INPUT) from error
    console = Console(highlight=False, soft_wrap=True, markup=False)
    console.print(table.title)
    console.print(table.text())
    console.print(f"written to {study.out}")
