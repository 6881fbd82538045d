"""Units that the figures of a log tell by themselves: stamps, distances, and what is beyond any vehicle."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.io.log import DETECTIONS_FILE, ODOMETRY_FILE, Detections, Log, Odometry
from pathspace_graph.settings.plausibility import PlausibilitySettings

from .hint import Hint

Array = NDArray[np.float64]

TIMES: Final = {1e-3: "milliseconds", 1e-6: "microseconds", 1e-9: "nanoseconds"}
"""Stamps may be in these units, by their size in s."""
LENGTHS: Final = {1e-2: "centimetres", 1e-3: "millimetres"}
"""Positions may be in these units, by their size in m."""


def stamps_in_seconds(log: Log, settings: PlausibilitySettings) -> tuple[Log, list[Hint]]:
    """Returns the log with its stamps in seconds, and a hint for each file in which they are not."""
    found = []
    odometry, cycles = log.odometry, log.cycles
    unit = _unit_of_time(odometry.t, settings)
    if unit is not None:
        found.append(_stamps_hint(ODOMETRY_FILE, odometry.t, unit))
        odometry = replace(odometry, t=odometry.t * unit)
    stamps = stamps_of(cycles)
    unit = _unit_of_time(stamps, settings)
    if unit is not None:
        found.append(_stamps_hint(DETECTIONS_FILE, stamps, unit))
        cycles = tuple(replace(cycle, t=cycle.t * unit) for cycle in cycles)
    return (replace(log, odometry=odometry, cycles=cycles) if found else log), found


def _unit_of_time(stamps: Array, settings: PlausibilitySettings) -> float | None:
    """Returns the unit of stamps (s) that would give a usual rate, or None where seconds do."""
    step = _median(np.abs(np.diff(stamps)))
    if step <= settings.longest_step:
        return None
    fitting = [unit for unit in TIMES if settings.shortest_step <= step * unit <= settings.longest_step]
    return fitting[0] if fitting else None


def _stamps_hint(file: str, stamps: Array, unit: float) -> Hint:
    step = _median(np.abs(np.diff(stamps)))
    return Hint(
        "stamps",
        file,
        "column t",
        f"rows follow each other after {step:.4g} s as a rule",
        f"the stamps are in {TIMES[unit]}, not in seconds",
        f"multiply column t by {unit:g}",
    )


def whole_stamps(log: Log) -> list[Hint]:
    """Returns a hint for each file whose stamps are only the seconds, or only the fraction of a second."""
    found = []
    for file, t in ((ODOMETRY_FILE, log.odometry.t), (DETECTIONS_FILE, stamps_of(log.cycles))):
        falls = np.flatnonzero(np.diff(t) < 0.0)
        if len(falls) >= 2 and np.ptp(t) <= max(1.0, 1.0 / min(TIMES)):
            figure = f"the stamps fall {len(falls)} times and stay between {t.min():.4g} and {t.max():.4g}"
            likely, advice = "this is only the fraction of each second", "add the seconds to it"
        elif len(t) > 2 and (np.diff(t) == 0.0).mean() > 0.5 and (t == np.floor(t)).all():
            figure = f"the stamps are whole numbers, {len(t) / len(np.unique(t)):.0f} rows to each"
            likely, advice = "these are only the whole seconds", "add the fraction of each second"
        else:
            continue
        found.append(Hint("stamps", file, "column t", figure, likely, advice))
    return found


def one_clock(log: Log) -> list[Hint]:
    """Returns a hint where the stamps of all cycles are before or after those of the odometry."""
    if not log.cycles:
        return []
    first, last = float(log.odometry.t[0]), float(log.odometry.t[-1])
    begin, end = log.cycles[0].t, log.cycles[-1].t
    if begin <= last and end >= first:
        return []
    return [
        Hint(
            "clocks",
            DETECTIONS_FILE,
            "column t",
            f"the stamps go from {begin:.12g} to {end:.12g} s, those of {ODOMETRY_FILE} from {first:.12g} to "
            f"{last:.12g} s",
            "the two files were stamped by different clocks, such as the sensor's and the receiver's",
            "stamp both by one clock",
        )
    ]


def positions_in_metres(log: Log, settings: PlausibilitySettings) -> tuple[Log, list[Hint]]:
    """Returns the log with its detections in metres, and a hint where they were not."""
    ranges = np.concatenate([np.zeros(0), *(np.hypot(*cycle.points_vehicle.T) for cycle in log.cycles)])
    typical = _median(ranges)
    if typical > settings.farthest:
        fitting = [unit for unit in LENGTHS if typical * unit <= settings.far] or [min(LENGTHS)]
        unit, likely = fitting[0], f"the positions are in {LENGTHS[fitting[0]]}, not in metres"
    elif 0.0 < typical < settings.nearest:
        unit, likely = 1e3, "the positions were divided by 1000 although they were in metres"
    else:
        return log, []
    scaled = moved(log, lambda points: points * unit)
    found = f"detections are {typical:.4g} m away as a rule"
    return scaled, [
        Hint("positions", DETECTIONS_FILE, "columns x, y", found, likely, f"multiply x and y by {unit:g}")
    ]


def moved(log: Log, by: Callable[[Array], Array]) -> Log:
    """Returns the log with other detections (m, 2)."""
    cycles = [replace(cycle, points_vehicle=by(cycle.points_vehicle)) for cycle in log.cycles]
    return replace(log, cycles=tuple(cycles))


def beyond_any_vehicle(odometry: Odometry, settings: PlausibilitySettings) -> list[Hint]:
    """Returns hints about speeds and yaw rates that no vehicle has."""
    found = []
    speed = float(np.quantile(np.hypot(odometry.twist[:, 0], odometry.twist[:, 1]), 0.9))
    if speed > settings.fastest:
        likely = "the speeds are not in m/s, but in mm/s or cm/s"
        size = f"the speed is more than {speed:.4g} m/s in a tenth of the rows"
        found.append(Hint("speeds", ODOMETRY_FILE, "columns vx, vy", size, likely, "give them in m/s"))
    rate = float(np.quantile(np.abs(odometry.twist[:, 2]), 0.9))
    if rate > settings.fastest_turn:
        likely = "the yaw rate is in degrees per second, not in rad/s"
        size = f"the yaw rate is more than {rate:.4g} rad/s in a tenth of the rows"
        found.append(Hint("yaw rate", ODOMETRY_FILE, "column wz", size, likely, "multiply it by pi/180"))
    return found


def stamps_of(cycles: Sequence[Detections]) -> Array:
    """Returns the stamps (C,) of cycles in s."""
    return np.array([cycle.t for cycle in cycles])


def _median(values: Array) -> float:
    return float(np.median(values)) if len(values) else 0.0
