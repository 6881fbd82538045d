"""What the calibration found at the end of a run says about the vehicle, in words."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from pathspace_graph.io.results import VehicleState

LIMIT: Final = 3.0
"""A calibration farther from zero than this number of its prior's standard deviations is worth a line."""


@dataclass(frozen=True)
class Cause:
    """Says what a calibration means, and where its prior is in the settings."""

    group: str
    """The settings have the standard deviation in this group, under `sigma_` and the calibration's name."""
    text: str
    """This is the cause, with a place for the size."""
    unit: float
    """The size is the absolute calibration times this."""
    signs: tuple[str, str]
    """These words stand for a positive and for a negative calibration."""


CAUSES: Final = {
    "scale": Cause("odometry", "speeds are {:.1f} % too {}", 100.0, ("high", "low")),
    "bias": Cause("odometry", "the yaw rate is {:.4f} rad/s too {}", 1.0, ("high", "low")),
    "yaw": Cause(
        "calibration", "the sensor is turned by {:.1f} degrees to the {}", 180.0 / np.pi, ("left", "right")
    ),
    "lateral": Cause("calibration", "the sensor sits {:.2f} m too far to the {}", 1.0, ("left", "right")),
    "latency": Cause("calibration", "detections are {:.0f} ms {} than their stamps", 1e3, ("older", "newer")),
    "range_scale": Cause("calibration", "ranges are {:.1f} % too {}", 100.0, ("long", "short")),
    "range_bias": Cause("calibration", "ranges are {:.2f} m too {}", 1.0, ("long", "short")),
}
"""These are the causes by the name of the calibration."""


def by_prior(state: VehicleState, settings: Mapping[str, Any]) -> dict[str, float]:
    """Returns each calibration by the standard deviation of its prior.

    `settings` are those of the run as plain values. A calibration whose prior is not there is left out.
    """
    found = {}
    for name, (value, _) in state.by_name.items():
        prior = settings.get(CAUSES[name].group, {}).get(f"sigma_{name}")
        if prior is not None:
            found[name] = value / prior
    return found


def diagnose(state: VehicleState, settings: Mapping[str, Any]) -> list[str]:
    """Returns a line for each calibration that its prior did not expect, with the likely cause in words.

    `settings` are those of the run as plain values. The prior's standard deviations are there.
    """
    values, lines = state.by_name, []
    for name, ratio in by_prior(state, settings).items():
        if abs(ratio) > LIMIT:
            cause, size = CAUSES[name], CAUSES[name].unit * abs(values[name][0])
            text = cause.text.format(size, cause.signs[0 if ratio > 0.0 else 1])
            lines.append(f"{text} ({abs(ratio):.1f} sigmas of its prior)")
    return lines
