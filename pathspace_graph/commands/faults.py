"""`faults`: the suite of faults, each at three strengths beside the clean run, in parallel and resumable."""

from dataclasses import dataclass, replace

from pathspace_graph.estimators import DEFAULT
from pathspace_graph.eval.experiment.faults import only, strongest, suite
from pathspace_graph.eval.experiment.output import write_suite

from .studies import StudyCommand


@dataclass(frozen=True, kw_only=True)
class FaultSuite(StudyCommand):
    """Run every fault of the suite, or what remains of it, and write a table and a figure of what it costs.

    The suite is the shipped study `faults`. Each run is compared with the clean run on the same track and
    with the same seed.
    """

    estimator: str = DEFAULT
    """Name of the estimator, an online or a batch one."""
    only: tuple[str, ...] = ()
    """Names of the faults to run, as in the table."""
    quick: bool = False
    """Run each fault at its greatest strength only."""

    def run(self) -> None:
        """Check, run, write and report the suite; the exit code is 3 where runs failed."""
        chosen = replace(only(suite(), self.only), estimators=(self.estimator,))
        self.execute(strongest(chosen) if self.quick else chosen, write_suite)
