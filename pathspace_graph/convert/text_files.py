"""Text files: CSV with columns of any names and units, and JSON lines."""

import json
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from math import nan, pi
from pathlib import Path
from types import SimpleNamespace
from typing import Final, NoReturn

import numpy as np

from pathspace_graph.errors import InputError, SettingsError, check_name
from pathspace_graph.factors.arrays import Array
from pathspace_graph.io.covariances import covariances_of
from pathspace_graph.io.parsing import MAX_STAMP, is_number, read_text, shown
from pathspace_graph.io.tables import DELIMITERS, TUM, read_table, read_trajectory, read_tum
from pathspace_graph.labels import UNKNOWN

from .messages import ALONE, BROKEN, Points, cone_points, scan_points, yaw_of
from .recording import Recording
from .settings import LabelRule

ODOMETRY: Final = "odometry"
DETECTIONS: Final = "detections"
QUANTITIES: Final = {  # columns of each file and their quantities; a covariance is of the square of one
    ODOMETRY: {
        **{"t": "time", "vx": "speed", "vy": "speed", "wz": "yaw_rate"},
        **{"x": "length", "y": "length", "yaw": "angle", "qx": "", "qy": "", "qz": "", "qw": ""},
    },
    DETECTIONS: {
        **{"t": "time", "x": "length", "y": "length", "range": "length", "bearing": "angle", "label": ""},
        **{"xx": "length", "xy": "length", "yy": "length", "line": ""},
    },
}
COVARIANCE: Final = ("xx", "xy", "yy")  # columns of the covariance of a detection, if there is one
QUATERNION: Final = ("qx", "qy", "qz", "qw")  # columns of a rotation, in place of a yaw
OTHER_NAMES: Final = {"x": "tx", "y": "ty", "yaw": "theta"}  # columns of a pose, by the usual ones
UNITS: Final[Mapping[str, Mapping[str, float]]] = {  # units of each quantity, in SI units
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    "length": {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "km": 1e3},
    "angle": {"rad": 1.0, "deg": pi / 180.0},
    "speed": {"m/s": 1.0, "mm/s": 1e-3, "cm/s": 1e-2, "km/s": 1e3, "km/h": 1.0 / 3.6, "mph": 0.44704},
    "yaw_rate": {"rad/s": 1.0, "deg/s": pi / 180.0},
}
MAX_BEARING: Final = 2.0 * pi  # largest bearing (rad); more are degrees
LARGEST: Final = 1e30  # largest number of a file; stamps in nanoseconds are large
MANY_ROWS: Final = 20  # number of rows from which nanoseconds are checked
LEAST_NANOSECONDS: Final = 1e6  # that fractions of so many rows reach
MIN_PERIOD: Final = 1e-5  # least median period of samples (s); less is a wrong unit of time
MAX_PERIOD: Final = 1e3  # largest median period of samples (s); more is a wrong unit of time


def read_csv(
    odometry: Path,
    detections: Path,
    rule: LabelRule,
    columns: Sequence[str] = (),
    units: Sequence[str] = (),
    *,
    from_poses: bool = False,
    held: bool = False,
) -> Recording:
    """Read the drive in two CSV files; an InputError names file, row and column.

    Quantities are in columns of their own names, unless `columns` says `vx=speed`, `y=-cone_y` or
    `odometry.t=stamp`, and in SI units, unless `units` says `length=mm angle=deg time=ns`. Stamps may be ISO
    8601 dates, or seconds and nanoseconds in two columns (`t=sec+nsec`). The odometry has twists, or where
    they are missing or `from_poses` is stated poses, which may be a trajectory in the format of TUM.
    """
    used = _units(units)
    first = (line.split() for line in read_text(odometry).splitlines() if line.strip() and line[0] != "#")
    words = next(first, [])
    if len(words) == len(TUM) and all(map(is_number, words)):
        (t, motion), are_poses, rows = read_trajectory(odometry), True, read_tum(odometry).rows
    else:
        file = _File(ODOMETRY, odometry, columns, used)
        (motion, are_poses), t, rows = _motion(file, from_poses=from_poses), file.stamps(), file.table.rows
    scans = _scans(_File(DETECTIONS, detections, columns, used), rule)
    in_words = ", ".join(f"{quantity} in {unit}" for quantity, unit in sorted(used.items()))
    return Recording(
        t,
        motion,
        *scans,
        {"odometry": odometry.name, "detections": detections.name, "units": in_words},
        are_poses=are_poses,
        is_held=held,
        rows=rows,
        place=f"{odometry.name}, row",
        units="--units speed=km/h yaw_rate=deg/s",
    )


