"""Studies as they run: cells in parallel, each kept at once, so that a killed one is resumed; one frame."""

import ast
import os
import platform
import shutil
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from functools import cache, cached_property, partial
from hashlib import sha256
from importlib.machinery import EXTENSION_SUFFIXES, ModuleSpec
from importlib.metadata import packages_distributions, version
from importlib.util import find_spec
from itertools import combinations, product
from pathlib import Path
from typing import Any, Final

import joblib
import numpy as np
import pandas as pd
from joblib import Parallel, delayed, parallel_config
from threadpoolctl import threadpool_limits

from pathspace_graph import estimators as registry
from pathspace_graph.brief import Brief
from pathspace_graph.errors import InputError, OutputError, SettingsError, SolveError, install
from pathspace_graph.eval.metrics import measures
from pathspace_graph.eval.metrics.alignment import aligned_distance
from pathspace_graph.eval.metrics.measures import METRICS, versions
from pathspace_graph.eval.metrics.trajectory import ReachObserver
from pathspace_graph.io.files import atomic_folder, check_target, to_plain, write_json, write_text
from pathspace_graph.io.log import Log
from pathspace_graph.io.map import MAP_FILE, Map, read_map
from pathspace_graph.io.parsing import read_json, shown
from pathspace_graph.io.results import RunResult, commit_of, machine, write_result
from pathspace_graph.lengths import times
from pathspace_graph.loop.lap_solver import end_with
from pathspace_graph.plausibility.diagnosis import diagnose
from pathspace_graph.run import run_online, with_own
from pathspace_graph.settings.checked import leaves
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.sim.track import Track

from .study import Study, StudyDrive, identity, load_tracks, recorded_drive, simulated_drive, track_digest
from .tables import RUN, RUN_OF

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

CELLS: Final = "cells"  # folder of the kept cells
STUDY_FILE: Final = "study.json"
CELL_FORMAT: Final = "pathspace-cell/5"
CONNECT_SECONDS: Final = 20.0  # time (s) within which a cluster has to answer
Record = dict[str, Any]  # what is kept of a cell, in the types of JSON only
OnCell = Callable[[int, int], None]  # called with the numbers of cells that are done, and of all


class WorkerDiedError(RuntimeError):
    """The process that did the work died."""


# --- what a result depends on: sources, libraries, commit and machine ---------------------------------------

HOUSE: Final = __name__.partition(".")[0]
MEASURED: Final = (  # modules on which every result depends, whatever the estimator is
    *("run", "sim.simulate", "sim.track_generator", "plausibility.diagnosis"),
    "eval.metrics.measures",
)
Code = dict[str, str]  # digest of each source by its module, and version of each library by its name


@cache
def code_from(module: str) -> Code:
    """Return the code of a module, of the metrics and of all that they import, as this process has read it.

    Of what is installed, the version stands for the sources, except in the package of the module: an editable
    package has no version that changes with it. The standard library doesn't count.
    """
    if _spec(module) is None:  # a class of a notebook, or of the program itself
        raise SettingsError(f"estimators: expected one of a module with sources, found {module}")
    own, found, libraries = {HOUSE, module.partition(".")[0]}, Code(), set[str]()
    remaining = [(root, HOUSE) for root in (module, *(f"{HOUSE}.{one}" for one in MEASURED))]
    while remaining:
        name, importer = remaining.pop()
        package, spec = name.partition(".")[0], None if name in found else _spec(name)
        if spec is None or spec.origin is None:
            continue  # known already, an optional package that is not here, or a folder without sources
        if package not in own and {"site-packages", "dist-packages"} & set(Path(spec.origin).parts):
            libraries |= {package} - ({package} if importer == HOUSE else set())
            continue
        found[name] = _digest(Path(spec.origin))
        remaining += [(imported, package) for imported in _imports(name)]
    known = packages_distributions() if libraries else {}
    used = {distribution for library in libraries for distribution in known.get(library, [])}
    versioned = ("gtsam", "numpy", "scipy", *sorted(used))  # the first of which all results depend on
    return dict(sorted(found.items())) | {name: version(name) for name in versioned}


@cache
def _spec(name: str) -> ModuleSpec | None:
    """Return where a module is; None where it is none, is not here, or is of the standard library."""
    if name.partition(".")[0] in sys.stdlib_module_names:
        return None
    try:
        return find_spec(name)
    except (ImportError, ValueError):  # something else than a module, in a module or in a program
        return None


