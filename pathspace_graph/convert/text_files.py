"""Text files: CSV with columns of any names and units, and JSON lines."""

import json
from collections.abc import Mapping, Sequence
from math import pi
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final, NoReturn

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.errors import InputError, SettingsError, check_name
from pathspace_graph.factors.arrays import Array
from pathspace_graph.io.log import DETECTIONS_FILE, ODOMETRY_FILE, covariances_of
from pathspace_graph.io.parsing import is_number, read_text, shown
from pathspace_graph.io.tables import DELIMITERS, TUM, read_table, read_trajectory, read_tum
from pathspace_graph.labels import UNKNOWN

from .messages import ALONE, BROKEN, Points, cone_points, scan_points, yaw_of
from .recording import Recording, chosen_motion
from .settings import LabelRule, Topics

QUANTITIES: Final = {  # columns of each file and their quantities; a covariance is of the square of one
    "odometry": {
        **{"t": "time", "vx": "speed", "vy": "speed", "wz": "yaw_rate"},
        **{"x": "length", "y": "length", "yaw": "angle", "qx": "", "qy": "", "qz": "", "qw": ""},
    },
    "detections": {
        **{"t": "time", "x": "length", "y": "length", "range": "length", "bearing": "angle", "label": ""},
        **{"xx": "length", "xy": "length", "yy": "length", "line": ""},
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
LARGEST: Final = 1e30  # largest number of a file; stamps in nanoseconds are large


def read_csv(
    folder: Path, topics: Topics, rule: LabelRule, columns: Sequence[str] = (), units: Sequence[str] = ()
) -> Recording:
    """Read the drive in two CSV files; an InputError names file, row and column.

    Quantities are in columns of their own names, unless `columns` says `vx=speed`, `y=-cone_y` or
    `odometry.t=stamp`, and in SI units, unless `units` says `length=mm angle=deg time=ns`. Stamps may be
    seconds and nanoseconds in two columns (`t=sec+nsec`). The odometry has twists, or where they are missing
    or the topics say so poses, which may be a trajectory in the format of TUM.
    """
    odometry = folder / (topics.odometry or ODOMETRY_FILE)
    detections = folder / (topics.detections or DETECTIONS_FILE)
    used = _units(units)
    first = (line.split() for line in read_text(odometry).splitlines() if line.strip() and line[0] != "#")
    words = next(first, [])
    if len(words) == len(TUM) and all(map(is_number, words)):
        (t, motion), are_poses, rows = read_trajectory(odometry), True, read_tum(odometry).rows
    else:
        file = _Columns("odometry", odometry, columns, used)
        (motion, are_poses), t, rows = (
            _motion(file, from_poses=topics.from_poses),
            file.stamps(),
            file.table.rows,
        )
    scans = _scans(_Columns("detections", detections, columns, used), rule)
    in_words = ", ".join(f"{quantity} in {unit}" for quantity, unit in sorted(used.items()))
    return Recording(
        t,
        motion,
        *scans,
        {"odometry": odometry.name, "detections": detections.name, "units": in_words},
        rows,
        f"{odometry.name}, row",
        are_poses=are_poses,
        is_held=topics.held,
        units="--units states others, as speed=km/h yaw_rate=deg/s angle=deg",
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


class _Columns:
    """Columns of one of the files by quantity: numbers in SI units, NaN where one is missing, or texts."""

    def __init__(self, kind: str, file: Path, pairs: Sequence[str], units: Mapping[str, str]) -> None:
        named, self._kind, self._units = dict[str, str](), kind, units
        for pair in pairs:
            stated, _, name = pair.partition("=")
            only, _, key = stated.rpartition(".")
            if not name.removeprefix("-"):
                raise SettingsError(f"--columns: expected QUANTITY=COLUMN, found '{pair}'")
            known = {key: 0 for of, keys in QUANTITIES.items() if only in ("", of) for key in keys}
            check_name(key, known, f"--columns: expected one of {', '.join(known)} in '{pair}'")
            if only in ("", kind):
                named[key] = name
        self.table = read_table(file, delimiters=DELIMITERS)
        if any(map(is_number, self.table.columns)):
            self._fail("expected a header with the names of the columns")
        if not len(self.table):
            raise InputError(file, "expected at least one row, found a header only", 2)
        other = {"x": "tx", "y": "ty", "yaw": "theta"}  # columns of a pose, by the usual ones
        self.stated, found = {*named}, {k: v for k, v in other.items() if v in self.table.columns}
        self.named = found | {key: key for key in QUANTITIES[kind] if key in self.table.columns} | named

    def __contains__(self, key: str) -> bool:
        return key in self.named

    def has(self, *keys: str) -> bool:
        """Whether the file has all of these, also by a name that was stated for the other file."""
        return all(self.named.get(key, "").removeprefix("-") in self.table.columns for key in keys)

    def require(self, *keys: str, otherwise: str = "") -> None:
        """Raise an InputError where a quantity is not in the file."""
        for key in keys:
            if key not in self:
                self._fail(f"expected a column '{key}'{otherwise} (--columns {key}=NAME)")

    def texts(self, key: str) -> NDArray[Any]:
        name = self.named[key].removeprefix("-")
        if name not in self.table.columns:
            self._fail(f"expected a column '{name}' for {key}")
        return self.table.columns[name]

    def __getitem__(self, key: str) -> Array:
        quantity, name = QUANTITIES[self._kind][key], self.named[key]
        factor = UNITS[quantity][self._units[quantity]] if quantity else 1.0
        self.texts(key)
        numbers = self.table.numbers(name.removeprefix("-"), LARGEST, missing=True)
        return (-1.0 if name.startswith("-") else 1.0) * factor ** (2 if key in COVARIANCE else 1) * numbers

    def stamps(self) -> Array:
        """Stamps (rows,) in s, also of seconds and nanoseconds in two columns."""
        self.require("t", otherwise=", or t=SECONDS+NANOSECONDS")
        seconds, plus, fraction = self.named["t"].partition("+")
        if not plus:
            self.texts("t")
            return UNITS["time"][self._units["time"]] * self.table.numbers(seconds, LARGEST)
        t, nanoseconds = self.table.stack((seconds, fraction), LARGEST).T
        expected = f"expected nanoseconds from 0 to 999999999 in column '{fraction}', found others"
        self.table.require((nanoseconds >= 0.0) & (nanoseconds < 1e9), expected)
        return np.asarray(t + 1e-9 * nanoseconds)

    def _fail(self, expected: str) -> NoReturn:
        listed = ", ".join(self.table.columns)
        raise InputError(self.table.file, f"{expected}, found the columns {listed}", 1)


def _motion(file: _Columns, *, from_poses: bool) -> tuple[Array, bool]:
    """Twists (rows, 3) or poses (rows, 3) of the odometry, with NaN where they are missing; and which."""
    twists, poses = None, None
    if file.has("x", "y", "yaw"):
        poses = np.column_stack([file[key] for key in ("x", "y", "yaw")])
    elif file.has("x", "y", "qx", "qy", "qz", "qw"):
        turn = SimpleNamespace(**{axis: file[f"q{axis}"] for axis in "xyzw"})
        poses = np.column_stack([file["x"], file["y"], yaw_of(turn)])
    elif from_poses:
        file.require("x", "y", "yaw", otherwise=" for --from-poses")
    else:
        file.require("vx", "wz", otherwise=", or a pose x, y, yaw")
    if "vx" in file and "wz" in file:
        vy = file["vy"] if "vy" in file else np.zeros(len(file.table))
        twists = np.column_stack([file["vx"], vy, file["wz"]])
    return chosen_motion(twists, poses, "the odometry", file.table.file, from_poses=from_poses)


def _scans(file: _Columns, rule: LabelRule) -> tuple[Array, Points]:
    """Stamps of the perception cycles (n,) in s, and their points, in the file's order."""
    t = file.stamps()
    if "range" in file.named and ("x" not in file or "range" in file.stated):
        file.require("bearing")
        ranges, bearings = file["range"], file["bearing"]
        file.table.require(~(ranges < 0.0), "expected ranges of at least 0")
        points = np.column_stack([ranges * np.cos(bearings), ranges * np.sin(bearings)])
    else:
        file.require("x", "y", otherwise=", or range and bearing")
        points = np.column_stack([file["x"], file["y"]])
    covariances, labels, lines = None, np.full(len(t), UNKNOWN), np.full(len(t), ALONE)
    if any(key in file for key in COVARIANCE):
        file.require(*COVARIANCE)
        covariances = covariances_of(*(file[key] for key in COVARIANCE))
    if "label" in file:
        labels = rule.of_all(file.texts("label"))
    if "line" in file:
        lines = np.unique(file.texts("line"), return_inverse=True)[1]
    begins = np.diff(t, prepend=np.nan) != 0.0
    detections = Points.of(points, labels, covariances, lines)
    return t[begins], detections._replace(message=np.cumsum(begins) - 1)


def read_json_lines(file: Path, topics: Topics, rule: LabelRule) -> Recording:
    """Read the drive in a file of JSON lines, in SI units; an InputError names file and line.

    A line is `{"t": s, "twist": [vx, vy, wz]}` or `{"t": s, "detections": [{"x": m, "y": m, "label": "blue",
    "covariance": [[xx, xy], [xy, yy]]}, ...]}`, or both. Label and covariance are optional, and `range` and
    `bearing` may replace `x` and `y`. Where there is no twist, or the topics say so, the motion is that
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
            lists = [name for name in ("detections", "polylines") if hasattr(entry, name)]
            # each list is read as a message, and so is a scan
            points = [cone_points(SimpleNamespace(**{name: getattr(entry, name)}), rule) for name in lists]
            if hasattr(entry, "scan"):
                limits = {"range_min": 0.0, "range_max": np.inf}
                points.append(scan_points(SimpleNamespace(**{**limits, **vars(entry.scan)})))
        except BROKEN as error:
            expected = "expected a line with t, and with twist [vx, vy, wz], detections, polylines or a scan"
            told = f"found {shown(line)} ({type(error).__name__}: {error})"
            raise InputError(file, f"{expected}, {told}", row) from None
        scan_t += [stamp] * len(points)
        scans += points
    are_poses = bool(topics.from_poses or (moved["pose"] and not moved["twist"]))
    if topics.from_poses and not moved["pose"]:
        raise InputError(file, "--from-poses: expected lines with pose [x, y, yaw], found none")
    entries = moved["pose" if are_poses else "twist"]
    return Recording(
        np.array([t for _, t, _ in entries]),
        np.array([motion for _, _, motion in entries]).reshape(-1, 3),
        np.array(scan_t),
        Points.joined(scans),
        {"file": file.name},
        np.array([row for row, _, _ in entries], int),
        f"{file.name}, line",
        are_poses=are_poses,
        is_held=topics.held,
    )
