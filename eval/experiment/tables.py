"""Tables in every form, and those of a study."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import repeat
from math import isfinite, nan
from pathlib import Path
from typing import Final, Self

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from rich.table import Table as RichTable
from rich.text import Text
from tabulate import LATEX_ESCAPE_RULES, SEPARATING_LINE, tabulate

from pathspace_graph.eval.figures.style import save_figures
from pathspace_graph.eval.metrics.metric import (
    HIGHER,
    LOWER,
    MEAN_DIGITS,
    METRICS,
    UNKNOWN,
    Metric,
)
from pathspace_graph.io.files import write_text

from .frame import COMBINATION, RUN, RUN_OF, Contrast, contrasts, last_laps, write_results
from .plots import plot_differences
from .statistics import FEWEST, LEVEL, Estimate, estimate
from .study import Study

_UNICODE: Final = str.maketrans(  # LaTeX for characters that not every font has
    {"–": "--", "σ": r"$\sigma$", "−": "$-$", "±": r"$\pm$", "²": r"$^2$", "×": r"$\times$"}
)
_MARKS: Final = ("\ue000", "\ue001")  # around what is bold until LaTeX is escaped
_BOLD: Final = {"pipe": ("**", "**"), "latex_booktabs": (r"\textbf{", "}")}  # around what is bold, by form


@dataclass(frozen=True)
class Quantity:
    """A measured value in the unit of a table, with half the width of its interval."""

    value: float | None  # None where it is unknown
    half: float | None = None
    digits: int = 3  # number of digits after the decimal point
    sign: str = ""  # `+` for a difference
    is_best: bool = False  # whether it is bold where the form of the table has that

    @classmethod
    def estimated(cls, of: Estimate, digits: int = 3, factor: float = 1.0, sign: str = "") -> Self:
        """Return a mean with its 95 % interval, times a factor."""
        value, half = (factor * float(x) if isfinite(x) else None for x in (of.mean, of.half))
        return cls(value, half, digits, sign)

    @classmethod
    def of(cls, values: ArrayLike, digits: int = 3, factor: float = 1.0) -> Self:
        """Return the mean of the known values (n,), times a factor."""
        array = np.asarray(values, float)
        return cls.estimated(estimate(array[np.isfinite(array)]), digits, factor)

    @classmethod
    def measured(cls, metric: Metric, value: float, half: float = nan) -> Self:
        """Return a value of a metric in its unit."""
        return cls.estimated(Estimate(value, half, 1), metric.digits, metric.factor)

    @classmethod
    def row(cls, values: Iterable[float], *digits: int) -> tuple[Self, ...]:
        """Return values without intervals, each with its own digits, or all with the same."""
        every = digits if len(digits) > 1 else repeat(*digits)
        return tuple(cls.estimated(Estimate(v, nan, 1), k) for v, k in zip(values, every, strict=False))

    @property
    def texts(self) -> tuple[str, str]:
        """Value and half width of its interval, rounded; empty where they are not known."""
        value = "" if self.value is None else f"{self.value:{self.sign}.{self.digits}f}"
        return value, "" if self.half is None else f"{self.half:.{self.digits}f}"

    def __str__(self) -> str:
        return " ± ".join(filter(None, self.texts)) or UNKNOWN


@dataclass(frozen=True)
class Table:
    """Rows of cells under a header: first names, left-aligned, then texts or figures, right-aligned.

    Rows of one first name are a group where several have it.
    """

    header: tuple[str, ...]
    rows: tuple[tuple[object, ...], ...]  # texts and quantities
    title: str = ""  # sentence above the table
    names: int = 1  # number of first columns that are names
    label: str = ""  # of the table in LaTeX

    @property
    def groups(self) -> tuple[int, ...]:
        """Numbers of the rows at which a new group begins."""
        starts = (k for k in range(1, len(self.rows)) if self.rows[k][0] != self.rows[k - 1][0])
        return tuple(starts) if len({row[0] for row in self.rows}) < len(self.rows) else ()

    def parts(self, width: int) -> list[Self]:
        """Return tables of at most `width` characters, each with the names and some of the other columns."""
        border = 3  # characters between two columns
        columns = zip(self.header, *self.rows, strict=True)
        needed = [max(len(str(cell)) for cell in column) + border for column in columns]
        shared = sum(needed[: self.names]) + 1
        parts: list[list[int]] = [[]]
        for number in range(self.names, len(self.header)):
            if parts[-1] and shared + sum(needed[k] for k in (*parts[-1], number)) > width:
                parts.append([])
            parts[-1].append(number)
        return [self._only([*range(self.names), *part]) for part in parts]

    def _only(self, columns: Sequence[int]) -> Self:
        rows = (tuple(row[k] for k in columns) for row in self.rows)
        return replace(self, header=tuple(self.header[k] for k in columns), rows=tuple(rows))

    def rich(self) -> RichTable:
        """Return the table for a terminal, without its title; units in brackets aren't taken for markup."""
        table = RichTable()
        for number, name in enumerate(self.header):
            table.add_column(Text(name), justify="left" if number < self.names else "right")
        for number, row in enumerate(self.rows):
            table.add_row(*(Text(str(cell)) for cell in row), end_section=number + 1 in self.groups)
        return table

    def records(self) -> list[dict[str, str]]:
        """Return the rows as texts by the names of their columns."""
        return [dict(zip(self.header, map(str, row), strict=True)) for row in self.rows]

    def tidy(self) -> pd.DataFrame:
        """Return a row for each figure: its row and column in the table, its value and half width."""
        figures = [
            (row[0], column, *(cell.texts if isinstance(cell, Quantity) else (cell, "")))
            for row in self.rows
            for column, cell in zip(self.header[1:], row[1:], strict=True)
        ]
        return pd.DataFrame(figures, columns=[self.header[0], "column", "value", "half_width"])

    def text(self) -> str:
        """Return the table for a text file: its title, and columns aligned by blanks."""
        return f"{self._above}{self._formatted('simple')}\n"

    def markdown(self) -> str:
        return f"{self._above}{self._formatted('pipe')}\n"

    def latex(self) -> str:
        """Return a `table` environment in LaTeX, with the title as its caption; it needs booktabs."""
        caption = "".join(LATEX_ESCAPE_RULES.get(character, character) for character in self.title)
        begin = ["% \\usepackage{booktabs}", r"\begin{table}", r"\centering", rf"\caption{{{caption}}}"]
        begin += [rf"\label{{{self.label}}}"] if self.label else []
        return "\n".join([*begin, self._formatted("latex_booktabs"), r"\end{table}", ""]).translate(_UNICODE)

    def write(self, folder: Path, name: str, *suffixes: str) -> None:
        """Write the table to a folder as `txt`, `md` or `tex`."""
        for suffix in suffixes:
            write_text(folder / f"{name}.{suffix}", FORMS[suffix](self))

    @property
    def _above(self) -> str:
        return f"{self.title}\n\n" if self.title else ""

    def _formatted(self, style: str) -> str:
        rows: list[Sequence[str] | str] = []
        for number, row in enumerate(self.rows):
            rows += [SEPARATING_LINE] * (style == "latex_booktabs" and number in self.groups)
            rows.append([_cell(cell, style) for cell in row])
        sides = ["left"] * self.names + ["right"] * (len(self.header) - self.names)
        text = str(tabulate(rows, self.header, tablefmt=style, colalign=sides, disable_numparse=True))
        for mark, bold in zip(_MARKS, _BOLD.get(style, ()), strict=False):
            text = text.replace(mark, bold)
        return text


