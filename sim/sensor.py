"""The vehicle's sensors: noisy odometry, and a detector of cones, or of lines, kerbs or walls."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
import scipy  # which imports its modules when they are used
from msgspec import Meta
from numpy.random import Generator

from pathspace_graph.errors import SettingsError
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.se2 import left_of
from pathspace_graph.io.log import Detections, polar_covariances
from pathspace_graph.labels import BOUNDARIES, LEFT, RIGHT
from pathspace_graph.settings.checked import AtLeast0, Checked, Positive, Share, Signed

from .track import STEP, SmoothCurve, Track, arc_lengths, direction, ring

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline


@dataclass(frozen=True)
class OdometryNoise(Checked, group="odometry"):
    """Errors of the measured twist."""

    white: tuple[Positive, Positive, Positive] = (0.25, 0.12, 0.035)
    """Standard deviations of [vx, vy, wz], white from sample to sample (m/s, m/s, rad/s)."""
    scale: AtLeast0 = 0.004
    """Standard deviation of the scale error of vx and vy, drawn once for a log (-)."""
    gyro_bias: AtLeast0 = 0.0015
    """Standard deviation of the bias of wz, drawn once for a log (rad/s)."""
    slow: tuple[AtLeast0, AtLeast0, AtLeast0] = (0.0, 0.0, 0.0)
    """Standard deviations of the slow errors of [vx, vy, wz] beside the white noise (m/s, m/s, rad/s)."""
    slow_time: float = 5.0
    """Correlation time of the slow errors (s)."""

    def drift_sigmas(self, dt: float) -> Array:
        """Standard deviations (3,) of white noise that drifts as much, `dt` s apart.

        The spectrum at frequency 0: `white^2 + slow^2 (1 + rho) / (1 - rho)`, `rho = exp(-dt / slow_time)`.
        """
        return np.asarray(np.hypot(self.white, self.drift(dt) / np.sqrt(dt)))

    def drift(self, dt: float) -> Array:
        """Random walk (3,) of the pose by the slow errors of twists `dt` s apart (m, m, rad by root of s)."""
        rho = np.exp(-dt / self.slow_time)
        return np.asarray(np.sqrt(dt * (1.0 + rho) / (1.0 - rho)) * np.array(self.slow))


@dataclass(frozen=True)
class SensorSettings(Checked):
    """What the sensor sees, and its errors."""

    rate: float = 10.0
    """Perception cycles per second (Hz)."""
    range_max: float = 15.0
    """Greatest true range of a detection (m)."""
    range_min: AtLeast0 = 0.5
    """Least true range of a detection (m)."""
    fov: float = float(np.deg2rad(110.0))
    """Field of view, the whole angle (rad)."""
    range_sigma: float = 0.05
    """Standard deviation of the range at range 0 (m)."""
    range_sigma_growth: AtLeast0 = 0.012
    """Growth of that standard deviation with the range (m/m)."""
    bearing_sigma: float = float(np.deg2rad(0.9))
    """Standard deviation of the bearing (rad)."""
    detection_probability: Share = 0.98
    """Probability that a cone in the field of view is detected at range 0."""
    detection_falloff: AtLeast0 = 0.01
    """Decrease of the probability of detection with the range (1/m)."""
    blind_fraction: Share = 0.05
    """Share of the cones that are never detected, drawn once for a log."""
    wrong_colour: Share = 0.01
    """Probability that a detected boundary cone has the other boundary's label."""
    false_positives: AtLeast0 = 0.03
    """Expected number of detections of nothing in a cycle."""
    sigma_range_scale: AtLeast0 = 0.0005
    """Standard deviation of the scale error of the ranges (-) that the log states, as of a calibrated sensor;
    with 0 it states none."""
    range_bias: bool = False
    """Whether ranges have a systematic error, as those of cameras do."""
    range_bias_at: tuple[float, ...] = (4.0, 9.0)
    """Increasing ranges of the given systematic errors (m), which are linear between them."""
    range_bias_values: tuple[float, ...] = (0.02, 0.34)
    """Systematic errors at those ranges (m), typical of cameras."""
    range_bend: Signed = 0.0
    """Bend k of the ranges (1/m): a range r reads `k (r - range_bend_from)^2` longer beyond that range."""
    range_bend_from: AtLeast0 = 9.0
    """Range from which on ranges bend (m)."""
    slow_range: Share = 0.0
    """Share of a range's variance in the slow error of its cone (-)."""
    slow_bearing: Share = 0.0
    """Share of a bearing's variance in the slow error of its cone (-)."""
    slow_time: float = 5.0
    """Correlation time of the slow errors of a cone (s)."""
    duplicates: Share = 0.0
    """Probability that a second camera detects a detected cone of the overlap too, with its own errors."""
    overlap: tuple[float, float] = (0.0, float(np.pi))
    """Least and greatest bearing of the overlap, on both sides (rad)."""
    dropped_cycles: Share = 0.0
    """Share of the cycles in which nothing is detected."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.fov > 2 * np.pi or self.range_min >= self.range_max:
            raise SettingsError("sensor: expected fov <= 2 pi rad and range_min < range_max")
        if 1.0 + 2.0 * self.range_bend * max(self.range_max - self.range_bend_from, 0.0) <= 0.0:
            raise SettingsError(
                f"sensor.range_bend: expected farther cones to read farther, found {self.range_bend}"
            )
        least, greatest = self.overlap
        if not 0.0 <= least < greatest:
            raise SettingsError(f"sensor.overlap: expected 0 <= least < greatest, found {self.overlap}")
        at, values = self.range_bias_at, self.range_bias_values
        if not 0 < len(at) == len(values) or not np.all(np.diff(at) > 0):
            expected = "expected increasing ranges, one for each of range_bias_values"
            raise SettingsError(f"sensor.range_bias_at: {expected}")

    def range_sigmas(self, ranges: Array) -> Array:
        return self.range_sigma + self.range_sigma_growth * ranges

    def is_inside(self, ranges: Array, bearings: Array) -> BoolArray:
        near = (ranges >= self.range_min) & (ranges <= self.range_max)
        return near & (np.abs(bearings) <= self.fov / 2)

    def probabilities(self, ranges: Array) -> Array:
        """Probabilities of detection at true ranges (m,)."""
        return np.clip(self.detection_probability - self.detection_falloff * ranges, 0.0, 1.0)

    def systematic_errors(self, ranges: Array) -> Array:
        """Systematic errors (m,) of true ranges (m,), in m."""
        errors = np.interp(ranges, self.range_bias_at, self.range_bias_values) if self.range_bias else 0.0
        return np.asarray(errors + self.range_bend * np.maximum(ranges - self.range_bend_from, 0.0) ** 2)


def measure_twists(twists: Array, dt: float, noise: OdometryNoise, rng: Generator) -> tuple[Array, Array]:
    """`(1 + scale) [vx, vy]`, `wz + bias` (N, 3), `dt` s apart, with noise, and [scale, bias]."""
    scale = noise.scale * rng.standard_normal()
    bias = noise.gyro_bias * rng.standard_normal()
    white = rng.standard_normal(twists.shape) * np.array(noise.white)
    factors = np.array([1.0 + scale, 1.0 + scale, 1.0])
    measured = np.asarray(twists * factors + np.array([0.0, 0.0, bias]) + white)
    if any(noise.slow):
        rho, drawn = np.exp(-dt / noise.slow_time), rng.standard_normal(twists.shape)
        drawn[1:] *= np.sqrt(1.0 - rho**2)  # a Gauss-Markov process that has its size from the beginning on
        measured += scipy.signal.lfilter([1.0], [1.0, -rho], drawn, axis=0) * np.array(noise.slow)
    return measured, np.array([scale, bias])


def seen_from(pose: Array, points: Array) -> tuple[Array, Array]:
    """Ranges (m,) and bearings (m,) in [-pi, pi) of points (m, 2) from a pose [x, y, theta]."""
    step = points - pose[:2]
    bearings = np.arctan2(step[:, 1], step[:, 0]) - pose[2]
    return np.hypot(step[:, 0], step[:, 1]), (bearings + np.pi) % (2 * np.pi) - np.pi


class Sensor(ABC):
    """A detector whose range r reads `(1 + scale) r + bias`, with noise and with detections of nothing."""

    def __init__(self, settings: SensorSettings, false_rng: Generator, drop_rng: Generator) -> None:
        self._settings, self._false_rng, self._drop_rng = settings, false_rng, drop_rng

    @abstractmethod
    def _see(self, pose: Array, scale: float, bias: float) -> tuple[Array, Array, IntArray, IntArray, Array]:
        """Measured ranges, bearings, labels, true points (m,), and scatter beside the noise (m, 2) in m."""

    def detect(
        self, t: float, pose: Array, scale: float = 0.0, bias: float = 0.0
    ) -> tuple[Detections, IntArray]:
        """Detect a cycle from a pose [x, y, theta], where a range r reads `(1 + scale) r + bias`.

        The second result is the true cone of each detection (m,), or the nearest true point of a line. Each
        covariance is that of the noise of range and bearing, and of the scatter. Detections of nothing have
        the cone -1, and are uniform over the area of the field, with either boundary's label.
        """
        settings, rng = self._settings, self._false_rng
        count = int(rng.poisson(settings.false_positives))
        false = (
            np.sqrt(rng.uniform(settings.range_min**2, settings.range_max**2, count)),
            rng.uniform(-settings.fov / 2, settings.fov / 2, count),
            rng.integers(LEFT, RIGHT, count, endpoint=True),
            np.full(count, -1),
            np.zeros((count, 2)),
        )
        parts = zip(self._see(pose, scale, bias), false, strict=True)
        ranges, bearings, labels, index, scatter = (np.concatenate(part) for part in parts)
        along, across = settings.range_sigmas(ranges) ** 2, (ranges * settings.bearing_sigma) ** 2
        covariances = polar_covariances(bearings, along, across) + scatter[:, :, None] * scatter[:, None, :]
        points = np.column_stack([ranges * np.cos(bearings), ranges * np.sin(bearings)])
        kept = np.full(len(index), self._drop_rng.random() >= settings.dropped_cycles)
        return Detections(t, points, covariances, labels).where(kept), index[kept]


class ConeSensor(Sensor):
    def __init__(self, cones: Array, labels: IntArray, settings: SensorSettings, rng: Generator) -> None:
        blind_rng, self._cone_rng, false_rng, self._slow_rng, self._second_rng, drop_rng = rng.spawn(6)
        super().__init__(settings, false_rng, drop_rng)
        self._cones, self._labels = cones, labels
        count = round(settings.blind_fraction * len(cones))
        self.blind: IntArray = np.sort(blind_rng.permutation(len(cones))[:count])
        self._seen = np.setdiff1d(np.arange(len(cones)), self.blind)
        # of both cameras that may see a cone at once, along the ray and of the bearing
        self._slow = self._slow_rng.standard_normal((2, 2, len(cones)))

    def _see(self, pose: Array, scale: float, bias: float) -> tuple[Array, Array, IntArray, IntArray, Array]:
        settings, rng = self._settings, self._cone_rng
        ranges, bearings = seen_from(pose, self._cones[self._seen])
        inside = settings.is_inside(ranges, bearings)
        cones, ranges, bearings = self._seen[inside], ranges[inside], bearings[inside]
        # every cone in the field draws the same numbers, so that one setting doesn't shift another's
        chance, colour = rng.random((2, len(cones)))
        first = rng.standard_normal((2, len(cones)))
        second, again = self._second_rng.standard_normal((2, len(cones))), self._second_rng.random(len(cones))
        labels = self._labels[cones]
        flipped = (colour < settings.wrong_colour) & np.isin(labels, BOUNDARIES)
        labels = np.where(flipped, LEFT + RIGHT - labels, labels)
        hit = chance < settings.probabilities(ranges)
        overlap = np.digitize(np.abs(bearings), settings.overlap) == 1
        rows = np.stack([hit, hit & overlap & (again < settings.duplicates)])
        ranges = (1.0 + scale) * ranges + bias + settings.systematic_errors(ranges)
        # errors (2, 2, m) of unit variance by camera, range or bearing, and cone; each cone's slow ones are
        # Gauss-Markov processes that go on while it is not seen
        share, white = (
            np.array([settings.slow_range, settings.slow_bearing])[:, None],
            np.stack([first, second]),
        )
        errors = np.sqrt(1.0 - share) * white + np.sqrt(share) * self._slow[:, :, cones]
        rho = np.exp(-1.0 / (settings.rate * settings.slow_time))
        drawn = self._slow_rng.standard_normal(self._slow.shape)
        self._slow = rho * self._slow + np.sqrt(1.0 - rho**2) * drawn
        ranges = ranges + settings.range_sigmas(ranges) * errors[:, 0]
        bearings = bearings + settings.bearing_sigma * errors[:, 1]
        index = np.nonzero(rows)[1]
        return ranges[rows], bearings[rows], labels[index], cones[index], np.zeros((len(index), 2))


# --- points of lines, at different places in each cycle ----------------------------------------------------


@dataclass(frozen=True)
class LineSettings(Checked, group="line"):
    """Which points of the boundaries a sensor of lines sees."""

    spacing: AtLeast0 = 0.0
    """Mean distance of a cycle's points along each boundary (m); with 0 the sensor detects cones instead."""
    sigma_across: AtLeast0 = 0.0
    """Standard deviation of a point across its boundary beside the noise of range and bearing (m)."""
    gaps: Annotated[int, Meta(ge=0, description="a whole number of at least 0")] = 0
    """Number of stretches of 10 m of a boundary in which nothing is detected, drawn once for a log."""


