"""Tables of measured frames: rows of figures, each a mean with its 95 % interval."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

import pandas as pd

from .experiment.frame import RUN_OF, TIMES, contrasts, last_laps
from .experiment.statistics import by_track
from .experiment.study import Study
from .experiment.tables import Quantity, Table, names_of
from .metrics.metric import METRICS

ESTIMATORS: Final = ("fixed-lag", "spline", "landmark-fixed-lag", "landmark-batch", "ckf", "landmark-ckf")
ONLINE, BATCH, LANDMARKS = ESTIMATORS[:3]


def laps_table(frame: pd.DataFrame, laps: Sequence[int], keys: Sequence[str]) -> Table:
    """Return metrics of the online map after some laps, and of the batch where it ran."""
    online, batch = (frame[frame["estimator"] == name] for name in (ONLINE, BATCH))
    columns = {f"lap {lap}": online[online["lap"] == lap] for lap in dict.fromkeys(laps)}
    columns |= {"batch": last_laps(batch)} if len(batch) else {}
    return _by_metric(keys, columns)


def tracks_table(frame: pd.DataFrame) -> Table:
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

    rows = []
    for track in frame["track"].unique():
        parts = ((key, part[part["track"] == track]) for key, part in columns.values())
        rows.append((str(track), *(replace(_figure(key, part), half=None) for key, part in parts)))
    return Table(("track", *columns), tuple(rows))


def rmse_table(frame: pd.DataFrame) -> Table:
    """Return the rmse of every online estimator after each lap."""
    names = [name for name in ESTIMATORS if frame[frame["estimator"] == name]["lap"].nunique() > 1]
    rows = tuple(
        (str(lap), *(_figure("rmse", part[part["estimator"] == name]) for name in names))
        for lap, part in frame[frame["lap"] > 0].groupby("lap")
    )
    return Table(("rmse after lap [m]", *names), rows)


def metrics_table(frame: pd.DataFrame, keys: Sequence[str]) -> Table:
    """Return metrics of every estimator at the end of its last lap, one in each column."""
    return _by_metric(keys, _parts(frame, "estimator"))


def runs_table(frame: pd.DataFrame, names: Sequence[str], keys: Sequence[str]) -> Table:
    """Return metrics at the end of the last lap, with a row for each value of the columns `names`."""
    parts = _parts(frame, *names).items()
    rows = tuple((label, *(_figure(key, part) for key in keys)) for label, part in parts)
    return Table((", ".join(names), *(METRICS[key].heading for key in keys)), rows)


def skidpad_table(frame: pd.DataFrame) -> Table:
    """Return every estimator: its trajectory error over the whole drive, and its map at the end."""
    square = (frame["ate"] ** 2).groupby([frame[name] for name in RUN_OF]).transform("mean")
    return runs_table(frame.assign(ate=square**0.5), ("estimator",), ("ate", "rmse", "missed"))


def camera_table(frame: pd.DataFrame, limits: pd.DataFrame, keys: Sequence[str]) -> Table:
    """Return the map of each estimator on drawn cars, and the rmse of landmarks that are told all."""
    table = runs_table(frame, ("estimator",), keys)
    row = ("landmarks, given all", _figure("rmse", limits), *[Quantity(None)] * (len(keys) - 1))
    return replace(table, rows=(*table.rows, row))


def study_table(study: Study, frame: pd.DataFrame) -> Table:
    """Return each combination: the first metric of the study, its paired difference and p, and the others."""
    several = names_of(frame, "variant")
    first, *others = (key for key in study.metrics if key in frame and key not in TIMES)
    last, rows = last_laps(frame), []
    for contrast in contrasts(study, frame, first):
        names = [getattr(contrast, name) for name in several]
        part = last[(last[several] == names).all(axis=1)]
        difference = Quantity.of(contrast.differences, METRICS[first].digits, METRICS[first].factor)
        tested = (difference, *Quantity.row([contrast.p], 3))
        rest = (_figure(key, part) for key in others)
        rows.append((", ".join(names), _figure(first, part), *tested, *rest))
    heading, *headings = (METRICS[key].heading for key in (first, *others))
    return Table((", ".join(several), heading, "difference", "p", *headings), tuple(rows))


def _parts(frame: pd.DataFrame, *names: str) -> dict[str, pd.DataFrame]:
    """Return the last lap of each run, by the values of some columns."""
    groups = last_laps(frame).groupby([*names], sort=False)
    return {", ".join(map(str, values)): part for values, part in groups}


def _by_metric(keys: Sequence[str], parts: Mapping[str, pd.DataFrame]) -> Table:
    rows = ((METRICS[key].heading, *(_figure(key, part) for part in parts.values())) for key in keys)
    return Table(("metric", *parts), tuple(rows))


def _figure(key: str, part: pd.DataFrame) -> Quantity:
    metric, values = METRICS[key], part[key] if key in part else pd.Series(dtype=float)
    if metric.average == "rms":
        return Quantity.measured(metric, metric.over(values.astype(float)))
    if len(values):
        values = by_track(part.set_index("track")[key].astype(float).dropna())
    return Quantity.of(values, metric.digits, metric.factor)
