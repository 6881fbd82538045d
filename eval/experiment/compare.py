"""Every estimator on the same logs: the paper's Table 1, all metrics, and all files."""

import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd

from pathspace_graph import estimators as registry
from pathspace_graph.errors import check_name
from pathspace_graph.eval.figures.drawing import plot_maps, save_figures
from pathspace_graph.eval.metrics.accuracy import LapMetrics
from pathspace_graph.eval.metrics.measures import METRICS, PAPER, has_cones, versions
from pathspace_graph.factors.arrays import Array
from pathspace_graph.io.files import atomic_folder, write_json
from pathspace_graph.io.map import Map, read_map
from pathspace_graph.io.results import SMOOTHED_FILE, TRAJECTORY_FILE
from pathspace_graph.io.tables import read_trajectory
from pathspace_graph.settings.checked import Overrides
from pathspace_graph.settings.mapper import MapperSettings

from .run import EstimatorCell, Plan, Record, add_batch, make_plan, run_folder, run_records
from .study import Study, log_folders
from .tables import TextTable, estimate, write_csv

MARKER: Final = "comparison.json"  # file by which a comparison's folder is recognized


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
    study = Study(
        name="comparison",
        logs={name: (folder,) for name, folder in log_folders(logs).items()},
        estimators=tuple(dict.fromkeys(estimators or known)),
        settings=settings or MapperSettings(),
        own=own or {},
    )
    return make_plan(study, keep=True)


@dataclass(frozen=True, eq=False)
class Comparison:
    """All results, log by log."""

    study: Study
    results: Sequence[tuple[EstimatorCell, Record]]
    """Cell and record of each run."""
    frame: pd.DataFrame
    """Tidy row per run and lap, and one per run for the whole log."""
    has_truth: bool
    folder: Path  # of the files of the runs

    @property
    def failures(self) -> list[dict[str, Any]]:
        return [{**_names(cell), "error": one["failure"]} for cell, one in self.results if one["failure"]]

    @property
    def unsettled(self) -> list[dict[str, Any]]:
        """Names of the batches that did not converge."""
        runs = ((cell, one["rows"]) for cell, one in self.results)
        return [_names(cell) for cell, rows in runs if rows and rows[-1].get("converged") is False]


def _names(cell: EstimatorCell) -> dict[str, Any]:
    return {"log": cell.drive.track, "estimator": cell.estimator}


def compare(plan: Plan, folder: Path, **how: Any) -> Comparison:
    """Run what is missing of a plan in a folder; `how` is that of `run_records`."""
    records, rows = run_records(plan, folder, **how), list[dict[str, Any]]()
    results = [(cell, records[cell.id]) for cell in plan.cells]
    for cell, record in results:
        for row in record["rows"]:
            about = {"scope": "lap" if row["lap"] else "log", "lap": row["lap"] or record["lap_count"]}
            rows.append({**row, **_names(cell), **about})
    add_batch(rows, ("log",))
    known = [key for key in METRICS if any(key in row for row in rows)]
    frame = pd.DataFrame(rows, columns=["log", "estimator", "scope", "lap", *known])
    has_truth = "rmse" in frame or any(has_cones(cell.drive.load()[0].truth) for cell in plan.cells)
    return Comparison(plan.study, results, frame, has_truth, folder)


# --- tables ----------------------------------------------------------------------------------------------


def tables(comparison: Comparison) -> dict[str, TextTable]:
    """Return the tables by the name of their files."""
    without = (
        "size",
        "closed_at_end",
        "end_off",
        "crossings",
        "reported_degraded",
        "reported_lost",
        "ms_mean",
    )
    short = paper_table(comparison) if comparison.has_truth else final_table(comparison, without)
    return {"table": short, "metrics": final_table(comparison)}


def paper_frame(comparison: Comparison) -> pd.DataFrame:
    """Return rmse (m), missed (share) and size of each estimator and lap, means over `logs` logs.

    `rmse_half` and so on are half the widths of their 95 % intervals.

    An estimator that completed no lap on any log has a row without a lap, of its maps at the end of the logs.
    """
    rows = []
    for estimator in comparison.study.estimators:
        runs = comparison.frame.query("estimator == @estimator")
        laps = runs[runs["scope"] == "lap"]
        for lap, over_logs in laps.groupby("lap") if len(laps) else [(np.nan, runs)]:
            found = {metric.key: estimate(over_logs.get(metric.key, ())) for metric in PAPER}
            means = {key: mean for key, (mean, _) in found.items()}
            halves = {f"{key}_half": half for key, (_, half) in found.items()}
            rows.append({"estimator": estimator, "lap": lap, "logs": len(over_logs), **means, **halves})
    return pd.DataFrame(rows).astype({"lap": "Int64"})


