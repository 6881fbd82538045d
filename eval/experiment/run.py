"""Cells that run in parallel, each kept at once, so that an experiment that was killed goes on."""

import os
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass
from itertools import combinations, product
from pathlib import Path
from typing import Any, Final, TypeVar

import pandas as pd
from joblib import Parallel, delayed, parallel_config

from pathspace_graph import estimators as registry
from pathspace_graph.errors import InputError, OutputError, SettingsError
from pathspace_graph.eval.metrics.alignment import aligned_distance
from pathspace_graph.io.files import check_target, remove_manifest, write_json
from pathspace_graph.io.map import MAP_FILE, Map, read_map
from pathspace_graph.io.parsing import read_json, shown
from pathspace_graph.loop.worker import end_with
from pathspace_graph.sim.track import Track

from . import cells as store
from .cells import Cell, Outcome, Record
from .drives import AnyDrive, Drive, RecordedDrive, load_tracks, track_digest
from .frame import frame_of
from .provenance import code_of, here
from .study import Study

C = TypeVar("C")
R = TypeVar("R")

FORMAT: Final = "pathspace-study/1"
STUDY_FILE: Final = "study.json"
CONNECT_SECONDS: Final = 20.0  # time (s) within which a cluster has to answer

OnCell = Callable[[int, int], None]  # called with the numbers of cells that are done, and of all


class WorkerDiedError(RuntimeError):
    """The process that did the work died."""


def run_cells(
    cells: Sequence[C],
    work: Callable[[C], R],
    died: Callable[[C, WorkerDiedError], R],
    *,
    jobs: int = 1,
    cluster: str | None = None,
    on_cell: OnCell | None = None,
    begin: Callable[[], None] = lambda: None,
    read: Callable[[C], R | None] = lambda _: None,
    write: Callable[[C, R], None] = lambda *_: None,
) -> list[R]:
    """Run the cells that `read` knows no result of, and return all results.

    They run in `jobs` processes (-1: one for each core), or on the workers of a Dask scheduler. `work` is a
    function of a module that does not raise; where its process died, `died` makes the result. `begin` is
    called once there are workers, and `write` keeps each result at once.
    """
    check_jobs(jobs)
    known = {cell: read(cell) for cell in cells}
    results = {cell: result for cell, result in known.items() if result is not None}
    remaining = [cell for cell in cells if cell not in results]
    told = on_cell or (lambda *_: None)
    with workers(jobs, cluster) if remaining else nullcontext():
        begin()
        told(0, len(remaining))
        for done, (cell, result) in enumerate(outcomes(work, remaining), start=1):
            results[cell] = died(cell, result) if isinstance(result, WorkerDiedError) else result
            write(cell, results[cell])
            told(done, len(remaining))
    return [results[cell] for cell in cells]


