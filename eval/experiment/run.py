"""Studies as they run: cells of estimators and of functions, those that are missing, and one frame of all."""

import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from itertools import combinations, product
from pathlib import Path
from typing import Any, Final

import joblib
import numpy as np
import pandas as pd

from pathspace_graph import estimators as registry
from pathspace_graph.errors import InputError, OutputError, SolveError
from pathspace_graph.eval.metrics.alignment import aligned_distance
from pathspace_graph.eval.metrics.measures import measure, online_cycles, stage_times
from pathspace_graph.eval.metrics.metric import METRICS
from pathspace_graph.eval.metrics.summary import has_cones, lap_times, summarize, versions
from pathspace_graph.eval.metrics.trajectory import ReachObserver
from pathspace_graph.io.files import check_target, to_plain, write_json
from pathspace_graph.io.log import Log
from pathspace_graph.io.map import MAP_FILE, Map, read_map
from pathspace_graph.io.overrides import leaves
from pathspace_graph.io.parsing import read_json, shown
from pathspace_graph.io.results import RunResult, write_result
from pathspace_graph.lengths import times
from pathspace_graph.plausibility.diagnosis import diagnose
from pathspace_graph.run import run_online, with_own
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.sim.track import Track

from .drives import AnyDrive, Drive, RecordedDrive, identity, load_tracks, track_digest
from .provenance import code_from, code_of, here
from .runner import FILES, Cell, OnCell, Record, locked, run_cells, run_folder, workers
from .statistics import RUN, RUN_OF
from .study import Study

FORMAT: Final = "pathspace-study/1"
STUDY_FILE: Final = "study.json"
RowsOf = Callable[..., list[dict[str, Any]]]


@dataclass(frozen=True, eq=False)
class EstimatorCell(Cell):
    """An estimator with settings on the log of a drive."""

    drive: AnyDrive
    estimator: str
    settings: MapperSettings
    variant: str  # name of the settings
    parameters: Any = None  # the estimator's own, a frozen dataclass; None where it has none

    @property
    def module(self) -> str:
        return registry.module_of(self.estimator)

    @property
    def names(self) -> dict[str, Any]:
        return self.drive.names | {"estimator": self.estimator, "variant": self.variant}

    @cached_property
    def meaning(self) -> str:
        known = leaves(self.settings).items()
        settings = {name: value for name, value in known if registry.reads(self.estimator, name)}
        own = None if self.parameters is None else to_plain(asdict(self.parameters))
        return identity(drive=self.drive.id, estimator=self.estimator, settings=settings, own=own)

    def run(self) -> Record:
        log, hints = self.drive.load()
        begin, worked = time.perf_counter(), time.thread_time()
        result = run_estimator(self.estimator, self.settings, log, self.parameters)
        wall, processor = time.perf_counter() - begin - result.observing, time.thread_time() - worked
        cycles = online_cycles(result)
        took = wall, sum(record.processor for record in cycles) if cycles else processor
        said = [record.notice for record in result.cycles if record.notice]
        vehicle = result.at_scale_one().vehicle
        said += [] if vehicle is None else diagnose(vehicle, result.settings)
        record: Record = {
            "notices": "; ".join(dict.fromkeys(said)),
            "lap_count": result.laps,
            "rows": [{"lap": row.lap, **row.values} for row in measure(result, log, took)],
            "stages": stage_times(cycles),
        }
        if self.keep:  # as texts: a worker may have no disk in common with the study
            with tempfile.TemporaryDirectory() as place:
                write_result(Path(place) / "run", result, summarize(result, log, hints))
                files = (Path(place) / "run").iterdir()
                record[FILES] = {file.name: file.read_text(encoding="utf-8") for file in files}
        return record


def run_estimator(name: str, settings: MapperSettings, log: Log, parameters: Any = None) -> RunResult:
    """Run an online estimator, with its reach and its map at the end of each true lap, or a batch one."""
    if name not in registry.ONLINE:
        return with_own(registry.make_batch(name, settings, log, parameters).solve(log), parameters)
    estimator, truth = registry.make_online(name, settings, log, parameters), log.at_scale_one().truth
    observers = [ReachObserver(truth)] if has_cones(truth) and len(truth.poses) else []
    result = run_online(log, estimator, name=name, snapshot_times=lap_times(log), observers=observers)
    result = replace(result, reach=times(observers[0].rows, (1, 2, 0), log.scale)) if observers else result
    return with_own(result, parameters)


@dataclass(frozen=True, eq=False)
class RowsCell(Cell):
    """A function with the arguments that its rows depend on."""

    function: RowsOf
    arguments: Mapping[str, Any]
    others: Mapping[str, Any] = field(default_factory=dict)  # arguments that change no row
    depends: Any = None  # on what its rows depend beside the arguments and its code

    @property
    def module(self) -> str:
        return str(self.function.__module__)

    @property
    def names(self) -> dict[str, Any]:
        return {name: value for name, value in self.arguments.items() if isinstance(value, str | int | float)}

    @cached_property
    def meaning(self) -> str:
        return str(joblib.hash([self.function.__qualname__, dict(self.arguments), self.depends]))

    def run(self) -> Record:
        return {"rows": self.function(**self.arguments, **self.others)}