def _digest(file: Path) -> str:
    """Return the digest of a source; for a compiled module it is that of its sources, if they are here."""
    compiled = file.name.endswith(tuple(EXTENSION_SUFFIXES))
    files = sorted(file.parent.rglob("*.[ch]pp")) if compiled else []
    return sha256(b"".join(one.read_bytes() for one in files or [file])).hexdigest()[:12]


@cache
def _imports(name: str) -> tuple[str, ...]:
    """Return the modules that a module imports anywhere in it, and the package that it lies in.

    Our own package runs nothing in its root that a module in it needs.
    """
    spec, parents = _spec(name), name.split(".")[:-1]
    found = [".".join(parents)] if parents and parents[0] != HOUSE else []
    if spec is None or not str(spec.origin).endswith(".py"):
        return tuple(found)
    package = name.split(".") if spec.submodule_search_locations is not None else parents
    for node in ast.walk(ast.parse(Path(str(spec.origin)).read_bytes())):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else []
            base = ".".join([*above, *filter(None, [node.module])])
            of_base = _spec(base)
            is_package = of_base is not None and of_base.submodule_search_locations is not None
            inner = [f"{base}.{alias.name}" for alias in node.names] if is_package else []
            modules = [one for one in inner if _spec(one) is not None]
            found += [base] * (len(modules) < len(node.names)) + modules  # the one that has the other names
    return tuple(dict.fromkeys(found))


def check_code(module: str, expected: Code, began: str) -> None:
    """Raise a SettingsError that names both unless this process has the code with which a study began."""
    found = code_from(module)
    if found == expected:
        return
    name = next(name for name in [*expected, *found] if expected.get(name) != found.get(name))
    own, other = (code.get(name, "missing") for code in (found, expected))
    raise SettingsError(
        f"{module}: expected the code of {began}, where the study began, "
        f"with {name} {other}, found {name} {own} on {here()}"
    )


def here() -> str:
    return f"{platform.node()} (process {os.getpid()})"


def origin_of(module: str) -> dict[str, Any]:
    """Return where and when a result of what is in a module is made, and with which libraries."""
    packages = {HOUSE, module.partition(".")[0]}
    specs = {name: _spec(name) for name in sorted(packages)}
    folders = {name: Path(spec.origin).parent for name, spec in specs.items() if spec and spec.origin}
    commits = {name: commit for name, folder in folders.items() if (commit := commit_of(folder))}
    return {
        **versions(),
        "commit": " ".join(commits.values() if len(packages) == 1 else map(" ".join, commits.items())),
        **machine(),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
    }


# --- cells -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, kw_only=True)
class Cell:
    """One part of a study, which is run once, in whatever process."""

    module: str
    """Name of the module of what is run."""
    names: Mapping[str, Any]
    """Names by which tables and messages know it, in the types of JSON."""
    meaning: str
    """Identity of everything that the result depends on, except the code."""
    code: Code
    """Code with which the study began."""
    work: Callable[[], Record]
    """Does what the cell does; the record has the `rows` that are returned, and other keys."""
    began: str = field(default_factory=here)
    """Process in which the study began."""
    keep: bool = False
    """Whether the files of its run are kept beside its record."""

    @cached_property
    def id(self) -> str:
        """Identity of everything that the result depends on: cells of one id have one result."""
        return f"{self.meaning}-{identity(**self.code)[:12]}"

    def record(self) -> Record:
        """Run it, whatever comes of it; a SettingsError where this process has other code than the study."""
        check_code(self.module, self.code, self.began)
        try:
            with threadpool_limits(limits=1):
                return self._recorded(self.work())
        except Exception as error:  # whatever ends a run belongs into the results
            return self.failed(error)

    def failed(self, error: BaseException) -> Record:
        """Return the record of a cell that ended with an error."""
        failure = " ".join(f"{type(error).__name__}: {error}".split())
        trace = "".join(traceback.format_exception(error))
        return self._recorded({"failure": failure, "traceback": trace, "rows": []})

    def _recorded(self, found: Record) -> Record:
        about = {"format": CELL_FORMAT, "id": self.id, "cell": self.names, "made": origin_of(self.module)}
        return dict(to_plain({**about, "failure": "", "traceback": "", **found}))


