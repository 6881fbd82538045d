"""A log: odometry, perception cycles and, where known, the truth; it is read from and written to a folder."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.errors import InputError
from pathspace_graph.factors.measured_noise import KnownNoise, MeasuredNoise
from pathspace_graph.labels import NAMES, label_from_name
from pathspace_graph.lengths import POSE

from .csv_table import FloatArray, Table, read_table
from .files import atomic_folder
from .limits import (
    MAX_ANGLE,
    MAX_DETECTIONS,
    MAX_DRIVE,
    MAX_HEADER_BYTES,
    MAX_HELD,
    MAX_NOISE,
    MAX_RANGE,
    MAX_SPEED,
    MAX_STAMP,
    MAX_YAW_RATE,
    shown,
)
from .manifest import verified
from .noise import noise_from_toml, noise_to_toml
from .parsing import parse_toml, read_text

IntArray = NDArray[np.int_]

FORMAT: Final = "pathspace-log/1"
LOG_FILE: Final = "log.toml"
ODOMETRY_FILE: Final = "odometry.csv"
DETECTIONS_FILE: Final = "detections.csv"
TRUTH_POSES_FILE: Final = "truth_poses.csv"
TRUTH_CONES_FILE: Final = "truth_cones.csv"
TRUTH_ASSOCIATIONS_FILE: Final = "truth_associations.csv"
FILES: Final = (
    LOG_FILE,
    ODOMETRY_FILE,
    DETECTIONS_FILE,
    TRUTH_POSES_FILE,
    TRUTH_CONES_FILE,
    TRUTH_ASSOCIATIONS_FILE,
)
"""A log has these files, those of the truth only where it is known."""

CALIBRATION: Final = ("scale", "bias")
"""The true calibration of the odometry has these names in the log's header."""

SENSOR: Final = ("yaw", "lateral", "latency", "range_scale", "range_bias")
"""The true constant errors of the sensor have these names in the log's header."""
NOISE: Final = ("sigma_vx", "sigma_vy", "sigma_wz", "slow_range", "slow_bearing", "slow_time")
"""The true noise has these names in the log's header, where it is not white as the log states it."""
_TRUE_ERRORS: Final = {"calibration": CALIBRATION, "sensor": SENSOR, "noise": NOISE}
"""These fields of the truth are in the log's header, by the names of their entries."""

MAX_HOLD: Final = 1.0
"""The last twist may be held for this time (s); a perception cycle later than that has no odometry."""
MIN_RELATIVE_DETERMINANT: Final = 1e-12
"""A covariance with det <= this * xx * yy is singular to double precision, so not positive definite."""


@dataclass(frozen=True, eq=False)
class Odometry:
    """Holds the measured body twists, each of which is held until the next."""

    LENGTHS: ClassVar = {"twist": POSE}

    t: FloatArray
    """These are the stamps (N,) in s, strictly increasing."""
    twist: FloatArray
    """Each row is a twist [vx, vy, wz] (N, 3) in m/s, m/s, rad/s, vehicle frame."""

    def between(self, start: float, end: float) -> Odometry:
        """Returns the twists in force from `start` to `end` (s): the first from `start`, the last held until
        `end`.

        Before the first row nothing moves; where no time passes there are no rows.
        """
        start = max(start, float(self.t[0]))
        first = int(np.searchsorted(self.t, start, side="right")) - 1
        stop = max(first, int(np.searchsorted(self.t, end, side="left"))) if end > start else first
        return Odometry(np.maximum(self.t[first:stop], start), self.twist[first:stop])

    def followed_by(self, later: Odometry) -> Odometry:
        """Returns these twists and the later ones that are newer."""
        new = later.t > self.t[-1] if len(self.t) else np.ones(len(later.t), bool)
        return Odometry(np.append(self.t, later.t[new]), np.concatenate([self.twist, later.twist[new]]))


