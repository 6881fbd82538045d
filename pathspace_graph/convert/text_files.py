"""Text files: CSV with columns of any names and units, and JSON lines."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import pi
from pathlib import Path
from typing import Any, Final

import numpy as np

from pathspace_graph.errors import InputError, SettingsError, check_name
from pathspace_graph.factors.arrays import Array
from pathspace_graph.io.log import covariances_of
from pathspace_graph.io.parsing import MAX_STAMP, Table, read_table, read_text, shown
from pathspace_graph.labels import UNKNOWN

from .messages import Points
from .recording import Recording
from .settings import LabelRule

ODOMETRY: Final = "odometry"
DETECTIONS: Final = "detections"
QUANTITIES: Final = {  # columns of each file and their quantities; a covariance is of the square of one
    ODOMETRY: {"t": "time", "vx": "speed", "vy": "speed", "wz": "yaw_rate"},
    DETECTIONS: {
        **{"t": "time", "x": "length", "y": "length", "range": "length", "bearing": "angle", "label": ""},
        **{"xx": "length", "xy": "length", "yy": "length"},
    },
}
COVARIANCE: Final = ("xx", "xy", "yy")  # columns of the covariance of a detection, if there is one
UNITS: Final[Mapping[str, Mapping[str, float]]] = {  # units of each quantity, in SI units
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    "length": {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "km": 1e3},
    "angle": {"rad": 1.0, "deg": pi / 180.0},
    "speed": {"m/s": 1.0, "mm/s": 1e-3, "cm/s": 1e-2, "km/s": 1e3, "km/h": 1.0 / 3.6, "mph": 0.44704},
    "yaw_rate": {"rad/s": 1.0, "deg/s": pi / 180.0},
}
MAX_BEARING: Final = 2.0 * pi  # largest bearing (rad); more are degrees
LARGEST: Final = 1e30  # largest number of a file; stamps in nanoseconds are large
UNSTATED: Final = ((np.nan, np.nan), (np.nan, np.nan))  # covariance of a detection that states none
MIN_PERIOD: Final = 1e-5  # least mean period of samples (s); less is a wrong unit of time
MAX_PERIOD: Final = 1e3  # largest mean period of samples (s); more is a wrong unit of time


def read_csv(
    odometry: Path, detections: Path, rule: LabelRule, columns: Sequence[str] = (), units: Sequence[str] = ()
) -> Recording:
    """Return what two CSV files have of a drive; an InputError names file, row and column.

    Quantities are in columns of their own names, unless `columns` says `vx=speed`, `y=-cone_y` or
    `odometry.t=stamp`, and in SI units, unless `units` says `length=mm angle=deg time=ns`.
    """
    named, used = _named(columns), _units(units)
    twists, found = (
        _File(kind, read_table(file, ()), named, used)
        for kind, file in ((ODOMETRY, odometry), (DETECTIONS, detections))
    )
    t = twists.stamps()
    vx, wz = twists.numbers("vx"), twists.numbers("wz")
    vy = twists.numbers("vy") if twists.has("vy") else np.zeros(len(t))
    in_words = ", ".join(f"{quantity} in {unit}" for quantity, unit in sorted(used.items()))
    source = {"odometry": odometry.name, "detections": detections.name, "units": in_words}
    return Recording(t, np.column_stack([vx, vy, wz]), *_scans(found, rule), source)


def _named(pairs: Sequence[str]) -> dict[tuple[str, str], str]:
    """Return columns by kind of file and quantity, with a minus where the sign changes."""
    named: dict[tuple[str, str], str] = {}
    for pair in pairs:
        key, equals, name = pair.partition("=")
        if not equals or not name.removeprefix("-"):
            raise SettingsError(f"--columns: expected QUANTITY=COLUMN, found '{pair}'")
        only, _, key = key.rpartition(".")
        known = dict.fromkeys(key for kind, keys in QUANTITIES.items() if only in ("", kind) for key in keys)
        check_name(key, known, f"--columns: expected one of {', '.join(known)} in '{pair}'")
        named |= {(kind, key): name for kind in ([only] if only else QUANTITIES)}
    return named


def _units(pairs: Sequence[str]) -> dict[str, str]:
    """Return the units of the quantities; those of a `speed` and a `yaw_rate` follow the others."""
    names = {"time": "s", "length": "m", "angle": "rad"}
    for pair in pairs:
        quantity, equals, unit = pair.partition("=")
        check_name(quantity, UNITS, f"--units: expected one of {', '.join(UNITS)} in '{pair}'")
        if not equals or unit not in UNITS[quantity]:
            known = ", ".join(UNITS[quantity])
            raise SettingsError(f"--units: expected {quantity}= one of {known}, found '{pair}'")
        names[quantity] = unit
    return {"speed": f"{names['length']}/s", "yaw_rate": f"{names['angle']}/s", **names}


@dataclass(frozen=True)
class _File:
    """One of the files, whose columns are read by quantity and in SI units."""

    kind: str
    table: Table
    named: dict[tuple[str, str], str]
    units: dict[str, str]

    def __post_init__(self) -> None:
        if not len(self.table):
            raise InputError(self.table.file, "expected at least one row, found a header only", 2)

    def has(self, key: str) -> bool:
        """Return whether the file has the column of a quantity; one that was named must be there."""
        return (self.kind, key) in self.named or key in self.table.columns

    def column(self, key: str) -> str:
        column = self.named.get((self.kind, key), key).removeprefix("-")
        if column not in self.table.columns:
            expected = f"expected a column '{column}' for {key} (--columns {key}=NAME)"
            found = f"found the columns {', '.join(self.table.columns)}"
            raise InputError(self.table.file, f"{expected}, {found}", 1)
        return column

    def numbers(self, key: str, power: int = 1) -> Array:
        """Return a column (rows,) in the SI unit, or in its square where `power` is 2."""
        quantity = QUANTITIES[self.kind][key]
        sign = -1.0 if self.named.get((self.kind, key), "").startswith("-") else 1.0
        factor = sign * UNITS[quantity][self.units[quantity]] ** power
        return np.asarray(factor * self.table.numbers(self.column(key), LARGEST))

    def stamps(self) -> Array:
        """Return the stamps (rows,) in s, whose unit has to be plausible."""
        t, unit, name = self.numbers("t"), self.units["time"], self.column("t")
        self.table.require(
            np.abs(t) <= MAX_STAMP,
            f"expected stamps of at most {MAX_STAMP:g} s in column '{name}', found more: is their unit not "
            f"{unit} (--units time=ns)?",
        )
        stamps = np.unique(t)
        period = float(np.ptp(stamps)) / max(len(stamps) - 1, 1)
        if len(stamps) > 1 and not MIN_PERIOD < period < MAX_PERIOD:
            expected = f"expected stamps in {unit} in column '{name}'"
            found = f"found them {period:.3g} s apart: is their unit another one?"
            raise InputError(self.table.file, f"{expected}, {found}")
        return t


def _scans(file: _File, rule: LabelRule) -> tuple[Array, list[Points]]:
    """Return the stamps of the perception cycles (n,) in s, and the points of each, in the file's order."""
    t, points, covariances = file.stamps(), _points(file), None
    labels = np.full(len(t), UNKNOWN)
    if any(map(file.has, COVARIANCE)):
        covariances = covariances_of(*(file.numbers(key, power=2) for key in COVARIANCE))
    if file.has("label"):
        labels = rule.of_all(np.array(file.table.columns[file.column("label")]))
    starts = np.flatnonzero(np.diff(t, prepend=np.nan))
    detections = Points.of(points, labels, covariances)
    spans = [slice(*span) for span in pairwise([*starts.tolist(), len(t)])]
    return t[starts], [detections.where(span) for span in spans]


