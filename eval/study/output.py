"""The tables and figures in the folder of a finished study."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import pandas as pd

from pathspace_graph.eval.figures.files import SUFFIXES, render
from pathspace_graph.io.files import replacing, write_text

from .by_track import track_tables
from .frame import times_of, without_times
from .plot import figures
from .study import Study
from .table import as_latex, as_markdown, as_text, caption, summary_tables

RESULTS: Final = "results.csv"
TIMES: Final = "times.csv"


def write_tables(study: Study, frame: pd.DataFrame, out: Path) -> str:
    """Writes `results.csv`, `times.csv` and the summary in three forms, and returns its text."""
    write_results(frame, out)
    tables, note = [*track_tables(study, frame), *summary_tables(study, frame)], caption(study, frame)
    text = as_text(tables, note)
    write_text(out / "summary.txt", text)
    write_text(out / "summary.md", as_markdown(tables, note))
    write_text(out / "summary.tex", as_latex(tables, note))
    return text


def write_results(frame: pd.DataFrame, out: Path) -> None:
    """Writes `results.csv` and `times.csv`."""
    for name, table in ((RESULTS, without_times(frame)), (TIMES, times_of(frame))):
        with replacing(out / name) as temporary:
            table.to_csv(temporary, index=False, lineterminator="\n")


def write_figures(study: Study, frame: pd.DataFrame, out: Path) -> None:
    """Writes each figure as a picture and as vectors."""
    for name, figure in figures(study, frame).items():
        for suffix in SUFFIXES:
            with replacing(out / "figures" / f"{name}{suffix}") as temporary:
                render(figure, temporary, suffix)
