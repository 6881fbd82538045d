"""What the commands that run a study share: their options, how a study is run, and what failed."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import pandas as pd
from rich.console import Console

from pathspace_graph.errors import SettingsError
from pathspace_graph.eval.experiment.run import make_plan, run_plan
from pathspace_graph.eval.experiment.study import Study
from pathspace_graph.eval.experiment.workers import check_jobs
from pathspace_graph.io.files import write_manifest
from pathspace_graph.progress import progress

CELLS_FAILED: Final = 3
"""Exit code of a study that is written, but some of whose cells failed."""
LINES: Final = 20
"""About the number of lines of progress of a whole study where there is no terminal."""


@dataclass(frozen=True, kw_only=True)
class StudyCommand:
    """Options of every command that runs a study."""

    out: Path
    """Folder for everything; a study that was begun there is continued."""
    jobs: int = -1
    """Number of processes at a time, -1 for one on each core."""
    cluster: str | None = None
    """Address of a Dask scheduler (tcp://HOST:8786) on whose workers the study runs instead."""
    retry_failed: bool = False
    """Run again what failed before."""
    tracks: tuple[str, ...] = ()
    """Track files, and seeds of generated tracks, in place of the study's own."""
    seeds: tuple[int, ...] = ()
    """Seeds in place of the study's own."""
    laps: int | None = None
    """Number of laps in place of the study's own."""

    def execute(self, study: Study, write: Callable[[Study, pd.DataFrame, Path], str]) -> None:
        """Check, run, write and report a study; the exit code is 3 where cells failed.

        `write` writes the results to the folder, and returns the text that is printed.
        """
        check_jobs(self.jobs)
        study = with_drives(study, self.tracks, self.seeds, self.laps)
        plan = make_plan(study)
        with progress("runs", lines=LINES) as advance:
            frame = run_plan(plan, self.out, self.jobs, self.cluster, self.retry_failed, advance)
        say = Console(soft_wrap=True, highlight=False, markup=False)
        text = write(study, frame, self.out)
        write_manifest(self.out)
        say.print(text.rstrip("\n"))
        say.print(f"\nwritten to {self.out}")
        report_failures(frame, len(plan.cells))


def with_drives(study: Study, tracks: tuple[str, ...], seeds: tuple[int, ...], laps: int | None) -> Study:
    """Return the study with other tracks, seeds and laps, where any are given.

    A track is a file, or the seed of a generated track.
    """
    if laps is not None and laps < 1:
        raise SettingsError(f"--laps: expected at least 1, found {laps}")
    own: dict[str, object] = {"seeds": seeds} if seeds else {}
    own |= {"laps": laps} if laps else {}
    own |= {"tracks": tuple(int(t) if t.isdecimal() else Path(t) for t in tracks)} if tracks else {}
    return replace(study, **own)  # type: ignore[arg-type]


def report_failures(frame: pd.DataFrame, cells: int) -> None:
    """Say on standard error how many cells failed, and exit with code 3 where any did."""
    failures = frame[frame["failure"] != ""]
    if len(failures):
        line = f"{len(failures)} of {cells} cells failed, the first of {failures.iloc[0]['failure']}"
        Console(stderr=True, soft_wrap=True, highlight=False, markup=False).print(line)
        raise SystemExit(CELLS_FAILED)