def curve_through(points: Array, closed: bool) -> SmoothCurve:
    """Smooth curve through the points (n, 2) of a boundary in driving order, by its arc length."""
    by_chord = _through(points, closed)
    s = np.linspace(0.0, by_chord.x[-1], int(np.ceil(by_chord.x[-1] / STEP)) + 1)
    spline = _through(np.asarray(by_chord(s))[: len(s) - closed], closed)
    return SmoothCurve(spline, float(spline.x[-1]), closed, np.zeros(len(spline.x)))


def _through(points: Array, closed: bool) -> CubicSpline:
    points = ring(points) if closed else points
    s = arc_lengths(points)
    new = np.diff(s, prepend=-1.0) > 0.0
    ends: Literal["periodic", "not-a-knot"] = "periodic" if closed else "not-a-knot"
    return scipy.interpolate.CubicSpline(s[new], points[new], bc_type=ends)


def as_lines(track: Track) -> Track:
    """Replace the cones of a track by points of smooth curves through them."""
    if track.path is not None:
        raise SettingsError(f"line.spacing: expected a track between two boundaries, found the {track.name}")
    rows = []
    for cones in (track.left, track.right):
        curve = curve_through(cones, track.closed)
        count = int(np.ceil(curve.length))  # points are a metre apart at most
        rows.append(curve.points(np.linspace(0.0, curve.length, count + 1)[: count + (not track.closed)]))
    return replace(track, left=rows[0], right=rows[1], other=np.zeros((0, 2)), other_labels=None)


