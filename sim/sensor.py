"""The vehicle's sensors: noisy odometry and detected cones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from pathspace_graph.errors import SettingsError, check_numbers
from pathspace_graph.io.log import Detections, covariances_of
from pathspace_graph.labels import LEFT, RIGHT, UNKNOWN

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int_]

FALSE_POSITIVE: Final = -1
"""This is the association of a detection that is of no cone."""


@dataclass(frozen=True)
class OdometryNoise:
    """Describes the errors of the measured twist."""

    white: tuple[float, float, float] = (0.25, 0.12, 0.035)
    """Each measurement of [vx, vy, wz] has these standard deviations (m/s, m/s, rad/s), white from sample to
    sample."""
    scale: float = 0.004
    """This is the standard deviation of the relative scale error of vx and vy, which is drawn once for a log
    (-)."""
    gyro_bias: float = 0.0015
    """This is the standard deviation of the bias of wz, which is drawn once for a log (rad/s)."""

    def __post_init__(self) -> None:
        if len(self.white) != 3 or not all(0 < sigma < np.inf for sigma in self.white):
            raise SettingsError(f"odometry.white: expected three positive numbers, found {self.white}")
        check_numbers(self, "odometry", ("scale", "gyro_bias"), "a number of at least 0")


@dataclass(frozen=True)
class SensorSettings:
    """Describes what the cone detector sees, and its errors."""

    rate: float = 10.0
    """The detector gives this number of perception cycles per second (Hz)."""
    range_max: float = 15.0
    """This is the greatest true range of a detected cone (m)."""
    range_min: float = 0.5
    """This is the least true range of a detected cone (m)."""
    fov: float = float(np.deg2rad(110.0))
    """This is the field of view, the whole angle (rad)."""
    range_sigma: float = 0.05
    """This is the standard deviation of the range at range 0 (m)."""
    range_sigma_growth: float = 0.012
    """The standard deviation of the range grows by this with the range (m/m)."""
    bearing_sigma: float = float(np.deg2rad(0.9))
    """This is the standard deviation of the bearing (rad)."""
    detection_probability: float = 0.98
    """A cone in the field of view is detected with this probability at range 0."""
    detection_falloff: float = 0.01
    """The probability of detection decreases by this with the range (1/m)."""
    blind_fraction: float = 0.05
    """This share of the cones is never detected; they are drawn once for a log."""
    wrong_colour: float = 0.01
    """A detected boundary cone has the other boundary's label with this probability."""
    false_positives: float = 0.03
    """A cycle has this expected number of detections of nothing."""
    range_bias: bool = False
    """Ranges have a systematic error, as those of cameras do, where this is true."""
    range_bias_at: tuple[float, ...] = (4.0, 9.0)
    """The systematic error is given at these increasing ranges (m); it is linear between them and constant
    outside."""
    range_bias_values: tuple[float, ...] = (0.02, 0.34)
    """The systematic error has these values at those ranges (m). Cameras typically have 0.02 m below 4 m and
    0.34 m beyond 8 m."""

    def __post_init__(self) -> None:
        positive = ("rate", "range_max", "bearing_sigma", "range_sigma", "fov")
        check_numbers(self, "sensor", positive, "a positive number")
        at_least_0 = ("range_min", "range_sigma_growth", "detection_falloff", "false_positives")
        check_numbers(self, "sensor", at_least_0, "a number of at least 0")
        if self.fov > 2 * np.pi or self.range_min >= self.range_max:
            raise SettingsError("sensor: expected fov <= 2 pi rad and range_min < range_max")
        shares = ("detection_probability", "blind_fraction", "wrong_colour")
        check_numbers(self, "sensor", shares, "a number in [0, 1]")
        if len(self.range_bias_at) != len(self.range_bias_values) or not np.all(
            np.diff(self.range_bias_at) > 0
        ):
            raise SettingsError(
                "sensor.range_bias_at: expected increasing ranges, one for each of range_bias_values"
            )

    def range_sigmas(self, ranges: FloatArray) -> FloatArray:
        """Returns the standard deviation of the range at each range (n,) in m."""
        return self.range_sigma + self.range_sigma_growth * ranges

    def range_biases(self, ranges: FloatArray) -> FloatArray:
        """Returns the systematic error at each range (n,) in m."""
        if not self.range_bias or not self.range_bias_at:
            return np.zeros_like(ranges)
        return np.interp(ranges, self.range_bias_at, self.range_bias_values)

    def detection_probabilities(self, ranges: FloatArray) -> FloatArray:
        """Returns the probability of detection at each range (n,)."""
        return np.clip(self.detection_probability - self.detection_falloff * ranges, 0.0, 1.0)