def run_cells(
    cells: Sequence[Cell],
    folder: Path,
    *,
    on_cell: OnCell | None = None,
    retry_failed: bool = False,
) -> dict[str, Record]:
    """Run the cells that a folder has no record of, by the `workers`, and return all records by id.

    Cells that mean the same are run once. Each record is kept as soon as it is there. When a worker dies,
    nobody knows which cell it had, so each that was under way is tried again alone.
    """
    every = {cell.id: cell for cell in cells}
    records = {name: known for name, cell in every.items() if (known := read_record(folder, cell))}
    if retry_failed:
        records = {name: record for name, record in records.items() if not record["failure"]}
    remaining = {name: cell for name, cell in every.items() if name not in records}
    command, total = " ".join([Path(sys.argv[0]).name, *sys.argv[1:]]), len(remaining)
    deaths: tuple[type[Exception], ...] = (BrokenProcessPool,)
    with suppress(ImportError):
        from distributed import KilledWorker  # noqa: PLC0415 - an extra

        deaths = (BrokenProcessPool, KilledWorker)

    def keep(record: Record) -> None:
        name = record["id"]
        record["made"]["command"] = command
        write_record(folder, remaining.pop(name), record)
        records[name] = record
        told(total - len(remaining), total)

    def tasks(sent: list[str]) -> Iterator[Any]:
        for name, cell in [*remaining.items()]:
            sent.append(name)
            yield delayed(Cell.record)(cell)

    told = on_cell or (lambda *_: None)
    told(0, total)
    while remaining:
        sent = list[str]()
        try:
            for record in Parallel(return_as="generator_unordered", batch_size=1)(tasks(sent)):
                keep(record)
        except deaths:
            for name in [name for name in sent if name in remaining]:
                try:  # one job would be done by this very process
                    (record,) = Parallel(n_jobs=2)([delayed(Cell.record)(remaining[name])])
                except deaths as error:
                    died = WorkerDiedError(f"the process that ran it died: {error}")
                    died.__cause__ = error
                    record = remaining[name].failed(died)
                keep(record)
    return {name: records[name] for name in every}


# --- what is kept ------------------------------------------------------------------------------------------


def read_record(folder: Path, cell: Cell) -> Record | None:
    """Return the cell's record in a study's folder, or None if there is none that is as it was written.

    One without the files of its run is none either, where they are to be kept.
    """
    try:
        record = read_json(folder / CELLS / f"{cell.id}.json", "a cell")
    except InputError:
        return None
    if not isinstance(record, dict) or record.pop("digest", None) != identity(record=record):
        return None
    if (record.get("format"), record.get("id")) != (CELL_FORMAT, cell.id):
        return None
    is_missing = cell.keep and not record["failure"] and not run_folder(folder, cell).exists()
    return None if is_missing else record


def write_record(folder: Path, cell: Cell, record: Record) -> None:
    """Write the record as a file of its own, whole or not at all, after the files of its run."""
    files = record.pop("files", None)
    if files is not None:
        with atomic_folder(run_folder(folder, cell), MAP_FILE, force=True) as run:
            for name, text in files.items():
                write_text(run / name, text)
    write_json(folder / CELLS / f"{cell.id}.json", {**record, "digest": identity(record=record)}, indent=1)


def of_other_code(folder: Path, cells: Iterable[Cell]) -> int:
    """Return the number of kept cells that mean the same as one of these and are of other code."""
    kept = {tuple(file.stem.split("-")) for file in (folder / CELLS).glob("[!.]*-*.json")}
    known = {cell.meaning: tuple(cell.id.split("-")) for cell in cells}
    return sum(known.get(one[0], one) != one for one in kept)


def run_folder(folder: Path, cell: Cell) -> Path:
    """Return the folder of the files of a run in that of its study."""
    return folder / CELLS / cell.id


@contextmanager
def unfinished(out: Path) -> Iterator[Path]:
    """Yield a folder beside `out` for the cells of what is not finished, which is gone once it is."""
    place = Path(os.path.realpath(out))
    folder = place.with_name(f"{place.name}.unfinished")
    yield folder
    shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def locked(out: Path) -> Iterator[None]:
    """Keep other processes from running a study in a folder; OutputError where one already does.

    The lock of a process ends with it, however it ends. Windows has no such locks.
    """
    out.mkdir(parents=True, exist_ok=True)
    if fcntl is None:
        yield
        return
    folder = os.open(out, os.O_RDONLY)
    try:
        try:
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise OutputError(f"{out}: expected no study that runs there, found one") from error
        yield
    finally:
        os.close(folder)


