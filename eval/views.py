"""Tables of measured frames: rows of figures, each a mean with its 95 % interval."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import repeat
from math import isfinite, isnan
from typing import Final, Self

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from .experiment.faults import outcomes
from .experiment.frame import COMBINATION, RUN, RUN_OF, TIMES, contrasts, last_laps
from .experiment.statistics import by_track, estimate
from .experiment.study import Study
from .metrics.metric import METRICS

ESTIMATORS: Final = ("fixed-lag", "spline", "landmark-fixed-lag", "landmark-batch", "ckf", "landmark-ckf")
ONLINE, BATCH, LANDMARKS = ESTIMATORS[:3]
FAULTS: Final = {  # columns of the table of faults: value and digits
    "rmse by clean": ("ratio_mean", 2),
    "least": ("ratio_min", 2),
    "most": ("ratio_max", 2),
    "missed [%]": ("missed", 1),
    "closed [%]": ("closed", 0),
    "lost at the end [%]": ("lost", 0),
    "largest error [m]": ("error_max", 1),
    "called degraded [%]": ("reported_degraded", 1),
    "reported [%]": ("reported", 0),
    "longest time over 1 m off [s]": ("divergence_time", 1),
    "longest way over 1 m off [m]": ("divergence_distance", 0),
}


@dataclass(frozen=True)
class Figure:
    """A measured value, with half the width of its 95 % interval over tracks or drives."""

    value: float | None  # value in the table's unit; None where there is none
    half: float | None = None
    digits: int = 3

    @classmethod
    def of(cls, values: ArrayLike, digits: int = 3, factor: float = 1.0) -> Self:
        """Return the mean of the known values (n,), times a factor."""
        array = np.asarray(values, float)
        mean = estimate(factor * array[np.isfinite(array)])
        value, half = (float(x) if isfinite(x) else None for x in (mean.mean, mean.half))
        return cls(value, half, digits)

    @classmethod
    def known(cls, value: float, digits: int = 3) -> Self:
        """Return a value without an interval, or none where it is NaN."""
        return cls(None if isnan(value) else float(value), None, digits)

    @classmethod
    def row(cls, values: Iterable[float], *digits: int) -> tuple[Self, ...]:
        """Return known values, each with its own digits, or all with the same."""
        return tuple(map(cls.known, values, digits if len(digits) > 1 else repeat(*digits)))

    @property
    def texts(self) -> tuple[str, str]:
        """Value and half width of its interval, rounded; empty where they are not known."""
        value, half = ("" if x is None else f"{x:.{self.digits}f}" for x in (self.value, self.half))
        return value, half

    def __str__(self) -> str:
        return " ± ".join(filter(None, self.texts))


Rows = tuple[tuple[str, tuple[Figure, ...]], ...]  # label and figures of each row
View = tuple[tuple[str, ...], Rows]  # header and rows of a table


def laps_table(frame: pd.DataFrame, laps: Sequence[int], keys: Sequence[str]) -> View:
    """Return metrics of the online map after some laps, and of the batch where it ran."""
    online, batch = (frame[frame["estimator"] == name] for name in (ONLINE, BATCH))
    columns = {f"lap {lap}": online[online["lap"] == lap] for lap in dict.fromkeys(laps)}
    columns |= {"batch": last_laps(batch)} if len(batch) else {}
    return _by_metric(keys, columns)


def tracks_table(frame: pd.DataFrame) -> View:
    """Return the online map and that of the batch, track by track: too few drives for an interval."""
    online, batch = (frame[frame["estimator"] == name] for name in (ONLINE, BATCH))
    first, last = online[online["lap"] == 1], last_laps(online)
    columns = {
        "rmse, lap 1 [m]": ("rmse", first),
        "rmse, last lap [m]": ("rmse", last),
        "rmse, batch [m]": ("rmse", last_laps(batch)),
        "missed, lap 1 [%]": ("missed", first),
        "size [% of cones]": ("size_share", last),
        "within 2σ [%]": ("inside", last),
        "NEES": ("nees", last),
    }

    def row(track: str) -> tuple[Figure, ...]:
        parts = ((key, part[part["track"] == track]) for key, part in columns.values())
        return tuple(replace(_figure(key, part), half=None) for key, part in parts)

    return ("track", *columns), tuple((str(track), row(track)) for track in frame["track"].unique())


def rmse_table(frame: pd.DataFrame) -> View:
    """Return the rmse of every online estimator after each lap."""
    names = [name for name in ESTIMATORS if frame[frame["estimator"] == name]["lap"].nunique() > 1]
    rows = tuple(
        (str(lap), tuple(_figure("rmse", part[part["estimator"] == name]) for name in names))
        for lap, part in frame[frame["lap"] > 0].groupby("lap")
    )
    return ("rmse after lap [m]", *names), rows


def metrics_table(frame: pd.DataFrame, keys: Sequence[str]) -> View:
    """Return metrics of every estimator at the end of its last lap, one in each column."""
    return _by_metric(keys, _parts(frame, "estimator"))


def runs_table(frame: pd.DataFrame, names: Sequence[str], keys: Sequence[str]) -> View:
    """Return metrics at the end of the last lap, with a row for each value of the columns `names`."""
    rows = tuple(
        (label, tuple(_figure(key, part) for key in keys)) for label, part in _parts(frame, *names).items()
    )
    return (", ".join(names), *(METRICS[key].heading for key in keys)), rows


def skidpad_table(frame: pd.DataFrame) -> View:
    """Return every estimator: its trajectory error over the whole drive, and its map at the end."""
    square = (frame["ate"] ** 2).groupby([frame[name] for name in RUN_OF]).transform("mean")
    return runs_table(frame.assign(ate=square**0.5), ("estimator",), ("ate", "rmse", "missed"))


def camera_table(frame: pd.DataFrame, keys: Sequence[str]) -> View:
    """Return the map of each estimator on drawn cars, and the rmse that the landmarks' limit allows."""
    header, rows = runs_table(frame, ("estimator",), keys)
    limit = _figure("l", last_laps(frame).drop_duplicates([*RUN]))  # one of each drive
    return header, (*rows, ("landmarks, given all", (limit, *[Figure(None)] * (len(keys) - 1))))


