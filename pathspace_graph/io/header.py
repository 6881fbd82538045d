"""The header of a log in TOML: sensor and source, the noise and where it comes from, and the true errors."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
from msgspec import Meta, Struct, defstruct
from msgspec.structs import asdict, astuple

from pathspace_graph.errors import InputError
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.noise import MeasuredNoise, RayNoise
from pathspace_graph.factors.sensor import SENSOR
from pathspace_graph.labels import KINDS

from .parsing import MAX_HEADER_BYTES, MAX_NOISE, parse_toml, read_text, shown, typed

FORMAT: Final = "pathspace-log/1"
STATED: Final = "stated"
UNSTATED: Final = ("measured", "assumed")  # measured, or assumed where the drive shows too little
CALIBRATION: Final = ("scale", "bias")  # constant errors of the odometry
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
Kind = Annotated[str, Meta(pattern=f"^({'|'.join(KINDS)})$")]
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
    kind: Kind | None = None
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


_TRUTH: Final = {
    name: defstruct(name, [(entry, Number) for entry in entries]) for name, entries in TRUE_ERRORS.items()
}


def read_header(file: Path) -> Header:
    """Read the header of a log; an InputError names the file and the entry."""
    content = parse_toml(read_text(file, most=MAX_HEADER_BYTES), file)
    if content.get("format") != FORMAT:
        raise InputError(file, f'expected format = "{FORMAT}", found {shown(content.get("format"))}')
    return typed(content, Header, file)


def true_errors(header: Header, file: Path) -> dict[str, Array]:
    """Known true errors by the field of `Truth`; each group is whole, and a truth has a calibration."""
    stated = header.truth
    return {
        name: np.array(astuple(typed(stated, _TRUTH[name], file, "truth")))
        for name, entries in TRUE_ERRORS.items()
        if stated and (name == "calibration" or not stated.keys().isdisjoint(entries))
    }


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


def noise_sections(odometry: bool, detections: bool, measured: MeasuredNoise | None) -> dict[str, Any]:
    """Sections of the noise, where not all of it is stated."""
    if odometry and detections and measured is None:
        return {}
    has_rays = measured is not None and measured.along is not None
    section = {
        "odometry": STATED if odometry else UNSTATED[measured is None],
        "detections": STATED if detections else UNSTATED[not has_rays],
    }
    if measured is None:
        return {"noise": section}
    errors = np.column_stack([measured.sensor, measured.sensor_sigma])
    values = vars(measured) | dict(zip(SENSOR, errors, strict=True))
    for name in ("along", "across") if has_rays else ():
        values[name] = [*values[name].sigma, values[name].share, values[name].time]
    entries = (_MeasuredRays if has_rays else _Measured).__struct_fields__
    names = [name for name in entries if name != "range_bend" or measured.range_bend]
    return {"noise": section, "noise.measured": {name: values[name] for name in names}}


def to_toml(sections: Mapping[str, Mapping[str, Any]], scale: float = 1.0) -> str:
    lines = [f'format = "{FORMAT}"']
    lines += [] if scale == 1.0 else [f"scale = {toml_text(scale)}"]
    for name, entries in sections.items():
        lines += ["", f"[{name}]"]
        lines += [f"{key} = {toml_text(value)}" for key, value in entries.items() if value is not None]
    return "\n".join(lines) + "\n"


def toml_text(value: Any) -> str:
    """A text, a number or an array of numbers as TOML."""
    if not isinstance(value, str):
        return repr(np.asarray(value).tolist())
    # a JSON string is a TOML string, but for the delete character
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
