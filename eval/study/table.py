"""A study's summary: every combination beside its difference from the baseline, to read and to print."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
import pandas as pd

from pathspace_graph.eval.metrics.measures import MEAN_DIGITS, METRICS
from pathspace_graph.eval.metrics.paired import CORRECTION, LEVEL, Estimate
from pathspace_graph.eval.metrics.text_table import TextTable

from .frame import COMBINATION, RUN
from .statistics import Contrast, contrasts
from .study import Study

SMALLEST_P: Final = 0.001
"""A p below it is only told to be."""
FIGURES: Final = ("runs", "mean", "95 %", "difference", "95 %", "p", "")
"""Columns of every table, after those that name the combination."""


def summary_tables(study: Study, frame: pd.DataFrame) -> list[TextTable]:
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


def _table(study: Study, frame: pd.DataFrame, key: str) -> TextTable:
    several = [name for name in COMBINATION if frame[name].nunique() > 1] or ["variant"]
    header = (*several, *FIGURES)
    metric = METRICS[key]
    digits = max(metric.digits, MEAN_DIGITS)

    def row(contrast: Contrast) -> tuple[str, ...]:
        names = tuple(getattr(contrast, name) for name in several)
        value, difference = contrast.value, contrast.difference
        figures = (str(value.count), *_figures(value, metric.factor, digits, ""))
        if difference is None:
            return (*names, *figures, "baseline", "", "", "")
        by = _figures(difference, metric.factor, digits, "+")
        return (*names, *figures, *by, _p(contrast.p), "*" if contrast.significant else "")

    rows = tuple(row(contrast) for contrast in contrasts(study, frame, key))
    return TextTable(metric.heading, header, rows, names=len(several))


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


def as_text(tables: Sequence[TextTable], told: str) -> str:
    """Columns aligned by blanks."""
    return "\n\n".join([told, *(f"{table.title}\n{table.text()}" for table in tables)]) + "\n"


def as_markdown(tables: Sequence[TextTable], told: str) -> str:
    """For a README or an issue."""
    bold = (replace(table, title=f"**{table.title}**") for table in tables)
    return "\n".join([told.replace("*", r"\*") + "\n", *(table.markdown() for table in bold)])


def as_latex(tables: Sequence[TextTable], told: str) -> str:
    """A `table` for each metric, each with its own caption."""
    return "\n".join(replace(table, title=f"{table.title}. {told}").latex() for table in tables)
