"""Drives, cells of an estimator with settings on the log of one, and what is measured and kept of them."""

import hashlib
import json
import shutil
import time
import traceback
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final, Generic, Self, TypeVar

import numpy as np
from threadpoolctl import threadpool_limits

from pathspace_graph import estimators as registry
from pathspace_graph.errors import InputError, SettingsError, check_name
from pathspace_graph.eval.metrics.measures import Row, measure
from pathspace_graph.eval.metrics.metric import METRICS
from pathspace_graph.eval.metrics.summary import has_cones, lap_times, summarize
from pathspace_graph.eval.metrics.trajectory import ReachObserver
from pathspace_graph.io.files import atomic_folder, is_temporary, to_plain, write_json, write_text
from pathspace_graph.io.log import (
    DETECTIONS_FILE,
    LOG_FILE,
    ODOMETRY_FILE,
    TRUTH_ASSOCIATIONS_FILE,
    TRUTH_CONES_FILE,
    TRUTH_POSES_FILE,
    Log,
)
from pathspace_graph.io.map import MAP_FILE
from pathspace_graph.io.overrides import leaves
from pathspace_graph.io.parsing import read_json
from pathspace_graph.io.results import RunResult, write_result
from pathspace_graph.plausibility.diagnosis import diagnose
from pathspace_graph.plausibility.hint import Hint
from pathspace_graph.plausibility.judge import read_plausible_log
from pathspace_graph.run import run_online
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.settings.online import LimitSettings
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track import EVENTS, Track
from pathspace_graph.sim.track_files import read_track
from pathspace_graph.sim.track_generator import generate_track

from .provenance import Code, check_code, made

TRACK_SUFFIXES: Final = (".yaml", ".yml", ".csv")
CELLS: Final = "cells"  # folder of the kept cells
FORMAT: Final = "pathspace-cell/4"
LOG_FILES: Final = (  # of a log, all that an estimate or a metric of it depends on
    *(LOG_FILE, ODOMETRY_FILE, DETECTIONS_FILE),
    *(TRUTH_POSES_FILE, TRUTH_CONES_FILE, TRUTH_ASSOCIATIONS_FILE),
)
RECORDED: Final = "recorded"  # noise of a drive that was not simulated
RUN_FILES: Final = "files"  # key of the kept files of a run, on their way from its process
DIGEST: Final = "digest"  # key of a record's digest in its file
RESOLUTION: Final = 1e-3  # length (m) and angle (rad) to which the geometry of a track identifies it
ROUNDING: Final = 1.0 / np.pi  # shift that keeps coordinates of few decimals off the edges of millimetres
Record = dict[str, Any]  # what is kept of a cell, in the types of JSON only
_latest: dict[str, Log] = {}  # the log that was simulated last, by its drive


def track_digest(track: Track) -> str:
    """Return the identity of a track's geometry to the millimetre, wherever it came from.

    The last digits of a generated track depend on the processor; the seeds of its drives do not.
    """
    parts = (track.left, track.right, track.other, track.start, track.cone_labels)
    rounded = (np.floor(np.asarray(part) / RESOLUTION + ROUNDING).astype("<i8") for part in parts)
    cones = b"|".join(part.tobytes() for part in rounded)
    return hashlib.sha256(cones + str(track.closed).encode()).hexdigest()[:20]


@dataclass(frozen=True, eq=False)
class Drive:
    """One lap or more on a track."""

    track: Track
    seed: int  # number of the drive on its track
    noise: str
    simulation: SimulationSettings

    @property
    def names(self) -> dict[str, Any]:
        return {"track": self.track.name, "seed": self.seed, "noise": self.noise}

    @property
    def source(self) -> str:
        """Seed with which `simulate` makes the same log of this track and noise."""
        return str(self.own_seed)

    @cached_property
    def own_seed(self) -> int:
        """Seed of the simulation: drives of one seed on several tracks are independent samples."""
        return int(identity(track=track_digest(self.track), seed=self.seed)[:8], 16)

    @cached_property
    def id(self) -> str:
        """Identity of everything that the log depends on, except the code."""
        simulation = asdict(self.simulation)
        return identity(track=track_digest(self.track), seed=self.own_seed, simulation=simulation)

    def load(self) -> Log:
        """Return the log; the last one is kept, since cells are in the order of their logs."""
        if self.id not in _latest:
            _latest.clear()
            _latest[self.id] = simulate(self.track, self.simulation, self.own_seed)
        return _latest[self.id]


@dataclass(frozen=True, eq=False)
class RecordedDrive:
    """A log in a folder, one of those that were driven on a track."""

    track: str
    seed: int  # number of the log on its track
    folder: Path

    @property
    def names(self) -> dict[str, Any]:
        return {"track": self.track, "seed": self.seed, "noise": RECORDED}

    @property
    def source(self) -> str:
        """Name of the log."""
        return self.folder.resolve().name

    @property
    def simulation(self) -> None:
        return None

    @cached_property
    def id(self) -> str:
        """Identity of what is in the files of the log."""
        digest = hashlib.sha256()
        for name in LOG_FILES:
            file = self.folder / name
            digest.update(name.encode() + (file.read_bytes() if file.exists() else b""))
        return digest.hexdigest()[:20]

    def load(self) -> Log:
        if self.id not in _latest:
            _latest.clear()
            _latest[self.id] = read_plausible_log(self.folder, LimitSettings())[0]
        return _latest[self.id]