def _units(pairs: Sequence[str]) -> dict[str, str]:
    """Units of the quantities; those of a `speed` and a `yaw_rate` follow the others."""
    names = {"time": "s", "length": "m", "angle": "rad"}
    for pair in pairs:
        quantity, _, unit = pair.partition("=")
        check_name(quantity, UNITS, f"--units: expected one of {', '.join(UNITS)} in '{pair}'")
        if unit not in UNITS[quantity]:
            known = ", ".join(UNITS[quantity])
            raise SettingsError(f"--units: expected {quantity}= one of {known}, found '{pair}'")
        names[quantity] = unit
    return {"speed": f"{names['length']}/s", "yaw_rate": f"{names['angle']}/s", **names}


class _File:
    """One of the files, whose columns are read by quantity and in SI units."""

    def __init__(self, kind: str, file: Path, pairs: Sequence[str], units: Mapping[str, str]) -> None:
        self.named, self._units, self._quantities = dict[str, str](), units, QUANTITIES[kind]
        for pair in pairs:
            stated, _, name = pair.partition("=")
            only, _, key = stated.rpartition(".")
            if not name.removeprefix("-"):
                raise SettingsError(f"--columns: expected QUANTITY=COLUMN, found '{pair}'")
            known = {key: 0 for of, keys in QUANTITIES.items() if only in ("", of) for key in keys}
            check_name(key, known, f"--columns: expected one of {', '.join(known)} in '{pair}'")
            if only in ("", kind):
                self.named[key] = name
        self.table = read_table(file, delimiters=DELIMITERS)
        if any(map(is_number, self.table.columns)):
            found = f"found the numbers {', '.join(self.table.columns)}"
            raise InputError(file, f"expected a header with the names of the columns, {found}", 1)
        if not len(self.table):
            raise InputError(file, "expected at least one row, found a header only", 2)

    def has(self, key: str) -> bool:
        """Whether the file has the column of a quantity; one that was named must be there."""
        return key in self.named or key in self.table.columns

    def find(self, key: str) -> str:
        """Column of a quantity, by the name that was stated or by a usual one; empty without one."""
        names = self.named.get(key, "").removeprefix("-"), key, OTHER_NAMES.get(key)
        return next((name for name in names if name in self.table.columns), "")

    def column(self, key: str, name: str = "") -> str:
        """Column of a quantity, which must be there."""
        name = name or self.named.get(key, key).removeprefix("-")
        if name not in self.table.columns:
            otherwise = f", or {key}=SECONDS+NANOSECONDS" * (key == "t")
            pose = ", or a pose x, y, yaw" * (key in ("vx", "wz"))
            self.fail(f"expected a column '{name}' for {key}{pose} (--columns {key}=NAME{otherwise})")
        return name

    def fail(self, expected: str) -> NoReturn:
        """Raise an InputError that lists the columns."""
        raise InputError(self.table.file, f"{expected}, found the columns {', '.join(self.table.columns)}", 1)

    def numbers(self, key: str, power: int = 1, name: str = "") -> Array:
        """A column (rows,) in the SI unit or, for `power` 2, its square; NaN where it is missing."""
        quantity = self._quantities[key]
        sign = -1.0 if self.named.get(key, "").startswith("-") else 1.0
        factor = sign * (UNITS[quantity][self._units[quantity]] ** power if quantity else 1.0)
        return np.asarray(factor * self.table.numbers(self.column(key, name), LARGEST, missing=True))

    def stamps(self) -> Array:
        """Stamps (rows,) in s: numbers, dates, or seconds and nanoseconds in two columns."""
        stated, unit, table = self.named.get("t", "t"), self._units["time"], self.table
        if "+" in stated and stated not in table.columns:
            names = stated.split("+", 1)
            t, fractions = (table.numbers(self.column("t", name), LARGEST) for name in names)
            expected = f"expected nanoseconds from 0 to 999999999 in column '{names[1]}', found others"
            table.require((fractions >= 0.0) & (fractions < 1e9), expected)
            if len(t) >= MANY_ROWS and 0.0 < fractions.max() < LEAST_NANOSECONDS:
                found = f"found at most {fractions.max():.0f}: is their unit another one?"
                raise InputError(table.file, f"expected nanoseconds in column '{names[1]}', {found}")
            t, unit = t + 1e-9 * fractions, "s"
        elif np.isnan(seconds_of_date(table.columns[self.column("t")][0])):
            t = UNITS["time"][unit] * table.numbers(self.column("t"), LARGEST)
        else:
            t, unit = np.array([seconds_of_date(text) for text in table.columns[self.column("t")]]), "s"
            expected = f"expected a date by ISO 8601 in column '{stated}', as in the rows before"
            table.require(~np.isnan(t), expected)
        most = f"expected stamps of at most {MAX_STAMP:g} s in column '{stated}', found more"
        table.require(np.abs(t) <= MAX_STAMP, f"{most}: is their unit not {unit} (--units time=ns)?")
        stamps = np.unique(t)
        period = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 1.0
        if not MIN_PERIOD < period < MAX_PERIOD:
            found = f"found them {period:.3g} s apart: is their unit another one?"
            raise InputError(table.file, f"expected stamps in {unit} in column '{stated}', {found}")
        return np.asarray(t)