def measure_twists(twists: FloatArray, noise: OdometryNoise, rng: Generator) -> tuple[FloatArray, FloatArray]:
    """Returns measured twists (N, 3), and the scale error (-) and the bias (rad/s) that they have (2,).

    They are `(1 + scale) [vx, vy]` and `wz + bias`, each plus white noise.
    """
    scale = noise.scale * rng.standard_normal()
    bias = noise.gyro_bias * rng.standard_normal()
    white = rng.standard_normal(twists.shape) * np.array(noise.white)
    factors = np.array([1.0 + scale, 1.0 + scale, 1.0])
    return np.asarray(twists * factors + np.array([0.0, 0.0, bias]) + white), np.array([scale, bias])


class ConeSensor:
    """Detects the cones of one log, some of which it never sees."""

    def __init__(self, cones: FloatArray, labels: IntArray, settings: SensorSettings, rng: Generator) -> None:
        blind_rng, self._cone_rng, self._false_rng = rng.spawn(3)
        self._cones, self._labels, self._settings = cones, labels, settings
        count = round(settings.blind_fraction * len(cones))
        self.blind: IntArray = np.sort(blind_rng.permutation(len(cones))[:count])
        self._seen = np.setdiff1d(np.arange(len(cones)), self.blind)

    def detect(self, t: float, pose: FloatArray) -> tuple[Detections, IntArray]:
        """Returns a perception cycle from a pose [x, y, theta], and the true cone of each detection (m,)."""
        ranges, bearings, labels, cones = self._detect_cones(pose)
        false_ranges, false_bearings, false_labels = self._false_positives()
        ranges = np.concatenate([ranges, false_ranges])
        bearings = np.concatenate([bearings, false_bearings])
        points, covariances = _cartesian(ranges, bearings, self._settings)
        detections = Detections(t, points, covariances, np.concatenate([labels, false_labels]))
        return detections, np.concatenate([cones, np.full(len(false_ranges), FALSE_POSITIVE)])

    def _detect_cones(self, pose: FloatArray) -> tuple[FloatArray, FloatArray, IntArray, IntArray]:
        settings, rng = self._settings, self._cone_rng
        ranges, bearings = _polar(self._cones[self._seen], pose)
        inside = (ranges <= settings.range_max) & (ranges >= settings.range_min)
        inside &= np.abs(bearings) <= settings.fov / 2
        cones, ranges, bearings = self._seen[inside], ranges[inside], bearings[inside]
        # every cone in the field draws the same numbers, so that one setting doesn't shift another's
        chance, colour = rng.random((2, len(cones)))
        noise = rng.standard_normal((2, len(cones)))
        labels = self._labels[cones]
        flipped = (colour < settings.wrong_colour) & (labels != UNKNOWN)
        labels = np.where(flipped, LEFT + RIGHT - labels, labels)
        hit = chance < settings.detection_probabilities(ranges)
        measured = ranges + settings.range_biases(ranges) + settings.range_sigmas(ranges) * noise[0]
        return measured[hit], (bearings + settings.bearing_sigma * noise[1])[hit], labels[hit], cones[hit]

    def _false_positives(self) -> tuple[FloatArray, FloatArray, IntArray]:
        """Draws detections of nothing, uniform over the area of the field, with either boundary's label."""
        settings, rng = self._settings, self._false_rng
        count = int(rng.poisson(settings.false_positives))
        ranges = np.sqrt(rng.uniform(settings.range_min**2, settings.range_max**2, count))
        bearings = rng.uniform(-settings.fov / 2, settings.fov / 2, count)
        return ranges, bearings, rng.integers(LEFT, RIGHT, count, endpoint=True)


def _polar(cones: FloatArray, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Returns range and bearing (n,) of points in the map frame, seen from a pose."""
    step = cones - pose[:2]
    bearings = np.arctan2(step[:, 1], step[:, 0]) - pose[2]
    return np.hypot(step[:, 0], step[:, 1]), np.asarray((bearings + np.pi) % (2 * np.pi) - np.pi)


def _cartesian(
    ranges: FloatArray, bearings: FloatArray, settings: SensorSettings
) -> tuple[FloatArray, FloatArray]:
    """Returns points (m, 2) and covariances `R(b) diag(s_r^2, (r s_b)^2) R(b)^T`, vehicle frame."""
    cos, sin = np.cos(bearings), np.sin(bearings)
    along, across = settings.range_sigmas(ranges) ** 2, (ranges * settings.bearing_sigma) ** 2
    xx = cos**2 * along + sin**2 * across
    yy = sin**2 * along + cos**2 * across
    xy = cos * sin * (along - across)
    covariances = covariances_of(xx, xy, yy)
    return np.column_stack([ranges * cos, ranges * sin]), covariances