def _points(file: _File) -> Array:
    if file.has("x") and (DETECTIONS, "range") not in file.named:
        return np.column_stack([file.numbers("x"), file.numbers("y")])
    if not file.has("range"):
        file.column("x")  # raises: neither x and y nor range and bearing are there
    ranges, bearings = file.numbers("range"), file.numbers("bearing")
    name, unit = file.column("bearing"), file.units["angle"]
    file.table.require(
        np.abs(bearings) <= MAX_BEARING,
        f"expected bearings of at most a whole turn in column '{name}', found more: is their unit not {unit} "
        "(--units angle=deg)?",
    )
    file.table.require(ranges >= 0.0, f"expected ranges of at least 0 in column '{file.column('range')}'")
    return np.column_stack([ranges * np.cos(bearings), ranges * np.sin(bearings)])


def read_json_lines(file: Path, rule: LabelRule) -> Recording:
    """Return what a file of JSON lines has of a drive, in SI units; an InputError names file and line.

    A line is `{"t": s, "twist": [vx, vy, wz]}` or `{"t": s, "detections": [{"x": m, "y": m, "label": "blue",
    "covariance": [[xx, xy], [xy, yy]]}, ...]}`, with `range` and `bearing` in place of `x` and `y` where one
    likes; label and covariance are optional. A line may have both.
    """
    t, twists, scan_t, scans = [], [], [], []
    for row, line in enumerate(read_text(file).splitlines(), start=1):
        if not line.strip():
            continue
        try:
            entry = json.loads(line)
            stamp = float(entry["t"])
            if "twist" in entry:
                t.append(stamp)
                twists.append(np.array(entry["twist"], dtype=float).reshape(3))
            if "detections" in entry:
                scan_t.append(stamp)
                scans.append(_points_of_objects(entry["detections"], rule))
        except (ValueError, TypeError, KeyError, IndexError, OverflowError, RecursionError) as error:
            expected = "expected a line with t, and with twist [vx, vy, wz] or a list of detections"
            found = f"found {shown(line)} ({type(error).__name__}: {error})"
            raise InputError(file, f"{expected}, {found}", row) from None
    measured = np.array(t), np.array(twists).reshape(-1, 3)
    return Recording(*measured, np.array(scan_t), scans, {"file": file.name})


def _points_of_objects(objects: list[dict[str, Any]], rule: LabelRule) -> Points:
    points, covariances, labels = [], [], []
    for one in objects:
        if "range" in one:
            r, bearing = float(one["range"]), float(one["bearing"])
            place = r * np.cos(bearing), r * np.sin(bearing)
        else:
            place = one["x"], one["y"]
        points.append(np.array(place, dtype=float))
        covariances.append(np.array(one.get("covariance", UNSTATED), dtype=float).reshape(2, 2))
        labels.append(rule.of(one["label"]) if "label" in one else UNKNOWN)
    return Points.of(points, labels, covariances)
