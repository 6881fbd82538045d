"""Tables in every form, and the files of a study: its tables, tidy results, and a figure of differences."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from rich.table import Table
from rich.text import Text
from tabulate import LATEX_ESCAPE_RULES, SEPARATING_LINE, tabulate

from pathspace_graph.eval.figures.style import BLUE, DARK, GREY, WIDTH, Picture, figure_context, save_figures
from pathspace_graph.eval.metrics.metric import (
    HIGHER,
    LATER_LAPS,
    LOWER,
    MEAN_DIGITS,
    METRICS,
    UNKNOWN,
    Column,
    Metric,
    column_of,
)
from pathspace_graph.io.files import write_text

from .frame import COMBINATION, RUN, RUN_OF, Contrast, contrasts, last_laps, write_results
from .statistics import FEWEST, LEVEL, Estimate
from .study import Study

MAX_PANELS: Final = 3  # most metrics side by side in the figure of differences

_UNICODE: Final = str.maketrans(  # LaTeX for characters that not every font has
    {"–": "--", "σ": r"$\sigma$", "−": "$-$", "±": r"$\pm$", "²": r"$^2$", "×": r"$\times$"}
)


_STRONG: Final = ("\ue000", "\ue001")  # around what is bold, in the rows of a table


def strong(text: str) -> str:
    """Return a cell's text that is bold where the form of the table has that."""
    return text.join(_STRONG)


@dataclass(frozen=True)
class TextTable:
    """Rows of text under a header: first names, left-aligned, then numbers, right-aligned."""

    title: str  # sentence above the table, which may be empty
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    groups: tuple[int, ...] = ()  # row numbers at which a new group of rows begins
    names: int = 1  # number of first columns that are names
    label: str = ""  # of the table in LaTeX

    def parts(self, width: int) -> list[Self]:
        """Return tables of at most `width` characters, each with the names and some of the other columns."""
        border = 3  # characters between two columns
        needed = [max(map(len, column)) + border for column in zip(self.header, *self.rows, strict=True)]
        shared = sum(needed[: self.names]) + 1
        parts: list[list[int]] = [[]]
        for number in range(self.names, len(self.header)):
            if parts[-1] and shared + sum(needed[k] for k in (*parts[-1], number)) > width:
                parts.append([])
            parts[-1].append(number)
        return [self._only([*range(self.names), *part]) for part in parts]

    def _only(self, columns: Sequence[int]) -> Self:
        header, *rows = (tuple(row[k] for k in columns) for row in (self.header, *self.rows))
        return replace(self, header=header, rows=tuple(rows))

    def rich(self) -> Table:
        """Return the table for a terminal, without its title; units in brackets aren't taken for markup."""
        table = Table()
        for number, name in enumerate(self.header):
            table.add_column(Text(name), justify="left" if number < self.names else "right")
        for number, row in enumerate(self.rows):
            table.add_row(*(Text(_plain(cell)) for cell in row), end_section=number + 1 in self.groups)
        return table

    def records(self) -> list[dict[str, str]]:
        """Return the rows as texts by the names of their columns."""
        return [dict(zip(self.header, map(_plain, row), strict=True)) for row in self.rows]

    def text(self) -> str:
        """Return the table for a text file, without its title: columns aligned by blanks."""
        return self._formatted("simple", [[_plain(cell) for cell in row] for row in self.rows])

    def markdown(self) -> str:
        rows = [[_with(cell.replace("|", r"\|"), "**", "**") for cell in row] for row in self.rows]
        title = f"{self.title}\n\n" if self.title else ""
        return f"{title}{self._formatted('pipe', rows)}\n"

    def latex(self) -> str:
        """Return a `table` environment in LaTeX, with the title as its caption; it needs booktabs."""
        rows: list[Sequence[str] | str] = []
        for number, row in enumerate(self.rows):
            rows += [SEPARATING_LINE, row] if number in self.groups else [row]
        caption = "".join(LATEX_ESCAPE_RULES.get(character, character) for character in self.title)
        begin = ["% \\usepackage{booktabs}", r"\begin{table}", r"\centering", rf"\caption{{{caption}}}"]
        begin += [rf"\label{{{self.label}}}"] if self.label else []
        table = _with(self._formatted("latex_booktabs", rows), r"\textbf{", "}")
        return "\n".join([*begin, table, r"\end{table}", ""]).translate(_UNICODE)

    def write(self, folder: Path, name: str, *suffixes: str) -> None:
        """Write the table to a folder as `txt` (with its title), `md` or `tex`."""
        title = f"{self.title}\n\n" if self.title else ""
        forms = {"txt": lambda: f"{title}{self.text()}\n", "md": self.markdown, "tex": self.latex}
        for suffix in suffixes:
            write_text(folder / f"{name}.{suffix}", forms[suffix]())

    def _formatted(self, style: str, rows: Sequence[Sequence[str] | str]) -> str:
        sides = ["left"] * self.names + ["right"] * (len(self.header) - self.names)
        return str(tabulate(rows, self.header, tablefmt=style, colalign=sides, disable_numparse=True))


