"""Every estimator on the same logs: the paper's Table 1, all metrics, paired differences, and all files."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from itertools import zip_longest
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd

from pathspace_graph import estimators as registry
from pathspace_graph.errors import check_name
from pathspace_graph.eval.figures.style import save_figures
from pathspace_graph.eval.metrics.accuracy import LapMetrics
from pathspace_graph.eval.metrics.measures import online_cycles, stage_times
from pathspace_graph.eval.metrics.metric import MEAN_DIGITS, METRICS, PAPER, UNKNOWN, Metric
from pathspace_graph.eval.metrics.summary import has_cones, summarize, versions
from pathspace_graph.io.files import atomic_folder, write_json, write_text
from pathspace_graph.io.results import BatchRun, write_result
from pathspace_graph.plausibility.judge import read_plausible_log
from pathspace_graph.settings.evaluation import GhostSettings
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.settings.online import LimitSettings

from .cells import Cell, Outcome, run_cell
from .drives import NamedLog, log_folders
from .frame import add_batch, write_csv
from .plots import blind_spot_figure, plot_maps
from .run import OnCell, run_cells
from .statistics import difference, estimate
from .tables import TextTable, group_starts

MARKER: Final = "comparison.json"  # file by which a comparison's folder is recognized
RUN: Final = ("log", "estimator")
WITHOUT_TRUTH: Final = (  # metrics that say something of a log without true cones
    *("size", "closed_at_end", "end_off", "crossings", "reported_degraded", "reported_lost", "ms_mean"),
)
_PAIRED: Final = ("rmse", "rmse_capped", "missed", "missed_2m", "missed_1m", "ate", *WITHOUT_TRUTH)
"""Metrics whose differences are in the table; the file has all."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """All outcomes, log by log; the estimators are compared with one of them, the reference."""

    logs: tuple[NamedLog, ...]
    estimators: tuple[str, ...]
    reference: str
    outcomes: tuple[Outcome, ...] = ()

    @cached_property
    def frame(self) -> pd.DataFrame:
        """Tidy row per run and lap, and one per run for the whole log."""
        rows: list[dict[str, Any]] = []
        for outcome in self.outcomes:
            laps = 0 if outcome.result is None else outcome.result.laps
            for row in outcome.rows:
                about = {"scope": "lap" if row.lap else "log", "lap": row.lap or laps}
                rows.append({**outcome.names, **about, **row.values})
        add_batch(rows, ("log",))
        return pd.DataFrame(rows, columns=None if rows else [*RUN, "scope", "lap"])

    @property
    def final(self) -> pd.DataFrame:
        return self.frame[self.frame["scope"] == "log"]

    def times(self) -> pd.DataFrame:
        """Return a tidy row per run and stage, in s."""
        ran = [(outcome.names, outcome.result) for outcome in self.outcomes if outcome.result is not None]
        rows = [{**names, **stage} for names, run in ran for stage in stage_times(online_cycles(run))]
        return pd.DataFrame(rows, columns=[*RUN, "stage", "mean", "median", "p99", "share"])

    @property
    def has_truth(self) -> bool:
        return any(has_cones(named.log.truth) for named in self.logs)

    @property
    def paired(self) -> bool:
        """Whether there are differences to show: several estimators on several logs."""
        return len(self.logs) > 1 and len(self.estimators) > 1

    @property
    def failures(self) -> list[Outcome]:
        return [outcome for outcome in self.outcomes if outcome.failure]

    @property
    def unsettled(self) -> list[Outcome]:
        """Outcomes of batches that did not converge."""
        return [o for o in self.outcomes if isinstance(o.result, BatchRun) and not o.result.converged]


def read_logs(folder: Path, limits: LimitSettings | None = None) -> tuple[NamedLog, ...]:
    """Return the log of a log folder, or those of a folder of log folders; InputError if it is neither."""
    folders = log_folders(folder)
    read = {name: read_plausible_log(entry, limits or LimitSettings()) for name, entry in folders.items()}
    return tuple(NamedLog(name, log, tuple(hints)) for name, (log, hints) in read.items())


def choose(names: Sequence[str]) -> tuple[str, ...]:
    """Return estimators by name, or all that are known if none is named; SettingsError if one is unknown."""
    known = registry.known_estimators()
    for name in names:
        check_name(name, known, "--estimators: expected a known estimator")
    return tuple(dict.fromkeys(names or known))


def choose_reference(name: str | None, estimators: Sequence[str]) -> str:
    """Return the named one, or the default estimator if it is compared, or else the first."""
    if name is None:
        return registry.DEFAULT_ONLINE if registry.DEFAULT_ONLINE in estimators else estimators[0]
    check_name(name, estimators, "--reference: expected an estimator that is compared")
    return name


def compare(
    logs: Sequence[NamedLog],
    estimators: Sequence[str],
    settings: MapperSettings | None = None,
    *,
    reference: str | None = None,
    ghosts: GhostSettings | None = None,
    jobs: int = 1,
    on_run: OnCell | None = None,
) -> Comparison:
    """Run every estimator on every log, `jobs` at a time; a failure of one does not stop the others."""
    settings, measured = settings or MapperSettings(), {"ghost_settings": ghosts}
    cells = [Cell(log, name, settings, measured=measured) for log in logs for name in estimators]
    found = run_cells(cells, run_cell, Outcome.failed, jobs=jobs, on_cell=on_run)
    chosen = choose_reference(reference, estimators)
    return Comparison(tuple(logs), tuple(estimators), chosen, tuple(found))


# --- tables ----------------------------------------------------------------------------------------------


def tables(comparison: Comparison) -> dict[str, TextTable]:
    """Return the tables by the name of their files, differences only where runs can be paired."""
    short = paper_table(comparison) if comparison.has_truth else final_table(comparison, WITHOUT_TRUTH)
    found = {"table": short, "metrics": final_table(comparison)}
    return found | ({"paired": paired_table(comparison)} if comparison.paired else {})


def paper_frame(comparison: Comparison) -> pd.DataFrame:
    """Return rmse (m), missed (share) and size of each estimator and lap, means over `logs` logs.

    `rmse_half` and so on are half the widths of their 95 % intervals.

    An estimator that completed no lap on any log has a row without a lap, of its maps at the end of the logs.
    """
    keys = [metric.key for metric in PAPER]
    frame = comparison.frame.reindex(columns=[*RUN, "scope", "lap", *keys])
    rows = []
    for estimator in comparison.estimators:
        runs = frame[frame["estimator"] == estimator]
        laps = runs[runs["scope"] == "lap"]
        for lap, over_logs in laps.groupby("lap") if len(laps) else [(np.nan, runs)]:
            found = {key: estimate(over_logs[key].astype(float).dropna().to_numpy()) for key in keys}
            values = {name: of.mean for name, of in found.items()}
            values |= {f"{name}_half": of.half for name, of in found.items()}
            rows.append({"estimator": estimator, "lap": lap, "logs": len(over_logs)} | values)
    return pd.DataFrame(rows).astype({"lap": "Int64"})


def paper_table(comparison: Comparison) -> TextTable:
    """Return the paper's Table 1, lap by lap."""
    logs = ["logs"] if len(comparison.logs) > 1 else []
    rows = []
    for row in paper_frame(comparison).to_dict("records"):
        lap = ("end" if row["logs"] else "failed") if pd.isna(row["lap"]) else str(int(row["lap"]))
        cells = (*(str(row[key]) for key in logs), *(_cell(metric, row) for metric in PAPER))
        rows.append((row["estimator"], lap, *cells))
    header = ("estimator", "lap", *logs, *(metric.heading for metric in PAPER))
    return TextTable(_title(comparison, "at the end of each lap"), header, tuple(rows), group_starts(rows))


