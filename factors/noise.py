"""Noise: whitening, Huber's robust loss, and noise measured on a drive's odometry and detections."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar, Final

import numpy as np

from . import _kernels as kernels
from .arrays import Array
from .se2 import left_of
from .sensor import SENSOR_SIZE, by_bend


def whiteners(covariances: Array) -> Array:
    """Return lower triangular W (m, 2, 2) with `W' W = K^-1` for covariances K (m, 2, 2).

    `W r` has two independent entries of unit variance where r has covariance K.
    """
    xx, xy, yy = covariances[:, 0, 0], covariances[:, 0, 1], covariances[:, 1, 1]
    out = np.zeros(covariances.shape)
    out[:, 0, 0] = 1.0 / np.sqrt(xx)
    out[:, 1, 1] = 1.0 / np.sqrt(yy - xy * xy / xx)
    out[:, 1, 0] = -xy / xx * out[:, 1, 1]
    return out


def huber_weights(whitened: Array, threshold: float) -> Array:
    """Weights `w = min(1, threshold / |z|)` of whitened residuals z in a Gauss-Newton step.

    An infinite threshold gives plain least squares: every weight is 1.
    """
    return 1.0 / np.maximum(np.abs(whitened) / threshold, 1.0)


def huber_loss(whitened: Array, threshold: float) -> Array:
    """Huber's loss of whitened residuals z with threshold k.

    `rho(z) = z^2 / 2` for `|z| <= k`, and `k (|z| - k / 2)` beyond.
    """
    inner = np.minimum(np.abs(whitened), threshold)
    return np.asarray(inner * (np.abs(whitened) - 0.5 * inner))


def huber_roots(whitened: Array, threshold: float) -> Array:
    """`sign(z) sqrt(2 rho(z))`: half its square is the loss rho of `huber_loss`."""
    return np.sign(whitened) * np.sqrt(2.0 * huber_loss(whitened, threshold))


ASSUMED_DRIFT: Final = (0.05, 0.05, 0.0017)
"""Drift of an odometry of which nothing else is known (m, m, rad by root of s): 0.5 m, 0.9 degrees in 90 s.

