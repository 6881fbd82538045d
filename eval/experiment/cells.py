"""Cells of an estimator with settings on the log of a drive, and what is measured and kept of them."""

import shutil
import time
import traceback
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final, Generic, Self, TypeVar

from threadpoolctl import threadpool_limits

from pathspace_graph import estimators as registry
from pathspace_graph.errors import InputError
from pathspace_graph.eval.metrics.measures import Row, measure
from pathspace_graph.eval.metrics.metric import METRICS
from pathspace_graph.eval.metrics.summary import has_cones, lap_times, summarize
from pathspace_graph.eval.metrics.trajectory import ReachObserver
from pathspace_graph.io.files import atomic_folder, to_plain, write_json, write_text
from pathspace_graph.io.log import Log
from pathspace_graph.io.map import MAP_FILE
from pathspace_graph.io.overrides import leaves
from pathspace_graph.io.parsing import read_json
from pathspace_graph.io.results import RunResult, write_result
from pathspace_graph.plausibility.diagnosis import diagnose
from pathspace_graph.run import run_online
from pathspace_graph.settings.mapper import MapperSettings

from .drives import AnyDrive, NamedLog, identity
from .provenance import Code, check_code, made

CELLS: Final = "cells"  # folder of the kept cells
FORMAT: Final = "pathspace-cell/4"
RUN_FILES: Final = "files"  # key of the kept files of a run, on their way from its process
DIGEST: Final = "digest"  # key of a record's digest in its file
Record = dict[str, Any]  # what is kept of a cell, in the types of JSON only


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
