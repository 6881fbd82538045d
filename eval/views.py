"""Views of the measured frames: the figures of each table of the pages."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import isfinite, isnan
from typing import Final, Self

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from .experiment.faults import outcomes
from .experiment.frame import COMBINATION, RUN, RUN_OF, TIMES, contrasts, estimate, last_laps
from .experiment.study import DEFAULT, Study
from .metrics.metric import METRICS

ESTIMATORS: Final = ("fixed-lag", "spline", "landmark-fixed-lag", "landmark-batch", "ckf", "landmark-ckf")
ONLINE, BATCH, LANDMARKS = ESTIMATORS[:3]
TITLES: Final = {"ate": "trajectory error [m]", "nees": "NEES of the map"}
TITLES_CAMERA: Final = TITLES | {"turn_nees": "NEES of the turn", "reported_degraded": "degraded [%]"}
"""Headings in tables that are short of room."""
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
}
RECOVERY: Final = {  # how long a vehicle is over a metre off after closing: value and digits
    "longest time [s]": ("divergence_time", 1),
    "longest way [m]": ("divergence_distance", 0),
}


@dataclass(frozen=True)
class Figure:
    """A measured value, with half the width of its 95 % interval over drives or runs."""

    value: float | None  # value in the table's unit; None where there is none
    half: float | None = None
    digits: int = 3

    @classmethod
    def of(cls, values: ArrayLike, digits: int = 3, factor: float = 1.0) -> Self:
        """Return the mean of the known values (n,), times a factor."""
        array = np.asarray(values, float)
        mean = estimate(factor * array[np.isfinite(array)])
        value, half = (round(x, 6) if isfinite(x) else None for x in (mean.mean, mean.half))
        return cls(value, half, digits)

    @classmethod
    def known(cls, value: float, digits: int = 3) -> Self:
        """Return a value without an interval, or none where it is NaN."""
        return cls(None if isnan(value) else round(value, 6), None, digits)

    @property
    def text(self) -> str:
        if self.value is None:
            return ""
        half = "" if self.half is None else f" ± {self.half:.{self.digits}f}"
        return f"{self.value:.{self.digits}f}{half}"


Rows = tuple[tuple[str, tuple[Figure, ...]], ...]  # label and figures of each row
View = tuple[tuple[str, ...], Rows]  # header and rows of a table


def lap_columns(frame: pd.DataFrame, laps: Sequence[int], keys: Sequence[str]) -> View:
    """Return metrics of the online map after some laps, and of the batch where it ran."""
    online, batch = (frame[frame["estimator"] == name] for name in (ONLINE, BATCH))
    drives = len(online[online["lap"] == online["lap"].min()])
    columns = {f"lap {lap}": online[online["lap"] == lap] for lap in laps}
    columns |= {"batch": last_laps(batch)} if len(batch) else {}
    return (f"mean over {drives} drives, at the end of", *columns), _by_metric(keys, columns)


def compared_table(frame: pd.DataFrame) -> View:
    """Return every estimator at the end of its last lap."""
    keys = ("rmse", "missed", "size", "ate")
    return _header("estimator, last lap", keys, TITLES), _by_part(_estimators(frame), keys)


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


def laps_table(frame: pd.DataFrame) -> View:
    """Return the rmse of every online estimator after each lap."""
    names = [name for name in ESTIMATORS if frame[frame["estimator"] == name]["lap"].nunique() > 1]
    rows = tuple(
        (str(lap), tuple(_figure("rmse", part[part["estimator"] == name]) for name in names))
        for lap, part in frame[frame["lap"] > 0].groupby("lap")
    )
    return ("rmse after lap [m]", *(f"`{name}`" for name in names)), rows


def metrics_table(frame: pd.DataFrame, keys: Sequence[str], names: Sequence[str] = ESTIMATORS) -> View:
    """Return metrics of every estimator at the end of its last lap."""
    parts = _estimators(frame, names)
    return ("last lap", *parts), _by_metric(keys, parts)


def skidpad_table(frame: pd.DataFrame) -> View:
    """Return every estimator: its trajectory error over the whole drive, and its map at the end."""
    square = (frame["ate"] ** 2).groupby([frame[name] for name in RUN_OF]).transform("mean")
    keys, parts = ("ate", "rmse", "missed"), _estimators(frame.assign(ate=square**0.5))
    return _header("estimator", keys, TITLES), _by_part(parts, keys)


def camera_table(frame: pd.DataFrame) -> View:
    """Return the map of each estimator at stated and at measured noise, and the limit of its landmarks."""
    keys, last = ("rmse", "missed", "nees", "turn_nees", "reported_degraded"), last_laps(frame)
    runs = last.groupby(["estimator", "variant"], sort=False)
    stated = {DEFAULT: "stated"}  # since a simulated log states its own noise
    parts = {f"`{estimator}`, {stated.get(noise, noise)}": part for (estimator, noise), part in runs}
    oracle = (_figure("l", last.drop_duplicates([*RUN])), *[Figure(None)] * (len(keys) - 1))  # one a drive
    rows = (*_by_part(parts, keys), ("landmarks, told all", oracle))
    return _header("estimator, noise", keys, TITLES_CAMERA), rows


def study_table(study: Study, frame: pd.DataFrame) -> View:
    """Return each combination: the first metric of the study, its paired difference and p, and the others."""
    several = [name for name in COMBINATION if frame[name].nunique() > 1] or ["variant"]
    first, *others = (key for key in study.metrics if key in frame and key not in TIMES)
    last, rows = last_laps(frame), []
    for contrast in contrasts(study, frame, first):
        names, by = [getattr(contrast, name) for name in several], contrast.difference
        part = last[(last[several] == names).all(axis=1)]
        difference = Figure(None) if by is None else _difference(first, contrast.differences)
        p = Figure.known(contrast.p)
        rest = (_figure(key, part) for key in others)
        rows.append((", ".join(names), (_figure(first, part), difference, p, *rest)))
    headings = [METRICS[key].heading for key in (first, *others)]
    return (", ".join(several), headings[0], "difference", "p", *headings[1:]), tuple(rows)


def difference_table(study: Study, frame: pd.DataFrame, other: str, keys: Sequence[str]) -> View:
    """Return metrics of the baseline and of another estimator, and what the other has more, paired."""
    parts = {name: frame[frame["estimator"] == name] for name in (str(study.baseline.estimator), other)}
    rows = []
    for key in keys:
        by = (c.differences for c in contrasts(study, frame, key) if c.estimator == other)
        figures = (_figure(key, part) for part in parts.values())
        rows.append((METRICS[key].heading, (*figures, _difference(key, next(by, ())))))
    return ("lap 1", *(f"`{name}`" for name in parts), "difference"), tuple(rows)


def hints_table(rows: pd.DataFrame) -> View:
    """Return the share of the logs that are told by their cause, for each mistake, or accused."""
    spoiled, good = rows[rows["kind"] == "spoiled"], rows[rows["kind"] == "good"]
    groups = {str(name): of["reported"] for name, of in spoiled.groupby("name", sort=False)}
    groups |= {"**all mistakes**": spoiled["reported"], "**good logs, accused of any**": good["notices"]}
    shares = {name: (float(np.sum(told)), float(len(told))) for name, told in groups.items()}
    return ("mistake", "reported", "logs"), tuple(
        (name, tuple(Figure.known(count, 0) for count in counts)) for name, counts in shares.items()
    )


def faults_table(study: Study, frame: pd.DataFrame, columns: Mapping[str, tuple[str, int]] = FAULTS) -> View:
    """Return what each fault costs by the clean run on the same track, and whether anything was said."""
    rows = []
    for noise, values in zip(study.noise, outcomes(study, frame), strict=True):
        values |= {name: values[name] / max(values["runs"], 1) for name in ("closed", "lost", "reported")}
        figures = tuple(
            Figure.of([values[key]], digits, 100.0 if "%" in title else 1.0)
            for title, (key, digits) in columns.items()
        )
        rows.append((noise, figures))
    return ("fault", *columns), tuple(rows)


def _estimators(frame: pd.DataFrame, names: Sequence[str] = ESTIMATORS) -> dict[str, pd.DataFrame]:
    last = last_laps(frame)
    parts = {f"`{name}`": last[last["estimator"] == name] for name in names}
    return {name: part for name, part in parts.items() if len(part)}


def _header(label: str, keys: Sequence[str], titles: Mapping[str, str]) -> tuple[str, ...]:
    return (label, *(titles.get(key, METRICS[key].heading) for key in keys))


def _by_part(parts: Mapping[str, pd.DataFrame], keys: Sequence[str]) -> Rows:
    return tuple((name, tuple(_figure(key, part) for key in keys)) for name, part in parts.items())


def _by_metric(keys: Sequence[str], parts: Mapping[str, pd.DataFrame]) -> Rows:
    return tuple((METRICS[key].heading, tuple(_figure(key, part) for part in parts.values())) for key in keys)


def _figure(key: str, part: pd.DataFrame) -> Figure:
    metric, values = METRICS[key], part[key] if key in part else pd.Series(dtype=float)
    if metric.average == "rms":
        return Figure.known(metric.factor * metric.over(values.astype(float)), metric.digits)
    return Figure.of(values, metric.digits, metric.factor)


def _difference(key: str, differences: Sequence[float]) -> Figure:
    return Figure.of(differences, METRICS[key].digits, METRICS[key].factor)
