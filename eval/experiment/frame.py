"""The one frame: results with a row for each run and lap, its views, and paired statistics of it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy import stats

from pathspace_graph.estimators import DEFAULT_BATCH
from pathspace_graph.eval.metrics.metric import METRICS
from pathspace_graph.eval.metrics.summary import versions
from pathspace_graph.factors.arrays import Array
from pathspace_graph.io.files import replacing
from pathspace_graph.io.overrides import leaves

from .cells import Cell, Drive, Record
from .study import Study

COMBINATION: Final = ("noise", "estimator", "variant")  # columns of a combination, which is compared
RUN: Final = ("track", "seed")  # columns of a drive; combinations are paired on the same drive and noise
RUN_OF: Final = (*RUN, *COMBINATION)
TIMES: Final = tuple(key for key, metric in METRICS.items() if metric.time)  # wall times
MADE: Final = ("commit", "host", "processor", "blas", "date", "command")  # where and when a run was made
LEVEL: Final = 0.95  # confidence level of intervals; a difference is significant if p < 1 - LEVEL


def frame_of(study: Study, cells: Sequence[tuple[Cell[Drive], Record | None]]) -> pd.DataFrame:
    """Return a row for each run and lap, or one for a failed run; every varied setting is a column."""
    rows = []
    for cell, record in cells:
        assert record is not None, "every cell has been run by now"
        shared = {"study": study.name} | cell.names | _settings_row(study, cell)
        about = {"failure": record["failure"], "notices": record["notices"], **record["made"]}
        about["cell"] = cell.id
        rows += [shared | lap | about for lap in record["laps"]] or [shared | {"lap": None} | about]
    add_batch(rows, (*RUN, "noise", "variant"))
    settings = _settings_row(study, cells[0][0])
    order = ["study", *RUN_OF, *settings, "lap", *METRICS, "failure", "notices", *versions(), "cell"]
    known = dict.fromkeys([*order, *(name for row in rows for name in row)])
    frame = pd.DataFrame(rows, columns=[name for name in known if any(name in row for row in rows)])
    return frame.astype({"lap": "Int64"})


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


def _settings_row(study: Study, cell: Cell[Drive]) -> dict[str, Any]:
    """Return the varied settings of a cell; one that its estimator does not have is None."""
    settings, simulation = leaves(cell.settings), leaves(cell.drive.simulation)
    if cell.parameters is not None:
        settings |= {f"{cell.estimator}.{name}": value for name, value in leaves(cell.parameters).items()}
    row = {f"simulation.{name}": simulation[name] for name in study.varied_noise}
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


@dataclass(frozen=True, slots=True)
class Estimate:
    """Mean and its 95 % interval by Student's t over runs."""

    mean: float  # NaN without runs
    half: float  # half the width of the interval; NaN for fewer than two runs
    count: int  # number of runs, or of pairs of runs

    @property
    def low(self) -> float:
        return self.mean - self.half

    @property
    def high(self) -> float:
        return self.mean + self.half


def estimate(values: Array) -> Estimate:
    """Return the mean of the values (n,) and its interval, mean -+ t(0.975, n - 1) s / sqrt(n)."""
    n = len(values)
    if n < 2:
        return Estimate(float(values[0]) if n else float("nan"), float("nan"), n)
    half = float(stats.t.ppf(0.5 + LEVEL / 2, n - 1) * stats.sem(values))
    return Estimate(float(np.mean(values)), half, n)


def difference(values: ArrayLike, reference: ArrayLike) -> Estimate:
    """Return the estimate of values - reference (n,) over the pairs of which both are finite."""
    own, others = np.asarray(values, dtype=float), np.asarray(reference, dtype=float)
    finite = np.isfinite(own) & np.isfinite(others)
    return estimate(own[finite] - others[finite])


def paired_p(differences: Array) -> float:
    """Return the two-sided p of the paired t-test that the mean of the differences (n,) is 0.

    It is NaN for fewer than two pairs. Without any spread it is 1 where all differences are 0, else 0.
    """
    if len(differences) < 2:
        return float("nan")
    if np.ptp(differences) == 0.0:
        return float(differences[0] == 0.0)
    return float(stats.ttest_1samp(differences, 0.0).pvalue)


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


@dataclass(frozen=True)
class Contrast:
    """One metric of one combination, and its difference from the baseline, run by run."""

    noise: str
    estimator: str
    variant: str
    metric: str  # key of the metric
    value: Estimate  # mean over all runs, each at the end of its last lap
    difference: Estimate | None  # mean over the pairs; None for the baseline itself
    differences: tuple[float, ...] = ()
    p: float = float("nan")  # p of the paired t-test, corrected for all comparisons of the metric

    @property
    def significant(self) -> bool:
        """Whether chance alone rarely makes such a difference anywhere in the study."""
        return bool(self.p < 1.0 - LEVEL)


def contrasts(study: Study, frame: pd.DataFrame, metric: str) -> list[Contrast]:
    """Return every combination against the baseline of its noise, in the study's order."""
    known = last_laps(frame).astype({metric: float}).dropna(subset=[metric])
    runs = {key: of.set_index([*RUN])[metric] for key, of in known.groupby([*COMBINATION], sort=False)}
    nothing, contrasted = pd.Series(dtype=float), []
    for key in product(study.noise, study.estimators, study.points):
        base = (key[0], study.baseline.estimator or key[1], study.baseline_variant)
        values, against = runs.get(key, nothing), runs.get(base, nothing)
        contrast = Contrast(*key, metric, estimate(values.to_numpy()), None)
        if key != base:
            shared = values.index[values.index.isin(against.index)]
            d = values[shared].to_numpy() - against[shared].to_numpy()
            contrast = replace(contrast, difference=estimate(d), differences=tuple(d.tolist()), p=paired_p(d))
        contrasted.append(contrast)
    corrected = holm(np.array([contrast.p for contrast in contrasted]))
    return [replace(contrast, p=float(p)) for contrast, p in zip(contrasted, corrected, strict=True)]
