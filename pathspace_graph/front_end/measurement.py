"""Measurement of noise and sensor errors from odometry and detections alone, without a map.

Cones are static, and odometry is accurate over a few seconds, so the sightings of a cone should coincide.
Their residuals depend on range, motion and time: constant errors of the sensor shift all sightings by known
derivatives, white noise scatters them, and correlated errors shift the sightings of one cone together.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Self

import numpy as np

from pathspace_graph.copies import Copyable
from pathspace_graph.factors import _kernels as kernels
from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.noise import (
    ASSUMED_DRIFT,
    SURE,
    MeasuredNoise,
    RayNoise,
    huber_weights,
    ray_axes,
)
from pathspace_graph.factors.se2 import in_vehicle, rotations, to_map
from pathspace_graph.factors.sensor import BENDS_FROM, SENSOR_SIZE

from .sightings import (
    FIRST_ACROSS,
    FIRST_ALONG,
    FOLLOW_RANGE,
    MAD,
    MIN_SPEED_SHARE,
    SeenCycle,
    Sightings,
    TwistRecord,
)

PRIOR: Final = np.array([0.1, 0.1, 0.3, 0.3, 0.5, 0.02, 0.02])
"""Prior standard deviations of the constants: errors of the sensor (rad, m, s, -, m), bend of its ranges
(1/m) and bias of the yaw rate (rad/s). Without the bend, yaw, lateral offset and scale would absorb it."""
OF_BEND: Final = SENSOR_SIZE  # index of the bend among the constants
PASSES: Final = 4  # passes over the cycles, each of which tracks the cones again
ROUNDS_FIRST: Final = 5  # alternations of errors, noise and weights in a pass
ROUNDS_AGAIN: Final = 3  # alternations in a pass that starts from measured noise, nearly converged
CLUSTER_TIME: Final = 3.0  # time (s) over which errors of the odometry are correlated
COUNTED: Final = 0.8  # share of `FOLLOW_RANGE` beyond which only underestimated ranges are in reach
HARDLY: Final = 1e-6  # weight of sightings beyond it, so that a cone seen only there has a position
NOISE_HUBER: Final = 2.0  # threshold of Huber's loss (sigmas)
MIN_COUNT: Final = 5  # least number of sightings of a cone in use
MIN_ROWS: Final = 60  # least number of sightings with a reference from which noise is estimated
NEAR_SHARE: Final = 0.6  # references of a sighting: sightings of its cone within this share of its range
NEAR_TIME: Final = 6.0  # longest time to a reference (s), over which odometry is trusted
BINS: Final = 8  # largest number of range bins
STAY_TIMES: Final = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0)  # candidate correlation times (s)
LAGS: Final = (0.05, 0.3, 0.6, 1.0, 1.6, 2.5, 4.0)  # edges of the lag bins of the correlation (s)
MODEL_ERROR: Final = 0.05  # relative error of the linear model, one sigma
FIRST_SHARE: Final = 0.5  # prior share of the variance that is correlated
FIRST_CONES: Final = 8.0  # weight of `FIRST_SHARE`, in cones
LEAST_NOISE: Final = (0.02, 0.002)  # least noise along the ray (m) and across it (rad): cones have a size

Rays = tuple[RayNoise, RayNoise]
"""Noise along the ray and across it."""
Lagged = tuple[IntArray, IntArray, Array, IntArray]
"""Pairs of sightings of one cone, by index, with their lags (s) and bins in `LAGS`."""


@dataclass(eq=False)
class _Cones:
    """Sightings of cones with enough of them, sorted by cone, with the linear model `p + A b`, map frame."""

    table: Sightings
    begins: IntArray  # (c,) row of each cone's first sighting
    counts: IntArray  # (c,) number of its sightings
    axes: Array  # (2, n, 2) unit vectors along the ray and across it, map frame
    points: Array  # (n, 2) sightings p in m, map frame by dead reckoning
    ranges: Array  # (n,) measured range of the cone, without noise once `without` has run (m)
    columns: Array  # (n, 2, 7) derivatives A by the constants (`PRIOR`)

    def without(self, off: Array) -> Self:
        """Return the sightings with ranges and derivatives at positions without their noise `off` (n, 2).

        Noisy ranges would bias the weights towards short sightings and shrink the estimated errors.
        """
        seen = self.table.point - in_vehicle(off, self.table.pose)
        columns = derivatives_by_constants(self.table, np.repeat(self.begins, self.counts), seen)
        return replace(self, ranges=np.hypot(*seen.T), columns=columns)

    def on_axes(self, off: Array, rows: IntArray | slice = slice(None)) -> Array:
        """Return the components (2, k) of offsets (k, 2), map frame, along and across the rays of `rows`."""
        return np.array([(off * axis[rows]).sum(axis=1) for axis in self.axes])

    def sigmas(self, noise: Rays) -> Array:
        """Return the standard deviations (2, n) of the sightings along and across their rays, in m."""
        return np.array([one.sigmas(self.ranges) for one in noise])

    def information(self, noise: Rays, weights: Array) -> Array:
        by_ray, by_side = self.axes[:, :, :, None] * self.axes[:, :, None, :]
        along, across = (weights / self.sigmas(noise) ** 2)[:, :, None, None]
        return np.asarray(along * by_ray + across * by_side)


def _cones(sightings: Sightings) -> _Cones | None:
    speed = np.hypot(sightings.twist[:, 0], sightings.twist[:, 1])
    moving = speed > MIN_SPEED_SHARE * np.median(speed) if len(speed) else np.zeros(0, bool)
    count = np.bincount(sightings.cone[moving]) if moving.any() else np.zeros(1, np.intp)
    chosen = np.flatnonzero(moving)
    chosen = chosen[count[sightings.cone[chosen]] >= MIN_COUNT]
    if len(chosen) < MIN_ROWS:
        return None
    table = sightings.where(chosen[np.argsort(sightings.cone[chosen], kind="stable")])
    begins, counts = runs(table.cone)
    axes = np.einsum("nij,nkj->kni", rotations(table.pose[:, 2]), ray_axes(table.point))
    points, ranges = to_map(table.point, table.pose), np.hypot(*table.point.T)
    columns = derivatives_by_constants(table, np.repeat(begins, counts), table.point)
    return _Cones(table, begins, counts, axes, points, ranges, columns)


def derivatives_by_constants(table: Sightings, first: IntArray, seen: Array) -> Array:
    """Return the derivatives (n, 2, 7) by the constants of sightings at points `seen` (n, 2), vehicle frame.

    The bias of the yaw rate counts from the first sighting of each cone or cell, at rows `first` (n,).
    """
    return kernels.by_constants(seen, table.twist, table.pose, table.by_bias, first, BENDS_FROM)


def runs(groups: IntArray) -> tuple[IntArray, IntArray]:
    """Return the first row (c,) and the size (c,) of each group; equal groups (n,) are adjacent."""
    begins = np.flatnonzero(np.diff(groups, prepend=-1))
    return begins, np.diff(np.append(begins, len(groups)))


def _solve(cones: _Cones, information: Array) -> tuple[Array, Array, Array, Array]:
    """Return the constants b (7,), two covariances (7, 7), and the residuals (n, 2) of the sightings.

    The cones' positions, weighted means of `p + A b`, are eliminated. The second covariance is `clustered`.
    """
    columns, points, own, vectors = kernels.centred(cones.begins, information, cones.columns, cones.points)
    covariance = np.asarray(np.linalg.inv(own.sum(axis=0) + np.diag(PRIOR**-2)), np.float64)
    errors = -covariance @ vectors.sum(axis=0)
    scores = vectors + own @ errors
    middle = np.add.reduceat(cones.table.t, cones.begins) / cones.counts
    return errors, covariance, clustered(middle, scores, covariance), points + columns @ errors


def clustered(middle: Array, scores: Array, covariance: Array) -> Array:
    """Return the cluster-robust covariance `P (sum g g') P` (7, 7) of the constants (White's estimator).

    g sums the scores (c, 7) of the cones seen in a stretch of `CLUSTER_TIME` seconds, by the mean stamp
    `middle` (c,) of each cone, in s. So it includes the errors of the odometry.
    """
    _, stretch = np.unique(np.floor(middle / CLUSTER_TIME), return_inverse=True)
    count = int(stretch.max()) + 1
    summed = np.zeros((count, scores.shape[1]))
    np.add.at(summed, stretch, scores)
    return np.asarray(covariance @ (summed.T @ summed) @ covariance * count / max(count - 1, 1))


def _residuals(cones: _Cones, errors: Array, noise: Rays, odometry: Array) -> tuple[IntArray, Array, Array]:
    """Return the rows (k,) of sightings that have nearer references, and their offsets from these.

    The offsets (2, k) along and across the ray (m) are corrected for the constant errors. The variances
    (2, k) of references and odometry (m^2) follow. `odometry` (3,) is its random walk (m, m, rad / sqrt(s)).
    """
    points, sigmas = cones.points + cones.columns @ errors, cones.sigmas(noise)
    weight = 1.0 / (sigmas**2).mean(axis=0)
    values, table = np.column_stack([points, *sigmas]), cones.table
    sought = NEAR_SHARE, NEAR_TIME
    rows, counts, means = kernels.references(table.cone, table.t, cones.ranges, weight, values, sought)
    offsets, lag = cones.on_axes(points[rows] - means[:, 1:3], rows), means[:, 0]
    across = odometry[1] ** 2 + (odometry[2] * cones.ranges[rows]) ** 2
    known = np.array([odometry[0] ** 2 * lag, across * lag])
    for axis, one in enumerate(noise):
        known[axis] += means[:, 3 + axis] ** 2 * np.maximum(1.0 / counts, one.share)
    return rows, offsets, known


def _ray_noise(
    cones: _Cones, rows: IntArray, lagged: Lagged, off: Array, reference: Array, least: tuple[float, float]
) -> RayNoise:
    """Return the noise along or across the ray by range, with its correlation, from `_residuals` (k,)."""
    ranges = cones.ranges[rows]
    order, bins = np.argsort(ranges), np.arange(max(min(BINS, len(rows) // (MIN_ROWS // 2)), 2))
    counts = len(rows) // len(bins) + (bins < len(rows) % len(bins))  # bins of equal count, by range
    begins, size = counts.cumsum() - counts, np.abs(off[order])
    middle, known = (np.add.reduceat(of[order], begins) / counts for of in (ranges, reference))
    size = size[np.lexsort((size, np.repeat(bins, counts)))]
    medians = 0.5 * (size[begins + (counts - 1) // 2] + size[begins + counts // 2])
    scatter = (MAD * medians) ** 2
    sigma = np.sqrt(np.clip(scatter - known, 0.25 * scatter, 4.0 * scatter))
    found = RayNoise(np.maximum(line_through(middle, sigma), least))
    share, time = _staying(lagged, off, reference, found.sigmas(ranges))
    count = len(np.unique(cones.table.cone[rows]))
    share = (count * share + FIRST_CONES * FIRST_SHARE) / (count + FIRST_CONES)
    return replace(found, share=share, time=time)


def line_through(ranges: Array, sigma: Array) -> Array:
    """Minimize `sum ((a + b r) / sigma - 1)^2` over `a, b >= 0` for sigmas (k,) at ranges r (k,)."""
    columns = np.stack([np.ones(len(ranges)), ranges], axis=1) / sigma[:, None]
    line = np.linalg.lstsq(columns, np.ones(len(sigma)), rcond=None)[0]
    if (line >= 0.0).all():
        return np.asarray(line)
    share = columns.sum(axis=0) / (columns**2).sum(axis=0)  # of either alone
    best = int(((share * columns - 1.0) ** 2).sum(axis=0).argmin())
    return np.asarray(share * (np.arange(2) == best))


def _lagged(cone: IntArray, t: Array) -> Lagged:
    """Return the ordered pairs of sightings (k,), sorted by cone, of one cone with a lag within `LAGS`."""
    begins, counts = runs(cone)
    repeats = np.repeat(counts, counts)
    i = np.repeat(np.arange(len(cone)), repeats)
    nth = np.arange(len(i)) - np.repeat(np.cumsum(repeats) - repeats, repeats)
    j = np.repeat(np.repeat(begins, counts), repeats) + nth
    lag = t[j] - t[i]
    inside = (lag >= LAGS[0]) & (lag < LAGS[-1])
    return i[inside], j[inside], lag[inside], np.digitize(lag[inside], LAGS)


def _staying(lagged: Lagged, off: Array, reference: Array, sigma: Array) -> tuple[float, float]:
    """Return share of the variance and correlation time (s) of the correlated part of errors `off` (k,)."""
    whitened, own = np.clip(off / sigma, -3.0, 3.0), reference / sigma**2
    i, j, lag, place = lagged
    product = whitened[i] * whitened[j] - 0.5 * (own[i] + own[j])
    scale = max(float((whitened**2 - own).mean()), 0.25)
    counts = np.bincount(place, minlength=len(LAGS))
    enough = np.flatnonzero(counts >= MIN_ROWS // 2)
    if len(enough) == 0:
        return 0.0, 1.0
    lags, correlations = (
        np.bincount(place, values)[enough] / counts[enough] for values in (lag, product / scale)
    )
    weights = np.sqrt(counts[enough])
    model = np.exp(-lags / np.array(STAY_TIMES)[:, None])  # a row for each time
    shares = np.clip((weights * model) @ correlations / (weights * model**2).sum(axis=1), 0.0, 1.0)
    best = int((weights * (correlations - shares[:, None] * model) ** 2).sum(axis=1).argmin())
    return float(shares[best]), STAY_TIMES[best]


class Measurement(Copyable):
    """Measurement of noise in steps short enough for a perception cycle.

    Each pass tracks the cones with the estimate so far, then alternates between errors, noise and weights.
    """

    def __init__(self, cycles: Sequence[SeenCycle], found: MeasuredNoise) -> None:
        """Start with the cycles of a drive and an estimate, which has the noise of the odometry at least."""
        self._sightings, self._passes = Sightings.of(cycles), PASSES if found.along is None else 1
        self._cones: _Cones | None = None
        self._found = found

    def advance(self) -> MeasuredNoise | None:
        """Take the next step; return the measured noise after the last one."""
        if self._cones is not None:
            return self._round(self._cones)
        self._cones = _cones(self._sightings.tracked(self._found))
        if self._cones is None:
            return self._passed(self._found)
        self._noise = self._found.along or FIRST_ALONG, self._found.across or FIRST_ACROSS
        self._rounds = ROUNDS_AGAIN if self._found.along else ROUNDS_FIRST
        self._weights = np.ones(len(self._cones.ranges))
        return None

    def _round(self, cones: _Cones) -> MeasuredNoise | None:
        walk, noise = self._found.odometry * np.sqrt(self._found.interval), self._noise
        errors, *covariances, off = _solve(cones, cones.information(noise, self._weights))
        cones = self._cones = cones.without(off)
        self._weights = huber_weights(np.hypot(*(cones.on_axes(off) / cones.sigmas(noise))), NOISE_HUBER) ** 2
        self._weights[cones.ranges > COUNTED * FOLLOW_RANGE] = HARDLY
        rows, (along, across), (by_along, by_across) = _residuals(cones, errors, noise, walk)
        if len(rows) < MIN_ROWS:
            return self._passed(self._found)
        lagged = _lagged(cones.table.cone[rows], cones.table.t[rows])
        self._noise = (
            _ray_noise(cones, rows, lagged, along, by_along, (LEAST_NOISE[0], 0.0)),
            _ray_noise(cones, rows, lagged, across, by_across, (0.0, LEAST_NOISE[1])),
        )
        self._rounds -= 1
        return None if self._rounds else self._passed(self._result(cones, errors, *covariances))

    def _result(self, cones: _Cones, errors: Array, covariance: Array, clustered: Array) -> MeasuredNoise:
        """Return the measured noise, with the constants (7,) and both of their covariances (7, 7).

        The constant part of a cone's error shifts its position; only the rest biases the constants.
        """
        stamps = np.unique(self._sightings.t)
        counts = int(np.median(cones.counts)), float(np.median(np.diff(stamps)))
        stays = max(one.inflation_of_slope(*counts) for one in self._noise)
        sigmas = np.sqrt(np.maximum(stays * np.diag(covariance), np.diag(clustered)))
        per_cycle = len(self._sightings.t) / len(stamps)
        return with_detections(self._found, self._noise, errors, sigmas, cones.table.t, (*counts, per_cycle))

    def _passed(self, found: MeasuredNoise) -> MeasuredNoise | None:
        self._passes -= 1
        self._found, self._cones = found, None
        return None if self._passes else found


def odometry_noise(twists: TwistRecord, known: MeasuredNoise | None) -> MeasuredNoise | None:
    """Return `known` with the measured noise of the odometry; None if there are too few twists."""
    white = twists.white()
    if white is None:
        return None
    sigma, interval = white
    found = known or MeasuredNoise(sigma, np.array(ASSUMED_DRIFT), interval)
    return replace(found, odometry=sigma, interval=interval)


def with_detections(
    found: MeasuredNoise,
    noise: Rays,
    errors: Array,
    sigmas: Array,
    t: Array,
    counts: tuple[int, float, float],
) -> MeasuredNoise:
    """Return `found` with the noise of detections at stamps t (n,) and the constants `errors` (7,).

    `counts` are the detections per cone, the time between them (s), and the detections per cycle.
    """
    sigmas = np.hypot(sigmas, MODEL_ERROR * np.abs(errors))
    is_bent = np.abs(errors[OF_BEND]) > SURE * sigmas[OF_BEND]
    count, period, per_cycle = counts
    return replace(
        found,
        along=noise[0],
        across=noise[1],
        count=count,
        period=period,
        per_cycle=per_cycle,
        sensor=errors[:SENSOR_SIZE],
        sensor_sigma=sigmas[:SENSOR_SIZE],
        range_bend=float(errors[OF_BEND]) if is_bent else 0.0,
        seconds=float(np.sum(np.minimum(np.diff(np.unique(t)), 1.0))),
    )
