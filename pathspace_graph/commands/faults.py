"""`faults`: the suite of faults, each at three strengths beside the clean run, in parallel and resumable."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from rich.console import Console

from pathspace_graph.estimators import DEFAULT
from pathspace_graph.eval.faults.output import write_suite
from pathspace_graph.eval.faults.suite import only, strongest, suite
from pathspace_graph.eval.harness.workers import check_jobs
from pathspace_graph.eval.study.run import make_plan, run_plan
from pathspace_graph.eval.study.study import Study
from pathspace_graph.progress import progress

from .studies import LINES, report_failures, with_drives


@dataclass(frozen=True, kw_only=True)
class FaultSuite:
    """Runs every fault of the suite, or what remains of it, and writes a table and a figure of what it costs.

    The suite is the shipped study `faults`. Each run is compared with the clean run on the same track and
    with the same seed.
    """

    out: Path
    """The suite is written to this folder; a suite that was begun there is continued."""
    estimator: str = DEFAULT
    """This estimator runs, an online or a batch one."""
    only: tuple[str, ...] = ()
    """Only these faults are run, by the names of the table."""
    quick: bool = False
    """Each fault is run at its greatest strength only."""
    jobs: int = -1
    """This number of processes runs at a time, -1 being one for each core."""
    cluster: str | None = None
    """The suite runs on the workers of the Dask scheduler with this address (tcp://HOST:8786) instead."""
    retry_failed: bool = False
    """Runs that failed before are run again."""
    tracks: tuple[str, ...] = ()
    """These track files, and seeds of generated tracks, replace the suite's own."""
    seeds: tuple[int, ...] = ()
    """These seeds replace the suite's own."""
    laps: int | None = None
    """This number of laps replaces the suite's own."""

    def run(self) -> None:
        """Checks, runs, writes and reports the suite; the exit code is 3 where runs failed."""
        check_jobs(self.jobs)
        study = with_drives(self._chosen(), self.tracks, self.seeds, self.laps)
        plan = make_plan(study)
        with progress("runs", lines=LINES) as advance:
            frame = run_plan(plan, self.out, self.jobs, self.cluster, self.retry_failed, advance)
        text = write_suite(study, frame, self.out)
        say = Console(soft_wrap=True, highlight=False, markup=False)
        say.print(text)
        say.print(f"written to {self.out}")
        report_failures(frame, len(plan.cells))

    def _chosen(self) -> Study:
        chosen = replace(only(suite(), self.only), estimators=(self.estimator,))
        return strongest(chosen) if self.quick else chosen