@dataclass(frozen=True, eq=False)
class Detections:
    """Holds the boundary points detected in one perception cycle."""

    LENGTHS: ClassVar = {"points_vehicle": 1, "covariances": 2}

    t: float
    """This is the stamp of the cycle (s)."""
    points_vehicle: FloatArray
    """Each row is a detected point (m, 2) in m, vehicle frame."""
    covariances: FloatArray
    """Each point has this covariance (m, 2, 2) in m^2, vehicle frame."""
    labels: IntArray
    """Each point has a label (m,): LEFT, RIGHT, UNKNOWN, ORANGE or BIG_ORANGE."""

    def where(self, chosen: NDArray[np.bool_]) -> Detections:
        """Return the chosen detections of the cycle."""
        if chosen.all():
            return self
        return Detections(self.t, self.points_vehicle[chosen], self.covariances[chosen], self.labels[chosen])


@dataclass(frozen=True)
class SensorInfo:
    """Holds what is known of the sensor; None stands where the log does not say."""

    LENGTHS: ClassVar = {"range_max": 1}

    range_max: float | None = None
    """This is the greatest range (m)."""
    fov: float | None = None
    """This is the field of view, the whole angle (rad)."""
    rate: float | None = None
    """The sensor gives this number of perception cycles per second (Hz)."""


@dataclass(frozen=True, eq=False)
class Truth:
    """Holds what a simulator or a survey knows, for evaluation only; what is not known has no rows."""

    LENGTHS: ClassVar = {
        "poses": POSE,
        "cones": 1,
        "sensor": (0, 1, 0, 0, 1),
        "noise": (1, 1, 0, 0, 0, 0),
    }

    pose_t: FloatArray
    """These are the stamps of the true poses (N,) in s."""
    poses: FloatArray
    """Each row is a true pose [x, y, theta] (N, 3) in m, m, rad, map frame."""
    cones: FloatArray
    """Each row is a true cone (M, 2) in m, map frame."""
    cone_labels: IntArray
    """Each true cone has the label LEFT, RIGHT or UNKNOWN (M,)."""
    associations: IntArray | None = None
    """Each detection, in file order, is of the true cone with this index (R,), and of none at -1; None means
    not known."""
    calibration: FloatArray | None = None
    """The odometry truly has this calibration (2,): scale error of the speeds (-), bias of the yaw rate
    (rad/s). None means not known."""
    sensor: FloatArray | None = None
    """Constant errors of the sensor (5,): yaw (rad), lateral offset (m), age of detections at their stamps
    (s), scale error (-) and bias (m) of ranges. None means not known, or none."""
    noise: FloatArray | None = None
    """Noise that is not white (6,): the sigmas of white noise of a twist that drifts as much (m/s, m/s,
    rad/s), the shares of a range's and a bearing's variance that stay with a cone (-), and the correlation
    time of those (s). None means not known, or white."""


@dataclass(frozen=True, eq=False)
class Log:
    """Holds all that a vehicle recorded on one drive."""

    LENGTHS: ClassVar = {
        "odometry": 0,
        "cycles": 0,
        "odometry_sigma": POSE,
        "sensor": 0,
        "measured": 0,
        "truth": 0,
    }

    odometry: Odometry
    """These are the measured body twists."""
    cycles: tuple[Detections, ...]
    """These are the perception cycles in order of time."""
    odometry_sigma: FloatArray
    """These are the standard deviations (3,) of a measured twist in m/s, m/s, rad/s, white from sample to
    sample."""
    sensor: SensorInfo = SensorInfo()
    """This is known of the sensor."""
    source: Mapping[str, str] = field(default_factory=dict)
    """These free texts say where the log comes from."""
    odometry_stated: bool = True
    """Whether somebody has stated the noise of the odometry; otherwise it was measured or assumed."""
    detections_stated: bool = True
    """Whether somebody has stated the covariances of the detections."""
    measured: MeasuredNoise | None = None
    """Noise and constant errors of the sensor, as the readings themselves show them."""
    truth: Truth | None = None
    """This is the truth where there is any."""

    @property
    def noise(self) -> KnownNoise:
        """Return what is known of the noise before the drive."""
        return KnownNoise(self.odometry_sigma, self.odometry_stated, self.detections_stated, self.measured)


