"""Calibration and noise in words: results of a run, and hints where a log states another noise."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.noise import MeasuredNoise
from pathspace_graph.factors.odometry import CALIBRATION
from pathspace_graph.factors.sensor import SENSOR
from pathspace_graph.health import LOST
from pathspace_graph.io.map import Map
from pathspace_graph.io.results import RunNoise, RunResult, VehicleState
from pathspace_graph.spline.boundary import Crossing, crossed_boundaries

PRIOR_LIMIT: Final = 3.0  # prior standard deviations from zero beyond which a calibration is reported


CALIBRATION_CAUSES: Final = {  # words, size of a calibration of 1 in them, words for the sign
    "scale": ("speeds are {:.1f} % too {}", 100.0, ("high", "low")),
    "bias": ("the yaw rate is {:.4f} rad/s too {}", 1.0, ("high", "low")),
    "yaw": ("the sensor is turned by {:.1f} degrees to the {}", 180.0 / np.pi, ("left", "right")),
    "lateral": ("the sensor sits {:.2f} m too far to the {}", 1.0, ("left", "right")),
    "latency": ("detections are {:.0f} ms {} than their stamps", 1e3, ("older", "newer")),
    "range_scale": ("ranges are {:.1f} % too {}", 100.0, ("long", "short")),
    "range_bias": ("ranges are {:.2f} m too {}", 1.0, ("long", "short")),
}


def cause_of(name: str, value: float) -> str:
    words, unit, (positive, negative) = CALIBRATION_CAUSES[name]
    return words.format(unit * abs(value), positive if value > 0.0 else negative)


def by_prior(state: VehicleState, settings: Mapping[str, Any]) -> dict[str, float]:
    """Calibrations in standard deviations of their priors, for those with a prior in the settings."""
    groups = {name: "odometry" if name in CALIBRATION else "calibration" for name in state.by_name}
    priors = {name: settings.get(group, {}).get(f"sigma_{name}") for name, group in groups.items()}
    return {name: state.by_name[name][0] / prior for name, prior in priors.items() if prior is not None}


def diagnose(state: VehicleState, settings: Mapping[str, Any]) -> list[str]:
    """Line for each calibration beyond `PRIOR_LIMIT`, with its cause and whether it is certain."""
    lines = []
    for name, ratio in by_prior(state, settings).items():
        value, sigma = map(float, state.by_name[name])
        if abs(ratio) > PRIOR_LIMIT:
            certainty = "certain" if abs(value) > CLEAR_ERROR * sigma else "uncertain"
            lines.append(f"{cause_of(name, value)} ({certainty})")
    return lines


def crossings_of(result: RunResult) -> list[Crossing]:
    """Places where the vehicle crossed the boundaries of its map, unless it was lost there."""
    path = result.trajectory if result.smoothed is None else result.smoothed
    return crossings_on(result.map, path, [record.health for record in result.cycles])


def crossings_on(track: Map, path: Array, health: Sequence[str]) -> list[Crossing]:
    """Places where a path (n, 3) crosses the boundaries of a map, but for poses that were lost."""
    lost = np.array([condition == LOST for condition in health], bool)
    known = ~lost if len(lost) == len(path) else None
    return crossed_boundaries(track.splines, path[:, :2], known)


CLEAR_ERROR: Final = 4.0  # standard deviations beyond which a measured error of the sensor is reported
# size beyond which it is reported (rad, m, s, -, m)
ERROR_WORTH: Final = {"yaw": 0.005, "lateral": 0.05, "latency": 0.01, "range_scale": 0.01, "range_bias": 0.05}


def noise_lines(noise: RunNoise | None) -> list[str]:
    """Line on the measured noise, and another one if ranges and speeds disagree."""
    if noise is None or noise.measured is None or "measured" not in (noise.odometry, noise.detections):
        return []
    lines = [measured_line(noise.measured)]
    if noise.size is not None:
        share = 100.0 * abs(noise.measured.sensor[SENSOR.index("range_scale")])
        whose, other = {"odometry": ("odometry's", "ranges"), "ranges": ("ranges'", "odometry")}[noise.size]
        advice = f"--calibration.trust {other} reverses that"
        lines.append(f"ranges and speeds disagree by {share:.0f} %: the map's size is the {whose} ({advice})")
    return lines


def measured_line(measured: MeasuredNoise) -> str:
    """Line on the noise, and on significant errors of the sensor."""
    forward, sideways, turning = (f"{sigma:.2g}" for sigma in measured.odometry)
    line = f"measured: odometry {forward} m/s, {sideways} m/s, {turning} rad/s from sample to sample"
    if measured.along is None or measured.across is None:
        return line
    rays, at = (measured.along, measured.across), 10.0
    along, across = (float(ray.sigmas(np.array([at]))[0]) for ray in rays)
    line += f"; detections {along:.2g} m along and {across:.2g} m across the ray at {at:g} m"
    if max(ray.share for ray in rays) > 0.1:
        shares = " and ".join(f"{100.0 * ray.share:.0f} %" for ray in rays)
        times = " and ".join(f"{ray.time:g} s" for ray in rays)
        line += f", of which {shares} of the variance stay with a cone for {times}"
    errors = zip(SENSOR, measured.sensor.tolist(), measured.sensor_sigma.tolist(), strict=True)
    clear = [
        cause_of(name, value)
        for name, value, sigma in errors
        if abs(value) > max(CLEAR_ERROR * sigma, ERROR_WORTH[name])
    ]
    return f"{line}; {', '.join(clear)}" if clear else line