# --- studies ---------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Plan:
    """A study with its tracks and all of its cells, in the order of the results."""

    study: Study
    tracks: tuple[Track, ...]
    cells: tuple[Cell[AnyDrive], ...]

    def resolved(self) -> dict[str, Any]:
        """Return the content of `study.json`: the study with every default written out."""
        study = self.study
        same = ("name", "question", "seeds", "laps", "estimators", "varied", "metrics", "columns")
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
            "reference_limits": study.reference_limits,
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
    measured = {"marginals": True, "reference_limits": study.reference_limits, "whole": False}
    drives: list[AnyDrive] = [
        Drive(track, seed, noise, study.simulation(noise))
        for noise, track, seed in product(study.noise, tracks, study.seeds)
    ]
    for track, folders in study.logs.items():
        drives += [RecordedDrive(track, number, folder) for number, folder in enumerate(folders)]
    cells = tuple(
        Cell(
            *(drive, estimator, variant.settings, name, measured),
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
    that of `run_plan`.
    """
    with tempfile.TemporaryDirectory() if out is None else nullcontext(out) as folder:
        return run_plan(make_plan(study, keep=keep), Path(folder), **how)


def run_plan(plan: Plan, out: Path, *, retry_failed: bool = False, **how: Any) -> pd.DataFrame:
    """Run a study, OutputError in another's folder; `how`: `jobs`, `cluster`, `on_cell` of `run_cells`.

    Cells that mean the same, since their estimator does not read what is varied, are run once.
    """
    check_folder(out, plan)
    remove_manifest(out)  # of a study that goes on; the last step writes it again
    command = " ".join([Path(sys.argv[0]).name, *sys.argv[1:]])

    def kept(cell: Cell[AnyDrive]) -> Record | None:
        record = store.read_record(out, cell)
        return None if record is not None and retry_failed and record["failure"] else record

    def write(cell: Cell[AnyDrive], record: Record) -> None:
        record["made"]["command"] = command
        store.write_record(out, cell, record)

    cells = [*{cell.id: cell for cell in reversed(plan.cells)}.values()][::-1]
    records = run_cells(
        cells,
        store.record_cell,
        lambda cell, error: store.record_of(cell, Outcome.failed(cell, error)),
        begin=lambda: write_json(out / STUDY_FILE, plan.resolved(), indent=1),
        read=kept,
        write=write,
        **how,
    )
    by_id = {cell.id: record for cell, record in zip(cells, records, strict=True)}
    add_agreement(out, cells, by_id)
    return frame_of(plan.study, [(cell, by_id[cell.id]) for cell in plan.cells])


def add_agreement(out: Path, cells: Sequence[Cell[AnyDrive]], records: Mapping[str, Record]) -> None:
    """Add how far each kept map of a recorded log is from those of the other logs of its track (m)."""
    maps = dict[tuple[Any, ...], dict[str, Map]]()
    for cell in cells:
        if isinstance(cell.drive, RecordedDrive) and (store.run_folder(out, cell) / MAP_FILE).exists():
            key = (cell.drive.track, cell.estimator, cell.settings, cell.parameters)
            maps.setdefault(key, {})[cell.id] = read_map(store.run_folder(out, cell))
    for alike in maps.values():
        for one, other in combinations(alike, 2):
            apart = aligned_distance(alike[one], alike[other])
            for cell_id in (one, other):
                for lap in records[cell_id]["laps"]:
                    lap["agreement"] = lap.get("agreement", 0.0) + apart / (len(alike) - 1)


def check_folder(out: Path, plan: Plan) -> None:
    """Raise OutputError if the folder holds something else, or a study of another name.

    One of the name may have changed: cells are used wherever they mean the same.
    """
    check_target(out, STUDY_FILE)
    file = out / STUDY_FILE
    if not file.is_file():
        return
    try:
        found = read_json(file, "a study")
    except InputError as error:
        raise OutputError(str(error)) from error
    name = found.get("name") if isinstance(found, dict) else None
    if name != plan.study.name:
        raise OutputError(f"{file}: expected the study {plan.study.name}, found {shown(name)}")


# --- workers ---------------------------------------------------------------------------------------------


def check_jobs(jobs: int) -> None:
    """Raise SettingsError unless the number of processes is at least 1, or -1."""
    if jobs < 1 and jobs != -1:
        raise SettingsError(f"jobs: expected at least 1, or -1 for every core, found {jobs}")


@contextmanager
def workers(jobs: int, cluster: str | None) -> Iterator[None]:
    """Start processes on this machine with one BLAS thread each, or connect to a Dask cluster's workers."""
    if cluster is None:
        leave = {"initializer": end_with, "initargs": (os.getpid(),)}
        with parallel_config(backend="loky", n_jobs=jobs, inner_max_num_threads=1, **leave):
            yield
        return
    try:
        from distributed import Client  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise SettingsError("--cluster: expected dask (pip install -e '.[cluster]'), found none") from error
    try:
        client = Client(cluster, timeout=CONNECT_SECONDS)
    except (OSError, ValueError) as error:
        raise SettingsError(f"--cluster: expected a Dask scheduler, found none at {cluster}") from error
    with client, parallel_config(backend="dask", wait_for_workers_timeout=CONNECT_SECONDS):
        yield


def outcomes(work: Callable[[C], R], items: Sequence[C]) -> Iterator[tuple[C, R | WorkerDiedError]]:
    """Yield (item, work(item)) in the order in which they finish; `work` must not raise.

    When a worker dies, nobody knows which item it had, so each item under way is tried again alone.
    """
    remaining, sent = dict(enumerate(items)), dict[int, C]()
    while remaining:
        sent.clear()
        try:
            for index, result in _run(work, _noted(remaining, sent)):
                yield remaining.pop(index), result
        except _deaths():
            for index in sent.keys() & remaining:
                yield sent[index], _alone(work, remaining.pop(index))


def _noted(items: dict[int, C], sent: dict[int, C]) -> Iterator[tuple[int, C]]:
    for index, item in list(items.items()):
        sent[index] = item
        yield index, item


def _run(work: Callable[[C], R], tasks: Iterable[tuple[int, C]], **options: Any) -> Iterator[tuple[int, R]]:
    parallel = Parallel(return_as="generator_unordered", batch_size=1, **options)
    yield from parallel(delayed(_numbered)(work, index, item) for index, item in tasks)


def _numbered(work: Callable[[C], R], index: int, item: C) -> tuple[int, R]:
    return index, work(item)


def _alone(work: Callable[[C], R], item: C) -> R | WorkerDiedError:
    try:
        ((_, result),) = _run(work, [(0, item)], n_jobs=2)  # one job would be done by this very process
    except _deaths() as error:
        return WorkerDiedError(f"the process that ran it died ({type(error).__name__})")
    return result


def _deaths() -> tuple[type[Exception], ...]:
    try:
        from distributed import KilledWorker  # noqa: PLC0415 - an extra
    except ImportError:
        return (BrokenProcessPool,)
    return (BrokenProcessPool, KilledWorker)
