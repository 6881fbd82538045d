"""`compare`: every estimator on one log or many, the paper's table and all that is measured besides."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Final

from rich.console import Console
from tyro.conf import Positional, arg

from pathspace_graph.eval.compare.comparison import Comparison, choose, choose_reference, compare, read_logs
from pathspace_graph.eval.compare.gap import with_gaps
from pathspace_graph.eval.compare.output import MARKER, tables, write_comparison
from pathspace_graph.eval.harness.workers import check_jobs
from pathspace_graph.eval.metrics.ghosts import GhostSettings
from pathspace_graph.io.files import check_target
from pathspace_graph.progress import progress
from pathspace_graph.settings.mapper import MapperSettings

FAILED: Final = 3
"""Exit code of a comparison that is written, but in which an estimator failed."""
FILE_WIDTH: Final = 160
"""Characters in a line of a table that doesn't go to a terminal."""


@dataclass(frozen=True, kw_only=True)
class Compare:
    """Run every estimator on a log, or on a folder of logs; write tables, figures and all maps.

    Of several logs the tables have means, and differences to the reference, paired over the logs, with their
    95 % confidence interval. An estimator that fails is reported and doesn't stop the others; the exit code
    is 3 then.
    """

    log: Positional[Path]
    """Log folder to read, or a folder of log folders."""
    out: Path
    """Folder for tables, figures and maps; an earlier comparison there is kept as a numbered backup."""
    estimators: tuple[str, ...] = ()
    """Names of the estimators, online and batch ones; all where none is named."""
    reference: str | None = None
    """The estimator that the others are held against: fixed-lag where it is compared, else the first."""
    jobs: int = 1
    """Runs at a time, -1 for every core. The times of updates are comparable with 1 job only."""
    ghosts: GhostSettings = field(default_factory=GhostSettings)
    """What counts as a ghost."""
    settings: Annotated[MapperSettings, arg(name="")] = field(default_factory=MapperSettings)
    """Of every estimator."""

    def run(self) -> None:
        """Check everything, run, write, and say what came out; exit code 3 where an estimator failed."""
        estimators = choose(self.estimators)
        reference = choose_reference(self.reference, estimators)
        check_jobs(self.jobs)
        check_target(self.out, MARKER)
        logs = read_logs(self.log)
        with progress("comparing", len(logs) * len(estimators)) as advance:
            comparison = compare(
                logs,
                estimators,
                self.settings,
                reference=reference,
                ghosts=self.ghosts,
                jobs=self.jobs,
                on_run=advance,
            )
        with progress("writing"):
            comparison = with_gaps(comparison)
            write_comparison(self.out, comparison, self.settings, self.jobs)
        self._report(comparison)

    def _report(self, comparison: Comparison) -> None:
        console = Console()
        if not console.is_terminal:
            console = Console(width=FILE_WIDTH)
        for table in tables(comparison).values():
            console.print(table.title, highlight=False, markup=False)
            for part in table.parts(console.width):
                console.print(part.rich())
        console.print(f"written to {self.out}", highlight=False, soft_wrap=True, markup=False)
        say = Console(stderr=True, soft_wrap=True, highlight=False, markup=False)
        for outcome in comparison.outcomes:
            if outcome.unsettled:
                say.print(f"{outcome.estimator} on {outcome.log}: not converged")
        for outcome in comparison.failures:
            say.print(f"{outcome.estimator} on {outcome.log}: failed, {outcome.failure}")
        if comparison.failures:
            raise SystemExit(FAILED)