def _with(text: str, before: str, after: str) -> str:
    return text.replace(_STRONG[0], before).replace(_STRONG[1], after)


def _plain(text: str) -> str:
    return _with(text, "", "")


def group_starts(rows: Sequence[Sequence[str]]) -> tuple[int, ...]:
    """Return the numbers of the rows whose first name is not that of the row before."""
    return tuple(k for k in range(1, len(rows)) if rows[k][0] != rows[k - 1][0])


# --- tables of studies ---------------------------------------------------------------------------------


def summary_tables(study: Study, frame: pd.DataFrame) -> list[TextTable]:
    """Return a table for each metric of the study that its runs have."""
    several, tables = [name for name in COMBINATION if frame[name].nunique() > 1] or ["variant"], []
    for metric in (METRICS[key] for key in study.metrics if key in frame):
        rows = []
        for contrast in contrasts(study, frame, metric.key):
            names = (getattr(contrast, name) for name in several)
            value, difference = contrast.value, contrast.difference
            by = ("baseline", "") if difference is None else _figures(metric, difference, "+")
            tested = (_p(contrast.p), _p(contrast.wilcoxon), "*" if contrast.significant else "")
            rows.append((*names, str(contrast.runs), *_figures(metric, value), *by, *tested))
        header = (*several, "runs", "mean", "95 %", "difference", "95 %", "p", "Wilcoxon", "")
        tables.append(TextTable(metric.heading, header, tuple(rows), names=len(several)))
    return tables


def results_table(
    study: Study, frame: pd.DataFrame, keys: Sequence[str] = (), label: str = "tab:results"
) -> TextTable:
    """Return a row for each combination and a column for each metric, by default those of the study.

    A cell is the mean and its interval over the tracks, at the end of the last lap. The best mean of a noise
    is bold, where a metric has a best.
    """
    shown = [METRICS[key] for key in keys or study.metrics if key in frame]
    several = [name for name in COMBINATION if frame[name].nunique() > 1] or ["estimator"]
    columns = {metric.key: contrasts(study, frame, metric.key) for metric in shown}
    rows = []
    for row, first in enumerate(columns[shown[0].key]) if shown else ():
        cells = [_mean(metric, columns[metric.key], row) for metric in shown]
        rows.append((*(getattr(first, name) for name in several), *cells))
    header, names = (*several, *(metric.heading for metric in shown)), len(several)
    title = f"{_about(study)} Mean and {_interval(frame)}{_laps(study)}."
    return TextTable(title, header, tuple(rows), group_starts(rows), names, label)


def _mean(metric: Metric, column: Sequence[Contrast], row: int) -> str:
    """Return the mean of a combination with its interval, bold where it is the best of its noise."""
    text = " ".join(filter(None, _figures(metric, column[row].value))) or UNKNOWN
    sign = (metric.key in LOWER) - (metric.key in HIGHER)
    means = [sign * of.value.mean for of in column if of.noise == column[row].noise and of.value.count]
    is_best = bool(sign and len(means) > 1) and sign * column[row].value.mean <= min(means)
    return strong(text) if is_best else text


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


def _figures(metric: Metric, of: Estimate, sign: str = "") -> tuple[str, str]:
    if not of.count:
        return "", ""
    digits = max(metric.digits, MEAN_DIGITS)
    half = "" if np.isnan(of.half) else f"± {metric.factor * of.half:.{digits}f}"
    return f"{metric.factor * of.mean:{sign}.{digits}f}", half


def as_text(tables: Sequence[TextTable], caption: str) -> str:
    return "\n\n".join([caption, *(f"{table.title}\n{table.text()}" for table in tables)]) + "\n"


def as_markdown(tables: Sequence[TextTable], caption: str) -> str:
    bold = (replace(table, title=f"**{table.title}**") for table in tables)
    return "\n".join([caption.replace("*", r"\*") + "\n", *(table.markdown() for table in bold)])


def as_latex(tables: Sequence[TextTable], caption: str) -> str:
    """Return a `table` environment for each metric, each with the whole caption."""
    return "\n".join(replace(table, title=f"{table.title}. {caption}").latex() for table in tables)


def track_tables(study: Study, frame: pd.DataFrame) -> list[TextTable]:
    """Return a table for each combination of noise, estimator and settings, if the study wants columns."""
    columns = [column_of(text) for text in study.columns]
    if not columns:
        return []
    several = [name for name in COMBINATION if frame[name].nunique() > 1] or ["estimator"]
    header = ("track", "runs", *(column.title for column in columns))
    return [
        TextTable(", ".join(str(runs[name].iloc[0]) for name in several), header, tuple(_rows(columns, runs)))
        for _, runs in frame.groupby([*COMBINATION], sort=False)
    ]


