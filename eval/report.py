"""The figures of the pages: each experiment measures some tables, which are written as tidy CSV.

An experiment is a study or a benchmark with a folder of its own, from which a stopped report goes on. A table
is named after its experiment. It has a row for each figure, and says by which command, at which commit, on
which machine and when it was measured. `docs/hooks.py` shows the files of `docs/figures` on the pages.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import pandas as pd

from pathspace_graph.errors import SettingsError, check_name
from pathspace_graph.settings.evaluation import ScalingSettings
from pathspace_graph.sim.mistakes import MISTAKES

from . import hints, joint, known, real, views
from .benchmark.measurement import figures, measure_drive
from .benchmark.roads import QUICK, make_drives
from .benchmark.scaling import measure_scaling, scaling_table
from .cars import on_tracks
from .experiment.drives import Drive, load_tracks
from .experiment.faults import at_strength, fault_table, kinds, only, outcomes, suite
from .experiment.frame import write_csv
from .experiment.provenance import made
from .experiment.rows import RowsOf, rows_of
from .experiment.run import run_study
from .experiment.study import Baseline, Study, find_study, read_study_file
from .experiment.tables import Quantity, Table
from .metrics.reference import landmark_limit
from .views import ESTIMATORS, LANDMARKS, ONLINE

ABLATIONS: Final = ("stations", "gauge", "robust", "density", "lag", "relinearize", "degree", "covariance")
"""Studies of parts of the method, driven by one estimator on generated tracks for two laps."""
GENERATED: Final = (0, 1, 2)  # seeds of the generated tracks, also of the benchmark
SPEED: Final = {  # figures of the benchmark: label, and digits
    "mean_by_isam2": ("mean update relative to iSAM2 with known data association", 2),
    "p99_by_isam2": ("99th percentile relative to that iSAM2", 2),
    "mean_by_landmark": ("mean update relative to landmark-fixed-lag", 2),
    "mean": ("mean update [ms]", 1),
    "p99": ("99th percentile of an update [ms]", 1),
    "closing": ("update that closes the loop [ms]", 1),
    "swap": ("update that swaps the map [ms]", 1),
    "slowest_other": ("slowest of all other updates [ms]", 1),
    "solve": ("batch of the open lap, in its own process [s]", 1),
}
CLOSING: Final = (  # metrics by which a map is compared with that of the batch, lap by lap
    *("rmse", "missed", "reach_median", "rmse_by_batch", "turn_from_batch", "turn_nees", "inside", "ate"),
)
COMPARED: Final = (  # metrics of the wider comparison
    *("missed_2m", "missed_1m", "rmse_capped", "mapped_to_truth", "truth_to_mapped", "ghost_landmarks"),
    *("ghost_metres", "along", "across", "nees", "inside", "closed", "bytes", "bytes_covariance"),
)
PAPER: Final = ("rmse", "missed", "size", "ate", "inside")
REACH: Final = ("reach_median", "reach_p10", "reach_short", "reach_error", "rmse")
CAMERA: Final = (
    *("rmse", "rmse_aligned", "missed", "closed", "nees", "turn_nees", "map_scale_nees", "reported_degraded"),
)
LINES: Final = ("rmse", "rmse_aligned", "missed", "closed", "size", "ate", "nees")
CENTRE_LINE: Final = (
    *("rmse", "missed", "nees", "inside", "centre", "centre_nees", "half_width", "half_width_nees"),
)

Tables = dict[str, Table]  # tables of an experiment, by what follows its name; empty for the one of that name


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What is driven; each experiment keeps its runs in a folder, and returns the tables that it measures."""

    quick: bool = False  # drive little, to see that everything works
    tracks: tuple[Path, ...] = ()  # folders of track files that are driven beside the generated tracks
    real: tuple[Path, ...] = ()  # folders of logs of a real car
    jobs: int = 1
    on_cell: Callable[[int, int], None] | None = None  # observer of the progress of a study

    def accuracy(self, folder: Path) -> Tables:
        """Drive every estimator on all tracks, with two seeds for three laps; later laps change little."""
        tracks: tuple[Path | int, ...] = GENERATED[:1] if self.quick else (*GENERATED, *self.tracks)
        estimators, laps = (ESTIMATORS[:3], 2) if self.quick else (ESTIMATORS, 3)
        drives: dict[str, Any] = {"tracks": tracks, "estimators": estimators, "seeds": (0, 1), "laps": laps}
        study = Study(name="accuracy", baseline=Baseline(estimator=ONLINE), metrics=PAPER, **drives)
        frame = self._run(study, folder)
        first = frame[(frame["lap"] == 1) & frame["estimator"].isin([ONLINE, LANDMARKS])]
        return {
            "": views.laps_table(frame, (1, 2, laps), CLOSING),
            "estimators": views.study_table(study, frame),
            "metrics": views.metrics_table(frame, COMPARED),
            "tracks": views.tracks_table(frame),
            "laps": views.rmse_table(frame),
            "reach": views.metrics_table(first, REACH),
        }

    def skidpad(self, folder: Path) -> Tables:
        seeds, names = tuple(range(2 if self.quick else 10)), ESTIMATORS[: 2 if self.quick else 4]
        study = Study(name="skidpad", tracks=(Path("skidpad"),), estimators=names, seeds=seeds, laps=1)
        return {"": views.skidpad_table(self._run(study, folder))}

    def camera(self, folder: Path) -> Tables:
        """Drive the study `camera` with one seed, whose noise is another one on each track."""
        study, frame = self._shipped("camera", folder, seeds=(0,))
        (noise,), (seed,), tracks = study.noise, study.seeds, load_tracks(study.tracks)
        drives = [Drive(track, seed, noise, study.simulation(noise)) for track in tracks]
        parts = [{"track": d.track, "settings": d.simulation, "seed": d.own_seed} for d in drives]
        limits = self._rows(landmark_limit, parts, folder / "landmarks")
        return {"": views.camera_table(frame, limits, CAMERA)}

    def hard(self, folder: Path) -> Tables:
        study, frame = self._shipped("hard", folder, seeds=(0,))
        return {"": views.laps_table(frame, (1, 2, study.laps), CLOSING)}

    def lines(self, folder: Path) -> Tables:
        """Drive the study `lines`, and the landmark graph where points are 4 m apart: each is a landmark."""
        study, frame = self._shipped("lines", folder / "curves", seeds=(0,))
        name = "4 m"
        beside = replace(study, estimators=(LANDMARKS,), noise={name: study.noise[name]})
        frame = pd.concat([frame, self._run(beside, folder / "landmarks")], ignore_index=True)
        return {"": views.runs_table(frame, ("noise", "estimator"), LINES)}

    def endurance(self, folder: Path) -> Tables:
        study, frame = self._shipped("endurance", folder, laps=30)
        shown = [lap for lap in (3, 10, 30) if lap <= study.laps] or [study.laps]
        return {"": views.laps_table(frame, shown, ("rmse", "inside", "nees", "ate"))}

    def centerline(self, folder: Path) -> Tables:
        """Drive estimators of two boundaries, whose centre line is compared with the true one."""
        return {"": views.metrics_table(self._shipped("centerline", folder, seeds=(0,))[1], CENTRE_LINE)}

    def ablation(self, folder: Path) -> Tables:
        """Drive the study of the folder's name for two laps, under the first and the last of its noises.

        One drive on each of four tracks: drives of one track are no independent samples.
        """
        name = folder.name
        noises = list(read_study_file(find_study(Path(name))).noise.items())
        small: dict[str, Any] = {"laps": 2, "noise": dict([noises[0], noises[-1]])}
        return {"": views.study_table(*self._shipped(name, folder, tracks=(0, 1, 2, 3), seeds=(0,), **small))}

    def faults(self, folder: Path) -> Tables:
        """Drive the suite of faults at the middle strengths."""
        study = at_strength(suite(), 0.5)
        if self.quick:
            study = replace(only(study, kinds(study)[:1]), tracks=(0,), laps=1)
        return {"": fault_table(study, outcomes(study, self._run(study, folder)))}

    def hints(self, folder: Path) -> Tables:
        tracks, mistakes = (GENERATED[:1], [*MISTAKES][:2]) if self.quick else (GENERATED, [*MISTAKES])
        return {"": hints.hints_table(self._rows(hints.judge, hints.parts_of(tracks, mistakes), folder))}

    def joint(self, folder: Path) -> Tables:
        tracks, drives = ((50,), 2) if self.quick else ((50, 51, 52), 8)
        return {"": joint.joint_table(self._rows(joint.of_track, on_tracks(tracks, drives=drives), folder))}

    def known(self, folder: Path) -> Tables:
        tracks, begins = ((60,), (0.3,)) if self.quick else (range(60, 68), (0.0, 0.3, 0.6))
        return {"": known.known_table(self._rows(known.of_track, on_tracks(tracks, begins=begins), folder))}

    def speed(self, _: Path) -> Tables:
        """Time every estimator in turn on the same cycles."""
        seeds, laps = (GENERATED[:1], 1) if self.quick else (GENERATED, 5)
        runs = [figures(measure_drive(seed, laps)) for seed in seeds]
        values = pd.DataFrame(runs).reindex(columns=[*SPEED])
        rows = ((label, Quantity.of(values[key], digits)) for key, (label, digits) in SPEED.items())
        return {"": Table(("figure", "measured"), tuple(rows))}

    def real_logs(self, folder: Path) -> Tables:
        if not self.real:
            raise SettingsError("--only real: expected logs in --real, found none")
        drives = real.map_real_logs(self.real, folder, **self._how)
        return {
            "runs": real.runs_table(drives),
            "maps": real.maps_table(drives),
            "joint": real.joint_table(drives),
            "measured": real.measured_table(drives),
        }

    def scale(self, folder: Path) -> Tables:
        settings = QUICK if self.quick else ScalingSettings(cones_max=800.0, laps=10)
        scaling = measure_scaling((ONLINE, LANDMARKS), make_drives(settings), settings, folder=folder)
        return {"": scaling_table(scaling)}

    def _shipped(self, name: str, folder: Path, **small: Any) -> tuple[Study, pd.DataFrame]:
        """Drive a shipped study, made smaller: with `quick` the first variant for one lap."""
        study = replace(read_study_file(find_study(Path(name))), **small)
        if self.quick:
            grids = tuple({key: values[:1] for key, values in grid.items()} for grid in study.grids[:1])
            variants = dict([*study.variants.items()][:1])
            study = replace(study, tracks=(0,), seeds=(0,), laps=1, variants=variants, grids=grids)
        return study, self._run(study, folder)

    def _run(self, study: Study, folder: Path) -> pd.DataFrame:
        return run_study(study, folder, **self._how)

    def _rows(self, function: RowsOf, parts: list[dict[str, Any]], folder: Path) -> pd.DataFrame:
        return rows_of(function, parts, folder, **self._how)

    @property
    def _how(self) -> dict[str, Any]:
        return {"jobs": self.jobs, "on_cell": self.on_cell}