def study_table(study: Study, frame: pd.DataFrame) -> View:
    """Return each combination: the first metric of the study, its paired difference and p, and the others."""
    several = [name for name in COMBINATION if frame[name].nunique() > 1] or ["variant"]
    first, *others = (key for key in study.metrics if key in frame and key not in TIMES)
    last, rows = last_laps(frame), []
    for contrast in contrasts(study, frame, first):
        names = [getattr(contrast, name) for name in several]
        part = last[(last[several] == names).all(axis=1)]
        difference = Figure.of(contrast.differences, METRICS[first].digits, METRICS[first].factor)
        rest = (_figure(key, part) for key in others)
        rows.append((", ".join(names), (_figure(first, part), difference, Figure.known(contrast.p), *rest)))
    headings = [METRICS[key].heading for key in (first, *others)]
    return (", ".join(several), headings[0], "difference", "p", *headings[1:]), tuple(rows)


def hints_table(rows: pd.DataFrame) -> View:
    """Return the number of logs whose cause is named, for each mistake, or that are accused."""
    spoiled, good = rows[rows["kind"] == "spoiled"], rows[rows["kind"] == "good"]
    groups = {str(name): of["named"] for name, of in spoiled.groupby("name", sort=False)}
    groups |= {"all mistakes": spoiled["named"], "good logs, accused of any": good["accused"]}
    rows = tuple((name, Figure.row((hits.sum(), len(hits)), 0)) for name, hits in groups.items())
    return ("mistake", "named", "logs"), rows


def faults_table(study: Study, frame: pd.DataFrame) -> View:
    """Return the cost of each fault relative to the clean run of its track, and how often it is reported."""
    rows = []
    for noise, values in zip(study.noise, outcomes(study, frame), strict=True):
        values |= {name: values[name] / max(values["runs"], 1) for name in ("closed", "lost", "reported")}
        figures = tuple(
            Figure.of([values[key]], digits, 100.0 if "%" in title else 1.0)
            for title, (key, digits) in FAULTS.items()
        )
        rows.append((noise, figures))
    return ("fault", *FAULTS), tuple(rows)


def _parts(frame: pd.DataFrame, *names: str) -> dict[str, pd.DataFrame]:
    """Return the last lap of each run, by the values of some columns."""
    groups = last_laps(frame).groupby([*names], sort=False)
    return {", ".join(map(str, values)): part for values, part in groups}


def _by_metric(keys: Sequence[str], parts: Mapping[str, pd.DataFrame]) -> View:
    figures = ((key, tuple(_figure(key, part) for part in parts.values())) for key in keys)
    return ("metric", *parts), tuple((METRICS[key].heading, row) for key, row in figures)


def _figure(key: str, part: pd.DataFrame) -> Figure:
    metric, values = METRICS[key], part[key] if key in part else pd.Series(dtype=float)
    if metric.average == "rms":
        return Figure.known(metric.factor * metric.over(values.astype(float)), metric.digits)
    if len(values):
        values = by_track(part.set_index("track")[key].astype(float).dropna())
    return Figure.of(values, metric.digits, metric.factor)
