"""The one runner: cells that run in parallel, each kept at once, so that a study that was killed goes on."""

import os
import shutil
import sys
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final, TypeVar

from joblib import Parallel, delayed, parallel_config
from threadpoolctl import threadpool_limits

from pathspace_graph.errors import InputError, OutputError, SettingsError, install
from pathspace_graph.io.files import atomic_folder, to_plain, write_json, write_text
from pathspace_graph.io.map import MAP_FILE
from pathspace_graph.io.parsing import read_json
from pathspace_graph.loop.worker import end_with

from .drives import identity
from .provenance import Code, check_code, made

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

R = TypeVar("R")
W = TypeVar("W")

CELLS: Final = "cells"  # folder of the kept cells
FORMAT: Final = "pathspace-cell/5"
FILES: Final = "files"  # key of the files of a run, on their way from its process
DIGEST: Final = "digest"  # key of a record's digest in its file
CONNECT_SECONDS: Final = 20.0  # time (s) within which a cluster has to answer
Record = dict[str, Any]  # what is kept of a cell, in the types of JSON only
OnCell = Callable[[int, int], None]  # called with the numbers of cells that are done, and of all


class WorkerDiedError(RuntimeError):
    """The process that did the work died."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Cell(ABC):
    """One part of a study, which is run once, in whatever process."""

    code: Code  # with which the study began
    began: str  # the process in which it did
    keep: bool = False  # whether the files of its run are kept beside its record

    @property
    @abstractmethod
    def module(self) -> str:
        """Name of the module of what is run."""

    @property
    @abstractmethod
    def names(self) -> dict[str, Any]:
        """Names by which tables and messages know it, in the types of JSON."""

    @property
    @abstractmethod
    def meaning(self) -> str:
        """Identity of everything that the result depends on, except the code."""

    @abstractmethod
    def run(self) -> Record:
        """Return what its record has: `rows`, and other keys."""

    @cached_property
    def id(self) -> str:
        """Identity of everything that the result depends on: cells of one id have one result."""
        return f"{self.meaning}-{identity(**self.code)[:12]}"

    def record(self) -> Record:
        """Run it, whatever comes of it; a SettingsError where this process has other code than the study."""
        check_code(self.module, self.code, self.began)
        try:
            with threadpool_limits(limits=1):
                return self._recorded(self.run())
        except Exception as error:  # whatever ends a run belongs into the results
            return self.failed(error)

    def failed(self, error: BaseException) -> Record:
        """Return the record of a cell that ended with an error."""
        failure = " ".join(f"{type(error).__name__}: {error}".split())
        trace = "".join(traceback.format_exception(error))
        return self._recorded({"failure": failure, "traceback": trace, "rows": []})

    def _recorded(self, found: Record) -> Record:
        about = {"format": FORMAT, "id": self.id, "cell": self.names, "made": made(self.module)}
        return dict(to_plain({**about, "failure": "", "traceback": "", **found}))


def run_cells(
    cells: Sequence[Cell],
    folder: Path,
    *,
    on_cell: OnCell | None = None,
    retry_failed: bool = False,
) -> dict[str, Record]:
    """Run the cells that a folder has no record of, by the `workers`, and return all records by id.

    Cells that mean the same are run once. Each record is kept as soon as it is there.
    """
    every = {cell.id: cell for cell in cells}
    records = {name: known for name, cell in every.items() if (known := read_record(folder, cell))}
    if retry_failed:
        records = {name: record for name, record in records.items() if not record["failure"]}
    remaining = [cell for name, cell in every.items() if name not in records]
    command = " ".join([Path(sys.argv[0]).name, *sys.argv[1:]])
    told = on_cell or (lambda *_: None)
    told(0, len(remaining))
    for done, (cell, found) in enumerate(outcomes(Cell.record, remaining), start=1):
        record = cell.failed(found) if isinstance(found, WorkerDiedError) else found
        record["made"]["command"] = command
        write_record(folder, cell, record)
        records[cell.id] = record
        told(done, len(remaining))
    return {name: records[name] for name in every}


# --- what is kept ------------------------------------------------------------------------------------------


def read_record(folder: Path, cell: Cell) -> Record | None:
    """Return the cell's record in a study's folder, or None if there is none that is as it was written.

    One without the files of its run is none either, where they are to be kept.
    """
    try:
        record = read_json(_file(folder, cell), "a cell")
    except InputError:
        return None
    if not isinstance(record, dict) or record.pop(DIGEST, None) != identity(record=record):
        return None
    if (record.get("format"), record.get("id")) != (FORMAT, cell.id):
        return None
    is_missing = cell.keep and not record["failure"] and not run_folder(folder, cell).exists()
    return None if is_missing else record


def write_record(folder: Path, cell: Cell, record: Record) -> None:
    """Write the record as a file of its own, whole or not at all, after the files of its run."""
    files = record.pop(FILES, None)
    if files is not None:
        with atomic_folder(run_folder(folder, cell), MAP_FILE, force=True) as run:
            for name, text in files.items():
                write_text(run / name, text)
    write_json(_file(folder, cell), {**record, DIGEST: identity(record=record)}, indent=1)


def of_other_code(folder: Path, cells: Iterable[Cell]) -> int:
    """Return the number of kept cells that mean the same as one of these and are of other code."""
    kept = {tuple(file.stem.split("-")) for file in (folder / CELLS).glob("[!.]*-*.json")}
    known = {cell.meaning: tuple(cell.id.split("-")) for cell in cells}
    return sum(known.get(one[0], one) != one for one in kept)


def run_folder(folder: Path, cell: Cell) -> Path:
    """Return the folder of the files of a run in that of its study."""
    return folder / CELLS / cell.id


def _file(folder: Path, cell: Cell) -> Path:
    return folder / CELLS / f"{cell.id}.json"


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


def outcomes(work: Callable[[W], R], items: Sequence[W]) -> Iterator[tuple[W, R | WorkerDiedError]]:
    """Yield (item, work(item)) in the order in which they finish; `work` must not raise.

    When a worker dies, nobody knows which item it had, so each item under way is tried again alone.
    """
    remaining, sent = dict(enumerate(items)), list[int]()

    def run(numbers: Iterable[int], **options: Any) -> Iterator[tuple[int, R]]:
        def tasks() -> Iterator[Any]:
            for number in numbers:
                sent.append(number)
                yield delayed(_numbered)(work, number, remaining[number])

        yield from Parallel(return_as="generator_unordered", batch_size=1, **options)(tasks())

    deaths = _deaths()
    while remaining:
        sent.clear()
        try:
            for number, result in run(list(remaining)):
                yield remaining.pop(number), result
        except deaths:
            for number in [number for number in sent if number in remaining]:
                try:
                    ((_, again),) = run([number], n_jobs=2)  # one job would be done by this very process
                except deaths as error:
                    died = WorkerDiedError(f"the process that ran it died ({type(error).__name__})")
                    yield remaining.pop(number), died
                else:
                    yield remaining.pop(number), again


def _numbered(work: Callable[[W], R], number: int, item: W) -> tuple[int, R]:
    return number, work(item)


def _deaths() -> tuple[type[Exception], ...]:
    try:
        from distributed import KilledWorker  # noqa: PLC0415 - an extra
    except ImportError:
        return (BrokenProcessPool,)
    return (BrokenProcessPool, KilledWorker)