# --- workers -----------------------------------------------------------------------------------------------


def check_jobs(jobs: int) -> None:
    """Raise SettingsError unless the number of processes is at least 1, or -1."""
    if jobs < 1 and jobs != -1:
        raise SettingsError(f"jobs: expected at least 1, or -1 for every core, found {jobs}")


@contextmanager
def workers(jobs: int = 1, cluster: str | None = None) -> Iterator[None]:
    """Start processes on this machine with one BLAS thread each, or connect to a Dask cluster's workers.

    With one job the work is done by this very process.
    """
    check_jobs(jobs)
    if cluster is None:
        leave = {"initializer": end_with, "initargs": (os.getpid(),)}
        with parallel_config(backend="loky", n_jobs=jobs, inner_max_num_threads=1, **leave):
            yield
        return
    try:
        from distributed import Client  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise SettingsError(f"--cluster: expected dask ({install('cluster')}), found none") from error
    try:
        client = Client(cluster, timeout=CONNECT_SECONDS)
    except (OSError, ValueError) as error:
        raise SettingsError(f"--cluster: expected a Dask scheduler, found none at {cluster}") from error
    with client, parallel_config(backend="dask", wait_for_workers_timeout=CONNECT_SECONDS):
        yield


# --- cells of estimators and of functions ------------------------------------------------------------------


@dataclass(frozen=True, eq=False, kw_only=True)
class EstimatorCell(Cell):
    """An estimator with settings on the log of a drive."""

    drive: StudyDrive
    estimator: str
    settings: MapperSettings
    parameters: Any
    """Own ones of the estimator, a frozen dataclass; None where it has none."""


def estimator_record(
    drive: StudyDrive, name: str, settings: MapperSettings, parameters: Any, keep: bool
) -> Record:
    """Run an estimator on a drive's log, and return its metrics and, where they are kept, its files."""
    log, hints = drive.load()
    begin, worked = time.perf_counter(), time.thread_time()
    result = run_estimator(name, settings, log, parameters)
    wall, processor = time.perf_counter() - begin - result.observing, time.thread_time() - worked
    cycles = measures.online_cycles(result)
    took = wall, sum(record.processor for record in cycles) if cycles else processor
    said = [record.notice for record in result.cycles if record.notice]
    vehicle = result.at_scale_one().vehicle
    said += [] if vehicle is None else diagnose(vehicle, result.settings)
    record: Record = {
        "notices": "; ".join(dict.fromkeys(said)),
        "lap_count": result.laps,
        "rows": measures.measure(result, log, took),
        "stages": measures.stage_times(cycles),
    }
    if keep:  # as texts: a worker may have no disk in common with the study
        with tempfile.TemporaryDirectory() as place:
            write_result(Path(place) / "run", result, measures.summarize(result, log, hints))
            files = (Path(place) / "run").iterdir()
            record["files"] = {file.name: file.read_text(encoding="utf-8") for file in files}
    return record


def run_estimator(name: str, settings: MapperSettings, log: Log, parameters: Any = None) -> RunResult:
    """Run an online estimator, with its reach and its map at the end of each true lap, or a batch one."""
    if name not in registry.ONLINE:
        return with_own(registry.make_batch(name, settings, log, parameters).solve(log), parameters)
    estimator, truth = registry.make_online(name, settings, log, parameters), log.at_scale_one().truth
    observers = [ReachObserver(truth)] if measures.has_cones(truth) and len(truth.poses) else []
    result = run_online(
        log, estimator, name=name, snapshot_times=measures.lap_times(log), observers=observers
    )
    result = replace(result, reach=times(observers[0].rows, (1, 2, 0), log.scale)) if observers else result
    return with_own(result, parameters)


