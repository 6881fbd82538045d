"""A study's summary: every combination beside its difference from the baseline, to read and to print."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import pandas as pd

from .online_table import markdown_table
from .study import Study
from .study_frame import COMBINATION, RUN
from .study_metrics import METRICS
from .study_statistics import CORRECTION, LEVEL, Comparison, Estimate, compare

SMALLEST_P: Final = 0.001
"""A p below it is only told to be."""
FIGURES: Final = ("runs", "mean", "95 %", "difference", "95 %", "p", "")
"""Columns of every table, after those that name the combination."""
Rows = list[tuple[str, ...]]


@dataclass(frozen=True)
class SummaryTable:
    """One metric of every combination, as text."""

    title: str
    """The metric with its unit."""
    header: tuple[str, ...]
    """Of the columns."""
    rows: Rows
    """One for each combination."""


def summary_tables(study: Study, frame: pd.DataFrame) -> list[SummaryTable]:
    """A table for each metric of the study that its runs have."""
    return [_table(study, frame, metric) for metric in study.metrics if metric in frame]


def caption(study: Study, frame: pd.DataFrame) -> str:
    """What the tables tell, and how it was tested."""
    base = study.baseline
    against = f"{base.estimator}: {study.baseline_variant}" if base.estimator else study.baseline_variant
    runs = frame.groupby([*RUN, *COMBINATION], sort=False)["failure"].first()
    return (
        f"{study.name}: {study.question} "
        f"{len(runs)} runs ({int((runs != '').sum())} failed) of {study.laps} laps, at the end of the last. "
        f"Mean and {100 * LEVEL:g} % interval (Student's t) over track x seed; difference from {against} "
        f"paired over track and seed; p of the paired t-test, corrected after {CORRECTION} over all "
        f"comparisons of the metric; * where p < {1 - LEVEL:.2f}."
    )


def _table(study: Study, frame: pd.DataFrame, metric: str) -> SummaryTable:
    several = [name for name in COMBINATION if frame[name].nunique() > 1] or ["variant"]
    header = (*several, *FIGURES)
    style = METRICS[metric]

    def row(comparison: Comparison) -> tuple[str, ...]:
        names = tuple(getattr(comparison, name) for name in several)
        value, difference = comparison.value, comparison.difference
        figures = (str(value.count), *_figures(value, style.factor, style.digits, ""))
        if difference is None:
            return (*names, *figures, "baseline", "", "", "")
        by = _figures(difference, style.factor, style.digits, "+")
        return (*names, *figures, *by, _p(comparison.p), "*" if comparison.significant else "")

    return SummaryTable(
        style.title, header, [row(comparison) for comparison in compare(study, frame, metric)]
    )


def _p(p: float) -> str:
    if np.isnan(p):
        return ""
    return f"{p:.3f}" if p >= SMALLEST_P else f"<{SMALLEST_P:g}"


def _figures(estimated: Estimate, factor: float, digits: int, sign: str) -> tuple[str, str]:
    if not estimated.count:
        return "", ""
    mean = f"{factor * estimated.mean:{sign}.{digits}f}"
    half = "" if np.isnan(estimated.half) else f"± {factor * estimated.half:.{digits}f}"
    return mean, half


def as_text(tables: Sequence[SummaryTable], told: str) -> str:
    """Columns aligned by blanks."""
    return "\n\n".join([told, *(f"{table.title}\n{_aligned(table)}" for table in tables)]) + "\n"


def _aligned(table: SummaryTable) -> str:
    lines = [table.header, *table.rows]
    widths = [max(len(line[i]) for line in lines) for i in range(len(table.header))]
    names = len(table.header) - len(FIGURES)

    def join(line: tuple[str, ...]) -> str:
        cells = (
            f"{text:<{width}}" if i < names else f"{text:>{width}}"
            for i, (text, width) in enumerate(zip(line, widths, strict=True))
        )
        return "  ".join(cells).rstrip()

    return "\n".join([join(table.header), "-" * (sum(widths) + 2 * len(widths) - 2), *map(join, table.rows)])


def as_markdown(tables: Sequence[SummaryTable], told: str) -> str:
    """For a README or an issue."""
    parts = [f"**{table.title}**\n\n{markdown_table(table.header, table.rows)}" for table in tables]
    return "\n\n".join([told.replace("*", r"\*"), *parts]) + "\n"


_LATEX: Final = str.maketrans(
    {
        "%": r"\%",
        "_": r"\_",
        "&": r"\&",
        "#": r"\#",
        "±": r"$\pm$",
        "σ": r"$\sigma$",
        "²": r"$^2$",
        "×": r"$\times$",
    }
)
"""What text means in LaTeX."""


def as_latex(tables: Sequence[SummaryTable], told: str) -> str:
    """A `table` for each metric; needs booktabs."""
    return "\n".join(_latex(table, told) for table in tables)


def _latex(table: SummaryTable, told: str) -> str:
    left = len(table.header) - len(FIGURES)
    columns = "l" * left + "r" * (len(table.header) - left)
    lines = [
        " & ".join(line).translate(_LATEX | {ord("&"): "&"}) + r" \\" for line in (table.header, *table.rows)
    ]
    return "\n".join(
        [
            r"\begin{table}",
            r"\centering",
            rf"\caption{{{f'{table.title}. {told}'.translate(_LATEX)}}}",
            rf"\begin{{tabular}}{{{columns}}}",
            r"\toprule",
            lines[0],
            r"\midrule",
            *lines[1:],
            r"\bottomrule",
            r"\end{tabular}",
            r"\end{table}",
            "",
        ]
    )
