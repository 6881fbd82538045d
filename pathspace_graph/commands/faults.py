"""`faults`: the suite of faults, each at three strengths beside the clean run, in parallel and resumable."""

from dataclasses import dataclass, replace

from pathspace_graph.estimators import DEFAULT
from pathspace_graph.eval.experiment.faults import only, strongest, suite
from pathspace_graph.eval.experiment.output import write_suite

from .studies import StudyCommand


@dataclass(frozen=True, kw_only=True)
class FaultSuite(StudyCommand):
    """Runs every fault of the suite, or what remains of it, and writes a table and a figure of what it costs.

    The suite is the shipped study `faults`. Each run is compared with the clean run on the same track and
    with the same seed.
    """

    estimator: str = DEFAULT
    """This estimator runs, an online or a batch one."""
    only: tuple[str, ...] = ()
    """Only these faults are run, by the names of the table."""
    quick: bool = False
    """Each fault is run at its greatest strength only."""

    def run(self) -> None:
        """Checks, runs, writes and reports the suite; the exit code is 3 where runs failed."""
        chosen = replace(only(suite(), self.only), estimators=(self.estimator,))
        self.execute(strongest(chosen) if self.quick else chosen, write_suite)