def rows_of(
    function: Callable[..., list[dict[str, Any]]],
    arguments: Iterable[Mapping[str, Any]],
    folder: Path | None = None,
    *,
    jobs: int = 1,
    on_cell: OnCell | None = None,
    depends: Any = None,
) -> pd.DataFrame:
    """Return the rows of a function of a module for each of some arguments; SolveError where one fails.

    With a `folder` they are kept there, so that a study that was killed goes on. `depends` is what the rows
    depend on beside the arguments and the code of the module.
    """
    code, cells = code_from(function.__module__), list[Cell]()

    def work(of: Mapping[str, Any]) -> Record:
        return {"rows": function(**of)}

    for of in arguments:
        cell = Cell(
            module=function.__module__,
            names={name: value for name, value in of.items() if isinstance(value, str | int | float)},
            meaning=str(joblib.hash([function.__qualname__, dict(of), depends])),
            code=code,
            work=partial(work, of),
        )
        cells.append(cell)
    with tempfile.TemporaryDirectory() if folder is None else nullcontext(folder) as place, workers(jobs):
        records = run_cells(cells, Path(place), on_cell=on_cell, retry_failed=True)
    for cell in cells:
        if failure := records[cell.id]["failure"]:
            raise SolveError(f"{', '.join(map(str, cell.names.values()))}: {failure}")
    rows = [row for cell in cells for row in records[cell.id]["rows"]]
    return pd.DataFrame([{k: np.nan if v is None else v for k, v in row.items()} for row in rows])


# --- studies ---------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, repr=False)
class Plan(Brief):
    """A study with its tracks and all of its cells, in the order of the results."""

    study: Study
    tracks: tuple[Track, ...]
    cells: tuple[EstimatorCell, ...]


def make_plan(study: Study, *, keep: bool = False) -> Plan:
    """Read and generate the tracks, and return the cells, grouped by the log that they share.

    With `keep`, the map, trajectory, cycles and summary of each are kept.

    A SettingsError says what is broken in an estimator of another package.
    """
    tracks, points = tuple(load_tracks(study.tracks)), study.points
    for name, variant in product(study.estimators, points.values()):
        registry.check_estimator(name, variant.settings, dict(variant.parameters).get(name))
    drives = [
        simulated_drive(track, seed, noise, study.simulation(noise))
        for noise, track, seed in product(study.noise, tracks, study.seeds)
    ]
    for track, folders in study.logs.items():
        limits = study.settings.limits
        drives += [recorded_drive(track, number, folder, limits) for number, folder in enumerate(folders)]
    cells = list[EstimatorCell]()
    for drive, estimator, (name, variant) in product(drives, study.estimators, points.items()):
        settings, parameters = variant.settings, dict(variant.parameters).get(estimator)
        read = {k: v for k, v in leaves(settings).items() if registry.reads(estimator, k)}
        own = None if parameters is None else to_plain(asdict(parameters))
        module = registry.module_of(estimator)
        cell = EstimatorCell(
            module=module,
            names={"track": drive.track, "seed": drive.seed, "noise": drive.noise}
            | {"estimator": estimator, "variant": name},
            meaning=identity(drive=drive.id, estimator=estimator, settings=read, own=own),
            code=code_from(module),
            work=partial(estimator_record, drive, estimator, settings, parameters, keep),
            keep=keep,
            drive=drive,
            estimator=estimator,
            settings=settings,
            parameters=parameters,
        )
        cells.append(cell)
    return Plan(study, tracks, tuple(cells))


def run_study(
    study: Study | Plan, out: Path | str | None = None, *, keep: bool = False, **how: Any
) -> pd.DataFrame:
    """Run the cells of a study that are missing, and return all of its results, a row per run and lap.

    Finished cells are kept in the folder `out`, if there is one, and with `keep` what each has made. `how` is
    that of `run_records`.
    """
    plan = study if isinstance(study, Plan) else make_plan(study, keep=keep)
    with tempfile.TemporaryDirectory() if out is None else nullcontext(out) as folder:
        records = run_records(plan, Path(folder), **how)
        # how far each kept map of a recorded log is from those of the other logs of its track (m)
        maps = dict[tuple[Any, ...], dict[str, Map]]()
        for cell in plan.cells:
            run = run_folder(Path(folder), cell)
            if cell.drive.simulation is None and (run / MAP_FILE).exists():
                key = (cell.drive.track, cell.estimator, cell.settings, cell.parameters)
                maps.setdefault(key, {})[cell.id] = read_map(run)
    for alike in maps.values():
        for one, other in combinations(alike, 2):
            apart = aligned_distance(alike[one], alike[other])
            for whole in (records[one]["rows"][-1], records[other]["rows"][-1]):
                whole["agreement"] = whole.get("agreement", 0.0) + apart / (len(alike) - 1)
    return frame_of(plan.study, [(cell, records[cell.id]) for cell in plan.cells])