def final_table(comparison: Comparison, keys: Sequence[str] = tuple(METRICS)) -> TextTable:
    """Return the means over the logs of metrics of whole logs, with a column for each estimator."""
    final, names = comparison.final, comparison.estimators
    known = [METRICS[key] for key in keys if key in final and final[key].astype(float).notna().any()]
    rows = tuple(
        (m.heading, *(m.text(m.over(final.loc[final["estimator"] == name, m.key])) for name in names))
        for m in known
    )
    return TextTable(_title(comparison, "at the end of the log"), ("metric", *names), rows)


def paired_frame(comparison: Comparison) -> pd.DataFrame:
    """Return a tidy row for each estimator and metric of whole logs: its difference from the reference."""
    reference, rows = comparison.reference, []
    final = comparison.final.set_index([*RUN]).unstack("estimator")
    keys = [key for key in METRICS if key in final]
    for estimator in (name for name in comparison.estimators if name != reference):
        for key in keys:
            values = final[key].reindex(columns=[estimator, reference]).to_numpy(float)
            d = difference(*values.T)
            rows.append([estimator, reference, key, d.mean, d.low, d.high, d.count])
    return pd.DataFrame(rows, columns=["estimator", "reference", "metric", "mean", "low", "high", "pairs"])


def paired_table(comparison: Comparison) -> TextTable:
    """Return the differences with their intervals: a row for each metric, a column for each estimator."""
    paired = paired_frame(comparison)
    others = [name for name in comparison.estimators if name != comparison.reference]
    rows = []
    for metric in (METRICS[key] for key in _PAIRED):
        by_estimator = paired[paired["metric"] == metric.key].set_index("estimator")
        if by_estimator["mean"].notna().any():
            rows.append((metric.heading, *(_interval(metric, by_estimator.loc[name]) for name in others)))
    title = (
        f"Difference from {comparison.reference}, mean [95 % interval] over {len(comparison.logs)} logs, "
        "paired; * where 0 is outside of it. Positive: the reference has less."
    )
    return TextTable(title, ("metric", *others), tuple(rows))


