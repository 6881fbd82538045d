"""The one frame: results with a row for each run and lap, its views, and what differs in it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd

from pathspace_graph.estimators import DEFAULT_BATCH
from pathspace_graph.eval.metrics.metric import METRICS
from pathspace_graph.eval.metrics.summary import versions
from pathspace_graph.io.files import replacing
from pathspace_graph.io.overrides import leaves

from .cells import EstimatorCell
from .runner import Record
from .statistics import LEVEL, Estimate, by_track, estimate, holm, paired_p, wilcoxon_p
from .study import Study

COMBINATION: Final = ("noise", "estimator", "variant")  # columns of a combination, which is compared
RUN: Final = ("track", "seed")  # columns of a drive; combinations are paired on the same drive and noise
RUN_OF: Final = (*RUN, *COMBINATION)
TIMES: Final = tuple(key for key, metric in METRICS.items() if metric.time)
MADE: Final = ("commit", "host", "processor", "blas", "date", "command")  # where and when a run was made


def frame_of(study: Study, cells: Sequence[tuple[EstimatorCell, Record]]) -> pd.DataFrame:
    """Return a row for each run and lap, or one for a failed run; every varied setting is a column."""
    rows = []
    for cell, record in cells:
        shared = {"study": study.name} | cell.names | _settings_row(study, cell)
        about = {"failure": record["failure"], "notices": record.get("notices", ""), **record["made"]}
        about |= {"drive": cell.drive.source, "cell": cell.id}
        rows += [shared | lap | about for lap in lap_rows(record["rows"])] or [shared | {"lap": None} | about]
    add_batch(rows, (*RUN, "noise", "variant"))
    settings = _settings_row(study, cells[0][0])
    order = ["study", *RUN_OF, *settings, "lap", *METRICS, "failure", "notices", *versions(), "drive", "cell"]
    known = dict.fromkeys([*order, *(name for row in rows for name in row)])
    frame = pd.DataFrame(rows, columns=[name for name in known if any(name in row for row in rows)])
    return frame.astype({"lap": "Int64"})


def lap_rows(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return a row for each lap, with the metrics of the whole run, the last row, beside its own.

    A run that completed no lap has one row, that of the whole run as lap 1.
    """
    if not rows:
        return []
    *laps, whole = rows
    shared = {key: value for key, value in whole.items() if key != "lap" and METRICS[key].scope == "run"}
    return [{**row, **shared} for row in laps] or [{**whole, "lap": 1}]


def add_batch(rows: Sequence[dict[str, Any]], names: Sequence[str]) -> None:
    """Add the turn (rad) of each map from that of the batch with the same `names`, and the rmse by its own.

    The turns are from the truth, since small turns add up. Rows that lack a metric, like the batch, are left.
    """
    batches = {tuple(row[name] for name in names): row for row in rows if row["estimator"] == DEFAULT_BATCH}
    for row in rows:
        batch = batches.get(tuple(row[name] for name in names), {})
        if row["estimator"] != DEFAULT_BATCH and {"turn", "rmse"} <= set(row) & set(batch):
            row["turn_from_batch"] = float(row["turn"] - batch["turn"])
            row["rmse_by_batch"] = float(row["rmse"] / batch["rmse"])


def _settings_row(study: Study, cell: EstimatorCell) -> dict[str, Any]:
    """Return the varied settings of a cell; one that its estimator does not have is None."""
    settings, simulated = leaves(cell.settings), cell.drive.simulation
    simulation = {} if simulated is None else leaves(simulated)
    if cell.parameters is not None:
        settings |= {f"{cell.estimator}.{name}": value for name, value in leaves(cell.parameters).items()}
    row = {f"simulation.{name}": simulation.get(name) for name in study.varied_noise}
    own = {"study", *RUN_OF}
    row |= {f"settings.{name}" if name in own else name: settings.get(name) for name in study.varied}
    return {name: " ".join(map(str, v)) if isinstance(v, tuple) else v for name, v in row.items()}


def without_times(frame: pd.DataFrame) -> pd.DataFrame:
    """Return the columns that are the same whenever the study is run."""
    return frame.drop(columns=[*TIMES, *MADE], errors="ignore")


def write_results(frame: pd.DataFrame, out: Path) -> None:
    """Write the results, and apart from them how long they took, and where and when they were made."""
    write_csv(out / "results.csv", without_times(frame))
    times = [name for name in (*TIMES, *MADE) if name in frame]
    write_csv(out / "times.csv", frame[["study", *RUN_OF, "lap", *times]])


def write_csv(file: Path, frame: pd.DataFrame) -> None:
    """Write a frame without its index, whole or not at all."""
    with replacing(file) as temporary:
        frame.to_csv(temporary, index=False, lineterminator="\n")


def last_laps(frame: pd.DataFrame) -> pd.DataFrame:
    """Return the last row of each run that finished."""
    finished = frame[frame["failure"] == ""]
    return finished.groupby(list(RUN_OF), sort=False).tail(1)


@dataclass(frozen=True)
class Contrast:
    """One metric of one combination, and its difference from the baseline, drive by drive."""

    noise: str
    estimator: str
    variant: str
    metric: str  # key of the metric
    runs: int  # number of runs with a value at the end of their last lap
    value: Estimate  # mean over the tracks
    difference: Estimate | None  # mean over the tracks; None for the baseline itself
    differences: tuple[float, ...] = ()  # of each track, or of each drive of a single track
    p: float = float("nan")  # p of the paired t-test over them, corrected for all hypotheses of the metric
    wilcoxon: float = float("nan")  # p of Wilcoxon's signed-rank test over them, not corrected

    @property
    def significant(self) -> bool:
        """Whether chance alone rarely makes such a difference anywhere in the study."""
        return bool(self.p < 1.0 - LEVEL)


def contrasts(study: Study, frame: pd.DataFrame, metric: str) -> list[Contrast]:
    """Return every combination against the baseline of its noise, in the study's order.

    Nothing is tested where all differences are 0, as between cells that mean the same, nor of a wall time,
    which depends on what else the machine does. The cells of a drive are run one after another, so that
    processor times are.
    """
    known = last_laps(frame).astype({metric: float}).dropna(subset=[metric])
    runs = {key: of.set_index([*RUN])[metric] for key, of in known.groupby([*COMBINATION], sort=False)}
    nothing = pd.Series(dtype=float, index=pd.MultiIndex.from_arrays([[], []], names=RUN))
    contrasted = []
    for key in product(study.noises, study.estimators, study.points):
        base = (key[0], study.baseline.estimator or key[1], study.baseline_variant)
        values, against = runs.get(key, nothing), runs.get(base, nothing)
        contrast = Contrast(*key, metric, len(values), estimate(by_track(values).to_numpy()), None)
        if key != base:
            d = by_track((values - against).dropna()).to_numpy()
            contrast = replace(contrast, difference=estimate(d), differences=tuple(d.tolist()))
            if d.any() and METRICS[metric].time != "wall":
                contrast = replace(contrast, p=paired_p(d), wilcoxon=wilcoxon_p(d))
        contrasted.append(contrast)
    corrected = holm(np.array([contrast.p for contrast in contrasted]))
    return [replace(contrast, p=float(p)) for contrast, p in zip(contrasted, corrected, strict=True)]