def seconds_of_date(text: str) -> float:
    """Time (s) since 1970 of a date with a time by ISO 8601, UTC without an offset; else NaN."""
    try:
        date = datetime.fromisoformat("" if is_number(text) else text.strip())
    except ValueError:
        return nan
    return (date if date.tzinfo else date.replace(tzinfo=UTC)).timestamp()


def _motion(file: _File, *, from_poses: bool) -> tuple[Array, bool]:
    """Twists (rows, 3) or poses (rows, 3) of the odometry, with NaN where they are missing; and which."""
    x, y, yaw = (file.find(key) for key in ("x", "y", "yaw"))
    turned = [file.find(key) for key in QUATERNION]
    has_poses = bool(x and y and (yaw or all(turned)))
    if from_poses and not has_poses:
        file.fail("--from-poses: expected the columns x, y and yaw, or a quaternion (--columns yaw=NAME)")
    if has_poses and (from_poses or not (file.has("vx") and file.has("wz"))):
        if not yaw:
            turn = (file.numbers(key, name=name) for key, name in zip(QUATERNION, turned, strict=True))
            heading = np.asarray(yaw_of(SimpleNamespace(**dict(zip("xyzw", turn, strict=True)))))
        else:
            heading = file.numbers("yaw", name=yaw)
        return np.column_stack([file.numbers("x", name=x), file.numbers("y", name=y), heading]), True
    vx, wz = file.numbers("vx"), file.numbers("wz")
    vy = file.numbers("vy") if file.has("vy") else np.zeros(len(vx))
    twists = np.column_stack([vx, vy, wz])
    if has_poses and not np.nan_to_num(twists).any() and np.ptp(file.numbers("x", name=x)) > 0.0:
        found = "found zeros while the pose moves; --from-poses makes the twists from the poses"
        raise InputError(file.table.file, f"expected twists, {found}")
    return twists, False


def _scans(file: _File, rule: LabelRule) -> tuple[Array, Points]:
    """Stamps of the perception cycles (n,) in s, and their points, in the file's order."""
    t, points, table = file.stamps(), _points(file), file.table
    covariances, labels, lines = None, np.full(len(t), UNKNOWN), np.full(len(t), ALONE)
    if any(map(file.has, COVARIANCE)):
        covariances = covariances_of(*(file.numbers(key, power=2) for key in COVARIANCE))
    if file.has("label"):
        labels = rule.of_all(table.columns[file.column("label")])
    if "line" in file.named:
        lines = np.unique(table.columns[file.column("line")], return_inverse=True)[1]
    begins = np.diff(t, prepend=np.nan) != 0.0
    detections = Points.of(points, labels, covariances, lines)
    return t[begins], detections._replace(message=np.cumsum(begins) - 1)


