"""`ablate`, `faults`, `scale` and `report`: studies over many logs, in parallel and resumable."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Final

import pandas as pd
from tyro.conf import Positional, arg

from pathspace_graph.console import LINES, note, output, progress, say
from pathspace_graph.errors import SettingsError
from pathspace_graph.estimators import DEFAULT_ONLINE, ONLINE, check_online
from pathspace_graph.eval.benchmark import scaling as timing
from pathspace_graph.eval.benchmark.roads import QUICK, ScalingSettings, make_drives
from pathspace_graph.eval.benchmark.scaling import measure_scaling
from pathspace_graph.eval.experiment.drives import log_folders
from pathspace_graph.eval.experiment.faults import at_strength, only, suite, write_suite
from pathspace_graph.eval.experiment.run import make_plan, run_plan
from pathspace_graph.eval.experiment.runner import check_jobs, of_other_code, unfinished
from pathspace_graph.eval.experiment.study import Study, find_study, read_study_file
from pathspace_graph.eval.experiment.tables import write_study
from pathspace_graph.eval.report import Plan, write_report
from pathspace_graph.io.files import check_target, write_manifest
from pathspace_graph.settings.mapper import MapperSettings

CELLS_FAILED: Final = 3  # exit code of a study that is written, but some of whose cells failed


@dataclass(frozen=True, kw_only=True)
class StudyCommand:
    """Options of every command that runs a study."""

    out: Path
    """Folder for everything; a study that was begun there is continued."""
    jobs: int = -1
    """Number of processes at a time, -1 for one on each core."""
    cluster: str | None = None
    """Address of a Dask scheduler (tcp://HOST:8786) on whose workers the study runs instead."""
    keep: bool = False
    """Keep map, trajectory, cycles and summary of each run, in a folder of its cell."""
    retry_failed: bool = False
    """Run again what failed before."""
    tracks: tuple[str, ...] = ()
    """Track files, and seeds of generated tracks, in place of the study's own."""
    logs: tuple[Path, ...] = ()
    """Recorded logs, or folders of them, in place of the study's own drives, each of a track of its own."""
    seeds: tuple[int, ...] = ()
    """Seeds in place of the study's own."""
    laps: int | None = None
    """Number of laps in place of the study's own."""

    def execute(self, study: Study, write: Callable[[Study, pd.DataFrame, Path], str]) -> None:
        """Check and run a study, `write` it and print the text of it; exit with 3 where cells failed."""
        check_jobs(self.jobs)
        study = with_drives(study, self)
        plan = make_plan(study, keep=self.keep)
        if stale := of_other_code(self.out, plan.cells):
            note(f"{stale} runs in {self.out} are of other code, and are not used")
        with progress("runs", lines=LINES) as advance:
            how: dict[str, Any] = {"cluster": self.cluster, "retry_failed": self.retry_failed}
            frame = run_plan(plan, self.out, jobs=self.jobs, on_cell=advance, **how)
        text = write(study, frame, self.out)
        write_manifest(self.out)
        say(text.rstrip("\n"), f"\nwritten to {self.out}")
        failures = frame[frame["failure"] != ""]["failure"].tolist()
        if failures:
            note(f"{len(failures)} of {len(plan.cells)} cells failed, the first of {failures[0]}")
            raise SystemExit(CELLS_FAILED)


def with_drives(study: Study, given: StudyCommand) -> Study:
    """Return the study with the tracks (files, or seeds of generated ones), logs, seeds and laps given."""
    if given.laps is not None and given.laps < 1:
        raise SettingsError(f"--laps: expected at least 1, found {given.laps}")
    tracks = tuple(int(track) if track.isdecimal() else Path(track) for track in given.tracks)
    logs = {name: (folder,) for path in given.logs for name, folder in log_folders(path).items()}
    if tracks or logs:
        study = replace(study, tracks=tracks, logs=logs)
    chosen: dict[str, Any] = {"seeds": given.seeds, "laps": given.laps}
    return replace(study, **{name: value for name, value in chosen.items() if value})


@dataclass(frozen=True, kw_only=True)
class Ablate(StudyCommand):
    """Run a study, or what remains of it, and write its results, its summary and its figures."""

    study: Positional[Path]
    """TOML file of the study, or name of one that comes with the package."""
    baseline: str | None = None
    """Variant or estimator that the others are compared with, in place of the study's own; a finished study
    gets new tables only."""

    def run(self) -> None:
        study = read_study_file(find_study(self.study))
        self.execute(study if self.baseline is None else study.against(self.baseline), write_study)


@dataclass(frozen=True, kw_only=True)
class FaultSuite(StudyCommand):
    """Run the suite of faults, or what remains of it, and write a table and a figure of what each costs.

    The suite is the shipped study `faults`. Each run is compared with the clean run on the same track and
    with the same seed.
    """

    estimator: str = DEFAULT_ONLINE
    """Name of the estimator, an online or a batch one."""
    only: tuple[str, ...] = ()
    """Names of the faults to run, as in the table."""
    quick: bool = False
    """Run each fault at its greatest strength only."""

    def run(self) -> None:
        chosen = replace(only(suite(), self.only), estimators=(self.estimator,))
        self.execute(at_strength(chosen, 1.0) if self.quick else chosen, write_suite)


@dataclass(frozen=True, kw_only=True)
class Scale:
    """Time every online estimator on ever larger maps and more and more detections, and draw the slopes.

    All run in this one process, cycle for cycle in turn, so that other work of the machine slows all of them
    alike. An estimator that takes longer than the budget is stopped there, and the table says so. Memory is
    measured by tracemalloc, for Python and numpy, while the first lap of the closed road is mapped. Finished
    sweeps are kept in `OUT.unfinished` until all are there, so that the same command goes on where it was
    killed.
    """

    out: Path
    """Folder for points, slopes and figures; earlier ones there are kept as a numbered backup."""
    estimators: tuple[str, ...] = ()
    """Names of the online estimators; by default all."""
    quick: bool = False
    """Take less than a minute, with small maps and few laps, to see that everything works. It goes with no
    other `scaling` option."""
    scaling: ScalingSettings = field(default_factory=ScalingSettings)
    """What is measured."""
    settings: Annotated[MapperSettings, arg(name="")] = field(default_factory=MapperSettings)
    """Settings of every estimator."""

    def run(self) -> None:
        names = tuple(dict.fromkeys(self.estimators or ONLINE))
        for name in names:
            check_online(name, "--estimators")
        if self.quick and self.scaling != ScalingSettings():
            raise SettingsError("--quick: expected no other --scaling options with it, found some")
        check_target(self.out, timing.MARKER)
        measured = QUICK if self.quick else self.scaling
        with progress("simulating"):
            drives = make_drives(measured)
        with unfinished(self.out) as folder:
            with progress("timing", drives.cycles, lines=LINES) as advance:
                scaling = measure_scaling(names, drives, measured, self.settings, folder, advance)
            timing.write_scaling(self.out, scaling)
        output(wide=True).print(timing.scaling_table(scaling).rich())
        say(*timing.stops(scaling), f"written to {self.out}")


@dataclass(frozen=True, kw_only=True)
class Report:
    """Measure the figures of the pages, or what remains of them, and write each table as a tidy CSV.

    The experiments are `accuracy`, `skidpad`, `camera`, `faults`, `hard`, `lines`, `endurance`, `centerline`,
    the ablations `stations`, `gauge`, `robust`, `density`, `lag`, `relinearize`, `degree` and `covariance`,
    and `hints`, `known`, `joint`, `speed`, `scale` and, with logs, `real`. Each row of a table says by which
    command, at which commit, on which machine and when it was measured.
    """

    out: Path
    """Folder for the tables and the runs; a report that was begun there is continued."""
    jobs: int = -1
    """Number of processes at a time, -1 for one on each core."""
    only: tuple[str, ...] = ()
    """Names of the experiments to run."""
    tracks: tuple[Path, ...] = ()
    """Track files, or folders of them, that `accuracy` drives beside the generated tracks."""
    real: tuple[Path, ...] = ()
    """Folders of logs of a real car, which are mapped as well."""
    quick: bool = False
    """Drive little, to see that everything works."""

    def run(self) -> None:
        check_jobs(self.jobs)
        drives: dict[str, Any] = {"tracks": self.tracks, "real": self.real, "quick": self.quick}
        with progress("runs", lines=LINES) as advance:
            written = [*write_report(Plan(jobs=self.jobs, on_cell=advance, **drives), self.out, self.only)]
        for file, table in written:
            say(f"{file}\n{table.text()}\n")
