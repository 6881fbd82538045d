"""Good logs of many kinds: what is unusual about them is no mistake."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np

from pathspace_graph.io.log import Detections, Log, Odometry
from pathspace_graph.labels import LEFT
from pathspace_graph.settings.checked import Overrides, override
from pathspace_graph.sim.sensor import OdometryNoise, SensorSettings
from pathspace_graph.sim.simulate import preset, simulate
from pathspace_graph.sim.track_generator import generate_track

from .mistakes import with_cycles

_SENSOR, _ODOMETRY = SensorSettings(), OdometryNoise()
_NOISY: Final = {
    **{f"sensor.{name}": 3.0 * getattr(_SENSOR, name) for name in ("range_sigma", "range_sigma_growth")},
    "sensor.bearing_sigma": 3.0 * _SENSOR.bearing_sigma,
    "odometry.white": tuple(3.0 * sigma for sigma in _ODOMETRY.white),
    **{f"odometry.{name}": 3.0 * getattr(_ODOMETRY, name) for name in ("scale", "gyro_bias")},
}
SIMULATED: Final[dict[str, Overrides]] = {  # kinds of good logs, by what is unusual about their simulation
    "as simulated": {},
    **{f"field of view of {degrees} degrees": {"sensor.fov": np.deg2rad(degrees)} for degrees in (180, 360)},
    **{f"range of {metres:g} m": {"sensor.range_max": metres} for metres in (5.0, 8.0, 20.0)},
    "noise times 3": _NOISY,
    **{f"{rate:g} cycles per second": {"sensor.rate": rate} for rate in (2.0, 5.0, 20.0)},
    "30 % of the cones missed": {"sensor.detection_probability": 0.7, "sensor.blind_fraction": 0.15},
    "5 false positives in a cycle": {"sensor.false_positives": 5.0},
    "30 % wrong colours": {"sensor.wrong_colour": 0.3},
    "without colours": {"faults.sensor.colourless": 1.0},
    "yaw-rate bias of 0.02 rad/s": {"faults.odometry.yaw_rate_bias": 0.02},
    "wheel slip of 50 %": {"faults.odometry.slip": 0.5},
    "latency of 100 ms": {"faults.sensor.latency": 0.1},
    "sensor turned by 2 degrees": {"faults.sensor.yaw": 0.0349},
    "sensor 0.2 m to the left": {"faults.sensor.lateral": 0.2},
    "ranges 4 % too long": {"faults.sensor.range_scale": 0.04},
    "odometry missing for 2 s": {"faults.odometry.gap": 2.0},
    "no detections for 5 s": {"faults.sensor.dropout": 5.0},
    "driven the other way round": {"faults.vehicle.wrong_way": True},
    "stands for 10 s first": {"vehicle.rest": 10.0},
    "stands at the end, creeps by odometry": {"vehicle.stand": 8.0, "faults.odometry.false_travel": 3.0},
    **{f"drawn car {number}": {"draw": True} for number in range(6)},
}
PRESET: Final = {  # kinds of good logs, by their presets
    "camera and ins": {"sensor": "camera", "odometry": "ins"},
    "points of lines": {"sensor": "line"},
}


def backs_up(log: Log) -> Log:
    """Return the log of a vehicle that goes the same way backward: time runs the other way."""
    end = float(log.odometry.t[-1])
    odometry = Odometry(end - log.odometry.t[::-1], -log.odometry.twist[::-1])
    cycles = [replace(cycle, t=end - cycle.t) for cycle in log.cycles[::-1] if cycle.t <= end]
    return replace(log, odometry=odometry, cycles=tuple(cycles), truth=None)


def in_unix_time(log: Log) -> Log:
    log = with_cycles(log, lambda cycle: {"t": cycle.t + 1.7e9})
    return replace(log, odometry=replace(log.odometry, t=log.odometry.t + 1.7e9), truth=None)


def kept(log: Log, chosen: Callable[[Detections], np.ndarray]) -> Log:
    cycles = (cycle.where(chosen(cycle)) for cycle in log.cycles)
    return replace(log, cycles=tuple(cycle for cycle in cycles if len(cycle.labels)), truth=None)


def every(log: Log, step: int, end: float = np.inf) -> Log:
    """Return the log with some of the twists, up to a stamp (s)."""
    odometry = Odometry(*(one[log.odometry.t <= end][::step] for one in (log.odometry.t, log.odometry.twist)))
    return replace(log, odometry=odometry, cycles=tuple(cycle for cycle in log.cycles if cycle.t <= end))


def _nearest_three(cycle: Detections) -> np.ndarray:
    return np.asarray(np.argsort(np.argsort(np.hypot(*cycle.points_vehicle.T))) < 3)


EDITED: Final[dict[str, Callable[[Log], Log]]] = {  # kinds of good logs, by how they are edited
    "one boundary": lambda log: kept(log, lambda cycle: cycle.labels == LEFT),
    "three cones in a cycle": lambda log: kept(log, _nearest_three),
    "backs up": backs_up,
    "odometry at 10 Hz": lambda log: every(log, 5),
    "stamps since 1970": in_unix_time,
    "open road": lambda log: every(log, 1, float(log.odometry.t.mean())),
}


def good_log(track: int, kind: str) -> Log:
    """Return the good log of a kind; each drawn car is another one."""
    settings = override(replace(preset(PRESET.get(kind, {})), laps=1), SIMULATED.get(kind, {}), "")
    seed = track + 3 * list(SIMULATED).index(kind) if settings.draw else 0
    log = simulate(generate_track(np.random.default_rng(track)), settings, seed)
    return EDITED[kind](log) if kind in EDITED else log
