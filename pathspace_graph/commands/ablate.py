"""`ablate`: a study over tracks, seeds, noise, estimators and settings, in parallel and resumable."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pandas as pd
from tyro.conf import Positional

from pathspace_graph.eval.study.file import find_study, read_study
from pathspace_graph.eval.study.output import write_figures, write_tables
from pathspace_graph.eval.study.study import Study

from .studies import StudyCommand


@dataclass(frozen=True, kw_only=True)
class Ablate(StudyCommand):
    """Runs a study, or what remains of it, and writes its results, its summary and its figures."""

    study: Positional[Path]
    """The study is read from this TOML file, or is one that comes with the package, by its name."""

    def run(self) -> None:
        """Checks, runs, writes and reports the study; the exit code is 3 where cells failed."""
        self.execute(read_study(find_study(self.study)), write_results)


def write_results(study: Study, frame: pd.DataFrame, folder: Path) -> str:
    """Writes the tables and the figures of a study to a folder, and returns its summary."""
    summary = write_tables(study, frame, folder)
    write_figures(study, frame, folder)
    return summary
