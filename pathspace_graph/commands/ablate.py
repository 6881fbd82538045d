"""`ablate`: a study over tracks, seeds, noise, estimators and settings, in parallel and resumable."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from tyro.conf import Positional

from pathspace_graph.eval.harness.workers import check_jobs
from pathspace_graph.eval.study.file import find_study, read_study
from pathspace_graph.eval.study.output import write_figures, write_tables
from pathspace_graph.eval.study.run import make_plan, run_plan
from pathspace_graph.progress import progress

from .studies import LINES, report_failures, with_drives


@dataclass(frozen=True, kw_only=True)
class Ablate:
    """Runs a study, or what remains of it, and writes its results, its summary and its figures."""

    study: Positional[Path]
    """The study is read from this TOML file, or is one that comes with the package, by its name."""
    out: Path
    """The study is written to this folder; a study that was begun there is continued."""
    jobs: int = -1
    """This number of processes runs at a time, -1 being one for each core."""
    cluster: str | None = None
    """The study runs on the workers of the Dask scheduler with this address (tcp://HOST:8786) instead."""
    retry_failed: bool = False
    """Cells that failed before are run again."""
    tracks: tuple[str, ...] = ()
    """These track files, and seeds of generated tracks, replace the study's own."""
    seeds: tuple[int, ...] = ()
    """These seeds replace the study's own."""
    laps: int | None = None
    """This number of laps replaces the study's own."""

    def run(self) -> None:
        """Checks, runs, writes and reports the study; the exit code is 3 where cells failed."""
        check_jobs(self.jobs)
        study = with_drives(read_study(find_study(self.study)), self.tracks, self.seeds, self.laps)
        plan = make_plan(study)
        with progress("cells", lines=LINES) as advance:
            frame = run_plan(plan, self.out, self.jobs, self.cluster, self.retry_failed, advance)
        summary = write_tables(study, frame, self.out)
        write_figures(study, frame, self.out)
        say = Console(soft_wrap=True, highlight=False, markup=False)
        say.print(summary, end="")
        say.print(f"\nwritten to {self.out}")
        report_failures(frame, len(plan.cells))
