"""Means and paired differences with their intervals and tests; tables, figure and files of results."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from rich.table import Table
from rich.text import Text
from scipy import stats
from tabulate import LATEX_ESCAPE_RULES

from pathspace_graph.eval.figures import drawing
from pathspace_graph.eval.metrics.measures import METRICS, UNKNOWN, Metric, figure
from pathspace_graph.factors.arrays import Array
from pathspace_graph.io.files import atomic_file, write_text

from .study import Study

COMBINATION: Final = ("noise", "estimator", "variant")  # columns of a combination, which is compared
RUN: Final = ("track", "seed")  # columns of a drive; combinations are paired on the same drive and noise
RUN_OF: Final = (*RUN, *COMBINATION)
TIMES: Final = tuple(key for key, metric in METRICS.items() if metric.time)
LEVEL: Final = 0.95  # confidence level of intervals; a difference is significant if p < 1 - LEVEL

MADE: Final = ("commit", "host", "processor", "blas", "date", "command")  # where and when a run was made
RATIO: Final = "ratio"  # note of a ratio of two estimators beside a published one


def by_track(values: pd.Series) -> pd.Series:
    """Return the mean of each track, of values by track and seed; of a single track the values themselves.

    Drives of one track meet the same bends and cones, so tracks are the independent samples. Of a single
    track nothing can be said but about its drives.
    """
    tracks = values.groupby(level="track", sort=False).mean()
    return tracks if len(tracks) > 1 else values


def estimate(values: ArrayLike) -> tuple[float, float]:
    """Return the mean m of independent values (n,) that are known, and the half width of its interval.

    It is Student's `t s / sqrt(n)`. The mean is NaN without values, the half width for fewer than two.
    """
    known = np.asarray(values, float)
    known = known[np.isfinite(known)]
    n = len(known)
    if n < 2:
        return float(known[0]) if n else float("nan"), float("nan")
    half = stats.t.ppf(0.5 + LEVEL / 2, n - 1) * stats.sem(known)
    return float(np.mean(known)), float(half)


def paired_p(differences: Array) -> float:
    """Return the two-sided p of the paired t-test that the mean of the differences (n,) is 0.

    It is NaN for fewer than two pairs. Without any spread it is 1 where all differences are 0, else 0.
    """
    if len(differences) < 2:
        return float("nan")
    if np.ptp(differences) <= 1e-12 * np.abs(differences).max():  # but for round-off all are the same
        return float(differences[0] == 0.0)
    return float(stats.ttest_1samp(differences, 0.0).pvalue)


def wilcoxon_p(differences: Array) -> float:
    """Return the two-sided p of Wilcoxon's signed-rank test, which asks for no normal distribution.

    It is at least `2^(1 - n)` for n pairs, and NaN without a pair that differs.
    """
    different = differences[differences != 0.0]
    return float(stats.wilcoxon(different).pvalue) if len(different) else float("nan")


def holm(p: Array) -> Array:
    """Return p (m,) corrected by Holm's method.

    The i-th smallest becomes `max over j <= i of (m - j) p_(j)`, j from 0, at most 1. NaN isn't counted and
    stays NaN. scipy.stats corrects the false discovery rate only, so this is written by hand.
    """
    corrected = np.full(len(p), np.nan)
    known = np.flatnonzero(~np.isnan(p))
    order = known[np.argsort(p[known], kind="stable")]
    factors = len(order) - np.arange(len(order))
    corrected[order] = np.minimum(np.maximum.accumulate(factors * p[order]), 1.0)
    return corrected


# --- contrasts -------------------------------------------------------------------------------------------


def last_laps(frame: pd.DataFrame) -> pd.DataFrame:
    """Return the last row of each run that finished."""
    finished = frame[frame["failure"] == ""]
    return finished.groupby(list(RUN_OF), sort=False).tail(1)


def names_of(frame: pd.DataFrame, otherwise: str) -> list[str]:
    """Return the columns in which the combinations differ, or another one where there is only one."""
    return [name for name in COMBINATION if frame[name].nunique() > 1] or [otherwise]


def contrasts(study: Study, frame: pd.DataFrame, metric: str) -> pd.DataFrame:
    """Compare each combination with the baseline of its noise: a row for each, in the study's order.

    It has the number of `runs` with a value at the end of their last lap, the `mean` over the tracks and
    `half` its interval, the same of the `difference` from the baseline (NaN for the baseline itself), and
    the `differences` of each track, or of each drive of a single one. `p` is that of the paired t-test over
    them, corrected for all hypotheses of the metric, and `wilcoxon` that of the signed-rank test, not
    corrected. Where it is `significant`, chance alone rarely makes such a difference anywhere in the study.

    Nothing is tested where all differences are 0, as between cells that mean the same, nor of a wall time,
    which depends on what else the machine does. The cells of a drive are run one after another, so that
    processor times are.
    """
    known = last_laps(frame).astype({metric: float}).dropna(subset=[metric])
    runs = {key: of.set_index([*RUN])[metric] for key, of in known.groupby([*COMBINATION], sort=False)}
    nothing = pd.Series(dtype=float, index=pd.MultiIndex.from_arrays([[], []], names=RUN))
    rows = []
    for key in product(study.noises, study.estimators, study.points):
        base = (key[0], study.baseline.estimator or key[1], study.baseline_variant)
        values, against = runs.get(key, nothing), runs.get(base, nothing)
        d = np.zeros(0) if key == base else by_track((values - against).dropna()).to_numpy()
        is_tested = d.any() and METRICS[metric].time != "wall"
        tests = (paired_p(d), wilcoxon_p(d)) if is_tested else (np.nan, np.nan)
        rows.append(
            (*key, key == base, len(values), *estimate(by_track(values)), *estimate(d), tuple(d), *tests)
        )
    columns = (*COMBINATION, "is_baseline", "runs", "mean", "half", "difference", "difference_half")
    found = pd.DataFrame(rows, columns=[*columns, "differences", "p", "wilcoxon"])
    found["p"] = holm(found["p"].to_numpy())
    return found.assign(significant=found["p"] < 1.0 - LEVEL)


# --- tables of texts -------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class TextTable:
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

    def rich(self) -> Table:
        """Return the table for a terminal, without its title; units in brackets aren't taken for markup."""
        table = Table()
        for number, name in enumerate(self.frame):
            table.add_column(Text(name), justify="left" if number < self.names else "right")
        for row in self.frame.itertuples(index=False):
            table.add_row(*map(Text, row))
        return table

    def text(self, form: str = "txt") -> str:
        """Return the table for a file of this suffix: plain text, Markdown or LaTeX."""
        if form == "tex":
            return self.latex()
        sides = ["left"] * self.names + ["right"] * (self.frame.shape[1] - self.names)
        frame = self.frame.replace(r"\|", r"\|", regex=True) if form == "md" else self.frame
        how: dict[str, Any] = {"tablefmt": "pipe" if form == "md" else "simple", "disable_numparse": True}
        above = f"{self.title}\n\n" if self.title else ""
        return f"{above}{frame.to_markdown(index=False, colalign=sides, **how)}\n"

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
        # characters that not every font has
        known: dict[str, Any] = {"–": "--", "σ": r"$\sigma$", "−": "$-$", "±": r"$\pm$", "²": r"$^2$"}
        return f"% \\usepackage{{booktabs}}\n{text}".translate(str.maketrans(known | {"×": r"$\times$"}))

    def write(self, folder: Path, name: str, *suffixes: str) -> None:
        """Write the table to a folder as `txt`, `md` or `tex`."""
        for suffix in suffixes:
            write_text(folder / f"{name}.{suffix}", self.text(suffix))


