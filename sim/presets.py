"""Settings of a simulation by name: sensors that were measured on a real car."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Final

import numpy as np

from pathspace_graph.errors import check_name

from .faults import SensorFaults
from .sensor import OdometryNoise, SensorSettings
from .simulate import SimulationSettings

CAMERA: Final = SensorSettings(
    rate=5.0,
    range_max=40.0,
    fov=float(np.deg2rad(150.0)),
    range_sigma=0.03,
    range_sigma_growth=0.041,
    bearing_sigma=0.0163,
    detection_probability=0.95,
    detection_falloff=0.015,
    blind_fraction=0.0,
    false_positives=0.5,
    slow_range=0.1,
    slow_bearing=0.5,
    slow_time=4.0,
    duplicates=0.1,
    dropped_cycles=0.02,
)
CAMERA_FAULTS: Final = SensorFaults(
    latency=-0.12, yaw=-0.0175, range_scale=0.08, range_bias=-0.19, colourless=0.03
)
INS: Final = OdometryNoise(white=(0.009, 0.003, 0.003), slow=(0.03, 0.01, 0.002), slow_time=5.0)
INS_RATE: Final = 40.0

PLAIN: Final = "plain"
"""The preset of this name changes nothing."""


def _camera(settings: SimulationSettings) -> SimulationSettings:
    return replace(settings, sensor=CAMERA, faults=replace(settings.faults, sensor=CAMERA_FAULTS))


def _ins(settings: SimulationSettings) -> SimulationSettings:
    return replace(settings, odometry=INS, vehicle=replace(settings.vehicle, rate=INS_RATE))


PRESETS: Final[dict[str, dict[str, Callable[[SimulationSettings], SimulationSettings]]]] = {
    "sensor": {PLAIN: lambda settings: settings, "camera": _camera},
    "odometry": {PLAIN: lambda settings: settings, "ins": _ins},
}
"""Each group of settings has presets by name."""


def preset(names: Mapping[str, str]) -> SimulationSettings:
    """Returns the defaults of a simulation with a named preset for some groups of `PRESETS`."""
    settings = SimulationSettings()
    for group, name in names.items():
        check_name(name, PRESETS[group], f"{group}: expected a known preset")
        settings = PRESETS[group][name](settings)
    return settings
