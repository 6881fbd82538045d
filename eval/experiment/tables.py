"""Tables of texts in every form, those of a study, and the files of its results."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
import pandas as pd
from rich.table import Table as RichTable
from rich.text import Text
from tabulate import LATEX_ESCAPE_RULES

from pathspace_graph.eval.figures.style import save_figures
from pathspace_graph.eval.metrics.measures import METRICS, UNKNOWN, Metric, figure
from pathspace_graph.io.files import replacing, write_text

from .plots import plot_differences
from .statistics import (
    COMBINATION,
    LEVEL,
    RUN,
    RUN_OF,
    TIMES,
    Estimate,
    by_track,
    contrasts,
    estimate,
    last_laps,
)
from .study import Study

MADE: Final = ("commit", "host", "processor", "blas", "date", "command")  # where and when a run was made
MEAN_DIGITS: Final = 2  # least number of digits after the decimal point of a mean beside its difference
FORMS: Final = {"txt": "simple", "md": "pipe"}  # form in tabulate by the suffix of a file
_UNICODE: Final = str.maketrans(  # LaTeX for characters that not every font has
    {"–": "--", "σ": r"$\sigma$", "−": "$-$", "±": r"$\pm$", "²": r"$^2$", "×": r"$\times$"}
)


@dataclass(frozen=True, eq=False)
class Table:
    """Texts in columns below a title: first names, left-aligned, then figures, right-aligned."""

    frame: pd.DataFrame
    title: str = ""  # sentence above the table
    names: int = 1  # number of first columns that are names
    label: str = ""  # of the table in LaTeX
    best: pd.DataFrame | None = None  # which texts are bold in LaTeX

    @classmethod
    def of(
        cls, header: Iterable[str], rows: Iterable[Sequence[str]], title: str = "", names: int = 1
    ) -> Self:
        return cls(pd.DataFrame([*rows], columns=[*header], dtype=str), title, names)

    def records(self) -> list[dict[str, str]]:
        """Return the rows as texts by the names of their columns."""
        return [*self.frame.to_dict("records")]

    @property
    def tidy(self) -> pd.DataFrame:
        """Row for each figure: its row and column in the table, its value and half width."""
        name, *columns = self.frame
        rows = []
        for row, column in ((row, column) for row in self.records() for column in columns):
            value, _, half = row[column].removeprefix(UNKNOWN).partition(" ± ")
            rows.append((row[name], column, value, half))
        return pd.DataFrame(rows, columns=[name, "column", "value", "half_width"])

    def rich(self) -> RichTable:
        """Return the table for a terminal, without its title; units in brackets aren't taken for markup."""
        table = RichTable()
        for number, name in enumerate(self.frame):
            table.add_column(Text(name), justify="left" if number < self.names else "right")
        for row in self.frame.itertuples(index=False):
            table.add_row(*map(Text, row))
        return table

    def text(self, form: str = "txt") -> str:
        """Return the table for a file of this suffix, by `FORMS`, or as LaTeX."""
        if form == "tex":
            return self.latex()
        sides = ["left"] * self.names + ["right"] * (self.frame.shape[1] - self.names)
        frame = self.frame.replace(r"\|", r"\|", regex=True) if form == "md" else self.frame
        how: dict[str, Any] = {"tablefmt": FORMS[form], "colalign": sides, "disable_numparse": True}
        above = f"{self.title}\n\n" if self.title else ""
        return f"{above}{frame.to_markdown(index=False, **how)}\n"

    def latex(self) -> str:
        """Return a `table` environment in LaTeX, with the title as its caption; it needs booktabs."""
        shown = self.frame.style.hide(axis=0).format(escape="latex").format_index(escape="latex", axis=1)
        if self.best is not None:
            bold = self.best.map({True: "textbf:--rwrap", False: ""}.get)
            shown = shown.apply(lambda _: bold, axis=None)
        caption = "".join(LATEX_ESCAPE_RULES.get(character, character) for character in self.title)
        sides = "l" * self.names + "r" * (self.frame.shape[1] - self.names)
        above = {"caption": caption, "label": self.label or None, "position_float": "centering"}
        text = shown.to_latex(hrules=True, column_format=sides, **above)
        return f"% \\usepackage{{booktabs}}\n{text}".translate(_UNICODE)

    def write(self, folder: Path, name: str, *suffixes: str) -> None:
        """Write the table to a folder as `txt`, `md` or `tex`."""
        for suffix in suffixes:
            write_text(folder / f"{name}.{suffix}", self.text(suffix))


