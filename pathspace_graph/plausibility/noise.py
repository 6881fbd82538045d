"""Noise that a log states, held against what its own readings show."""

from dataclasses import replace
from typing import Final

import numpy as np

from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.noise import RayNoise, ray_sigmas
from pathspace_graph.front_end.front_end import measure_log
from pathspace_graph.front_end.gate import TWIST
from pathspace_graph.front_end.measurement import DRIFT, LEAST
from pathspace_graph.front_end.sightings import GATE, MAX_RANGE, TwistRecord
from pathspace_graph.io.log import Log

from .hint import Hint, told

NOISE_FACTOR: Final = 1.5  # of measured and stated noise of the odometry, from which it is wrong
NOISE_AGREEMENT: Final = 1.2  # most between differences of different orders of white noise
SCATTER_FACTOR: Final = 2.0  # of scatter and covariances, which a few cones and odometry tell less well
NOISE_SHARE: Final = 0.75  # share of the detections from which on wrong covariances are told
NOISE_CYCLES: Final = 300  # most cycles on which the noise of detections is measured


def noise_hints(log: Log) -> list[Hint]:
    """Return hints where the readings contradict the noise that the log states by a large factor."""
    found = _odometry(log) if log.odometry_stated else []
    return found + (_detections(log) if log.detections_stated else [])


def _odometry(log: Log) -> list[Hint]:
    """Return a hint where noise from sample to sample contradicts the stated one.

    Motion is in the differences too: noise is too small only where all orders agree, too large only beside
    the least slow errors of any odometry.
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
        figures = [
            f"{name} scatters by {values[k]:.2g} {unit}, where {stated[k]:.2g} is stated"
            for k, (name, unit) in enumerate(TWIST.items())
            if which[k]
        ]
        if figures:
            slow = ", unless it stands for errors that change slowly" if size == "large" else ""
            hints.append(told("noise of odometry", figures=", ".join(figures), size=size + slow))
    return hints


def _detections(log: Log) -> list[Hint]:
    cycles = log.cycles[:NOISE_CYCLES]
    measured = measure_log(replace(log, cycles=cycles))
    if measured is None or measured.along is None or measured.across is None:
        return []
    points = np.concatenate([cycle.points_vehicle for cycle in cycles])
    sigmas = ray_sigmas(points, np.concatenate([cycle.covariances for cycle in cycles]))
    ranges = np.hypot(*points.T)
    near = ranges < MAX_RANGE
    hints = []
    for axis, (name, ray) in enumerate((("along", measured.along), ("across", measured.across))):
        size = _contradicted(ranges[near], sigmas[near, axis], ray, axis)
        if size:
            at = float(np.median(ranges[near]))
            scatter = float(ray.sigmas(np.array([at]))[0])
            stated = scatter * float(np.median(sigmas[near, axis] / ray.sigmas(ranges[near])))
            figures = {"scatter": scatter, "at": at, "stated": stated}
            hints.append(told("noise of detections", way=name, size=size, **figures))
    return hints


def _contradicted(ranges: Array, stated: Array, ray: RayNoise, axis: int) -> str:
    """Return whether the stated standard deviations (m,) are too small or too large in most detections.

    A cone is no point, which bounds the scatter from below, and a gate bounds it from above.
    """
    measured = ray.sigmas(ranges)
    floor = np.array([np.full(len(ranges), LEAST[0]), LEAST[1] * ranges])[axis]
    small = measured > SCATTER_FACTOR * np.maximum(stated, floor)
    gate = np.minimum(GATE[0] + GATE[1] * ranges, GATE[2])
    large = (SCATTER_FACTOR * measured < stated) & (3.0 * measured < gate)
    for size, which in (("small", small), ("large", large)):
        if len(which) and which.mean() > NOISE_SHARE:
            return size
    return ""