EXPERIMENTS: Final[Mapping[str, Callable[[Plan, Path], Tables]]] = {
    "accuracy": Plan.accuracy,
    "skidpad": Plan.skidpad,
    "camera": Plan.camera,
    "faults": Plan.faults,
    "hard": Plan.hard,
    "lines": Plan.lines,
    "endurance": Plan.endurance,
    "centerline": Plan.centerline,
    **dict.fromkeys(ABLATIONS, Plan.ablation),
    "hints": Plan.hints,
    "known": Plan.known,
    "joint": Plan.joint,
    "speed": Plan.speed,
    "scale": Plan.scale,
    "real": Plan.real_logs,
}
QUICKEST: Final = ("accuracy", "skidpad", "camera", "faults", "robust", "hints", "speed", "scale")
"""Experiments of a quick report: the others have no view of their own."""


def write_report(plan: Plan, folder: Path, names: Sequence[str] = ()) -> Iterator[tuple[Path, Table]]:
    """Run experiments, by default all that the plan has logs for; write and yield each table."""
    for name in names:
        check_name(name, EXPERIMENTS, "--only: expected an experiment")
    every = QUICKEST if plan.quick else [name for name in EXPERIMENTS if name != "real" or plan.real]
    for name in names or every:
        for part, table in EXPERIMENTS[name](plan, folder / name).items():
            file = folder / f"{'_'.join(filter(None, (name, part)))}.csv"
            write_csv(file, table.tidy().assign(**provenance(plan, name)))
            yield file, table


def provenance(plan: Plan, name: str) -> dict[str, str]:
    """Return commit, machine and date of this run, and the command that measures an experiment again."""
    run = made(__name__)
    given = {"accuracy": " --tracks TRACKS" * bool(plan.tracks), "real": " --real LOGS"}.get(name, "")
    command = f"pathspace-graph report --only {name}{given}{' --quick' * plan.quick}"
    return {
        "commit": run["commit"],
        "machine": run["processor"],
        "date": run["date"][:10],
        "command": command,
    }