It is not observable on an open drive: a cone is in view for about 3 s, and the noise of its detections hides
an error of the speed below 0.05 m/s."""
TINY: Final = float(np.finfo(float).tiny)  # smallest divisor of lengths, which are zero where it counts
SURE: Final = 4.0  # sigmas from which an error of the sensor is significant
STAYS: Final = 1.5  # growth of the sigma of a cone's mean from which correlated errors count


@dataclass(frozen=True, eq=False)
class RayNoise:
    """Error of a detection in one direction, along the ray or across it.

    Its standard deviation at range r is `sigma[0] + sigma[1] r`. Two errors of one cone, a time dt apart,
    have the correlation `share exp(-dt / time)`.
    """

    LENGTHS: ClassVar = {"sigma": (1, 0)}

    sigma: Array  # (2,) standard deviation at range 0 (m), and its growth with the range (m/m)
    share: float = 0.0  # correlated share of the variance
    time: float = 1.0  # correlation time of that share (s)

    def sigmas(self, ranges: Array) -> Array:
        """Standard deviations (m,) of single detections at ranges (m,), in m."""
        return np.asarray(self.sigma[0] + self.sigma[1] * ranges)

    def inflation(self, count: int, period: float) -> float:
        """Variance of the mean of `count` errors of one cone, relative to independent errors.

        Detections are `period` (s) apart: `1 + 2 sum_k (1 - k / count) share exp(-k period / time)`.
        """
        k = np.arange(1, max(count, 1))
        return float(1.0 + 2.0 * self.share * ((1.0 - k / count) * np.exp(-k * period / self.time)).sum())

    def inflation_of_slope(self, count: int, period: float) -> float:
        """Variance of a slope over `count` errors of one cone, relative to independent errors.

        It is `g' R g / g' g`, with the times g from their middle and the correlations R.
        """
        times = period * (np.arange(count) - 0.5 * (count - 1))
        alike = self.share * np.exp(-np.abs(times[:, None] - times) / self.time)
        return float(1.0 - self.share + times @ alike @ times / max(times @ times, TINY))


@dataclass(frozen=True, eq=False)
class TwistNoise:
    """Noise of a measured twist: white noise of each reading, and a drift that lasts for many of them."""

    white: Array  # (3,) standard deviation of a single twist (m/s, m/s, rad/s)
    drift: Array = field(default_factory=lambda: np.zeros(3))
    """(3,) Random walk of the integrated pose (m, m and rad by root of s)."""

    def sigmas(self, durations: Array) -> Array:
        """Standard deviations (k, 3) of twists that are held for durations dt (k,), in s.

        `sqrt(white^2 + drift^2 / dt)`: the integral over dt has the variance `white^2 dt^2 + drift^2 dt`.
        """
        if not self.drift.any():
            return np.broadcast_to(self.white, (len(durations), len(self.white)))
        walk = self.drift**2 / np.maximum(durations, MIN_DURATION)[:, None]
        return np.asarray(np.sqrt(self.white**2 + walk))


MIN_DURATION: Final = 1e-6  # s; a twist that is held for less moves nothing


@dataclass(frozen=True, eq=False)
class MeasuredNoise:
    """Noise of odometry and detections, measured on the readings of a drive alone."""

    LENGTHS: ClassVar = {
        "odometry": (1, 1, 0),
        "drift": (1, 1, 0),
        "along": 0,
        "across": 0,
        "sensor": (0, 1, 0, 0, 1),
        "sensor_sigma": (0, 1, 0, 0, 1),
        "range_bend": -1,
    }

    odometry: Array  # (3,) standard deviation of a twist's white noise (m/s, m/s, rad/s)
    drift: Array  # (3,) slow part of its error, a random walk of the pose (m, m and rad by root of s)
    interval: float  # time between two twists (s)
    along: RayNoise | None = None  # along the ray; None if too few cones were seen often enough
    across: RayNoise | None = None  # across the ray, as `along`
    count: int = 1  # median number of detections of one cone
    period: float = 0.1  # time between two perception cycles (s)
    per_cycle: float = 1.0  # mean number of cones seen in a cycle
    sensor: Array = field(default_factory=lambda: np.zeros(SENSOR_SIZE))
    """(5,) Constant errors of the sensor (`factors.sensor:SENSOR`), given the odometry's scale."""
    sensor_sigma: Array = field(default_factory=lambda: np.full(SENSOR_SIZE, np.inf))
    """(5,) Their standard deviations; infinite if not measured."""
    range_bend: float = 0.0
    """Bend of the ranges (1/m), see `factors.sensor:by_bend`; 0 if not significant."""
    seconds: float = 0.0  # time of driving that the noise was measured on (s)

    @property
    def twist(self) -> TwistNoise:
        """Noise of a twist."""
        return TwistNoise(self.odometry, self.drift)

    @cached_property
    def _inflations(self) -> Array:
        known = [one for one in (self.along, self.across) if one is not None]
        return np.array([one.inflation(self.count, self.period) for one in known])

    def covariances(self, points: Array, *, inflated: bool) -> Array | None:
        """Covariances (m, 2, 2) of detections at points (m, 2), vehicle frame; None if not measured.

        They can be `inflated`, so that sightings of one cone count as independent.
        """
        if self.along is None or self.across is None:
            return None
        ranges, ray = rays(points)
        factors = self._inflations if inflated else (1.0, 1.0)
        along = factors[0] * self.along.sigmas(ranges) ** 2
        across = factors[1] * self.across.sigmas(ranges) ** 2
        covariances = (along - across)[:, None, None] * (ray[:, :, None] * ray[:, None, :])
        covariances[:, [0, 1], [0, 1]] += across[:, None]
        return np.asarray(covariances)

    def inflated(self, points: Array, covariances: Array) -> Array:
        """Inflate covariances C (m, 2, 2) of single detections, so that sightings count as independent.

        The result is `G C G`, where G has the roots of the inflations along and across the ray. C does not
        change unless one of them exceeds `STAYS`.
        """
        if self.along is None or self.across is None:
            return covariances
        roots = np.sqrt(self._inflations)
        if (roots < STAYS).all():
            return covariances
        axes = ray_axes(points)
        wider = np.einsum("mki,k,mkj->mij", axes, roots, axes)
        return np.asarray(wider @ covariances @ wider)

    @cached_property
    def shown(self) -> Array:
        """Significant errors (5,) of the sensor, of more than `SURE` sigmas; the others are zero."""
        return np.where(np.abs(self.sensor) > SURE * self.sensor_sigma, self.sensor, 0.0)

    def unbent(self, points: Array) -> Array:
        """Remove `range_bend` from the ranges of detections at points (m, 2), vehicle frame."""
        if self.range_bend == 0.0:
            return points
        return points - self.range_bend * by_bend(points)[:, None] * points

    def corrected(self, points: Array, twist: Array, *, shown: bool = False) -> Array:
        """Remove all constant errors, or those `shown`, from detections at points (m, 2), vehicle frame."""
        errors, points = self.shown if shown else self.sensor, self.unbent(points)
        if not errors.any():
            return points
        return kernels.shifted(points, np.full((len(points), 3), twist), errors)


def rays(points: Array) -> tuple[Array, Array]:
    """Ranges (m,) of points (m, 2), and unit vectors (m, 2) along their rays, vehicle frame."""
    ranges = np.hypot(points[:, 0], points[:, 1])
    return ranges, points / np.maximum(ranges, TINY)[:, None]


def ray_axes(points: Array) -> Array:
    """Unit vectors (m, 2, 2) along and across the rays to points (m, 2), vehicle frame."""
    _, ray = rays(points)
    return np.stack([ray, left_of(ray)], axis=1)


def ray_sigmas(points: Array, covariances: Array) -> Array:
    """Standard deviations (m, 2) along and across the rays to points (m, 2), vehicle frame."""
    axes = ray_axes(points)
    return np.asarray(np.sqrt(np.einsum("mki,mij,mkj->mk", axes, covariances, axes)))


@dataclass(frozen=True, eq=False)
class KnownNoise:
    """Noise as known before a drive."""

    LENGTHS: ClassVar = {"odometry": (1, 1, 0), "drift": (1, 1, 0), "measured": 0}

    odometry: Array  # (3,) standard deviation of a twist (m/s, m/s, rad/s), stated or assumed
    odometry_stated: bool = True
    detections_stated: bool = True  # whether the log states the covariances of the detections
    measured: MeasuredNoise | None = None  # on the whole of this drive, or on an earlier one
    sigma_range_scale: float | None = None
    """Stated standard deviation of the scale error of the ranges (-)."""
    drift: Array | None = None
    """(3,) Stated drift of the odometry (m, m and rad by root of s); a white noise says nothing of it."""

    @property
    def twist(self) -> TwistNoise:
        """Noise of a twist; an unstated one includes the drift."""
        drift = self.drift
        if drift is None:
            drift = np.array(ASSUMED_DRIFT) if self.odometry_stated else np.zeros(3)
        return TwistNoise(self.odometry, drift)