def paper_table(comparison: Comparison) -> TextTable:
    """Return the paper's Table 1, lap by lap."""
    found = paper_frame(comparison)
    ends = np.where(found["logs"] > 0, "end", "failed")
    texts = found[["estimator"]].assign(lap=found["lap"].astype("str").where(found["lap"].notna(), ends))
    if len(comparison.study.logs) > 1:
        texts["logs"] = found["logs"].astype("str")
    for metric in PAPER:
        both = zip(found[metric.key], found[f"{metric.key}_half"], strict=True)
        texts[metric.heading] = [metric.text(*pair) for pair in both]
    return TextTable(texts, _title(comparison, "at the end of each lap"))


def final_table(comparison: Comparison, keys: Sequence[str] = tuple(METRICS)) -> TextTable:
    """Return the means over the logs of metrics of whole logs, with a column for each estimator."""
    frame, names = comparison.frame, comparison.study.estimators
    final = frame[frame["scope"] == "log"]
    known = [METRICS[key] for key in keys if key in final and final[key].astype(float).notna().any()]
    of = {name: final[final["estimator"] == name] for name in names}
    rows = ((m.heading, *(m.text(m.over(of[name][m.key])) for name in names)) for m in known)
    return TextTable.of(("metric", *names), rows, _title(comparison, "at the end of the log"))


def side_by_side(laps: dict[str, Sequence[LapMetrics]]) -> TextTable:
    """Return Table 1 as in the paper: a row per lap, with rmse, missed and size under each estimator."""
    titles = "   ".join(metric.heading for metric in PAPER)
    header, rows = ("lap", *(f"{name}\n{titles}" for name in laps)), []
    for lap, beside in enumerate(zip_longest(*laps.values()), start=1):
        values = ({} if row is None else asdict(row) for row in beside)
        texts = ([(m.text(row.get(m.key, np.nan)), len(m.heading)) for m in PAPER] for row in values)
        rows.append((str(lap), *("   ".join(text.rjust(width) for text, width in three) for three in texts)))
    return TextTable.of(header, rows, names=0)


def _title(comparison: Comparison, when: str) -> str:
    names = [*comparison.study.logs]
    logs = names[0] if len(names) == 1 else f"mean over {len(names)} logs"
    missing = " (the log has no true cones, which rmse, missed and most other metrics need)"
    return f"{logs}, {when}{'' if comparison.has_truth else missing}"


# --- files -----------------------------------------------------------------------------------------------


def write_comparison(out: Path, comparison: Comparison, jobs: int, *, force: bool = False) -> None:
    """Write all files of a comparison (docs/formats.md), or on failure none.

    Each of several logs has a folder of its own. An earlier comparison in `out` is replaced if `force`.
    """
    study = comparison.study
    stages = [{**_names(of), **stage} for of, one in comparison.results for stage in one.get("stages", ())]
    times = pd.DataFrame(stages, columns=["log", "estimator", "stage", "mean", "median", "p99", "share"])
    frames = {"table": paper_frame(comparison), "metrics": comparison.frame, "times": times}
    with atomic_folder(out, MARKER, force=force) as folder:
        for name, table in tables(comparison).items():
            table.write(folder, name, "md", "tex")
        for name, frame in frames.items():
            write_csv(folder / f"{name}.csv", frame)
        for log in study.logs:  # with the files of its runs, and their maps in one picture
            place = folder if len(study.logs) == 1 else folder / log
            drawn, truth = dict[str, tuple[Map, Array]](), None
            place.mkdir(exist_ok=True)
            for cell, record in comparison.results:
                if cell.drive.track != log or record["failure"]:
                    continue
                run = shutil.copytree(run_folder(comparison.folder, cell), place / cell.estimator)
                file = next(run / name for name in (SMOOTHED_FILE, TRAJECTORY_FILE) if (run / name).exists())
                whole = record["rows"][-1]
                known = [metric for metric in PAPER if whole.get(metric.key) is not None]
                texts = [f"{m.title} {m.text(whole[m.key])} {m.unit}".strip() for m in known]
                drawn[f"{cell.estimator}\n{', '.join(texts)}"] = read_map(run), read_trajectory(file)[1]
                truth = cell.drive.load()[0].truth
            if drawn:
                save_figures(place, {"maps": plot_maps(drawn, truth)})
        about = {
            "format": "pathspace-comparison/1",
            "logs": [*study.logs],
            "estimators": study.estimators,
            "failures": comparison.failures,
            "jobs": jobs,
            "settings": asdict(study.settings),
            "versions": versions(),
        }
        write_json(folder / MARKER, about)