# --- tables of results -----------------------------------------------------------------------------------


def mean(key: str, runs: pd.DataFrame) -> str:
    """Return the mean of a metric over the tracks of runs with its interval, or its root mean square."""
    metric, values = METRICS[key], runs[key].astype(float) if key in runs else pd.Series(dtype=float)
    if metric.average == "rms":
        return metric.text(metric.over(values))
    if len(values):
        values = by_track(runs.assign(**{key: values}).set_index("track")[key].dropna())
    return estimate(values).text(metric.digits, metric.factor)


def by_metric(parts: Mapping[str, pd.DataFrame], keys: Sequence[str]) -> Table:
    """Return a row for each metric, and a column for each part of the runs."""
    rows = ((METRICS[key].heading, *(mean(key, runs) for runs in parts.values())) for key in keys)
    return Table.of(("metric", *parts), rows)


def by_name(frame: pd.DataFrame, names: Sequence[str], keys: Sequence[str]) -> Table:
    """Return the last laps of the runs, with a row for each value of the columns `names`."""
    groups = last_laps(frame).groupby([*names], sort=False)
    rows = ((", ".join(map(str, of)), *(mean(key, runs) for key in keys)) for of, runs in groups)
    return Table.of((", ".join(names), *(METRICS[key].heading for key in keys)), rows)


# --- tables of studies -----------------------------------------------------------------------------------


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
    names, rows, best = names_of(frame, "estimator"), dict[str, list[str]](), dict[str, list[bool]]()
    for metric in shown:
        column = contrasts(study, frame, metric.key)
        rows |= {name: [getattr(one, name) for one in column] for name in names}
        rows[metric.heading] = [_mean(metric, one.value) for one in column]
        sign = (metric.best == "least") - (metric.best == "most")
        means = pd.Series([sign * one.value.mean for one in column])
        of_noise = means.groupby([one.noise for one in column])
        differs = (of_noise.transform("nunique") > 1) & bool(sign)
        best[metric.heading] = (differs & (means == of_noise.transform("min"))).tolist()
    texts = pd.DataFrame(rows)
    laps = f", at the end of the last of {study.laps} laps" if study.tracks else ""
    title = f"{f'{study.name}: {study.question}'.strip()} Mean and {_interval(frame)}{laps}."
    bold = pd.DataFrame(best).reindex(columns=texts.columns, fill_value=False)
    return Table(texts, title, len(names), label, bold)


def summary_tables(study: Study, frame: pd.DataFrame) -> list[Table]:
    """Return a table for each metric of the study that its runs have: each combination by the baseline."""
    names, tables = names_of(frame, "variant"), []
    for metric in (METRICS[key] for key in study.metrics if key in frame):
        rows = []
        for one in contrasts(study, frame, metric.key):
            by = "baseline" if one.difference is None else _mean(metric, one.difference, "+")
            tested = (_p(one.p), _p(one.wilcoxon), "*" if one.significant else "")
            rows.append(
                (*(getattr(one, n) for n in names), str(one.runs), _mean(metric, one.value), by, *tested)
            )
        header = (*names, "runs", "mean", "difference", "p", "Wilcoxon", "")
        tables.append(Table.of(header, rows, metric.heading, len(names)))
    return tables


def contrast_table(study: Study, frame: pd.DataFrame) -> Table:
    """Return each combination: the first metric of the study, its paired difference and p, and the others."""
    names, last = names_of(frame, "variant"), last_laps(frame)
    first, *others = (METRICS[key] for key in study.metrics if key in frame and key not in TIMES)
    rows = []
    for one in contrasts(study, frame, first.key):
        values = [getattr(one, name) for name in names]
        runs = last[(last[names] == values).all(axis=1)]
        difference = estimate(one.differences).text(first.digits, first.factor)
        rest = (mean(other.key, runs) for other in others)
        rows.append((", ".join(values), mean(first.key, runs), difference, figure(one.p), *rest))
    headings = (first.heading, "difference", "p", *(other.heading for other in others))
    return Table.of((", ".join(names), *headings), rows)


