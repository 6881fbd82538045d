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
    fov=float(np.deg2rad(130.0)),
    range_sigma=0.03,
    range_sigma_growth=0.05,
    bearing_sigma=0.0125,
    detection_probability=1.0,
    detection_falloff=0.022,
    blind_fraction=0.0,
    wrong_colour=0.001,
    false_positives=0.05,
    slow_range=0.08,
    slow_bearing=0.8,
    slow_time=8.0,
    duplicates=0.9,
    overlap=(float(np.deg2rad(5.0)), float(np.deg2rad(17.0))),
    dropped_cycles=0.005,
)
"""Three cameras of a Formula Student car, as its recordings of three laps show them.

Their fields span bearings of +-65 degrees. A smoothed map gave the errors of some 900 passes of cones. Those
along the ray grow to 0.5 m at 10 m and 1.2 m at 22 m, with hardly any correlation from cycle to cycle. Those
across are 0.007 rad about their mean over a pass, but 0.011 to 0.015 rad between two cameras that see the
same cone: most of the error stays with the cone. The correlation time gave these figures and those of lag 1
to 5 again in a simulated log. Of the cones in the overlaps, at bearings of 5 to 17 degrees on both sides, 75
to 100 % are seen twice. 0.5 % of the cycles are missing. A cone is detected with a probability of 0.97 below
6 m, 0.8 at 14 m, 0.5 at 22 m and 0.15 at 37 m. Of the detections within 12 m, 0.1 % have the other
boundary's colour and about 0.04 a cycle are of no cone.
"""
CAMERA_FAULTS: Final = SensorFaults(
    latency=-0.12, yaw=-0.0175, range_scale=0.08, range_bias=-0.19, colourless=0.01
)
"""Constant errors of these cameras against the odometry, which differ a little from lap to lap.

Fits on each lap gave stamps 0.108 to 0.131 s early, a yaw of 0.6 to 1.4 degrees to the right, and ranges
0.19 m too short and 7 to 9 % too long.
"""
INS: Final = OdometryNoise(
    white=(0.009, 0.003, 0.003), gyro_bias=0.0002, slow=(0.03, 0.03, 0.0005), slow_time=5.0
)
"""Inertial navigation of the same car.

Third differences of the readings gave the white noise. The slow errors and the bias are such that a lap of
240 m in 90 s ends 1 m and 0.02 rad off by dead reckoning: the three laps ended 0.8, 0.8 and 1.9 m, and 0.01
to 0.03 rad off. The correlation time is assumed.
"""
INS_RATE: Final = 40.0
"""Rate of the INS (Hz)."""

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