def _cell(cell: object, style: str) -> str:
    text = str(cell).replace("|", r"\|") if style == "pipe" else str(cell)
    return text.join(_MARKS) if style in _BOLD and isinstance(cell, Quantity) and cell.is_best else text


FORMS: Final[Mapping[str, Callable[[Table], str]]] = {
    "txt": Table.text,
    "md": Table.markdown,
    "tex": Table.latex,
}
"""Forms of a table by the suffix of its file."""


# --- tables of studies ---------------------------------------------------------------------------------


def summary_tables(study: Study, frame: pd.DataFrame) -> list[Table]:
    """Return a table for each metric of the study that its runs have."""
    several, tables = names_of(frame, "variant"), []
    for metric in (METRICS[key] for key in study.metrics if key in frame):
        rows = []
        for contrast in contrasts(study, frame, metric.key):
            names, difference = (getattr(contrast, name) for name in several), contrast.difference
            by = "baseline" if difference is None else _mean(metric, difference, "+")
            tested = (_p(contrast.p), _p(contrast.wilcoxon), "*" if contrast.significant else "")
            rows.append((*names, str(contrast.runs), _mean(metric, contrast.value), by, *tested))
        header = (*several, "runs", "mean", "difference", "p", "Wilcoxon", "")
        tables.append(Table(header, tuple(rows), metric.heading, names=len(several)))
    return tables


def names_of(frame: pd.DataFrame, otherwise: str) -> list[str]:
    """Return the columns in which the combinations differ, or another one where there is only one."""
    return [name for name in COMBINATION if frame[name].nunique() > 1] or [otherwise]