def rows_of(
    function: RowsOf,
    arguments: Iterable[Mapping[str, Any]],
    folder: Path | None = None,
    *,
    jobs: int = 1,
    on_cell: OnCell | None = None,
    **more: Any,
) -> pd.DataFrame:
    """Return the rows of a function of a module for each of some arguments; SolveError where one fails.

    With a `folder` they are kept there, so that a study that was killed goes on. `more` is for the cells.
    """
    code, began = code_from(function.__module__), here()
    cells = [RowsCell(function, of, code=code, began=began, **more) for of in arguments]
    with tempfile.TemporaryDirectory() if folder is None else nullcontext(folder) as place, workers(jobs):
        records = run_cells(cells, Path(place), on_cell=on_cell, retry_failed=True)
    for cell in cells:
        if failure := records[cell.id]["failure"]:
            raise SolveError(f"{', '.join(map(str, cell.names.values()))}: {failure}")
    rows = [row for cell in cells for row in records[cell.id]["rows"]]
    return pd.DataFrame([{k: np.nan if v is None else v for k, v in row.items()} for row in rows])


# --- studies ---------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Plan:
    """A study with its tracks and all of its cells, in the order of the results."""

    study: Study
    tracks: tuple[Track, ...]
    cells: tuple[EstimatorCell, ...]

    def resolved(self) -> dict[str, Any]:
        """Return the content of `study.json`: the study with every default written out."""
        study = self.study
        same = ("name", "question", "seeds", "laps", "estimators", "varied", "metrics")
        return {
            "format": FORMAT,
            **{name: getattr(study, name) for name in same},
            "tracks": [{"name": track.name, "digest": track_digest(track)} for track in self.tracks],
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


def make_plan(study: Study, *, keep: bool = False) -> Plan:
    """Read and generate the tracks, and return the cells, grouped by the log that they share.

    With `keep`, the map, trajectory, cycles and summary of each are kept.

    A SettingsError says what is broken in an estimator of another package.
    """
    tracks, points = tuple(load_tracks(study.tracks)), study.points
    for name, variant in product(study.estimators, points.values()):
        registry.check_estimator(name, variant.settings, dict(variant.parameters).get(name))
    code, began = {name: code_of(name) for name in study.estimators}, here()
    drives: list[AnyDrive] = [
        Drive(track, seed, noise, study.simulation(noise))
        for noise, track, seed in product(study.noise, tracks, study.seeds)
    ]
    for track, folders in study.logs.items():
        limits = study.settings.limits
        drives += [RecordedDrive(track, number, folder, limits) for number, folder in enumerate(folders)]
    cells = tuple(
        EstimatorCell(
            *(drive, estimator, variant.settings, name),
            parameters=dict(variant.parameters).get(estimator),
            keep=keep,
            code=code[estimator],
            began=began,
        )
        for drive in drives
        for estimator, (name, variant) in product(study.estimators, points.items())
    )
    return Plan(study, tracks, cells)


def run_study(study: Study, out: Path | str | None = None, *, keep: bool = False, **how: Any) -> pd.DataFrame:
    """Run the cells of a study that are missing, and return all of its results, a row per run and lap.

    Finished cells are kept in the folder `out`, if there is one, and with `keep` what each has made. `how` is
    that of `run_records`.
    """
    with tempfile.TemporaryDirectory() if out is None else nullcontext(out) as folder:
        return run_plan(make_plan(study, keep=keep), Path(folder), **how)


def run_plan(plan: Plan, out: Path, **how: Any) -> pd.DataFrame:
    """Run what is missing of a study in a folder, and return its frame; `how` is that of `run_records`."""
    records = run_records(plan, out, **how)
    add_agreement(out, plan.cells, records)
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
    file = out / STUDY_FILE
    if file.is_file():
        try:
            found = read_json(file, "a study")
        except InputError as error:
            raise OutputError(str(error)) from error
        name = found.get("name") if isinstance(found, dict) else None
        if name != plan.study.name:
            raise OutputError(f"{file}: expected the study {plan.study.name}, found {shown(name)}")
    with workers(jobs, cluster), locked(out):
        write_json(file, plan.resolved(), indent=1)
        return run_cells(plan.cells, out, on_cell=on_cell, retry_failed=retry_failed)


def add_agreement(out: Path, cells: Sequence[EstimatorCell], records: Mapping[str, Record]) -> None:
    """Add how far each kept map of a recorded log is from those of the other logs of its track (m)."""
    maps = dict[tuple[Any, ...], dict[str, Map]]()
    for cell in cells:
        if isinstance(cell.drive, RecordedDrive) and (run_folder(out, cell) / MAP_FILE).exists():
            key = (cell.drive.track, cell.estimator, cell.settings, cell.parameters)
            maps.setdefault(key, {})[cell.id] = read_map(run_folder(out, cell))
    for alike in maps.values():
        for one, other in combinations(alike, 2):
            apart = aligned_distance(alike[one], alike[other])
            for whole in (records[one]["rows"][-1], records[other]["rows"][-1]):
                whole["agreement"] = whole.get("agreement", 0.0) + apart / (len(alike) - 1)


# --- results ---------------------------------------------------------------------------------------------


def frame_of(study: Study, cells: Sequence[tuple[EstimatorCell, Record]]) -> pd.DataFrame:
    """Return a row for each run and lap, or one for a failed run; every varied setting is a column.

    The row of a lap has the metrics of the whole run, the last row of a record, beside its own. A run that
    completed no lap has one row, that of the whole run as lap 1.
    """
    rows = list[dict[str, Any]]()
    for cell, record in cells:
        shared = {"study": study.name} | cell.names | _settings_row(study, cell)
        about = {"failure": record["failure"], "notices": record.get("notices", ""), **record["made"]}
        about |= {"drive": cell.drive.source, "cell": cell.id}
        if not record["rows"]:
            rows.append(shared | {"lap": None} | about)
            continue
        *laps, whole = record["rows"]
        of_run = {key: value for key, value in whole.items() if key != "lap" and METRICS[key].scope == "run"}
        rows += [shared | lap | of_run | about for lap in laps or [whole | {"lap": 1}]]
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
