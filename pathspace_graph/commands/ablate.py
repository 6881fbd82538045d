"""`ablate`: a study over tracks, seeds, noise, estimators and settings, in parallel and resumable."""

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from pathspace_graph.eval.experiment.output import write_study
from pathspace_graph.eval.experiment.study import find_study, read_study

from .studies import StudyCommand


@dataclass(frozen=True, kw_only=True)
class Ablate(StudyCommand):
    """Run a study, or what remains of it, and write its results, its summary and its figures."""

    study: Positional[Path]
    """TOML file of the study, or name of one that comes with the package."""

    def run(self) -> None:
        """Check, run, write and report the study; the exit code is 3 where cells failed."""
        self.execute(read_study(find_study(self.study)), write_study)
