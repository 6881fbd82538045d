"""Every estimator on the same logs: the paper's Table 1, all metrics, and all files."""

import shutil
from collections.abc import Mapping, Sequence
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
from pathspace_graph.eval.metrics.metric import METRICS, PAPER
from pathspace_graph.eval.metrics.summary import has_cones, versions
from pathspace_graph.io.files import atomic_folder, write_json
from pathspace_graph.io.map import read_map
from pathspace_graph.io.overrides import Overrides
from pathspace_graph.io.results import SMOOTHED_FILE, TRAJECTORY_FILE
from pathspace_graph.io.tables import read_trajectory
from pathspace_graph.settings.mapper import MapperSettings

from .cells import EstimatorCell
from .drives import log_folders
from .frame import add_batch, write_csv
from .plots import Drawn, plot_maps
from .run import Plan, make_plan, run_records
from .runner import Record, run_folder
from .statistics import estimate
from .study import Study
from .tables import Quantity, Table

MARKER: Final = "comparison.json"  # file by which a comparison's folder is recognized
RUN: Final = ("log", "estimator")
WITHOUT_TRUTH: Final = (  # metrics that say something of a log without true cones
    *("size", "closed_at_end", "end_off", "crossings", "reported_degraded", "reported_lost", "ms_mean"),
)


def plan_of(
    logs: Path,
    estimators: Sequence[str] = (),
    settings: MapperSettings | None = None,
    own: Overrides | None = None,
) -> Plan:
    """Return the plan of every estimator, or those named, on a log or a folder of logs."""
    known = registry.known_estimators()
    for name in estimators:
        check_name(name, known, "--estimators: expected a known estimator")
    chosen = tuple(dict.fromkeys(estimators or known))
    study = Study(
        name="comparison",
        logs={name: (folder,) for name, folder in log_folders(logs).items()},
        estimators=chosen,
        settings=settings or MapperSettings(),
        own=own or {},
    )
    return make_plan(study, keep=True)


@dataclass(frozen=True, eq=False)
class Comparison:
    """All results, log by log."""

    plan: Plan
    records: Mapping[str, Record]  # by the cell
    folder: Path  # of the files of the runs

    @cached_property
    def results(self) -> tuple[tuple[EstimatorCell, Record], ...]:
        return tuple((cell, self.records[cell.id]) for cell in self.plan.cells)

    @cached_property
    def frame(self) -> pd.DataFrame:
        """Tidy row per run and lap, and one per run for the whole log."""
        rows: list[dict[str, Any]] = []
        for cell, record in self.results:
            for row in record["rows"]:
                about = {"scope": "lap" if row["lap"] else "log", "lap": row["lap"] or record["lap_count"]}
                rows.append({**row, **_names(cell), **about})
        add_batch(rows, ("log",))
        order = [*RUN, "scope", "lap", *METRICS]
        known = [name for name in order if name in order[:4] or any(name in row for row in rows)]
        return pd.DataFrame(rows, columns=known)

    @property
    def final(self) -> pd.DataFrame:
        return self.frame[self.frame["scope"] == "log"]

    def times(self) -> pd.DataFrame:
        """Return a tidy row per run and stage, in s."""
        rows = [
            {**_names(cell), **stage} for cell, record in self.results for stage in record.get("stages", ())
        ]
        return pd.DataFrame(rows, columns=[*RUN, "stage", "mean", "median", "p99", "share"])

    @property
    def logs(self) -> tuple[str, ...]:
        return tuple(self.plan.study.logs)

    @property
    def estimators(self) -> tuple[str, ...]:
        return self.plan.study.estimators

    @cached_property
    def has_truth(self) -> bool:
        return "rmse" in self.frame or any(has_cones(cell.drive.load()[0].truth) for cell in self.plan.cells)

    @property
    def failures(self) -> list[dict[str, Any]]:
        return [{**_names(cell), "error": one["failure"]} for cell, one in self.results if one["failure"]]

    @property
    def unsettled(self) -> list[dict[str, Any]]:
        """Names of the batches that did not converge."""
        return [
            _names(cell)
            for cell, one in self.results
            if one["rows"] and one["rows"][-1].get("converged") is False
        ]


def compare(plan: Plan, folder: Path, **how: Any) -> Comparison:
    """Run what is missing of a plan in a folder; `how` is that of `run_records`."""
    return Comparison(plan, run_records(plan, folder, **how), folder)


def _names(cell: EstimatorCell) -> dict[str, Any]:
    return {"log": cell.names["track"], "estimator": cell.estimator}


# --- tables ----------------------------------------------------------------------------------------------