# --- tables of results -----------------------------------------------------------------------------------


def mean(metric: Metric, runs: pd.DataFrame) -> str:
    """Return the mean of a metric over the tracks of runs with its interval, or its root mean square."""
    values = runs[metric.key].astype(float) if metric.key in runs else pd.Series(dtype=float)
    if metric.average == "rms":
        return metric.text(metric.over(values))
    if len(values):
        values = by_track(runs.assign(value=values).set_index("track")["value"].dropna())
    return metric.text(*estimate(values))


def by_metric(parts: Mapping[str, pd.DataFrame], metrics: Sequence[Metric]) -> TextTable:
    """Return a row for each metric, and a column for each part of the runs."""
    rows = ((metric.heading, *(mean(metric, runs) for runs in parts.values())) for metric in metrics)
    return TextTable.of(("metric", *parts), rows)


def by_name(frame: pd.DataFrame, names: Sequence[str], metrics: Sequence[Metric]) -> TextTable:
    """Return a row for the rows of a frame with each value of the columns `names`."""
    groups = frame.groupby([*names], sort=False)
    rows = ((", ".join(map(str, of)), *(mean(metric, runs) for metric in metrics)) for of, runs in groups)
    return TextTable.of((", ".join(names), *(metric.heading for metric in metrics)), rows)


