"""`compare`: every estimator on one log or many, the paper's table, and all further metrics."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Final

from tyro.conf import Positional, arg

from pathspace_graph.console import note, output, progress, say
from pathspace_graph.eval.experiment import compare as experiment
from pathspace_graph.eval.experiment.compare import MARKER, Comparison, compare, tables, write_comparison
from pathspace_graph.eval.experiment.run import check_jobs
from pathspace_graph.eval.metrics.accuracy import GhostSettings
from pathspace_graph.io.files import check_target
from pathspace_graph.settings.mapper import MapperSettings

from .online import tell

FAILED: Final = 3
"""Exit code of a comparison that is written, but in which an estimator failed."""


@dataclass(frozen=True, kw_only=True)
class Compare:
    """Run every estimator on a log, or on a folder of logs, and write tables, figures and all maps.

    For several logs the tables have means, and differences from the reference, paired over the logs, with
    their 95 % confidence interval. An estimator that fails is reported and does not stop the others; the exit
    code is 3 then.
    """

    log: Positional[Path]
    """Folder of the log, or of several logs."""
    out: Path
    """Folder for tables, figures and maps; an earlier comparison there is kept as a numbered backup."""
    estimators: tuple[str, ...] = ()
    """Names of the estimators, online and batch ones; by default all."""
    reference: str | None = None
    """Estimator that the others are compared with: fixed-lag where it runs, otherwise the first."""
    jobs: int = 1
    """Number of runs at a time, -1 for one on each core; times of updates are comparable with 1 only."""
    ghosts: GhostSettings = field(default_factory=GhostSettings)
    """Definition of a ghost."""
    settings: Annotated[MapperSettings, arg(name="")] = field(default_factory=MapperSettings)
    """Settings of every estimator."""

    def run(self) -> None:
        estimators = experiment.choose(self.estimators)
        reference = experiment.choose_reference(self.reference, estimators)
        check_jobs(self.jobs)
        check_target(self.out, MARKER)
        logs = experiment.read_logs(self.log, self.settings.limits)
        for named in logs:
            tell(named.hints, of=named.name if len(logs) > 1 else "")
        with progress("comparing", len(logs) * len(estimators)) as advance:
            how: dict[str, Any] = {"reference": reference, "ghosts": self.ghosts, "jobs": self.jobs}
            comparison = compare(logs, estimators, self.settings, on_run=advance, **how)
        with progress("writing"):
            write_comparison(self.out, comparison, self.settings, self.jobs)
        self._report(comparison)

    def _report(self, comparison: Comparison) -> None:
        console = output(wide=True)
        for table in tables(comparison).values():
            console.print(table.title, highlight=False, markup=False)
            for part in table.parts(console.width):
                console.print(part.rich())
        say(f"written to {self.out}")
        told = [(outcome.names, "not converged") for outcome in comparison.unsettled]
        told += [(outcome.names, f"failed, {outcome.failure}") for outcome in comparison.failures]
        note(*(f"{names['estimator']} on {names['log']}: {what}" for names, what in told))
        if comparison.failures:
            raise SystemExit(FAILED)
