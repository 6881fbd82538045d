"""Constant errors and noise in words: what a run has found, and where a log states another noise."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final, NamedTuple

import numpy as np

from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.noise import MeasuredNoise, RayNoise, ray_sigmas
from pathspace_graph.factors.sensor import SENSOR
from pathspace_graph.front_end.front_end import measure_log
from pathspace_graph.front_end.gate import TWIST
from pathspace_graph.front_end.measurement import DRIFT, LEAST_NOISE
from pathspace_graph.front_end.sightings import FOLLOW_RANGE, GATE_UNKNOWN, TwistRecord
from pathspace_graph.io.log import CALIBRATION, Log
from pathspace_graph.io.results import RunNoise, RunResult, VehicleState
from pathspace_graph.lengths import POSE_LENGTHS, Length, Text, joined, scaled
from pathspace_graph.spline.crossing import Crossing, crossed_boundaries

from .hint import Hint, told

PRIOR_LIMIT: Final = 3.0  # prior standard deviations from zero beyond which a calibration is worth a line


class Cause(NamedTuple):
    """What a calibration means."""

    text: str  # cause, with a place for the size
    unit: float  # size of a calibration of 1
    signs: tuple[str, str]  # words for a positive and for a negative calibration

    def told(self, value: float) -> str:
        return self.text.format(self.unit * abs(value), self.signs[0 if value > 0.0 else 1])


CALIBRATION_CAUSES: Final = {  # by the name of the calibration
    "scale": Cause("speeds are {:.1f} % too {}", 100.0, ("high", "low")),
    "bias": Cause("the yaw rate is {:.4f} rad/s too {}", 1.0, ("high", "low")),
    "yaw": Cause("the sensor is turned by {:.1f} degrees to the {}", 180.0 / np.pi, ("left", "right")),
    "lateral": Cause("the sensor sits {:.2f} m too far to the {}", 1.0, ("left", "right")),
    "latency": Cause("detections are {:.0f} ms {} than their stamps", 1e3, ("older", "newer")),
    "range_scale": Cause("ranges are {:.1f} % too {}", 100.0, ("long", "short")),
    "range_bias": Cause("ranges are {:.2f} m too {}", 1.0, ("long", "short")),
}


def by_prior(state: VehicleState, settings: Mapping[str, Any], scale: float = 1.0) -> dict[str, float]:
    """Return each calibration whose prior is in a run's settings over the prior's standard deviation.

    Lengths of the state are those of a scene of this scale, lengths in settings those at scale 1.
    """
    state = scaled(state, 1.0 / scale)
    groups = {name: "odometry" if name in CALIBRATION else "calibration" for name in state.by_name}
    priors = {name: settings.get(group, {}).get(f"sigma_{name}") for name, group in groups.items()}
    return {name: state.by_name[name][0] / prior for name, prior in priors.items() if prior is not None}


def diagnose(state: VehicleState, settings: Mapping[str, Any], scale: float = 1.0) -> list[str]:
    """Return a line for each calibration that its prior in the settings did not expect, with the cause."""
    lines = []
    for name, ratio in by_prior(state, settings, scale).items():
        if abs(ratio) > PRIOR_LIMIT:
            text = CALIBRATION_CAUSES[name].told(float(state.by_name[name][0]))
            lines.append(f"{text} ({abs(ratio):.1f} sigmas of its prior)")
    return lines


def crossings_of(result: RunResult) -> list[Crossing]:
    """Return where the vehicle drove across the boundaries of its map."""
    path = result.trajectory if result.smoothed is None else result.smoothed
    return crossed_boundaries(result.map.splines, path[:, :2])


NOISE_RANGE: Final = 10.0  # range at which the noise of detections is told (m, at scale 1)
CLEAR_ERROR: Final = 4.0  # standard deviations beyond which a measured error of the sensor is told
# size beyond which it is told (rad, m, s, -, m, at scale 1)
ERROR_WORTH: Final = {"yaw": 0.005, "lateral": 0.05, "latency": 0.01, "range_scale": 0.01, "range_bias": 0.05}
IN_METRES: Final = ("lateral", "range_bias")  # errors of the sensor in m
STAYING_TOLD: Final = 0.1  # share of the variance from which errors that stay with a cone are told


def noise_lines(noise: RunNoise | None, scale: float = 1.0) -> list[str]:
    """Return a line on what was measured, and another one where ranges and speeds disagree."""
    if noise is None or noise.measured is None or "measured" not in (noise.odometry, noise.detections):
        return []
    lines = [measured_line(noise.measured, scale)]
    if noise.size is not None:
        share = 100.0 * abs(noise.measured.sensor[SENSOR.index("range_scale")])
        whose, other = {"odometry": ("odometry's", "ranges"), "ranges": ("ranges'", "odometry")}[noise.size]
        advice = f"--calibration.trust {other} turns it round"
        lines.append(f"ranges and speeds disagree by {share:.0f} %: the map's size is the {whose} ({advice})")
    return lines


def measured_line(measured: MeasuredNoise, scale: float = 1.0) -> str:
    """Return a line on the noise in a scene of this scale, and the clear constant errors of the sensor."""
    forward, sideways, turning = (f"{sigma:.2g}" for sigma in measured.odometry)
    line = f"measured: odometry {forward} m/s, {sideways} m/s, {turning} rad/s from sample to sample"
    if measured.along is None or measured.across is None:
        return line
    rays = measured.along, measured.across
    at = NOISE_RANGE * scale
    along, across = (float(ray.sigmas(np.array([at]))[0]) for ray in rays)
    line += f"; detections {along:.2g} m along and {across:.2g} m across the ray at {at:g} m"
    if max(ray.share for ray in rays) > STAYING_TOLD:
        shares = " and ".join(f"{100.0 * ray.share:.0f} %" for ray in rays)
        times = " and ".join(f"{ray.time:g} s" for ray in rays)
        line += f", of which {shares} of the variance stay with a cone for {times}"
    errors = _errors(measured, scale)
    return f"{line}; {', '.join(errors)}" if errors else line


def _errors(measured: MeasuredNoise, scale: float) -> list[str]:
    worth = {name: scale * least if name in IN_METRES else least for name, least in ERROR_WORTH.items()}
    errors = zip(SENSOR, measured.sensor.tolist(), measured.sensor_sigma.tolist(), strict=True)
    return [
        CALIBRATION_CAUSES[name].told(value)
        for name, value, sigma in errors
        if abs(value) > max(CLEAR_ERROR * sigma, worth[name])
    ]


NOISE_FACTOR: Final = 1.5  # of measured and stated noise of the odometry, from which it is wrong
NOISE_AGREEMENT: Final = 1.2  # most between differences of different orders of white noise
SCATTER_FACTOR: Final = 2.0  # of scatter and covariances, which a few cones and odometry tell less well
NOISE_SHARE: Final = 0.75  # share of the detections from which on wrong covariances are told
NOISE_CYCLES: Final = 300  # most cycles on which the noise of detections is measured


def noise_hints(log: Log, *, stay: bool = True) -> list[Hint]:
    """Return hints where the readings contradict the noise that the log states by a large factor.

    That of detections is only known if they `stay` where they are.
    """
    found = _odometry(log) if log.odometry_stated else []
    return found + (_detections(log) if log.detections_stated and stay else [])


def _odometry(log: Log) -> list[Hint]:
    """Return a hint where noise from sample to sample contradicts the stated one.

    It is too small only where all orders of differences, in which motion is too, agree.
    """
    twists = TwistRecord()
    twists.add(log.odometry)
    orders, white = twists.orders(), twists.white()
    if orders is None or white is None:
        return []
    least, interval = white
    agree = orders.max(axis=0) < NOISE_AGREEMENT * least
    small = agree & (least > NOISE_FACTOR * log.odometry_sigma)
    most = np.hypot(least, DRIFT / np.sqrt(interval))
    large = NOISE_FACTOR * most < log.odometry_sigma
    stated, hints = log.odometry_sigma, []
    for which, values, size in ((small, least, "small"), (large, most, "large")):
        figures = [_scatter(k, float(values[k]), float(stated[k])) for k in np.flatnonzero(which).tolist()]
        if figures:
            slow = ", unless it stands for errors that change slowly" if size == "large" else ""
            hints.append(told("noise of odometry", figures=joined(figures, ", "), size=size + slow))
    return hints


def _scatter(component: int, value: float, stated: float) -> Text:
    """Return that a component of the twist scatters by a value where another one is stated."""
    (name, unit), power = list(TWIST.items())[component], POSE_LENGTHS[component]
    template = "{name} scatters by {value:.2g} {unit}, where {stated:.2g} is stated"
    return Text(template, name=name, unit=unit, value=Length(value, power), stated=Length(stated, power))


def _detections(log: Log) -> list[Hint]:
    cycles = log.cycles[:NOISE_CYCLES]
    measured = measure_log(replace(log, cycles=cycles))
    if measured is None or measured.along is None or measured.across is None:
        return []
    points = np.concatenate([cycle.points_vehicle for cycle in cycles])
    sigmas = ray_sigmas(points, np.concatenate([cycle.covariances for cycle in cycles]))
    ranges = np.hypot(*points.T)
    near = ranges < FOLLOW_RANGE
    hints = []
    for axis, (name, ray) in enumerate((("along", measured.along), ("across", measured.across))):
        size = _contradicted(ranges[near], sigmas[near, axis], ray, axis)
        if size:
            at = float(np.median(ranges[near]))
            scatter = float(ray.sigmas(np.array([at]))[0])
            stated = scatter * float(np.median(sigmas[near, axis] / ray.sigmas(ranges[near])))
            figures = {"scatter": Length(scatter), "at": Length(at), "stated": Length(stated)}
            hints.append(told("noise of detections", way=name, size=size, **figures))
    return hints


def _contradicted(ranges: Array, stated: Array, ray: RayNoise, axis: int) -> str:
    """Return how stated sigmas (m,) are wrong; the size of a cone and a gate bound the scatter."""
    measured = ray.sigmas(ranges)
    floor = np.array([np.full(len(ranges), LEAST_NOISE[0]), LEAST_NOISE[1] * ranges])[axis]
    small = measured > SCATTER_FACTOR * np.maximum(stated, floor)
    gate = np.minimum(GATE_UNKNOWN[0] + GATE_UNKNOWN[1] * ranges, GATE_UNKNOWN[2])
    large = (SCATTER_FACTOR * measured < stated) & (3.0 * measured < gate)
    for size, which in (("small", small), ("large", large)):
        if len(which) and which.mean() > NOISE_SHARE:
            return size
    return ""