# --- tables of studies -----------------------------------------------------------------------------------


def _shown(frame: pd.DataFrame, keys: Iterable[str]) -> list[Metric]:
    """Return the metrics that a frame has; beside differences a mean has at least two digits."""
    known = (METRICS[key] for key in keys if key in frame)
    return [replace(metric, digits=max(metric.digits, 2)) for metric in known]


def results_table(
    study: Study, frame: pd.DataFrame, keys: Sequence[str] = (), label: str = "tab:results"
) -> TextTable:
    """Return a row for each combination and a column for each metric, by default those of the study.

    A cell is the mean and its interval over the tracks, at the end of the last lap. The best mean of a noise
    is bold, where a metric has a best.
    """
    names, texts, best = names_of(frame, "estimator"), pd.DataFrame(), pd.DataFrame()
    for metric in _shown(frame, keys or study.metrics):
        found = contrasts(study, frame, metric.key)
        texts[names] = found[names]
        texts[metric.heading] = [metric.text(*pair) for pair in found[["mean", "half"]].to_numpy()]
        sign = (metric.best == "least") - (metric.best == "most")
        means = sign * found["mean"]
        of_noise = means.groupby(found["noise"])
        differs = (of_noise.transform("nunique") > 1) & bool(sign)
        best[metric.heading] = differs & (means == of_noise.transform("min"))
    laps = f", at the end of the last of {study.laps} laps" if study.tracks else ""
    title = f"{f'{study.name}: {study.question}'.strip()} Mean and {_interval(frame)}{laps}."
    bold = best.reindex(columns=texts.columns, fill_value=False)
    return TextTable(texts, title, len(names), label, bold)


def summary_tables(study: Study, frame: pd.DataFrame) -> list[TextTable]:
    """Return a table for each metric of the study that its runs have: each combination by the baseline."""
    names, tables = names_of(frame, "variant"), []
    for metric in _shown(frame, study.metrics):
        rows = []
        found: Any = contrasts(study, frame, metric.key).itertuples()
        for one in found:
            difference = metric.text(one.difference, one.difference_half, sign="+")
            by = "baseline" if one.is_baseline else difference
            tested = (_p(one.p), _p(one.wilcoxon), "*" if one.significant else "")
            value = str(one.runs), metric.text(one.mean, one.half)
            rows.append((*(getattr(one, name) for name in names), *value, by, *tested))
        header = (*names, "runs", "mean", "difference", "p", "Wilcoxon", "")
        tables.append(TextTable.of(header, rows, metric.heading, len(names)))
    return tables