def log_folders(folder: Path) -> dict[str, Path]:
    """Return a log's folder by its name, or those in a folder of logs; InputError if there is none."""
    folders = {folder.resolve().name: folder}
    if not (folder / LOG_FILE).exists():
        entries = sorted(folder.iterdir()) if folder.is_dir() else []
        folders = {e.name: e for e in entries if not is_temporary(e.name) and (e / LOG_FILE).is_file()}
    if not folders:
        raise InputError(folder, f"expected a log ({LOG_FILE}) or folders that are logs, found neither")
    return folders


def identity(**parts: Any) -> str:
    """Return a text that is the same for the same values, which are JSON's types only."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:20]


def load_tracks(tracks: Iterable[Path | int]) -> list[Track]:
    """Read or generate tracks, with the names that they have in the results.

    A folder stands for every track file in it, a number is the seed of a generated track, and the name of an
    event stands for its track. InputError where a file is no track or a folder has none.
    """
    every = list[Path | int]()
    for entry in tracks:
        if not isinstance(entry, Path) or not entry.is_dir():
            every.append(entry)
        elif files := sorted(file for file in entry.iterdir() if file.suffix in TRACK_SUFFIXES):
            every += files
        else:
            raise InputError(entry, f"expected track files ({', '.join(TRACK_SUFFIXES)}), found none")
    stems = [track.stem for track in every if isinstance(track, Path)]
    return [_load(track, stems) for track in every]


def _load(track: Path | int, stems: list[str]) -> Track:
    if isinstance(track, int):
        return replace(generate_track(np.random.default_rng(track)), name=f"generated {track}")
    if track.name in EVENTS and not track.exists():
        return EVENTS[track.name]()
    if not track.exists() and track.parent.is_dir():
        beside = sorted(entry.name for entry in track.parent.iterdir() if entry.suffix == track.suffix)
        try:
            check_name(track.name, beside, "expected a track file")
        except SettingsError as error:
            raise InputError(track, str(error)) from error
    folder = f"{track.resolve().parent.name}/" if stems.count(track.stem) > 1 else ""
    return replace(read_track(track), name=f"{folder}{track.stem}")


@dataclass(frozen=True, eq=False)
class NamedLog:
    """A log with the name of its folder, and the mistakes that are likely in it."""

    name: str
    log: Log
    hints: tuple[Hint, ...] = ()

    @property
    def names(self) -> dict[str, Any]:
        return {"log": self.name}

    @cached_property
    def id(self) -> str:
        return identity(log=self.name)

    def load(self) -> Log:
        return self.log


AnyDrive = Drive | RecordedDrive
D = TypeVar("D", AnyDrive, NamedLog)


@dataclass(frozen=True, eq=False)
class Cell(Generic[D]):
    """One run of an experiment."""

    drive: D
    estimator: str
    settings: MapperSettings
    variant: str | None = None  # name of the settings, where there are several
    measured: Mapping[str, Any] = field(default_factory=dict)  # keyword arguments of `measure`
    parameters: Any = None  # the estimator's own, a frozen dataclass; None where it has none
    keep: bool = False  # whether map, trajectory, cycles and summary are kept
    code: Code = field(default_factory=dict)  # with which the study began
    began: str = ""  # the process in which it did

    @cached_property
    def meaning(self) -> str:
        """Identity of everything that the result depends on, except the code."""
        known = leaves(self.settings).items()
        settings = {name: value for name, value in known if registry.reads(self.estimator, name)}
        own = None if self.parameters is None else to_plain(asdict(self.parameters))
        parts = {"drive": self.drive.id, "estimator": self.estimator, "settings": settings, "own": own}
        return identity(**parts, reference_limits=self.measured.get("reference_limits", False))

    @cached_property
    def id(self) -> str:
        """Identity of everything that the result depends on: cells of one id have one result."""
        return f"{self.meaning}-{identity(**self.code)[:12]}"

    @property
    def names(self) -> dict[str, Any]:
        names = self.drive.names | {"estimator": self.estimator}
        return names if self.variant is None else names | {"variant": self.variant}


@dataclass(frozen=True, eq=False)
class Outcome:
    """What came of a cell; a failure is a result as well."""

    names: Mapping[str, Any]
    rows: Sequence[Row] = ()  # metrics of each lap and, as the last row, of the run; none if it failed
    result: RunResult | None = None  # result of the run; None where the cell failed
    failure: str = ""  # line that names the error, if there was one
    trace: str = ""

    @classmethod
    def failed(cls, cell: Cell[Any], error: BaseException) -> Self:
        """Make the outcome of a cell that ended with an error."""
        failure = " ".join(f"{type(error).__name__}: {error}".split())
        return cls(cell.names, failure=failure, trace="".join(traceback.format_exception(error)))


def run_cell(cell: Cell[Any]) -> Outcome:
    """Run and measure a cell with one thread of BLAS; never raise."""
    try:
        with threadpool_limits(limits=1):
            log = cell.drive.load()
            begin = time.perf_counter()
            result = run_estimator(cell.estimator, cell.settings, log, cell.parameters)
            seconds = time.perf_counter() - begin - result.observing
            return Outcome(cell.names, measure(result, log, seconds, **cell.measured), result)
    except Exception as error:  # whatever ends a run belongs into the results
        return Outcome.failed(cell, error)


def run_estimator(name: str, settings: MapperSettings, log: Log, parameters: Any = None) -> RunResult:
    """Run an online estimator, with its reach and its map at the end of each true lap, or a batch one."""
    if name not in registry.ONLINE:
        return registry.make_batch(name, settings, log, parameters).solve(log)
    estimator, truth = registry.make_online(name, settings, log, parameters), log.truth
    observers = [ReachObserver(truth)] if has_cones(truth) and len(truth.poses) else []
    result = run_online(log, estimator, name=name, snapshot_times=lap_times(log), observers=observers)
    return replace(result, reach=observers[0].rows) if observers else result


def record_cell(cell: Cell[AnyDrive]) -> Record:
    """Run a cell in whatever process; a SettingsError where that has other code than the study."""
    check_code(cell.estimator, cell.code, cell.began)
    outcome = run_cell(cell)
    record = record_of(cell, outcome)
    if cell.keep and outcome.result is not None:
        record[RUN_FILES] = files_of(outcome.result, cell.drive.load())
    return record


def files_of(run: RunResult, log: Log) -> dict[str, str]:
    """Return the files of a run as texts by name: a worker may have no disk in common with the study."""
    with TemporaryDirectory() as folder:
        write_result(Path(folder) / "run", run, summarize(run, log))
        return {file.name: file.read_text(encoding="utf-8") for file in (Path(folder) / "run").iterdir()}


def record_of(cell: Cell[AnyDrive], outcome: Outcome) -> Record:
    run, said = outcome.result, list[str]()
    if run is not None:
        said += [record.notice for record in run.cycles if record.notice]
        said += [] if run.vehicle is None else diagnose(run.vehicle, run.settings, run.scale)
    record: Record = {"format": FORMAT, "id": cell.id, "cell": cell.names, "made": made(cell.estimator)}
    record |= {"failure": outcome.failure, "traceback": outcome.trace}
    record |= {"notices": "; ".join(dict.fromkeys(said)), "laps": lap_rows(outcome.rows)}
    return dict(to_plain(record))


def lap_rows(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Return a row for each lap, with the metrics of the whole run beside its own.

    A run that completed no lap has one row, that of the whole run as lap 1.
    """
    if not rows:
        return []
    *laps, whole = rows
    shared = {key: value for key, value in whole.values.items() if METRICS[key].scope == "run"}
    return [{"lap": row.lap, **row.values, **shared} for row in laps] or [{"lap": 1, **whole.values}]


