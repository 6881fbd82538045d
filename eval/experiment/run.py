"""Studies as they run: their plan, the cells that are missing, and the frame of all of them."""

import tempfile
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from itertools import combinations, product
from pathlib import Path
from typing import Any, Final

import pandas as pd

from pathspace_graph import estimators as registry
from pathspace_graph.errors import InputError, OutputError
from pathspace_graph.eval.metrics.alignment import aligned_distance
from pathspace_graph.io.files import check_target, write_json
from pathspace_graph.io.map import MAP_FILE, Map, read_map
from pathspace_graph.io.parsing import read_json, shown
from pathspace_graph.sim.track import Track

from .cells import EstimatorCell
from .drives import AnyDrive, Drive, RecordedDrive, load_tracks, track_digest
from .frame import frame_of
from .provenance import code_of, here
from .runner import OnCell, Record, run_cells, run_folder, workers
from .study import Study

FORMAT: Final = "pathspace-study/1"
STUDY_FILE: Final = "study.json"


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
    that of `run_plan`.
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

    It runs in `jobs` processes (-1: one for each core), or on the workers of a Dask scheduler.
    """
    check_folder(out, plan)
    with workers(jobs, cluster):
        write_json(out / STUDY_FILE, plan.resolved(), indent=1)
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


def check_folder(out: Path, plan: Plan) -> None:
    """Raise OutputError if the folder holds something else, or a study of another name.

    One of the name may have changed: cells are used wherever they mean the same.
    """
    check_target(out, STUDY_FILE, force=True)
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