def _interval(metric: Metric, row: Any) -> str:
    mean, low, high = (metric.factor * float(row[name]) for name in ("mean", "low", "high"))
    if np.isnan(mean):
        return UNKNOWN
    digits = max(metric.digits, MEAN_DIGITS)
    mark = "*" if low > 0.0 or high < 0.0 else ""
    return f"{mean:+.{digits}f} [{low:+.{digits}f}, {high:+.{digits}f}]{mark}"


def side_by_side(laps: dict[str, Sequence[LapMetrics]]) -> TextTable:
    """Return Table 1 as in the paper: a row per lap, with rmse, missed and size under each estimator."""
    titles = "   ".join(metric.heading for metric in PAPER)
    header, rows = ("lap", *(f"{name}\n{titles}" for name in laps)), []
    for lap, beside in enumerate(zip_longest(*laps.values()), start=1):
        values = ({} if row is None else asdict(row) for row in beside)
        three = ("   ".join(_cell(m, row).rjust(len(m.heading)) for m in PAPER) for row in values)
        rows.append((str(lap), *three))
    return TextTable("", header, tuple(rows), names=0)


def _title(comparison: Comparison, when: str) -> str:
    count = len(comparison.logs)
    logs = comparison.logs[0].name if count == 1 else f"mean over {count} logs"
    missing = " (the log has no true cones, which rmse, missed and most other metrics need)"
    return f"{logs}, {when}{'' if comparison.has_truth else missing}"


def _cell(metric: Metric, row: dict[Any, Any]) -> str:
    """Return a value, with its spread where there is one."""
    half = float(row.get(f"{metric.key}_half", np.nan))
    spread = "" if np.isnan(half) else f" ± {metric.factor * half:.{metric.digits}f}"
    return f"{metric.text(float(row.get(metric.key, np.nan)))}{spread}"


# --- files -----------------------------------------------------------------------------------------------


def write_comparison(out: Path, comparison: Comparison, settings: MapperSettings, jobs: int) -> None:
    """Write all files of a comparison (docs/formats.md), or on failure none.

    Each of several logs has a folder of its own. An earlier comparison in `out` becomes a numbered backup.
    """
    frames = {"table": paper_frame(comparison), "metrics": comparison.frame, "times": comparison.times()}
    if comparison.paired:
        frames["paired"] = paired_frame(comparison)
    with atomic_folder(out, MARKER) as folder:
        for name, table in tables(comparison).items():
            write_text(folder / f"{name}.md", table.markdown())
            write_text(folder / f"{name}.tex", table.latex())
        for name, frame in frames.items():
            write_csv(folder / f"{name}.csv", frame)
        for named in comparison.logs:
            _write_log(folder if len(comparison.logs) == 1 else folder / named.name, named, comparison)
        about = {
            "format": "pathspace-comparison/1",
            "logs": [named.name for named in comparison.logs],
            "estimators": comparison.estimators,
            "reference": comparison.reference,
            "failures": [{**o.names, "error": o.failure} for o in comparison.failures],
            "jobs": jobs,
            "settings": asdict(settings),
            "versions": versions(),
        }
        write_json(folder / MARKER, about)


def _write_log(folder: Path, named: NamedLog, comparison: Comparison) -> None:
    folder.mkdir(exist_ok=True)
    found = [outcome for outcome in comparison.outcomes if outcome.names["log"] == named.name]
    maps = {str(o.names["estimator"]): o.result.map for o in found if o.result is not None}
    for outcome in found:
        if outcome.result is not None:
            summary = summarize(outcome.result, named.log, named.hints)
            write_result(folder / outcome.names["estimator"], outcome.result, summary)
    if maps:
        save_figures(folder, {"maps": plot_maps(found, named.log)})
    if named.log.truth is not None and comparison.reference in maps:
        figure = blind_spot_figure(maps, comparison.reference, named.log.truth)
        save_figures(folder, {} if figure is None else {"blind_spot": figure})