def results_table(
    study: Study, frame: pd.DataFrame, keys: Sequence[str] = (), label: str = "tab:results"
) -> Table:
    """Return a row for each combination and a column for each metric, by default those of the study.

    A cell is the mean and its interval over the tracks, at the end of the last lap. The best mean of a noise
    is bold, where a metric has a best.
    """
    shown = [METRICS[key] for key in keys or study.metrics if key in frame]
    several = names_of(frame, "estimator")
    columns = [contrasts(study, frame, metric.key) for metric in shown]
    rows = []
    for of_row in zip(*columns, strict=True):
        means = (_mean(METRICS[one.metric], one.value) for one in of_row)
        best = (_is_best(one, column) for one, column in zip(of_row, columns, strict=True))
        cells = (replace(mean, is_best=is_best) for mean, is_best in zip(means, best, strict=True))
        rows.append((*(getattr(of_row[0], name) for name in several), *cells))
    header = (*several, *(metric.heading for metric in shown))
    title = f"{_about(study)} Mean and {_interval(frame)}{_laps(study)}."
    return Table(header, tuple(rows), title, len(several), label)


def _mean(metric: Metric, of: Estimate, sign: str = "") -> Quantity:
    return Quantity.estimated(of, max(metric.digits, MEAN_DIGITS), metric.factor, sign)


def _is_best(one: Contrast, column: Sequence[Contrast]) -> bool:
    """Whether the mean of a combination is the best of those of its noise, where they differ."""
    sign = (one.metric in LOWER) - (one.metric in HIGHER)
    means = [sign * of.value.mean for of in column if of.noise == one.noise and of.value.count]
    return bool(sign and len(set(means)) > 1) and sign * one.value.mean <= min(means)


def _about(study: Study) -> str:
    return f"{study.name}: {study.question}".strip()


def _laps(study: Study) -> str:
    return f", at the end of the last of {study.laps} laps" if study.tracks else ""


def _interval(frame: pd.DataFrame) -> str:
    """Return which interval stands beside a mean, and over what."""
    tracks = frame["track"].nunique()
    over = f"{tracks} tracks, each the mean of its drives" if tracks > 1 else "the drives of one track"
    samples = tracks if tracks > 1 else len(frame.groupby([*RUN]))
    kind = "bootstrap-t" if samples >= FEWEST else "Student's t"
    return f"{100 * LEVEL:g} % interval ({kind}) over {over}"


def _p(p: float) -> str:
    return "" if np.isnan(p) else f"{p:.3f}" if p >= 0.001 else "<0.001"


def caption(study: Study, frame: pd.DataFrame) -> str:
    """Return what the tables show, and how it was tested."""
    base = study.baseline
    against = f"{base.estimator}: {study.baseline_variant}" if base.estimator else study.baseline_variant
    runs = frame.groupby(list(RUN_OF), sort=False)["failure"].first()
    return (
        f"{_about(study)} "
        f"{len(runs)} runs ({int((runs != '').sum())} failed){_laps(study)}. "
        f"Mean and {_interval(frame)}; difference from {against} in the "
        f"same drives; p of the paired t-test over them, corrected by Holm's method over all comparisons of "
        f"the metric that differ at all, and p of Wilcoxon's signed-rank test, not corrected; * where p < "
        f"{1 - LEVEL:.2f}. Wall times are not tested."
    )


def joined(tables: Sequence[Table], caption: str, form: str) -> str:
    """Return the tables of a study in a form of `FORMS`, below their caption; in LaTeX each has it."""
    if form == "tex":
        return "\n".join(replace(table, title=f"{table.title}. {caption}").latex() for table in tables)
    if form == "md":
        caption, tables = caption.replace("*", r"\*"), [replace(t, title=f"**{t.title}**") for t in tables]
    return "\n".join([caption + "\n", *(FORMS[form](table) for table in tables)])


def track_tables(study: Study, frame: pd.DataFrame) -> list[Table]:
    """Return a table for each combination, track by track: the metrics of its runs at their last lap."""
    shown = [METRICS[key] for key in study.metrics if key in frame]
    header, titles = ("track", "runs", *(metric.heading for metric in shown)), names_of(frame, "estimator")
    tables = []
    for _, runs in frame.groupby([*COMBINATION], sort=False):
        rows = []
        for track, of in [*runs.groupby("track", sort=False), ("all", runs)]:
            last, count = last_laps(of), len(of.groupby([*RUN]))
            values = (Quantity.measured(m, m.over(last[m.key].astype(float))) for m in shown)
            rows.append((str(track), f"{len(last)} of {count}", *values))
        tables.append(Table(header, tuple(rows), ", ".join(str(runs[name].iloc[0]) for name in titles)))
    return tables


# --- files of studies ------------------------------------------------------------------------------------


def write_study(study: Study, frame: pd.DataFrame, out: Path) -> str:
    """Write results, times, figures and the summary in three forms, and return the text of the summary."""
    write_results(frame, out)
    tables, note = [*track_tables(study, frame), *summary_tables(study, frame)], caption(study, frame)
    for form in FORMS:
        write_text(out / f"summary.{form}", joined(tables, note, form))
    results_table(study, frame).write(out, "table", "tex")
    figure = plot_differences(study, frame)
    save_figures(out / "figures", {} if figure is None else {"differences": figure})
    return joined(tables, note, "txt")
