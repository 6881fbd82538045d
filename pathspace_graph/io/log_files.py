"""The folder of a log: header in TOML, tables and, where known, the truth (FORMATS)."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
from msgspec import Meta, Struct, defstruct
from msgspec.structs import asdict, astuple

from pathspace_graph.errors import InputError, check_type
from pathspace_graph.factors.noise import MeasuredNoise, RayNoise
from pathspace_graph.factors.odometry import CALIBRATION
from pathspace_graph.factors.sensor import SENSOR
from pathspace_graph.labels import KINDS, NAMES

from . import log as logs
from .files import atomic_folder, write_table
from .log import Log, SensorInfo, Truth
from .parsing import MAX_HEADER_BYTES, MAX_NOISE, Table, parse_toml, read_text, shown, typed
from .tables import read_table

FORMAT: Final = "pathspace-log/1"
STATED: Final = "stated"
UNSTATED: Final = ("measured", "assumed")  # measured, or assumed where the drive shows too little
TRUE_ERRORS: Final = {  # entries of the truth, by the field of `io.log:Truth` that holds them
    "calibration": CALIBRATION,
    "sensor": SENSOR,
    "noise": ("sigma_vx", "sigma_vy", "sigma_wz", "slow_range", "slow_bearing", "slow_time"),
    "bend": ("range_bend", "range_bend_from"),
    "rays": ("sigma_range", "sigma_range_growth", "sigma_bearing"),
}

Number = Annotated[float, Meta(ge=-MAX_NOISE, le=MAX_NOISE)]
AtLeast0 = Annotated[float, Meta(ge=0.0, le=MAX_NOISE)]
Positive = Annotated[float, Meta(gt=0.0, le=MAX_NOISE)]
Origin = Annotated[str, Meta(pattern=f"^({'|'.join((STATED, *UNSTATED))})$")]
Ray = tuple[AtLeast0, AtLeast0, Annotated[float, Meta(ge=0.0, le=1.0)], Positive]  # fields of a `RayNoise`
Error = tuple[Number, Positive]  # an error of the sensor and its sigma


class _Odometry(Struct):
    sigma: tuple[Positive, Positive, Positive]
    drift_sigmas: tuple[AtLeast0, AtLeast0, AtLeast0] | None = None


class _Sensor(Struct, frozen=True):
    range_max: Positive | None = None
    fov: Positive | None = None
    rate: Positive | None = None
    kind: Annotated[str, Meta(pattern=f"^({'|'.join(KINDS)})$")] | None = None
    sigma_range_scale: Positive | None = None


class _Measured(Struct, kw_only=True):
    odometry: tuple[AtLeast0, AtLeast0, AtLeast0]
    drift: tuple[AtLeast0, AtLeast0, AtLeast0]
    interval: Positive
    seconds: AtLeast0
    range_bend: Number = 0.0


class _MeasuredRays(_Measured, kw_only=True):
    along: Ray
    across: Ray
    count: Annotated[int, Meta(ge=1)]
    period: Positive
    per_cycle: Positive
    yaw: Error
    lateral: Error
    latency: Error
    range_scale: Error
    range_bias: Error


class _Noise(Struct, frozen=True):
    odometry: Origin = STATED
    detections: Origin = STATED
    measured: dict[str, Any] | None = None


class Header(Struct):
    """A header as it was read, without format."""

    odometry: _Odometry
    scale: Positive = 1.0
    sensor: _Sensor = _Sensor()
    noise: _Noise = _Noise()
    source: dict[str, Any] = {}
    truth: dict[str, Any] = {}


# --- reading -------------------------------------------------------------------------------------------


def read_log(folder: Path | str) -> Log:
    """Read and check a log folder; an InputError names the file, the row and what was expected."""
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(folder, "expected a log folder, found " + ("a file" if folder.exists() else "none"))
    file = folder / logs.LOG_FILE
    content = parse_toml(read_text(file, most=MAX_HEADER_BYTES), file)
    if content.get("format") != FORMAT:
        raise InputError(file, f'expected format = "{FORMAT}", found {shown(content.get("format"))}')
    header = typed(content, Header, file)
    odometry = logs.odometry_of(_table(folder, logs.ODOMETRY_FILE))
    table = _table(folder, logs.DETECTIONS_FILE)
    return Log(
        odometry=odometry,
        cycles=logs.cycles_in(table, float(odometry.t[0]), float(odometry.t[-1])),
        odometry_sigma=np.array(header.odometry.sigma),
        sensor=SensorInfo(**asdict(header.sensor)),
        source={key: str(value) for key, value in header.source.items()},
        odometry_stated=header.noise.odometry == STATED,
        detections_stated=header.noise.detections == STATED,
        odometry_drift=None if (drift := header.odometry.drift_sigmas) is None else np.array(drift),
        measured=measured_noise(header, file),
        truth=_read_truth(folder, len(table), header.truth, file),
        scale=header.scale,
    )


def _table(folder: Path, name: str) -> Table:
    """Read a table of a log; an unknown one of the truth has no rows."""
    if name in logs.TRUTH_FILES and not (folder / name).exists():
        return Table.of_arrays(folder / name, logs.COLUMNS[name], np.zeros((0, len(logs.COLUMNS[name]))))
    return read_table(folder / name, logs.COLUMNS[name])


def _read_truth(folder: Path, detection_count: int, stated: dict[str, Any], file: Path) -> Truth | None:
    """Truth of the tables and of what the header states, where each group of errors is whole."""
    known = [(folder / name).exists() for name in logs.TRUTH_FILES]
    if not stated and not any(known):
        return None
    errors = {}
    for name, entries in TRUE_ERRORS.items():
        if stated and (name == "calibration" or not stated.keys().isdisjoint(entries)):
            group = defstruct(name, [(entry, Number) for entry in entries])
            errors[name] = np.array(astuple(typed(stated, group, file, "truth")))
    poses, cones, table = (_table(folder, name) for name in logs.TRUTH_FILES)
    t, points = logs.increasing_times(poses), cones.stack(("x", "y"))
    truth = Truth(t, poses.stack(("x", "y", "theta")), points, logs.labels_of(cones), None, **errors)
    if not known[-1]:
        return truth
    if len(table) != detection_count:
        expected = f"a row for each of {detection_count} detections"
        raise InputError(table.file, f"expected {expected}, found {len(table)}")
    index = table.numbers("cone")
    good = (index == np.floor(index)) & (index >= -1) & (index < len(points))
    table.require(good, f"expected -1 or the index of one of {len(points)} true cones")
    return replace(truth, associations=index.astype(int))


def measured_noise(header: Header, file: Path) -> MeasuredNoise | None:
    stated, where = header.noise.measured, "noise.measured"
    if stated is None:
        return None
    has_rays = "along" in stated
    read = typed(stated, _MeasuredRays if has_rays else _Measured, file, where)
    entries = asdict(read)
    twist: dict[str, Any] = {name: np.array(entries.pop(name)) for name in ("odometry", "drift")}
    if not np.all(twist["odometry"] + twist["drift"] > 0.0):
        raise InputError(file, f"{where}: expected a twist with some noise as odometry or drift")
    if has_rays:
        for name in ("along", "across"):
            near, growth, share, time = entries[name]
            if not near + growth > 0.0:
                raise InputError(file, f"{where}.{name}: expected some noise")
            entries[name] = RayNoise(np.array([near, growth]), share, time)
        errors, sigmas = np.array([entries.pop(name) for name in SENSOR]).T
        entries |= {"sensor": errors, "sensor_sigma": sigmas}
    return MeasuredNoise(**twist, **entries)


# --- writing -------------------------------------------------------------------------------------------


def write_log(log: Log, folder: Path | str, *, check: bool = False, force: bool = False) -> None:
    """Write a log folder that `read_log` gives back exactly, but for cycles without detections.

    It is written as by `atomic_folder`, and replaces an earlier log if `force`; with `check`, a log that
    cannot be read is an InputError instead.
    """
    check_type("log", log, Log)
    cycles, truth = log.cycles, log.truth
    covariances = np.concatenate([np.zeros((0, 2, 2)), *(cycle.covariances for cycle in cycles)])
    columns: dict[str, tuple[Any, ...]] = {
        logs.ODOMETRY_FILE: (log.odometry.t, log.odometry.twist),
        logs.DETECTIONS_FILE: (
            [cycle.t for cycle in cycles for _ in cycle.labels],
            np.concatenate([np.zeros((0, 2)), *(cycle.points_vehicle for cycle in cycles)]),
            [NAMES[label] for cycle in cycles for label in cycle.labels],
            covariances[:, [0, 0, 1], [0, 1, 1]],
        ),
    }
    if truth is not None:
        columns[logs.TRUTH_POSES_FILE] = truth.pose_t, truth.poses
        columns[logs.TRUTH_CONES_FILE] = truth.cones, [NAMES[label] for label in truth.cone_labels]
        if truth.associations is not None:
            columns[logs.TRUTH_ASSOCIATIONS_FILE] = (truth.associations,)
    with atomic_folder(folder, logs.LOG_FILE, force=force) as target:
        (target / logs.LOG_FILE).write_text(_to_toml(log), encoding="utf-8", newline="\n")
        for name, values in columns.items():
            write_table(target / name, logs.COLUMNS[name], *values)
        if check:
            read_log(target)


def _to_toml(log: Log) -> str:
    """Text of the header; it has sections of the noise where not all of it is stated."""
    truth, measured, noise = dict[str, Any](), log.measured, dict[str, dict[str, Any]]()
    for name, entries in TRUE_ERRORS.items():
        values = getattr(log.truth, name, None)
        truth |= {} if values is None else dict(zip(entries, values, strict=True))
    if not (log.odometry_stated and log.detections_stated and measured is None):
        has_rays = measured is not None and measured.along is not None
        noise["noise"] = {
            "odometry": STATED if log.odometry_stated else UNSTATED[measured is None],
            "detections": STATED if log.detections_stated else UNSTATED[not has_rays],
        }
    if measured is not None:
        errors = np.column_stack([measured.sensor, measured.sensor_sigma])
        values = vars(measured) | dict(zip(SENSOR, errors, strict=True))
        for name in ("along", "across") if has_rays else ():
            values[name] = [*values[name].sigma, values[name].share, values[name].time]
        fields = (_MeasuredRays if has_rays else _Measured).__struct_fields__
        own = (name for name in fields if name != "range_bend" or measured.range_bend)
        noise["noise.measured"] = {name: values[name] for name in own}
    sections: dict[str, dict[str, Any]] = {
        "odometry": {"sigma": log.odometry_sigma, "drift_sigmas": log.odometry_drift},
        "sensor": vars(log.sensor),
        **noise,
        "source": {_toml(key): value for key, value in log.source.items()},
        **({"truth": truth} if truth else {}),
    }
    lines = [f'format = "{FORMAT}"', *([] if log.scale == 1.0 else [f"scale = {_toml(log.scale)}"])]
    for name, section in sections.items():
        known = {key: value for key, value in section.items() if value is not None}
        lines += ["", f"[{name}]", *(f"{key} = {_toml(value)}" for key, value in known.items())]
    return "\n".join(lines) + "\n"


def _toml(value: Any) -> str:
    """A text, a number or an array of numbers as TOML."""
    if not isinstance(value, str):
        return repr(np.asarray(value).tolist())
    # a JSON string is a TOML string, but for the delete character
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
