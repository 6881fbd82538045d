"""Calibration and noise in words: results of a run, and hints where a log states another noise."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final, NamedTuple

import numpy as np

from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.noise import ASSUMED_DRIFT, MeasuredNoise, RayNoise, ray_sigmas
from pathspace_graph.factors.sensor import SENSOR
from pathspace_graph.front_end.front_end import measure_log
from pathspace_graph.front_end.gate import TWIST
from pathspace_graph.front_end.measurement import LEAST_NOISE
from pathspace_graph.front_end.sightings import FOLLOW_RANGE, GATE_UNKNOWN, TwistRecord
from pathspace_graph.health import LOST
from pathspace_graph.io.header import CALIBRATION
from pathspace_graph.io.log import Log
from pathspace_graph.io.results import RunNoise, RunResult, VehicleState
from pathspace_graph.lengths import POSE_LENGTHS, Length, Text, joined, scaled
from pathspace_graph.spline.crossing import Crossing, crossed_boundaries

from .hint import Hint, hint_of

PRIOR_LIMIT: Final = 3.0  # prior standard deviations from zero beyond which a calibration is reported


class Cause(NamedTuple):
    """Meaning of a calibration."""

    template: str  # cause, with a place for the size
    unit: float  # size in words of a calibration of 1
    signs: tuple[str, str]  # words for a positive and a negative calibration

    def text_of(self, value: float) -> str:
        return self.template.format(self.unit * abs(value), self.signs[0 if value > 0.0 else 1])


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
    """Return calibrations in standard deviations of their priors, for those with a prior in the settings.

    Lengths of the state are in metres of a scene of this scale, lengths in settings at scale 1.
    """
    state = scaled(state, 1.0 / scale)
    groups = {name: "odometry" if name in CALIBRATION else "calibration" for name in state.by_name}
    priors = {name: settings.get(group, {}).get(f"sigma_{name}") for name, group in groups.items()}
    return {name: state.by_name[name][0] / prior for name, prior in priors.items() if prior is not None}


def diagnose(state: VehicleState, settings: Mapping[str, Any], scale: float = 1.0) -> list[str]:
    """Return a line for each calibration beyond `PRIOR_LIMIT`, with its cause."""
    lines = []
    for name, ratio in by_prior(state, settings, scale).items():
        if abs(ratio) > PRIOR_LIMIT:
            text = CALIBRATION_CAUSES[name].text_of(float(state.by_name[name][0]))
            lines.append(f"{text} ({abs(ratio):.1f} sigmas of its prior)")
    return lines


def crossings_of(result: RunResult) -> list[Crossing]:
    """Return the places where the vehicle crossed the boundaries of its map, unless it was lost there."""
    path = result.trajectory if result.smoothed is None else result.smoothed
    lost = np.array([record.health == LOST for record in result.cycles], bool)
    known = ~lost if len(lost) == len(path) else None
    return crossed_boundaries(result.map.splines, path[:, :2], known)


NOISE_RANGE: Final = 10.0  # range at which the noise of detections is reported (m, at scale 1)
CLEAR_ERROR: Final = 4.0  # standard deviations beyond which a measured error of the sensor is reported
# size beyond which it is reported (rad, m, s, -, m, at scale 1)
ERROR_WORTH: Final = {"yaw": 0.005, "lateral": 0.05, "latency": 0.01, "range_scale": 0.01, "range_bias": 0.05}
IN_METRES: Final = ("lateral", "range_bias")  # errors of the sensor in m
CORRELATED_SHARE: Final = 0.1  # share of the variance from which correlated errors are reported


def noise_lines(noise: RunNoise | None, scale: float = 1.0) -> list[str]:
    """Return a line on the measured noise, and another one if ranges and speeds disagree."""
    if noise is None or noise.measured is None or "measured" not in (noise.odometry, noise.detections):
        return []
    lines = [measured_line(noise.measured, scale)]
    if noise.size is not None:
        share = 100.0 * abs(noise.measured.sensor[SENSOR.index("range_scale")])
        whose, other = {"odometry": ("odometry's", "ranges"), "ranges": ("ranges'", "odometry")}[noise.size]
        advice = f"--calibration.trust {other} reverses that"
        lines.append(f"ranges and speeds disagree by {share:.0f} %: the map's size is the {whose} ({advice})")
    return lines


def measured_line(measured: MeasuredNoise, scale: float = 1.0) -> str:
    """Return a line on the noise in a scene of this scale, and on significant errors of the sensor."""
    forward, sideways, turning = (f"{sigma:.2g}" for sigma in measured.odometry)
    line = f"measured: odometry {forward} m/s, {sideways} m/s, {turning} rad/s from sample to sample"
    if measured.along is None or measured.across is None:
        return line
    rays = measured.along, measured.across
    at = NOISE_RANGE * scale
    along, across = (float(ray.sigmas(np.array([at]))[0]) for ray in rays)
    line += f"; detections {along:.2g} m along and {across:.2g} m across the ray at {at:g} m"
    if max(ray.share for ray in rays) > CORRELATED_SHARE:
        shares = " and ".join(f"{100.0 * ray.share:.0f} %" for ray in rays)
        times = " and ".join(f"{ray.time:g} s" for ray in rays)
        line += f", of which {shares} of the variance stay with a cone for {times}"
    errors = _errors(measured, scale)
    return f"{line}; {', '.join(errors)}" if errors else line


def _errors(measured: MeasuredNoise, scale: float) -> list[str]:
    worth = {name: scale * least if name in IN_METRES else least for name, least in ERROR_WORTH.items()}
    errors = zip(SENSOR, measured.sensor.tolist(), measured.sensor_sigma.tolist(), strict=True)
    return [
        CALIBRATION_CAUSES[name].text_of(value)
        for name, value, sigma in errors
        if abs(value) > max(CLEAR_ERROR * sigma, worth[name])
    ]


NOISE_FACTOR: Final = 1.5  # least ratio of measured and stated noise of the odometry for a hint
NOISE_AGREEMENT: Final = 1.2  # largest ratio between the orders of differences of white noise
SCATTER_FACTOR: Final = 2.0  # least ratio of measured and stated noise of detections for a hint
NOISE_SHARE: Final = 0.75  # least share of the detections with wrong covariances
NOISE_CYCLES: Final = 300  # largest number of cycles on which the noise of detections is measured


def noise_hints(log: Log, *, stay: bool = True) -> list[Hint]:
    """Return hints where the readings contradict the stated noise by a large factor.

    The noise of detections is measurable only if they `stay` in place, as cones do.
    """
    found = _odometry_hints(log) if log.odometry_stated else []
    return found + (_detection_hints(log) if log.detections_stated and stay else [])


def _odometry_hints(log: Log) -> list[Hint]:
    """Return hints where the white noise of the odometry contradicts the stated one.

    The stated noise is too small only if all orders of differences agree; otherwise they contain motion.
    """
    twists = TwistRecord()
    twists.add(log.odometry)
    orders, white = twists.orders(), twists.white()
    if orders is None or white is None:
        return []
    least, interval = white
    agree = orders.max(axis=0) < NOISE_AGREEMENT * least
    small = agree & (least > NOISE_FACTOR * log.odometry_sigma)
    most = np.hypot(least, np.array(ASSUMED_DRIFT) / np.sqrt(interval))
    large = NOISE_FACTOR * most < log.odometry_sigma
    stated, hints = log.odometry_sigma, []
    for which, values, size in ((small, least, "small"), (large, most, "large")):
        figures = [_scatter(k, float(values[k]), float(stated[k])) for k in np.flatnonzero(which).tolist()]
        if figures:
            slow = ", unless it stands for errors that change slowly" if size == "large" else ""
            hints.append(hint_of("noise of odometry", figures=joined(figures, ", "), size=size + slow))
    return hints


def _scatter(component: int, value: float, stated: float) -> Text:
    """Return the measured and the stated noise of a component of the twist in words."""
    (name, unit), power = list(TWIST.items())[component], POSE_LENGTHS[component]
    template = "{name} scatters by {value:.2g} {unit}, and {stated:.2g} is stated"
    return Text(template, name=name, unit=unit, value=Length(value, power), stated=Length(stated, power))


def _detection_hints(log: Log) -> list[Hint]:
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
            hints.append(hint_of("noise of detections", way=name, size=size, **figures))
    return hints


def _contradicted(ranges: Array, stated: Array, ray: RayNoise, axis: int) -> str:
    """Return whether stated sigmas (m,) are `small` or `large`, or neither (empty).

    The size of a cone is the least noise; tracking with a gate limits the largest measurable noise.
    """
    measured = ray.sigmas(ranges)
    floor = np.array([np.full(len(ranges), LEAST_NOISE[0]), LEAST_NOISE[1] * ranges])[axis]
    small = measured > SCATTER_FACTOR * np.maximum(stated, floor)
    gate = np.minimum(GATE_UNKNOWN[0] + GATE_UNKNOWN[1] * ranges, GATE_UNKNOWN[2])
    large = (SCATTER_FACTOR * measured < stated) & (3.0 * measured < gate)
    for size, which in (("small", small), ("large", large)):
        if len(which) and which.mean() > NOISE_SHARE:
            return size
    return ""
