"""Calibration and noise in words: results of a run, and hints where a log states another noise."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final

import numpy as np

from pathspace_graph.factors.noise import ASSUMED_DRIFT, MeasuredNoise, ray_sigmas
from pathspace_graph.factors.sensor import SENSOR
from pathspace_graph.front_end.front_end import measure_log
from pathspace_graph.front_end.gate import TWIST
from pathspace_graph.front_end.measurement import LEAST_NOISE
from pathspace_graph.front_end.sightings import FOLLOW_RANGE, GATE_UNKNOWN, TwistRecord
from pathspace_graph.health import LOST
from pathspace_graph.io.header import CALIBRATION
from pathspace_graph.io.log import Log
from pathspace_graph.io.results import RunNoise, RunResult, VehicleState
from pathspace_graph.spline.boundary import Crossing, crossed_boundaries

from .hint import Hint, hint_of

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
    """Return calibrations in standard deviations of their priors, for those with a prior in the settings."""
    groups = {name: "odometry" if name in CALIBRATION else "calibration" for name in state.by_name}
    priors = {name: settings.get(group, {}).get(f"sigma_{name}") for name, group in groups.items()}
    return {name: state.by_name[name][0] / prior for name, prior in priors.items() if prior is not None}


def diagnose(state: VehicleState, settings: Mapping[str, Any]) -> list[str]:
    """Return a line for each calibration beyond `PRIOR_LIMIT`, with its cause and whether it is certain."""
    lines = []
    for name, ratio in by_prior(state, settings).items():
        value, sigma = map(float, state.by_name[name])
        if abs(ratio) > PRIOR_LIMIT:
            certainty = "certain" if abs(value) > CLEAR_ERROR * sigma else "uncertain"
            lines.append(f"{cause_of(name, value)} ({certainty})")
    return lines


def crossings_of(result: RunResult) -> list[Crossing]:
    """Return the places where the vehicle crossed the boundaries of its map, unless it was lost there."""
    path = result.trajectory if result.smoothed is None else result.smoothed
    lost = np.array([record.health == LOST for record in result.cycles], bool)
    known = ~lost if len(lost) == len(path) else None
    return crossed_boundaries(result.map.splines, path[:, :2], known)


NOISE_RANGE: Final = 10.0  # range at which the noise of detections is reported (m)
CLEAR_ERROR: Final = 4.0  # standard deviations beyond which a measured error of the sensor is reported
# size beyond which it is reported (rad, m, s, -, m)
ERROR_WORTH: Final = {"yaw": 0.005, "lateral": 0.05, "latency": 0.01, "range_scale": 0.01, "range_bias": 0.05}
CORRELATED_SHARE: Final = 0.1  # share of the variance from which correlated errors are reported


def noise_lines(noise: RunNoise | None) -> list[str]:
    """Return a line on the measured noise, and another one if ranges and speeds disagree."""
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
    """Return a line on the noise, and on significant errors of the sensor."""
    forward, sideways, turning = (f"{sigma:.2g}" for sigma in measured.odometry)
    line = f"measured: odometry {forward} m/s, {sideways} m/s, {turning} rad/s from sample to sample"
    if measured.along is None or measured.across is None:
        return line
    rays, at = (measured.along, measured.across), NOISE_RANGE
    along, across = (float(ray.sigmas(np.array([at]))[0]) for ray in rays)
    line += f"; detections {along:.2g} m along and {across:.2g} m across the ray at {at:g} m"
    if max(ray.share for ray in rays) > CORRELATED_SHARE:
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


NOISE_FACTOR: Final = 1.5  # least ratio of measured and stated noise of the odometry for a hint
NOISE_AGREEMENT: Final = 1.2  # largest ratio between the orders of differences of white noise
SCATTER_FACTOR: Final = 2.0  # least ratio of measured and stated noise of detections for a hint
UNIT_FACTOR: Final = 10.0  # least ratio that tells another unit
NOISE_SHARE: Final = 0.75  # least share of the detections with wrong covariances
NOISE_CYCLES: Final = 300  # largest number of cycles on which the noise of detections is measured


def noise_hints(log: Log, *, stay: bool = True) -> list[Hint]:
    """Return hints where the readings of a log contradict the stated noise by a large factor.

    The noise of detections is measurable only if they `stay` in place, as cones do.
    """
    found = _odometry_hints(log) if log.odometry_stated else []
    return found + (_detection_hints(log) if log.detections_stated and stay else [])


def _odometry_hints(log: Log) -> list[Hint]:
    """Compare white noise: orders of differences that disagree contain motion as well."""
    twists = TwistRecord()
    twists.add(log.odometry)
    orders, white = twists.orders(), twists.white()
    if orders is None or white is None:
        return []
    (least, interval), stated, hints = white, log.odometry_sigma, []
    agree = orders.max(axis=0) < NOISE_AGREEMENT * least
    most = np.hypot(least, np.array(ASSUMED_DRIFT) / np.sqrt(interval))
    for which, values, size in (
        (agree & (least > NOISE_FACTOR * stated), least, "small"),
        (NOISE_FACTOR * most < stated, most, "large, unless it stands for errors that change slowly"),
    ):
        figures = [
            f"{name} scatters by {value:.2g} {TWIST[name]}, and {said:.2g} is stated"
            for name, value, said, chosen in zip(TWIST, values, stated, which, strict=True)
            if chosen
        ]
        if figures:
            hints.append(hint_of("noise of odometry", figures=", ".join(figures), size=size))
    return hints


def _detection_hints(log: Log) -> list[Hint]:
    """Compare standard deviations along the ray or across it, whichever is farther off.

    The size of a cone is the least noise; tracking with a gate limits the largest measurable noise.
    """
    cycles, found = log.cycles[:NOISE_CYCLES], dict[float, Hint]()
    measured = measure_log(replace(log, cycles=cycles))
    if measured is None or measured.along is None or measured.across is None:
        return []
    points = np.concatenate([cycle.points_vehicle for cycle in cycles])
    stated = ray_sigmas(points, np.concatenate([cycle.covariances for cycle in cycles]))
    near = (ranges := np.hypot(*points.T)) < FOLLOW_RANGE
    ranges, stated, at = ranges[near], stated[near], float(np.median(ranges[near]))
    gate = np.minimum(GATE_UNKNOWN[0] + GATE_UNKNOWN[1] * ranges, GATE_UNKNOWN[2])
    floors = np.full(len(ranges), LEAST_NOISE[0]), LEAST_NOISE[1] * ranges
    rays = ("along", measured.along), ("across", measured.across)
    for (way, ray), claimed, floor in zip(rays, stated.T, floors, strict=True):
        sigmas, scatter = ray.sigmas(ranges), float(ray.sigmas(np.array([at]))[0])
        small = (sigmas > SCATTER_FACTOR * np.maximum(claimed, floor)).mean()
        large = ((SCATTER_FACTOR * sigmas < claimed) & (3.0 * sigmas < gate)).mean()
        if max(small, large) > NOISE_SHARE:
            ratio = float(np.median(claimed / sigmas))
            is_unit = not 1.0 / UNIT_FACTOR < ratio < UNIT_FACTOR
            how = f"too {'small' if small > large else 'large'}"
            how += ", as in another unit, or there are none at all" if is_unit else ""
            figures = {
                "scatter": scatter,
                "at": at,
                "stated": scatter * ratio,
                "way": way,
                "how": how,
            }
            cause = "covariances" if is_unit else "noise"
            found[max(small, large)] = hint_of("noise of detections", cause=cause, **figures)
    return [found[max(found)]] if found else []
