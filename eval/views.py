"""Views of the measured frames: the figures of each table of the pages."""

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
TITLES: Final = {"ate": "trajectory error [m]", "nees": "NEES of the map"}
CAMERA: Final = (
    *("rmse", "rmse_aligned", "missed", "closed", "nees", "turn_nees", "map_scale_nees", "reported_degraded"),
)
LINES: Final = ("rmse", "rmse_aligned", "missed", "closed", "size", "ate", "nees")
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
        return cls(None if isnan(value) else round(float(value), 6), None, digits)

    @classmethod
    def row(cls, values: Iterable[float], *digits: int) -> tuple[Self, ...]:
        """Return known values, each with its own digits, or all with the same."""
        return tuple(map(cls.known, values, digits if len(digits) > 1 else repeat(*digits)))

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
    return _by_metric(f"mean over {drives} drives, at the end of", keys, columns)


def compared_table(frame: pd.DataFrame) -> View:
    """Return every estimator at the end of its last lap."""
    return _by_part("estimator, last lap", _estimators(frame), ("rmse", "missed", "size", "ate"))


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
    return _by_metric("last lap", keys, _estimators(frame, names))


def skidpad_table(frame: pd.DataFrame) -> View:
    """Return every estimator: its trajectory error over the whole drive, and its map at the end."""
    square = (frame["ate"] ** 2).groupby([frame[name] for name in RUN_OF]).transform("mean")
    return _by_part("estimator", _estimators(frame.assign(ate=square**0.5)), ("ate", "rmse", "missed"))


def camera_table(frame: pd.DataFrame) -> View:
    """Return the map of each estimator on drawn cars, and the limit of its landmarks."""
    last = last_laps(frame)
    parts = {f"`{estimator}`": part for estimator, part in last.groupby("estimator", sort=False)}
    oracle = (_figure("l", last.drop_duplicates([*RUN])), *[Figure(None)] * (len(CAMERA) - 1))  # one a drive
    header, rows = _by_part("estimator", parts, CAMERA, TITLES_CAMERA)
    return header, (*rows, ("landmarks, given all", oracle))


def lines_table(frame: pd.DataFrame) -> View:
    """Return the map of each estimator by the points that a sensor of lines gives."""
    last = last_laps(frame)
    parts = {
        f"{noise}, `{estimator}`": part
        for (noise, estimator), part in last.groupby(["noise", "estimator"], sort=False)
    }
    return _by_part("points, estimator", parts, LINES)


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
    """Return the share of the logs whose cause is named, for each mistake, or that are accused."""
    spoiled, good = rows[rows["kind"] == "spoiled"], rows[rows["kind"] == "good"]
    groups = {str(name): of["named"] for name, of in spoiled.groupby("name", sort=False)}
    groups |= {"**all mistakes**": spoiled["named"], "**good logs, accused of any**": good["accused"]}
    rows = tuple((name, Figure.row((hits.sum(), len(hits)), 0)) for name, hits in groups.items())
    return ("mistake", "named", "logs"), rows


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


def _by_part(
    label: str,
    parts: Mapping[str, pd.DataFrame],
    keys: Sequence[str],
    titles: Mapping[str, str] = TITLES,
) -> View:
    rows = tuple((name, tuple(_figure(key, part) for key in keys)) for name, part in parts.items())
    return (label, *(titles.get(key, METRICS[key].heading) for key in keys)), rows


def _by_metric(label: str, keys: Sequence[str], parts: Mapping[str, pd.DataFrame]) -> View:
    figures = ((key, tuple(_figure(key, part) for part in parts.values())) for key in keys)
    return (label, *parts), tuple((METRICS[key].heading, row) for key, row in figures)


def _figure(key: str, part: pd.DataFrame) -> Figure:
    metric, values = METRICS[key], part[key] if key in part else pd.Series(dtype=float)
    if metric.average == "rms":
        return Figure.known(metric.factor * metric.over(values.astype(float)), metric.digits)
    if len(values):
        values = by_track(part.set_index("track")[key].astype(float).dropna())
    return Figure.of(values, metric.digits, metric.factor)


def _difference(key: str, differences: Sequence[float]) -> Figure:
    return Figure.of(differences, METRICS[key].digits, METRICS[key].factor)