def read_record(folder: Path, cell: Cell[AnyDrive]) -> Record | None:
    """Return the cell's record in a study's folder, or None if there is none that is as it was written.

    A run that was not kept, and is to be, is none either.
    """
    try:
        record = read_json(_file(folder, cell), "a cell")
    except InputError:
        return None
    if not isinstance(record, dict) or record.pop(DIGEST, None) != identity(record=record):
        return None
    if (record.get("format"), record.get("id")) != (FORMAT, cell.id):
        return None
    is_missing = cell.keep and not record["failure"] and not (run_folder(folder, cell) / MAP_FILE).exists()
    return None if is_missing else record


def write_record(folder: Path, cell: Cell[AnyDrive], record: Record) -> None:
    """Write the record as a file of its own, whole or not at all, after the files of its run."""
    files = record.pop(RUN_FILES, None)
    if files is not None:
        shutil.rmtree(run_folder(folder, cell), ignore_errors=True)
        with atomic_folder(run_folder(folder, cell), MAP_FILE) as run:
            for name, text in files.items():
                write_text(run / name, text)
    write_json(_file(folder, cell), {**record, DIGEST: identity(record=record)}, indent=1)


def of_other_code(folder: Path, cells: Iterable[Cell[Any]]) -> int:
    """Return the number of kept cells that mean the same as one of these and are of other code."""
    kept = {tuple(file.stem.split("-")) for file in (folder / CELLS).glob("[!.]*-*.json")}
    known = {cell.meaning: tuple(cell.id.split("-")) for cell in cells}
    return sum(known.get(one[0], one) != one for one in kept)


def run_folder(folder: Path, cell: Cell[Any]) -> Path:
    """Return the folder of the files of a run in that of its study."""
    return folder / CELLS / cell.id


def _file(folder: Path, cell: Cell[AnyDrive]) -> Path:
    return folder / CELLS / f"{cell.id}.json"
