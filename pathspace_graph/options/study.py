"""`compare`, `ablate`, `faults`, `scale` and `report`: many runs, and their statistics."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from pathspace_graph.settings.estimators import BATCH_NAMES, ONLINE_NAMES
from pathspace_graph.settings.evaluation import ScalingSettings

from .map import Command, Estimation, FolderCommand, suggest

EVERY = (*ONLINE_NAMES, *BATCH_NAMES)
STUDIES = tuple(sorted(file.stem for file in (Path(__file__).parents[1] / "eval" / "studies").glob("*.toml")))


@dataclass(frozen=True, kw_only=True)
class Compare(Estimation, FolderCommand):
    """Run every estimator on a log or a folder of logs; or compare two maps.

    Of logs, tables, figures and all maps are written; of two maps, their distances and a picture.

    The paper's table is printed, or without truth what can be said without it; files have all metrics.
    For several logs the tables have means. An estimator that fails is reported and does not stop the others;
    the exit code is 3 then. Finished runs are kept in `OUT.unfinished` until all are there, so that the same
    command resumes after it was killed.
    """

    log: tuple[Path, ...] = field(kw_only=False)
    """Folder of the log, or of several logs; or the folders of two maps of one track."""
    out: Path
    """Folder for tables, figures and maps."""
    estimators: Annotated[tuple[str, ...], suggest(*EVERY)] = ()
    """Names of the estimators, online and batch ones; by default all."""
    jobs: int = 1
    """Number of runs at a time, -1 for one on each core; times of updates are comparable with 1 only."""


@dataclass(frozen=True, kw_only=True)
class StudyCommand(Command):
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


@dataclass(frozen=True, kw_only=True)
class Ablate(StudyCommand):
    """Run a study, or what remains of it, and write its results, its summary and its figures."""

    study: Annotated[Path, suggest(*STUDIES)] = field(kw_only=False)
    """TOML file of the study, or name of one that comes with the package."""
    baseline: str | None = None
    """Variant or estimator that the others are compared with, in place of the study's own; a finished study
    gets new tables only."""


@dataclass(frozen=True, kw_only=True)
class FaultSuite(StudyCommand):
    """Run the suite of faults, or what remains of it, and write a table and a figure of what each costs.

    The suite is the shipped study `faults`. Each run is compared with the clean run on the same track and
    with the same seed.
    """

    estimator: Annotated[str, suggest(*EVERY)] = ONLINE_NAMES[0]
    """Name of the estimator, an online or a batch one."""
    only: tuple[str, ...] = ()
    """Names of the faults to run, as in the table."""
    quick: bool = False
    """Run each fault at its greatest strength only."""


@dataclass(frozen=True, kw_only=True)
class Scale(Estimation, FolderCommand):
    """Time every online estimator on ever larger maps and more and more detections, and draw the slopes.

    All run in this one process, cycle for cycle in turn, so that other work of the machine slows all of them
    alike. An estimator that takes longer than the budget is stopped there, and the table says so. Finished
    sweeps are kept in `OUT.unfinished` until all are there, so that the same command goes on where it was
    killed.
    """

    out: Path
    """Folder for points, slopes and figures."""
    estimators: Annotated[tuple[str, ...], suggest(*ONLINE_NAMES)] = ()
    """Names of the online estimators; by default all."""
    quick: bool = False
    """Take less than a minute, with small maps and few laps, to see that everything works. It excludes all
    other `scaling` options."""
    scaling: ScalingSettings = field(default_factory=ScalingSettings)
    """What is measured."""


@dataclass(frozen=True, kw_only=True)
class Report(Command):
    """Measure the figures of the pages, or what remains of them, and write each table as a tidy CSV.

    The experiments are `accuracy`, `skidpad`, `camera`, `faults`, `hard`, `lines`, `endurance`, `centerline`,
    the ablations `stations`, `gauge`, `robust`, `density`, `lag`, `relinearize`, `degree` and `covariance`,
    and `known`, `joint`, `speed`, `scale` and, with logs, `real`. Each row of a table says by which
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
