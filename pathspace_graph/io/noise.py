"""The section of a log's header that says where its noise comes from, and what was measured of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np

from pathspace_graph.errors import InputError
from pathspace_graph.factors.measured_noise import MeasuredNoise, RayNoise
from pathspace_graph.factors.sensor import SENSOR

from .limits import MAX_NOISE, shown

STATED: Final = "stated"
UNSTATED: Final = ("measured", "assumed")
"""Noise that nobody has stated was measured, or it is assumed where the drive shows too little."""
RAYS: Final = ("along", "across")


def noise_to_toml(
    odometry_stated: bool, detections_stated: bool, measured: MeasuredNoise | None
) -> list[str]:
    """Return the lines of the section; there are none where all noise was stated and nothing measured."""
    if odometry_stated and detections_stated and measured is None:
        return []
    lines = ["", "[noise]"]
    rays = measured is not None and measured.along is not None
    for name, stated, known in (
        ("odometry", odometry_stated, measured is not None),
        ("detections", detections_stated, rays),
    ):
        lines.append(f'{name} = "{STATED if stated else UNSTATED[0 if known else 1]}"')
    return lines if measured is None else [*lines, "", "[noise.measured]", *_lines(measured)]


def _lines(measured: MeasuredNoise) -> list[str]:
    values: dict[str, Any] = {
        "odometry": measured.odometry.tolist(),
        "drift": measured.drift.tolist(),
        "interval": measured.interval,
    }
    if measured.along is not None and measured.across is not None:
        for name, ray in zip(RAYS, (measured.along, measured.across), strict=True):
            values[name] = [*ray.sigma.tolist(), ray.share, ray.time]
        values |= {"count": measured.count, "period": measured.period, "per_cycle": measured.per_cycle}
        for name, value, sigma in zip(SENSOR, measured.sensor, measured.sensor_sigma, strict=True):
            values[name] = [float(value), float(sigma)]
    values["seconds"] = measured.seconds
    return [f"{name} = {value!r}" for name, value in values.items()]


def noise_from_toml(file: Path, section: dict[str, Any]) -> dict[str, Any]:
    """Return the fields of a log that the section holds; a log without it has stated its noise."""
    found: dict[str, Any] = {}
    for name in ("odometry", "detections"):
        value = section.get(name, STATED)
        if value not in (STATED, *UNSTATED):
            expected = f'expected "stated", "measured" or "assumed" as [noise] {name}'
            raise InputError(file, f"{expected}, found {shown(value)}")
        found[f"{name}_stated"] = value == STATED
    measured = section.get("measured")
    return found if measured is None else found | {"measured": _measured(file, measured)}


def _measured(file: Path, section: Any) -> MeasuredNoise:
    if not isinstance(section, dict):
        raise InputError(file, f"expected a section [noise.measured], found {shown(section)}")
    sigmas = {name: _numbers(file, section, name, 3, 0.0) for name in ("odometry", "drift")}
    _require(file, sigmas["odometry"] + sigmas["drift"] > 0.0, "a twist with some noise as odometry or drift")
    interval, seconds = (float(_numbers(file, section, name, 1, 0.0)[0]) for name in ("interval", "seconds"))
    _require(file, interval > 0.0, "a positive number as interval")
    if RAYS[0] not in section:
        return MeasuredNoise(**sigmas, interval=interval, seconds=seconds)
    along, across = (_numbers(file, section, name, 4, 0.0) for name in RAYS)
    count, period, per_cycle = (
        float(_numbers(file, section, name, 1, 0.0)[0]) for name in ("count", "period", "per_cycle")
    )
    for name, ray in zip(RAYS, (along, across), strict=True):
        good = ray[0] + ray[1] > 0.0 and ray[2] <= 1.0 and ray[3] > 0.0
        _require(file, good, f"some noise, a share of at most 1 and a positive time as {name}")
    good = count >= 1.0 and count == int(count) and period > 0.0 and per_cycle > 0.0
    _require(file, good, "a whole number as count, and positive numbers as period and per_cycle")
    sensor = np.array([_numbers(file, section, name, 2, -MAX_NOISE) for name in SENSOR])
    _require(file, sensor[:, 1] > 0.0, "a positive sigma as the second number of each error of the sensor")
    return MeasuredNoise(
        **sigmas,
        interval=interval,
        along=RayNoise(along[:2], float(along[2]), float(along[3])),
        across=RayNoise(across[:2], float(across[2]), float(across[3])),
        count=int(count),
        period=period,
        per_cycle=per_cycle,
        sensor=sensor[:, 0],
        sensor_sigma=sensor[:, 1],
        seconds=seconds,
    )


def _require(file: Path, good: Any, expected: str) -> None:
    if not np.all(good):
        raise InputError(file, f"[noise.measured]: expected {expected}")


def _numbers(file: Path, section: dict[str, Any], name: str, count: int, least: float) -> Any:
    value = section.get(name)
    values = value if isinstance(value, list) else [value]
    good = len(values) == count and all(
        isinstance(one, int | float) and not isinstance(one, bool) and least <= one <= MAX_NOISE
        for one in values
    )
    if not good:
        expected = f"expected {count} number{'s' if count > 1 else ''} as [noise.measured] {name}"
        raise InputError(file, f"{expected}, found {shown(value)}")
    return np.array(values, dtype=float)
