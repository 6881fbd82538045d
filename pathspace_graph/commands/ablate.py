"""`ablate`: a study over tracks, seeds, noise, estimators and settings, in parallel and resumable."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from rich.console import Console
from tyro.conf import Positional

from pathspace_graph.errors import SettingsError
from pathspace_graph.eval.harness.workers import check_jobs
from pathspace_graph.eval.study.file import find_study, read_study
from pathspace_graph.eval.study.output import write_figures, write_tables
from pathspace_graph.eval.study.run import make_plan, run_plan
from pathspace_graph.eval.study.study import Study
from pathspace_graph.progress import progress

CELLS_FAILED: Final = 3
"""Exit code of a study that is written, but some of whose cells failed."""
LINES: Final = 20
"""A whole study writes about this many lines of progress where there is no terminal."""


@dataclass(frozen=True, kw_only=True)
class Ablate:
    """Run a study, or what is left of it, and write its results, its summary and its figures."""

    study: Positional[Path]
    """Study to run: a TOML file, or the name of one that comes with the package."""
    out: Path
    """The study's folder; one that was begun before goes on where it was."""
    jobs: int = -1
    """Processes at a time; -1 for every core."""
    cluster: str | None = None
    """Address of a Dask scheduler (tcp://HOST:8786) on whose workers the study runs instead."""
    retry_failed: bool = False
    """Run the cells again that failed before."""
    tracks: tuple[str, ...] = ()
    """In place of the study's own: track files, and seeds of generated tracks."""
    seeds: tuple[int, ...] = ()
    """In place of the study's own."""
    laps: int | None = None
    """In place of the study's own."""

    def run(self) -> None:
        """Check everything, run, write, and say what came out; exit code 3 where cells failed."""
        check_jobs(self.jobs)
        study = self._study()
        plan = make_plan(study)
        with progress("cells", lines=LINES) as advance:
            frame = run_plan(plan, self.out, self.jobs, self.cluster, self.retry_failed, advance)
        summary = write_tables(study, frame, self.out)
        write_figures(study, frame, self.out)
        say = Console(soft_wrap=True, highlight=False, markup=False)
        say.print(summary, end="")
        say.print(f"\nwritten to {self.out}")
        failures = frame[frame["failure"] != ""]
        if len(failures):
            first = failures.iloc[0]
            line = f"{len(failures)} of {len(plan.cells)} cells failed, the first of {first['failure']}"
            Console(stderr=True, soft_wrap=True, highlight=False, markup=False).print(line)
            raise SystemExit(CELLS_FAILED)

    def _study(self) -> Study:
        study = read_study(find_study(self.study))
        own = {name: value for name in ("seeds", "laps") if (value := getattr(self, name))}
        if self.laps is not None and self.laps < 1:
            raise SettingsError(f"--laps: expected at least 1, found {self.laps}")
        if self.tracks:
            own["tracks"] = tuple(int(t) if t.isdecimal() else Path(t) for t in self.tracks)
        return replace(study, **own)