class LineSensor(Sensor):
    """Points anywhere along both boundaries, drawn independently in each cycle.

    A covariance is that of the noise of range and bearing, and of the scatter across the boundary: the
    variance of the distance across is exact. Along the boundary a point lies anywhere, and the covariance
    says nothing of that.
    """

    def __init__(
        self, track: Track, labels: IntArray, settings: SensorSettings, line: LineSettings, rng: Generator
    ) -> None:
        """Take a track of `as_lines` in the map frame, and the label of each of its points."""
        gap_rng, self._place_rng, self._noise_rng, false_rng, drop_rng = rng.spawn(5)
        super().__init__(settings, false_rng, drop_rng)
        self._line, self._labels = line, labels
        self._curves = [curve_through(row, track.closed) for row in (track.left, track.right)]
        self._counts = (len(track.left), len(track.right))
        sides = gap_rng.integers(0, len(self._curves), line.gaps)
        self.gaps = [(int(side), float(gap_rng.uniform(0.0, self._curves[side].length))) for side in sides]
        """Boundary of each gap, and the place along it where the gap begins (m)."""

    def _see(self, pose: Array, scale: float, bias: float) -> tuple[Array, Array, IntArray, IntArray, Array]:
        settings, rng = self._settings, self._noise_rng
        drawn = []  # points of both boundaries, with their normals and the nearest true points
        for side, curve in enumerate(self._curves):
            count = int(self._place_rng.poisson(curve.length / self._line.spacing))
            s = self._place_rng.uniform(0.0, curve.length, count)
            for gap_side, begin in self.gaps:
                beyond = (s - begin) % curve.length if curve.closed else s - begin
                s = s[(side != gap_side) | (beyond < 0.0) | (beyond >= 10.0)]
            index = np.rint(s / curve.length * self._counts[side]).astype(int) % self._counts[side]
            drawn.append((curve.points(s), curve.normals(s), index + side * self._counts[0]))
        points, normals, nearest = (np.concatenate(parts) for parts in zip(*drawn, strict=True))
        chance, colour = rng.random((2, len(points)))
        along, bearing, across = rng.standard_normal((3, len(points)))
        points = points + normals * (self._line.sigma_across * across)[:, None]
        ranges, bearings = seen_from(pose, points)
        seen = settings.is_inside(ranges, bearings) & (chance < settings.probabilities(ranges))
        ranges = (1.0 + scale) * ranges + bias + settings.systematic_errors(ranges)
        ranges = ranges + settings.range_sigmas(ranges) * along
        bearings = bearings + settings.bearing_sigma * bearing
        labels = self._labels[nearest]
        labels = np.where(colour < settings.wrong_colour, LEFT + RIGHT - labels, labels)
        ahead = direction(pose[2])
        vehicle = np.column_stack([ahead, left_of(ahead)])  # turns rows of the map frame into it
        scatter = self._line.sigma_across * normals[seen] @ vehicle
        return ranges[seen], bearings[seen], labels[seen], nearest[seen], scatter