def track_tables(study: Study, frame: pd.DataFrame) -> list[Table]:
    """Return a table for each combination, track by track: the metrics of its runs at their last lap."""
    shown = [METRICS[key] for key in study.metrics if key in frame]
    header, titles = ("track", "runs", *(metric.heading for metric in shown)), names_of(frame, "estimator")
    tables = []
    for _, runs in frame.groupby([*COMBINATION], sort=False):
        rows = []
        for track, of in [*runs.groupby("track", sort=False), ("all", runs)]:
            last, count = last_laps(of), len(of.groupby([*RUN]))
            values = (metric.text(metric.over(last[metric.key].astype(float))) for metric in shown)
            rows.append((str(track), f"{len(last)} of {count}", *values))
        tables.append(Table.of(header, rows, ", ".join(str(runs[name].iloc[0]) for name in titles)))
    return tables


def _mean(metric: Metric, of: Estimate, sign: str = "") -> str:
    return of.text(max(metric.digits, MEAN_DIGITS), metric.factor, sign)


def _p(p: float) -> str:
    return "" if np.isnan(p) else f"{p:.3f}" if p >= 0.001 else "<0.001"


def _interval(frame: pd.DataFrame) -> str:
    """Return which interval stands beside a mean, and over what."""
    tracks = frame["track"].nunique()
    over = f"{tracks} tracks, each the mean of its drives" if tracks > 1 else "the drives of one track"
    return f"{100 * LEVEL:g} % interval (Student's t) over {over}"


def caption(study: Study, frame: pd.DataFrame) -> str:
    """Return what the tables show, and how it was tested."""
    base, name = study.baseline, study.baseline_variant
    against = f"{base.estimator}: {name}" if base.estimator else name
    runs = frame.groupby(list(RUN_OF), sort=False)["failure"].first()
    laps = f", at the end of the last of {study.laps} laps" if study.tracks else ""
    return (
        f"{f'{study.name}: {study.question}'.strip()} "
        f"{len(runs)} runs ({int((runs != '').sum())} failed){laps}. "
        f"Mean and {_interval(frame)}; difference from {against} in the "
        f"same drives; p of the paired t-test over them, corrected by Holm's method over all comparisons of "
        f"the metric that differ at all, and p of Wilcoxon's signed-rank test, not corrected; * where p < "
        f"{1 - LEVEL:.2f}. Wall times are not tested."
    )


def joined(tables: Sequence[Table], caption: str, form: str) -> str:
    """Return the tables of a study in a form, below their caption; in LaTeX each has it."""
    if form == "tex":
        return "\n".join(replace(table, title=f"{table.title}. {caption}").latex() for table in tables)
    if form == "md":
        caption, tables = caption.replace("*", r"\*"), [replace(t, title=f"**{t.title}**") for t in tables]
    return "\n".join([caption + "\n", *(table.text(form) for table in tables)])


# --- files of studies ------------------------------------------------------------------------------------


def write_study(study: Study, frame: pd.DataFrame, out: Path) -> str:
    """Write results, times, figures and the summary in three forms, and return the text of the summary."""
    write_results(frame, out)
    tables, note = [*track_tables(study, frame), *summary_tables(study, frame)], caption(study, frame)
    for form in ("txt", "md", "tex"):
        write_text(out / f"summary.{form}", joined(tables, note, form))
    results_table(study, frame).write(out, "table", "tex")
    save_figures(out / "figures", {"differences": plot_differences(study, frame)})
    return joined(tables, note, "txt")


def write_results(frame: pd.DataFrame, out: Path) -> None:
    """Write the results, and apart from them how long they took, and where and when they were made."""
    write_csv(out / "results.csv", without_times(frame))
    times = [name for name in (*TIMES, *MADE) if name in frame]
    write_csv(out / "times.csv", frame[["study", *RUN_OF, "lap", *times]])


def without_times(frame: pd.DataFrame) -> pd.DataFrame:
    """Return the columns that are the same whenever the study is run."""
    return frame.drop(columns=[*TIMES, *MADE], errors="ignore")


def write_csv(file: Path, frame: pd.DataFrame) -> None:
    """Write a frame without its index, whole or not at all."""
    with replacing(file) as temporary:
        frame.to_csv(temporary, index=False, lineterminator="\n")