def read_log(folder: Path | str) -> Log:
    """Reads and checks a log folder (FORMATS: A log).

    Anything wrong is an InputError that names the file, the row and what was expected.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(folder, "expected a log folder, found " + ("a file" if folder.exists() else "none"))
    with verified(folder, *FILES):
        return _read_log(folder)


def _read_log(folder: Path) -> Log:
    header = _read_toml(folder / LOG_FILE)
    odometry = _read_odometry(folder / ODOMETRY_FILE)
    table = read_table(folder / DETECTIONS_FILE, ("t", "x", "y", "label", "xx", "xy", "yy"))
    cycles = _cycles(table, float(odometry.t[0]), float(odometry.t[-1]))
    return Log(
        odometry=odometry,
        cycles=cycles,
        odometry_sigma=_odometry_sigma(folder / LOG_FILE, header),
        sensor=_sensor_info(folder / LOG_FILE, header),
        source={key: str(value) for key, value in _section(folder / LOG_FILE, header, "source").items()},
        **noise_from_toml(folder / LOG_FILE, _section(folder / LOG_FILE, header, "noise")),
        truth=_read_truth(folder, len(table), _true_errors(folder / LOG_FILE, header)),
    )


def write_log(log: Log, folder: Path | str, *, check: bool = False) -> None:
    """Writes a log folder that `read_log` gives back exactly.

    A cycle without detections has no row in the file, so it is left out. The folder appears as a whole or not
    at all; an earlier log there is kept as a numbered backup. With `check`, a log that cannot be read is an
    InputError, and is not written.
    """
    with atomic_folder(folder, LOG_FILE) as target:
        (target / LOG_FILE).write_text(_toml(log), encoding="utf-8", newline="\n")
        odometry = np.column_stack([log.odometry.t, log.odometry.twist]).tolist()
        _write_csv(target / ODOMETRY_FILE, "t,vx,vy,wz", odometry)
        _write_csv(target / DETECTIONS_FILE, "t,x,y,label,xx,xy,yy", _detection_rows(log.cycles))
        if log.truth is not None:
            _write_truth(log.truth, target)
        if check:
            _read_log(target)


def _read_toml(file: Path) -> dict[str, Any]:
    header = parse_toml(read_text(file, most=MAX_HEADER_BYTES), file)
    if header.get("format") != FORMAT:
        raise InputError(file, f'expected format = "{FORMAT}", found {shown(header.get("format"))}')
    return header


def _section(file: Path, header: dict[str, Any], name: str) -> dict[str, Any]:
    section = header.get(name, {})
    if not isinstance(section, dict):
        raise InputError(file, f"expected a section [{name}], found {shown(section)}")
    return section


def _odometry_sigma(file: Path, header: dict[str, Any]) -> FloatArray:
    sigma = _section(file, header, "odometry").get("sigma")
    good = isinstance(sigma, list) and len(sigma) == 3 and all(_is_positive(value) for value in sigma)
    if not good:
        raise InputError(file, f"expected three positive numbers as [odometry] sigma, found {shown(sigma)}")
    return np.array(sigma, dtype=float)


def _sensor_info(file: Path, header: dict[str, Any]) -> SensorInfo:
    section = _section(file, header, "sensor")
    values: dict[str, float | None] = {}
    for name in ("range_max", "fov", "rate"):
        value = section.get(name)
        if value is not None and not _is_positive(value):
            raise InputError(file, f"expected a positive number as [sensor] {name}, found {shown(value)}")
        values[name] = None if value is None else float(value)
    return SensorInfo(**values)


def _true_errors(file: Path, header: dict[str, Any]) -> dict[str, FloatArray]:
    """Returns the true calibration, errors of the sensor and noise, those of them that the header has."""
    section = _section(file, header, "truth")
    found = {}
    for field_name, names in _TRUE_ERRORS.items():
        values = [section.get(name) for name in names]
        if section and (names == CALIBRATION or any(name in section for name in names)):
            if not all(_is_number(value) for value in values):
                expected = f"{', '.join(names[:-1])} and {names[-1]}"
                raise InputError(file, f"expected numbers as [truth] {expected}, found {shown(values)}")
            found[field_name] = np.array(values, dtype=float)
    return found


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= MAX_NOISE


def _is_positive(value: object) -> bool:
    return isinstance(value, int | float) and _is_number(value) and value > 0


def _read_odometry(file: Path) -> Odometry:
    table = read_table(file, ("t", "vx", "vy", "wz"))
    if not len(table):
        raise InputError(file, "expected at least one row, found a header only", 2)
    t, speeds = _increasing_times(table), table.stack(("vx", "vy"), MAX_SPEED)
    held = np.abs(speeds[:-1]).max(axis=1) * np.diff(t)
    held_far = f"expected a twist that moves the vehicle by at most {MAX_HELD:g} m until the next row"
    table.require(np.append(held <= MAX_HELD, True), held_far)
    too_long = f"expected a drive of at most {MAX_DRIVE:g} m up to the next row"
    table.require(np.append(np.cumsum(held) <= MAX_DRIVE, True), too_long)
    return Odometry(t, np.column_stack([speeds, table.numbers("wz", MAX_YAW_RATE)]))


def _increasing_times(table: Table) -> FloatArray:
    t = table.numbers("t", MAX_STAMP)
    good = np.append(True, np.diff(t) > 0) if len(t) else np.ones(0, dtype=bool)
    table.require(good, "expected a time later than the row before")
    return t


def _cycles(table: Table, t_first: float, t_last: float) -> tuple[Detections, ...]:
    if not len(table):
        return ()
    t = table.numbers("t", MAX_STAMP)
    table.require(np.append(True, np.diff(t) >= 0), "expected a time not earlier than the row before")
    table.require(t >= t_first, f"expected a time not before the first odometry row ({t_first:g} s)")
    late = f"expected a time at most {MAX_HOLD:g} s after the last odometry row ({t_last:g} s)"
    table.require(t <= t_last + MAX_HOLD, late)
    points = table.stack(("x", "y"), MAX_RANGE)
    cycles = cycles_of(t, points, _covariances(table), _labels(table))
    counts = [len(cycle.labels) for cycle in cycles]
    if max(counts) > MAX_DETECTIONS:
        first = sum(counts[: int(np.argmax(counts))])
        table.fail(first, f"expected at most {MAX_DETECTIONS} detections in a cycle, found more")
    return cycles


def cycles_of(
    t: FloatArray, points_vehicle: FloatArray, covariances: FloatArray, labels: IntArray
) -> tuple[Detections, ...]:
    """Returns the perception cycles of detections (m,): neighbours with the same stamp (s) are one cycle."""
    starts = np.flatnonzero(np.diff(t, prepend=-np.inf))
    spans = [slice(a, b) for a, b in pairwise([*starts, len(t)])]
    return tuple(Detections(float(t[s.start]), points_vehicle[s], covariances[s], labels[s]) for s in spans)


def covariances_of(xx: FloatArray, xy: FloatArray, yy: FloatArray) -> FloatArray:
    """Returns covariances (m, 2, 2) from their entries (m,)."""
    return np.stack([xx, xy, xy, yy], axis=-1).reshape(-1, 2, 2)


def _covariances(table: Table) -> FloatArray:
    xx, xy, yy = (table.numbers(name, MAX_RANGE**2) for name in ("xx", "xy", "yy"))
    with np.errstate(over="ignore", invalid="ignore"):
        good = (xx > 0) & (yy > 0) & (xx * yy - xy * xy > MIN_RELATIVE_DETERMINANT * xx * yy)
    table.require(good, "expected a positive definite covariance (xx > 0, xx yy > xy^2)")
    return covariances_of(xx, xy, yy)


def _labels(table: Table) -> IntArray:
    return np.array([label_from_name(name) for name in table.columns["label"]], dtype=int)


def _read_truth(folder: Path, detection_count: int, errors: dict[str, FloatArray]) -> Truth | None:
    files = (folder / TRUTH_POSES_FILE, folder / TRUTH_CONES_FILE, folder / TRUTH_ASSOCIATIONS_FILE)
    if not errors and not any(file.exists() for file in files):
        return None
    pose_t, poses = _read_truth_poses(files[0])
    cones, cone_labels = _read_truth_cones(files[1])
    associations = _read_associations(files[2], detection_count, len(cones))
    return Truth(pose_t, poses, cones, cone_labels, associations, **errors)


def _read_truth_poses(file: Path) -> tuple[FloatArray, FloatArray]:
    if not file.exists():
        return np.zeros(0), np.zeros((0, 3))
    table = read_table(file, ("t", "x", "y", "theta"))
    points, theta = table.stack(("x", "y")), table.numbers("theta", MAX_ANGLE)
    return _increasing_times(table), np.column_stack([points, theta])


def _read_truth_cones(file: Path) -> tuple[FloatArray, IntArray]:
    if not file.exists():
        return np.zeros((0, 2)), np.zeros(0, dtype=int)
    table = read_table(file, ("x", "y", "label"))
    return table.stack(("x", "y")), _labels(table)


def _read_associations(file: Path, detection_count: int, cone_count: int) -> IntArray | None:
    if not file.exists():
        return None
    table = read_table(file, ("cone",))
    if len(table) != detection_count:
        raise InputError(file, f"expected a row for each of {detection_count} detections, found {len(table)}")
    cones = table.numbers("cone")
    good = (cones == np.floor(cones)) & (cones >= -1) & (cones < cone_count)
    table.require(good, f"expected -1 or the index of one of {cone_count} true cones")
    return cones.astype(int)


def _toml(log: Log) -> str:
    sigma = ", ".join(repr(float(value)) for value in log.odometry_sigma)
    sensor = {"range_max": log.sensor.range_max, "fov": log.sensor.fov, "rate": log.sensor.rate}
    lines = [f'format = "{FORMAT}"', "", "[odometry]", f"sigma = [{sigma}]", "", "[sensor]"]
    lines += [f"{name} = {float(value)!r}" for name, value in sensor.items() if value is not None]
    lines += noise_to_toml(log.odometry_stated, log.detections_stated, log.measured)
    lines += ["", "[source]"]
    lines += [f"{_toml_text(key)} = {_toml_text(value)}" for key, value in log.source.items()]
    errors = {names: getattr(log.truth, name, None) for name, names in _TRUE_ERRORS.items()}
    known = {names: values for names, values in errors.items() if values is not None}
    lines += ["", "[truth]"] if known else []
    for names, values in known.items():
        lines += [f"{name} = {value!r}" for name, value in zip(names, values.tolist(), strict=True)]
    return "\n".join(lines) + "\n"


def _toml_text(text: str) -> str:
    # a JSON string is a TOML string, but for the delete character
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _detection_rows(cycles: Iterable[Detections]) -> Iterable[list[object]]:
    for cycle in cycles:
        points, covariances = cycle.points_vehicle.tolist(), cycle.covariances.tolist()
        for (x, y), label, ((xx, xy), (_, yy)) in zip(
            points, cycle.labels.tolist(), covariances, strict=True
        ):
            yield [float(cycle.t), x, y, NAMES[label], xx, xy, yy]


def _write_truth(truth: Truth, target: Path) -> None:
    poses = np.column_stack([truth.pose_t, truth.poses]).tolist()
    _write_csv(target / TRUTH_POSES_FILE, "t,x,y,theta", poses)
    labels = [NAMES[label] for label in truth.cone_labels]
    cones = ([x, y, label] for (x, y), label in zip(truth.cones.tolist(), labels, strict=True))
    _write_csv(target / TRUTH_CONES_FILE, "x,y,label", cones)
    if truth.associations is not None:
        _write_csv(target / TRUTH_ASSOCIATIONS_FILE, "cone", ([cone] for cone in truth.associations.tolist()))


def _write_csv(file: Path, header: str, rows: Iterable[list[Any]]) -> None:
    # str of a Python float is the shortest text that reads back as the same number
    text = "".join(",".join(map(str, row)) + "\n" for row in rows)
    file.write_text(f"{header}\n{text}", encoding="utf-8", newline="\n")