def _rows(columns: Sequence[Column], frame: pd.DataFrame) -> Iterator[tuple[str, ...]]:
    finished = frame.groupby([*RUN], sort=False)["failure"].first() == ""
    values = [_values(column, frame).reindex(finished.index) for column in columns]
    for track, done in finished.groupby(level=0, sort=False):
        texts = (c.text(v.loc[done.index]) for c, v in zip(columns, values, strict=True))
        yield (str(track), f"{int(done.sum())} of {len(done)}", *texts)
    for name, over in {"mean": "mean", "median": "median", "largest": "max"}.items():
        texts = (c.text(v, over) for c, v in zip(columns, values, strict=True))
        yield (f"all, {name}", f"{int(finished.sum())} of {len(finished)}", *texts)


def _values(column: Column, frame: pd.DataFrame) -> pd.DataFrame:
    """Return a row for each run that finished, by track and seed: the values of the metrics by key."""
    laps = column.laps
    done = frame[frame["failure"] == ""] if laps else last_laps(frame)
    if laps == LATER_LAPS:
        done = done[done["lap"] > 1]
    elif laps.isdecimal():
        done = done[done["lap"] == int(laps)]
    done = done.reindex(columns=[*RUN, *(metric.key for metric in column.metrics)])
    by_run = done.groupby([*RUN], sort=False)
    return pd.DataFrame({m.key: by_run[m.key].agg(m.over) for m in column.metrics})


# --- files of studies ------------------------------------------------------------------------------------


def write_study(study: Study, frame: pd.DataFrame, out: Path) -> str:
    """Write results, times, figures and the summary in three forms, and return the text of the summary."""
    write_results(frame, out)
    tables, note = [*track_tables(study, frame), *summary_tables(study, frame)], caption(study, frame)
    for suffix, form in (("txt", as_text), ("md", as_markdown), ("tex", as_latex)):
        write_text(out / f"summary.{suffix}", form(tables, note))
    results_table(study, frame).write(out, "table", "tex")
    figure = plot_differences(study, frame)
    save_figures(out / "figures", {} if figure is None else {"differences": figure})
    return as_text(tables, note)


def plot_differences(study: Study, frame: pd.DataFrame) -> Picture | None:
    """Draw pairs, mean and interval of each combination for the first metrics; None where no run differs."""
    every = [contrasts(study, frame, metric) for metric in study.metrics if metric in frame]
    panels = [p for p in every if any(d != 0.0 for contrast in p for d in contrast.differences)][:MAX_PANELS]
    if not panels:
        return None
    rows = [i for i in range(len(panels[0])) if any(panel[i].differences for panel in panels)]
    names = [_name(study, panels[0][i]) for i in rows]
    with figure_context():
        figure = Picture(figsize=(WIDTH, 1.1 + 0.24 * len(rows)), layout="constrained")
        all_axes = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
        for axes, panel in zip(all_axes, panels, strict=True):
            _draw_differences(axes, [panel[i] for i in rows])
        all_axes[0].set_yticks(range(len(rows)), names)
        all_axes[0].set_ylim(len(rows) - 0.5, -0.5)
        text = "difference from the baseline: each pair, mean and 95 % interval; blue where significant"
        figure.supxlabel(text)
    return figure


def _draw_differences(axes: Axes, rows: Sequence[Contrast]) -> None:
    metric = METRICS[rows[0].metric]
    rng = np.random.default_rng(0)
    axes.axvline(0.0, color=DARK, linewidth=0.6, zorder=1)
    for row, contrast in enumerate(rows):
        if contrast.difference is None or not contrast.difference.count:
            continue
        color = BLUE if contrast.significant else GREY
        pairs = metric.factor * np.array(contrast.differences)
        scattered = row + rng.uniform(-0.22, 0.22, len(pairs))  # so that they can be seen apart
        axes.plot(pairs, scattered, ".", color=color, alpha=0.5, markersize=3.5, zorder=2)
        mean, half = metric.factor * contrast.difference.mean, metric.factor * contrast.difference.half
        look: dict[str, Any] = {"color": color, "markersize": 4.5, "elinewidth": 1.0}
        axes.errorbar(mean, row, xerr=None if np.isnan(half) else half, fmt="o", zorder=3, **look)
    axes.set_title(metric.heading)
    axes.grid(axis="x")


def _name(study: Study, contrast: Contrast) -> str:
    """Return the names of a combination that others have differently, `sigma_spacing=1` for
    `gauge.sigma_spacing=1` unless two groups have a setting of one name."""
    counts = {"noise": study.noises, "estimator": study.estimators, "variant": study.points}
    several = [getattr(contrast, column) for column, of in counts.items() if len(of) > 1]
    name = ", ".join(several) or f"{contrast.estimator}: {contrast.variant}"
    last = {field: field.rpartition(".")[2] for field in study.varied}
    if len(set(last.values())) == len(last):
        for field, short in last.items():
            name = name.replace(f"{field}=", f"{short}=")
    return name