def _points(file: _File) -> Array:
    if file.has("x") and "range" not in file.named:
        return np.column_stack([file.numbers("x"), file.numbers("y")])
    if not (file.has("range") and file.has("bearing")):
        file.fail("expected the columns x and y, or range and bearing (--columns x=NAME)")
    ranges, bearings = file.numbers("range"), file.numbers("bearing")
    most = f"expected bearings of at most a whole turn in column '{file.column('bearing')}', found more"
    file.table.require(~(np.abs(bearings) > MAX_BEARING), f"{most}: are they in degrees (--units angle=deg)?")
    file.table.require(~(ranges < 0.0), f"expected ranges of at least 0 in column '{file.column('range')}'")
    return np.column_stack([ranges * np.cos(bearings), ranges * np.sin(bearings)])


def read_json_lines(
    file: Path, rule: LabelRule, *, from_poses: bool = False, held: bool = False
) -> Recording:
    """Read the drive in a file of JSON lines, in SI units; an InputError names file and line.

    A line is `{"t": s, "twist": [vx, vy, wz]}` or `{"t": s, "detections": [{"x": m, "y": m, "label": "blue",
    "covariance": [[xx, xy], [xy, yy]]}, ...]}`, or both. Label and covariance are optional, and `range` and
    `bearing` may replace `x` and `y`. Where there is no twist, or `from_poses` is stated, the motion is that
    of `"pose": [x, y, yaw]`. Instead of detections a line may have
    `"polylines": [{"points": [[x, y], ...], "label": "left"}, ...]` or a scan as of a `LaserScan`:
    `"scan": {"angle_min": rad, "angle_increment": rad, "range_min": m, "range_max": m, "ranges": [m, ...]}`.
    """
    moved: dict[str, list[tuple[int, float, Array]]] = {"twist": [], "pose": []}
    scan_t, scans = [], []
    for row, line in enumerate(read_text(file).splitlines(), start=1):
        if not line.strip():
            continue
        try:
            entry = json.loads(line, object_hook=lambda entries: SimpleNamespace(**entries))
            stamp = float(entry.t)
            for name, found in moved.items():
                if hasattr(entry, name):
                    found.append((row, stamp, np.array(getattr(entry, name), dtype=float).reshape(3)))
            points = [*_points_of_line(entry, rule)]
        except BROKEN as error:
            expected = "expected a line with t, and with twist [vx, vy, wz], detections, polylines or a scan"
            told = f"found {shown(line)} ({type(error).__name__}: {error})"
            raise InputError(file, f"{expected}, {told}", row) from None
        scan_t += [stamp] * len(points)
        scans += points
    are_poses = bool(from_poses or (moved["pose"] and not moved["twist"]))
    if from_poses and not moved["pose"]:
        raise InputError(file, "--from-poses: expected lines with pose [x, y, yaw], found none")
    entries = moved["pose" if are_poses else "twist"]
    return Recording(
        np.array([t for _, t, _ in entries]),
        np.array([motion for _, _, motion in entries]).reshape(-1, 3),
        np.array(scan_t),
        Points.joined(scans),
        {"file": file.name},
        are_poses=are_poses,
        is_held=held,
        rows=np.array([row for row, _, _ in entries], int),
        place=f"{file.name}, line",
    )


def _points_of_line(entry: SimpleNamespace, rule: LabelRule) -> Iterator[Points]:
    """Yield the points of a line's lists and of its scan, each read as a message."""
    for name in ("detections", "polylines"):
        if hasattr(entry, name):
            yield cone_points(SimpleNamespace(**{name: getattr(entry, name)}), rule)
    if hasattr(entry, "scan"):
        yield scan_points(SimpleNamespace(**{"range_min": 0.0, "range_max": np.inf, **vars(entry.scan)}))