def tables(comparison: Comparison) -> dict[str, Table]:
    """Return the tables by the name of their files."""
    short = paper_table(comparison) if comparison.has_truth else final_table(comparison, WITHOUT_TRUTH)
    return {"table": short, "metrics": final_table(comparison)}


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


def paper_table(comparison: Comparison) -> Table:
    """Return the paper's Table 1, lap by lap."""
    logs = ["logs"] if len(comparison.logs) > 1 else []
    rows = []
    for row in paper_frame(comparison).to_dict("records"):
        lap = ("end" if row["logs"] else "failed") if pd.isna(row["lap"]) else str(int(row["lap"]))
        cells = (Quantity.measured(metric, row[metric.key], row[f"{metric.key}_half"]) for metric in PAPER)
        rows.append((row["estimator"], lap, *(str(row[key]) for key in logs), *cells))
    header = ("estimator", "lap", *logs, *(metric.heading for metric in PAPER))
    return Table(header, tuple(rows), _title(comparison, "at the end of each lap"))


def final_table(comparison: Comparison, keys: Sequence[str] = tuple(METRICS)) -> Table:
    """Return the means over the logs of metrics of whole logs, with a column for each estimator."""
    final, names = comparison.final, comparison.estimators
    known = [METRICS[key] for key in keys if key in final and final[key].astype(float).notna().any()]
    of = {name: final[final["estimator"] == name] for name in names}
    rows = ((m.heading, *(Quantity.measured(m, m.over(of[name][m.key])) for name in names)) for m in known)
    return Table(("metric", *names), tuple(rows), _title(comparison, "at the end of the log"))


def side_by_side(laps: dict[str, Sequence[LapMetrics]]) -> Table:
    """Return Table 1 as in the paper: a row per lap, with rmse, missed and size under each estimator."""
    titles = "   ".join(metric.heading for metric in PAPER)
    header, rows = ("lap", *(f"{name}\n{titles}" for name in laps)), []
    for lap, beside in enumerate(zip_longest(*laps.values()), start=1):
        values = ({} if row is None else asdict(row) for row in beside)
        texts = ([(m.text(row.get(m.key, np.nan)), len(m.heading)) for m in PAPER] for row in values)
        rows.append((str(lap), *("   ".join(text.rjust(width) for text, width in three) for three in texts)))
    return Table(header, tuple(rows), names=0)


def _title(comparison: Comparison, when: str) -> str:
    count = len(comparison.logs)
    logs = comparison.logs[0] if count == 1 else f"mean over {count} logs"
    missing = " (the log has no true cones, which rmse, missed and most other metrics need)"
    return f"{logs}, {when}{'' if comparison.has_truth else missing}"


# --- files -----------------------------------------------------------------------------------------------


def write_comparison(out: Path, comparison: Comparison, jobs: int, *, force: bool = False) -> None:
    """Write all files of a comparison (docs/formats.md), or on failure none.

    Each of several logs has a folder of its own. An earlier comparison in `out` is replaced if `force`.
    """
    frames = {"table": paper_frame(comparison), "metrics": comparison.frame, "times": comparison.times()}
    with atomic_folder(out, MARKER, force=force) as folder:
        for name, table in tables(comparison).items():
            table.write(folder, name, "md", "tex")
        for name, frame in frames.items():
            write_csv(folder / f"{name}.csv", frame)
        for log in comparison.logs:
            _write_log(folder if len(comparison.logs) == 1 else folder / log, log, comparison)
        about = {
            "format": "pathspace-comparison/1",
            "logs": comparison.logs,
            "estimators": comparison.estimators,
            "failures": comparison.failures,
            "jobs": jobs,
            "settings": asdict(comparison.plan.study.settings),
            "versions": versions(),
        }
        write_json(folder / MARKER, about)


def _write_log(folder: Path, name: str, comparison: Comparison) -> None:
    """Copy the files of the runs on a log, and draw their maps."""
    folder.mkdir(exist_ok=True)
    drawn, truth = dict[str, Drawn](), None
    for cell, record in comparison.results:
        if cell.names["track"] != name or record["failure"]:
            continue
        run = shutil.copytree(run_folder(comparison.folder, cell), folder / cell.estimator)
        file = next(run / name for name in (SMOOTHED_FILE, TRAJECTORY_FILE) if (run / name).exists())
        drawn[cell.estimator] = Drawn(read_map(run), read_trajectory(file)[1], record["rows"][-1])
        truth = cell.drive.load()[0].truth
    if drawn:
        save_figures(folder, {"maps": plot_maps(drawn, truth)})