def contrast_table(study: Study, frame: pd.DataFrame) -> TextTable:
    """Return each combination: the first metric of the study, its paired difference and p, and the others."""
    names, last = names_of(frame, "variant"), last_laps(frame)
    first, *others = (METRICS[key] for key in study.metrics if key in frame and key not in TIMES)
    found: Any = contrasts(study, frame, first.key).itertuples()
    rows = []
    for one in found:
        values = [getattr(one, name) for name in names]
        runs = last[(last[names] == values).all(axis=1)]
        difference = first.text(one.difference, one.difference_half)
        rest = (mean(other, runs) for other in others)
        rows.append((", ".join(values), mean(first, runs), difference, figure(one.p), *rest))
    headings = (first.heading, "difference", "p", *(other.heading for other in others))
    return TextTable.of((", ".join(names), *headings), rows)


def track_tables(study: Study, frame: pd.DataFrame) -> list[TextTable]:
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
        tables.append(TextTable.of(header, rows, ", ".join(str(runs[name].iloc[0]) for name in titles)))
    return tables


def beside_published(study: Study, frame: pd.DataFrame) -> pd.DataFrame:
    """Return each published value, ours after the same lap, its difference with the interval, and its note.

    Last in a metric are the ratios of the first published estimator to each other one, which other tracks
    and sensors change least. The values are in the units of the tables.
    """
    rows, known = [], frame[(frame["failure"] == "") & (frame["variant"] == study.baseline_variant)]
    first, *others = study.published.laps
    for metric in (METRICS[key] for key in study.published.laps[first] if key in frame):
        note, means = study.published.notes.get(metric.key, ""), dict[tuple[str, int], tuple[float, float]]()
        for name, of_laps in study.published.laps.items():
            for lap, there in enumerate(of_laps.get(metric.key, ()), 1):
                runs = known[(known["estimator"] == name) & (known["lap"] == lap)].set_index([*RUN])
                here, half = (metric.factor * x for x in estimate(by_track(runs[metric.key].astype(float))))
                if len(runs):
                    means[name, lap] = there, here
                    rows.append((metric.heading, name, lap, there, here, here - there, half, note))
        for other, (name, lap) in product(others, means):
            if name == first and min(means.get((other, lap), (0.0,))) > 0.0:
                there, here = np.divide(means[first, lap], means[other, lap])
                names = metric.title, f"{first} / {other}", lap
                rows.append((*names, there, here, here - there, np.nan, RATIO))
    header = ("metric", "estimator", "lap", "published", "here", "difference", "interval", "compared")
    return pd.DataFrame(rows, columns=header)


def plot_published(beside: pd.DataFrame) -> drawing.Picture:
    """Draw what `beside_published` returns by lap, published values dashed; ratios are left out."""
    panels = beside[beside["compared"] != RATIO].groupby("metric", sort=False)
    with drawing.figure_context():
        figure = drawing.Picture(figsize=(drawing.WIDTH, 2.4), layout="constrained")
        all_axes = figure.subplots(1, len(panels), squeeze=False)[0]
        for axes, (heading, panel) in zip(all_axes, panels, strict=True):
            lines = zip(panel.groupby("estimator", sort=False), drawing.PALETTE, strict=False)
            for (name, of), color in lines:
                axes.errorbar(of["lap"], of["here"], of["interval"], fmt="o-", color=color, label=name)
                axes.plot(of["lap"], of["published"], "s--", color=color, label=f"{name}, published")
            laps = sorted({*panel["lap"]})
            axes.set(title=heading, xlabel="lap", xticks=laps, xlim=(laps[0] - 0.5, laps[-1] + 0.5))
            axes.set_ylim(0.0, 1.1 * axes.get_ylim()[1])
        drawing.shared_legend(figure)
    return figure


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


