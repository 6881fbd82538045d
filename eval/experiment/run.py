"""Studies run in parallel; every finished cell is kept at once, so that one that was killed goes on."""

import tempfile
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import pandas as pd

from pathspace_graph.errors import InputError, OutputError
from pathspace_graph.io.files import check_target, remove_manifest, to_plain, write_json
from pathspace_graph.io.log import Log
from pathspace_graph.io.manifest import verified
from pathspace_graph.io.overrides import flatten
from pathspace_graph.io.parsing import read_json

from .cells import Cell, Outcome, Record, Store, record_cell, record_of
from .drives import Drive, NamedTrack, load_tracks, try_drive
from .frame import frame_of
from .study import Study
from .workers import check_jobs, outcomes, workers

FORMAT: Final = "pathspace-study/1"
STUDY_FILE: Final = "study.json"
_PRESENTATION: Final = ("question", "metrics", "columns")
"""Keys that may change without making another study, since no cell depends on them."""

OnCell = Callable[[int, int], None]
"""Called with the number of cells that are done, and with the number of all cells."""


@dataclass(frozen=True, eq=False)
class Plan:
    """A study with its tracks and all of its cells."""

    study: Study
    """The study."""
    tracks: tuple[NamedTrack, ...]
    """Tracks of the study."""
    cells: tuple[Cell[Drive], ...]
    """Runs of the study, in the order of the results."""

    def resolved(self) -> dict[str, Any]:
        """Return the content of `study.json`: the study with every default written out."""
        study = self.study
        return {
            "format": FORMAT,
            "name": study.name,
            "question": study.question,
            "tracks": [{"name": track.name, "digest": track.digest} for track in self.tracks],
            "seeds": study.seeds,
            "laps": study.laps,
            "noise": {name: asdict(study.simulation(name)) for name in study.noise},
            "estimators": study.estimators,
            "varied": study.varied,
            "variants": {name: asdict(settings) for name, settings in study.points.items()},
            "baseline": {"variant": study.baseline_variant, "estimator": study.baseline.estimator},
            "metrics": study.metrics,
            "columns": study.columns,
            "yardsticks": study.yardsticks,
        }


def make_plan(study: Study) -> Plan:
    """Read and generate the tracks, and return the cells, grouped by the log that they share."""
    tracks, points = tuple(load_tracks(study.tracks)), study.points
    measured = {"marginals": True, "yardsticks": study.yardsticks}
    drives = [
        Drive(track, seed, noise, study.simulation(noise))
        for noise in study.noise
        for track in tracks
        for seed in study.seeds
    ]
    cells = [
        Cell(drive, estimator, settings, variant, measured)
        for drive in drives
        for estimator in study.estimators
        for variant, settings in points.items()
    ]
    return Plan(study, tracks, tuple(cells))


def run_study(
    study: Study,
    out: Path | str | None = None,
    *,
    jobs: int = 1,
    cluster: str | None = None,
    retry_failed: bool = False,
    on_cell: OnCell | None = None,
) -> pd.DataFrame:
    """Run the cells of a study that are missing, and return all of its results, a row per run and lap.

    Finished cells are kept in the folder `out`, if there is one. The cells run in `jobs` processes (-1:
    one for each core), or on the workers of the Dask scheduler at the address `cluster`. OutputError if
    the folder belongs to another study.
    """
    check_jobs(jobs)
    plan = make_plan(study)
    if out is None:
        with tempfile.TemporaryDirectory() as folder:
            return run_plan(plan, Path(folder), jobs, cluster, retry_failed, on_cell)
    return run_plan(plan, Path(out), jobs, cluster, retry_failed, on_cell)


def run_plan(
    plan: Plan, out: Path, jobs: int, cluster: str | None, retry_failed: bool, on_cell: OnCell | None = None
) -> pd.DataFrame:
    """Do the same for a plan."""
    check_folder(out, plan)
    remove_manifest(out)  # of a study that goes on; the last step writes it again
    store = Store(out)
    remaining = [cell for cell in plan.cells if _is_missing(store.read(cell), retry_failed)]
    with workers(jobs, cluster) if remaining else nullcontext():
        write_json(out / STUDY_FILE, plan.resolved(), indent=1)
        if remaining:
            _run_cells(remaining, store, on_cell or (lambda done, total: None))
    store.drop_logs()
    return frame_of(plan.study, [(cell, store.read(cell)) for cell in plan.cells])


def check_folder(out: Path, plan: Plan) -> None:
    """Raise OutputError if the folder holds another study, or something else."""
    check_target(out, STUDY_FILE)
    file = out / STUDY_FILE
    if not file.is_file():
        return
    try:
        with verified(out, STUDY_FILE):
            found = read_json(file, "a study")
    except InputError as error:
        raise OutputError(str(error)) from error
    if not isinstance(found, dict):
        raise OutputError(f"{file}: expected a study, found {type(found).__name__}")
    expected, other = (
        flatten({key: value for key, value in content.items() if key not in _PRESENTATION})
        for content in (to_plain(plan.resolved()), found)
    )
    for name in expected | other:
        if expected.get(name) != other.get(name):
            raise OutputError(
                f"{file}: expected the study that is to be run, with {name} = {expected.get(name)}, "
                f"found another, with {other.get(name)}"
            )


def _is_missing(record: Record | None, retry_failed: bool) -> bool:
    return record is None or (retry_failed and bool(record["failure"]))


# --- work ------------------------------------------------------------------------------------------------


def _run_cells(cells: Sequence[Cell[Drive]], store: Store, on_cell: OnCell) -> None:
    """Simulate each log that is needed once, then run the cells; every result is kept at once."""
    broken = _simulate(cells, store)
    doomed = [cell for cell in cells if cell.drive.id in broken]
    for cell in doomed:
        store.write(cell, record_of(cell, Outcome.failed(cell, broken[cell.drive.id])))
    on_cell(len(doomed), len(cells))
    runnable = [cell for cell in cells if cell.drive.id not in broken]
    work = outcomes(record_cell, runnable, _Logs(store).load)
    for done, (cell, found) in enumerate(work, start=len(doomed) + 1):
        record = found if isinstance(found, dict) else record_of(cell, Outcome.failed(cell, found))
        store.write(cell, record)
        on_cell(done, len(cells))


def _simulate(cells: Sequence[Cell[Drive]], store: Store) -> dict[str, Exception]:
    """Simulate and keep the missing logs, and return the errors of those that fail."""
    drives = {cell.drive.id: cell.drive for cell in cells}
    wanted = [drive for drive in drives.values() if not store.has_log(drive)]
    broken: dict[str, Exception] = {}
    for drive, log in outcomes(try_drive, wanted, lambda _: ()):
        if isinstance(log, Exception):
            broken[drive.id] = log
        else:
            store.write_log(drive, log)
    return broken


class _Logs:
    """Logs from disk, one in memory at a time: cells are in the order of their logs."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._kept: tuple[Drive, Log] | None = None

    def load(self, cell: Cell[Drive]) -> tuple[Log]:
        if self._kept is None or self._kept[0] is not cell.drive:
            self._kept = (cell.drive, self._store.read_log(cell.drive))
        return (self._kept[1],)
