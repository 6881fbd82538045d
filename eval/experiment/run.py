"""Studies run in parallel; every finished cell is kept at once, so that one that was killed goes on."""

import tempfile
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Any, Final

import pandas as pd

from pathspace_graph.errors import InputError, OutputError
from pathspace_graph.io.files import check_target, remove_manifest, to_plain, write_json
from pathspace_graph.io.manifest import verified
from pathspace_graph.io.overrides import flatten
from pathspace_graph.io.parsing import read_json

from .cells import (
    Cell,
    Drive,
    NamedTrack,
    Outcome,
    Record,
    load_tracks,
    read_record,
    record_cell,
    record_of,
    write_record,
)
from .frame import frame_of
from .study import Study
from .workers import WorkerDiedError, check_jobs, outcomes, workers

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
    tracks: tuple[NamedTrack, ...]
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
    drives = product(study.noise, tracks, study.seeds)
    cells = tuple(
        Cell(drive, estimator, settings, variant, measured)
        for drive in (Drive(track, seed, noise, study.simulation(noise)) for noise, track, seed in drives)
        for estimator, (variant, settings) in product(study.estimators, points.items())
    )
    return Plan(study, tracks, cells)


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
    remaining = [cell for cell in plan.cells if _is_missing(read_record(out, cell), retry_failed)]
    with workers(jobs, cluster) if remaining else nullcontext():
        write_json(out / STUDY_FILE, plan.resolved(), indent=1)
        on_cell = on_cell or (lambda done, total: None)
        on_cell(0, len(remaining))
        for done, (cell, result) in enumerate(outcomes(record_cell, remaining), start=1):
            if isinstance(result, WorkerDiedError):
                write_record(out, cell, record_of(cell, Outcome.failed(cell, result)))
            else:
                write_record(out, cell, result)
            on_cell(done, len(remaining))
    return frame_of(plan.study, [(cell, read_record(out, cell)) for cell in plan.cells])


def _is_missing(record: Record | None, retry_failed: bool) -> bool:
    return record is None or (retry_failed and bool(record["failure"]))


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