def joined(tables: Sequence[TextTable], caption: str, form: str) -> str:
    """Return the tables of a study in a form, below their caption; in LaTeX each has it."""
    if form == "tex":
        return "\n".join(replace(table, title=f"{table.title}. {caption}").latex() for table in tables)
    if form == "md":
        caption, tables = caption.replace("*", r"\*"), [replace(t, title=f"**{t.title}**") for t in tables]
    return "\n".join([caption + "\n", *(table.text(form) for table in tables)])


# --- figure of studies ----------------------------------------------------------------------------------


def plot_differences(study: Study, frame: pd.DataFrame) -> drawing.Picture:
    """Draw pairs, mean and interval of the difference of each combination from the baseline.

    The panels are the first metrics in which any run differs; where none does, there are means in their
    place.
    """
    every = {key: contrasts(study, frame, key) for key in study.metrics if key in frame}
    differing = [key for key, found in every.items() if any(map(any, found["differences"]))]
    panels = {key: every[key] for key in (differing or [*every])[:3]}
    compared = np.any([found["differences"].map(len) > 0 for found in panels.values()], axis=0)
    rows = np.flatnonzero(compared | (not differing)).tolist()
    with drawing.figure_context():
        figure = drawing.Picture(figsize=(drawing.WIDTH, 1.1 + 0.24 * len(rows)), layout="constrained")
        all_axes = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
        for axes, (key, found) in zip(all_axes, panels.items(), strict=True):
            metric, rng = METRICS[key], np.random.default_rng(0)
            if differing:
                axes.axvline(0.0, color=drawing.DARK, linewidth=0.6, zorder=1)
            for row, (_, one) in enumerate(found.iloc[rows].iterrows()):
                mean, half = one[["difference", "difference_half"] if differing else ["mean", "half"]]
                if np.isnan(mean):
                    continue
                color = drawing.BLUE if one["significant"] else drawing.GREY
                pairs = metric.factor * np.array(one["differences"])
                scattered = row + rng.uniform(-0.22, 0.22, len(pairs))  # so that they can be seen apart
                axes.plot(pairs, scattered, ".", color=color, alpha=0.5, markersize=3.5, zorder=2)
                xerr = None if np.isnan(half) else metric.factor * half
                look: dict[str, Any] = {"color": color, "markersize": 4.5, "elinewidth": 1.0, "zorder": 3}
                axes.errorbar(metric.factor * mean, row, xerr=xerr, fmt="o", **look)
            axes.set_title(metric.heading)
            axes.grid(axis="x")
        names = next(iter(panels.values()))[names_of(frame, "variant")].iloc[rows]
        all_axes[0].set_yticks(range(len(rows)), names.agg(", ".join, axis=1))
        all_axes[0].set_ylim(len(rows) - 0.5, -0.5)
        text = "difference from the baseline: each pair, mean and 95 % interval; blue where significant"
        figure.supxlabel(text if differing else "mean and 95 % interval")
    return figure


# --- files of studies ------------------------------------------------------------------------------------


def write_study(study: Study, frame: pd.DataFrame, out: Path) -> str:
    """Write results, times, figures and the summary in three forms, and return the text of the summary."""
    write_results(frame, out)
    tables, note = [*track_tables(study, frame), *summary_tables(study, frame)], caption(study, frame)
    figures = {"differences": plot_differences(study, frame)}
    if study.published.laps and len(beside := beside_published(study, frame)):
        texts = beside.map(lambda x: figure(x) if isinstance(x, float) else str(x))
        tables.append(TextTable(texts, f"Beside {study.published.source}", 3))
        write_csv(out / "published.csv", beside)
        figures["published"] = plot_published(beside)
    for form in ("txt", "md", "tex"):
        write_text(out / f"summary.{form}", joined(tables, note, form))
    results_table(study, frame).write(out, "table", "tex")
    drawing.save_figures(out / "figures", figures)
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
    with atomic_file(file) as temporary:
        frame.to_csv(temporary, index=False, lineterminator="\n")
