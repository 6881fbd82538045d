"""The summary of a study: every combination beside its difference from the baseline, as text."""

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
"""A p below this is shown as smaller than it."""
FIGURES: Final = ("runs", "mean", "95 %", "difference", "95 %", "p", "")
"""Every table has these columns after those that name the combination."""


def summary_tables(study: Study, frame: pd.DataFrame) -> list[TextTable]:
    """Returns a table for each metric of the study that its runs have."""
    return [_table(study, frame, metric) for metric in study.metrics if metric in frame]


def caption(study: Study, frame: pd.DataFrame) -> str:
    """Returns what the tables show, and how it was tested."""
    base = study.baseline
    against = f"{base.estimator}: {study.baseline_variant}" if base.estimator else study.baseline_variant
    runs = frame.groupby([*RUN, *COMBINATION], sort=False)["failure"].first()
    return (
        f"{study.name}: {study.question} "
        f"{len(runs)} runs ({int((runs != '').sum())} failed) of {study.laps} laps, at the end of the last. "
        f"Mean and {100 * LEVEL:g} % interval (Student's t) over track x seed; difference from {against} "
        f"paired over track and seed; p of the paired t-test, corrected by {CORRECTION}'s method over all "
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


def as_text(tables: Sequence[TextTable], caption: str) -> str:
    """Returns the caption and the tables for a text file."""
    return "\n\n".join([caption, *(f"{table.title}\n{table.text()}" for table in tables)]) + "\n"


def as_markdown(tables: Sequence[TextTable], caption: str) -> str:
    """Returns the caption and the tables in Markdown."""
    bold = (replace(table, title=f"**{table.title}**") for table in tables)
    return "\n".join([caption.replace("*", r"\*") + "\n", *(table.markdown() for table in bold)])


def as_latex(tables: Sequence[TextTable], caption: str) -> str:
    """Returns a `table` environment for each metric, each with the whole caption."""
    return "\n".join(replace(table, title=f"{table.title}. {caption}").latex() for table in tables)