def run_records(
    plan: Plan,
    out: Path,
    *,
    jobs: int = 1,
    cluster: str | None = None,
    on_cell: OnCell | None = None,
    retry_failed: bool = False,
) -> dict[str, Record]:
    """Run what is missing of a study, and return the records by cell; OutputError in another's folder.

    It runs in `jobs` processes (-1: one for each core), or on the workers of a Dask scheduler. A folder has
    one study at a time, of one name; the study may have changed: cells are used wherever they mean the same.
    """
    check_target(out, STUDY_FILE, force=True)
    study, file = plan.study, out / STUDY_FILE
    if file.is_file():
        try:
            found = read_json(file, "a study")
        except InputError as error:
            raise OutputError(str(error)) from error
        name = found.get("name") if isinstance(found, dict) else None
        if name != study.name:
            raise OutputError(f"{file}: expected the study {study.name}, found {shown(name)}")
    same = ("name", "question", "seeds", "laps", "estimators", "varied", "metrics")
    resolved = {  # the study with every default written out
        "format": "pathspace-study/1",
        **{name: getattr(study, name) for name in same},
        "tracks": [{"name": track.name, "digest": track_digest(track)} for track in plan.tracks],
        "logs": {track: [folder.name for folder in folders] for track, folders in study.logs.items()},
        "noise": {name: asdict(study.simulation(name)) for name in study.noise},
        "variants": {name: asdict(variant.settings) for name, variant in study.points.items()},
        "parameters": {
            name: {of: asdict(own) for of, own in variant.parameters}
            for name, variant in study.points.items()
            if variant.parameters
        },
        "baseline": {"variant": study.baseline_variant, "estimator": study.baseline.estimator},
    }
    with workers(jobs, cluster), locked(out):
        write_json(file, resolved, indent=1)
        return run_cells(plan.cells, out, on_cell=on_cell, retry_failed=retry_failed)


# --- results ---------------------------------------------------------------------------------------------


def frame_of(study: Study, cells: Sequence[tuple[EstimatorCell, Record]]) -> pd.DataFrame:
    """Return a row for each run and lap, or one for a failed run; every varied setting is a column."""
    rows = list[dict[str, Any]]()
    for cell, record in cells:
        shared = {"study": study.name, **cell.names} | _settings_row(study, cell)
        about = {"failure": record["failure"], "notices": record.get("notices", ""), **record["made"]}
        about |= {"drive": cell.drive.source, "cell": cell.id}
        laps = measures.rows_by_lap(record["rows"]) if record["rows"] else [{"lap": None}]
        rows += [shared | lap | about for lap in laps]
    add_batch(rows, (*RUN, "noise", "variant"))
    settings = _settings_row(study, cells[0][0])
    order = ["study", *RUN_OF, *settings, "lap", *METRICS, "failure", "notices", *versions(), "drive", "cell"]
    known = dict.fromkeys([*order, *(name for row in rows for name in row)])
    frame = pd.DataFrame(rows, columns=[name for name in known if any(name in row for row in rows)])
    return frame.astype({"lap": "Int64"})


def add_batch(rows: Sequence[dict[str, Any]], names: Sequence[str]) -> None:
    """Add the turn (rad) of each map from that of the batch with the same `names`, and the rmse by its own.

    The turns are from the truth, since small turns add up. Rows that lack a metric, like the batch, are left.
    """
    default = registry.DEFAULT_BATCH
    batches = {tuple(row[name] for name in names): row for row in rows if row["estimator"] == default}
    for row in rows:
        batch = batches.get(tuple(row[name] for name in names), {})
        if row["estimator"] != default and {"turn", "rmse"} <= set(row) & set(batch):
            row["turn_from_batch"] = float(row["turn"] - batch["turn"])
            row["rmse_by_batch"] = float(row["rmse"] / batch["rmse"])


def _settings_row(study: Study, cell: EstimatorCell) -> dict[str, Any]:
    """Return the varied settings of a cell; one that its estimator does not have is None."""
    settings, simulated = leaves(cell.settings), cell.drive.simulation
    simulation = {} if simulated is None else leaves(simulated)
    if cell.parameters is not None:
        settings |= {f"{cell.estimator}.{name}": value for name, value in leaves(cell.parameters).items()}
    row = {f"simulation.{name}": simulation.get(name) for name in study.varied_noise}
    own = {"study", *RUN_OF}
    row |= {f"settings.{name}" if name in own else name: settings.get(name) for name in study.varied}
    return {name: " ".join(map(str, v)) if isinstance(v, tuple) else v for name, v in row.items()}
