"""Measurement of noise and sensor errors from odometry and detections alone, without a map.

Cones are static, and odometry is accurate over a few seconds, so the sightings of a cone should coincide.
Their residuals depend on range, motion and time: constant errors of the sensor shift all sightings by known
derivatives, white noise scatters them, and correlated errors shift the sightings of one cone together.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from math import comb
from typing import Final

import numpy as np

from pathspace_graph.copies import Copyable
from pathspace_graph.factors import _kernels as kernels
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.noise import SURE, MeasuredNoise, RayNoise, huber_weights, ray_axes
from pathspace_graph.factors.se2 import compose, in_vehicle, left_of, rotated, rotations, se2_exp, to_map
from pathspace_graph.factors.sensor import BENDS_FROM, SENSOR_SIZE
from pathspace_graph.io.log import Detections, Odometry
from pathspace_graph.mapping.tracks import Tracks

# --- twists ----------------------------------------------------------------------------------------------

MAD: Final = 1.4826  # standard deviation of a Gaussian over its median absolute deviation
MOST_TWISTS: Final = 4000  # largest number of newest twists
MIN_SPEED_SHARE: Final = 0.3  # least share of the median speed for the noise in motion
MIN_TWISTS: Final = 30  # least number of twists for white noise


def dead_reckoned(odometry: Odometry, stamps: Array) -> Array:
    """Poses (n, 3) at stamps (n,) in s by odometry alone, from the origin at its first row."""
    row = np.maximum(odometry.t.searchsorted(stamps, side="right") - 1, 0)
    held = np.maximum(stamps - odometry.t[row], 0.0)
    return compose(odometry.poses()[row], se2_exp(odometry.twist[row] * held[:, None]))


def without_repeats(parts: Sequence[Odometry]) -> Odometry:
    """Join odometry without repeated twists, which are held, up to a number of newest ones."""
    t = np.concatenate([np.zeros(0), *(part.t for part in parts)])
    twists = np.concatenate([np.zeros((0, 3)), *(part.twist for part in parts)])
    new = np.ones(len(t), bool)
    new[1:] = (np.diff(t) > 0.0) & (np.diff(twists, axis=0) != 0.0).any(axis=1)
    return Odometry(t[new][-MOST_TWISTS:], twists[new][-MOST_TWISTS:])


def twist_noise(odometry: Odometry) -> tuple[Array, float] | None:
    """Return the noise (k, 3) of a twist by differences of second to fourth order, and their interval (s).

    The noise by order k is the scaled median absolute difference over `sqrt(binomial(2 k, k))`. The least is
    the white noise; it is not white if orders disagree. None for too few twists.
    """
    odometry = without_repeats([odometry])
    twists, orders = odometry.twist, list[Array]()
    if len(twists) < MIN_TWISTS:
        return None
    speeds = np.hypot(twists[:, 0], twists[:, 1])
    drives = speeds > MIN_SPEED_SHARE * np.median(speeds)
    for k in (2, 3, 4):
        inside = np.lib.stride_tricks.sliding_window_view(drives, k + 1).all(axis=1)
        if inside.sum() >= MIN_TWISTS // 2:
            differences = np.abs(np.diff(twists, k, axis=0)[inside])
            orders.append(MAD * np.median(differences, axis=0) / np.sqrt(comb(2 * k, k)))
    return (np.array(orders), float(np.median(np.diff(odometry.t)))) if orders else None


# --- sightings of cones ----------------------------------------------------------------------------------

FOLLOW_RANGE: Final = 30.0  # largest range of a tracked cone (m): few cones beyond are seen from near later
GATE_LEAST: Final = 0.4  # distance within which a sighting is of a cone (m)
GATE_MOST: Final = 3.0  # largest such distance (m); a narrow gate would cut off the noise
FIRST_ALONG: Final = RayNoise(np.array([0.1, 0.04]))  # initial noise along the ray
FIRST_ACROSS: Final = RayNoise(np.array([0.05, 0.016]))  # and across it


@dataclass(frozen=True, eq=False)
class SeenCycle:
    """A perception cycle with its pose by dead reckoning."""

    detections: Detections  # detections as measured
    pose: Array  # (3,) pose by dead reckoning
    twist: Array  # (3,) twist of the vehicle (m/s, m/s, rad/s)


@dataclass(eq=False)
class Sightings:
    """Table of detections of static cones or points, in order of time."""

    cone: IntArray  # (n,) number of the cone, or the label while cones are unknown
    t: Array  # (n,) stamp (s)
    point: Array  # (n, 2) measured point in m, vehicle frame
    twist: Array  # (n, 3) twist of the vehicle (m/s, m/s, rad/s)
    pose: Array  # (n, 3) pose by dead reckoning
    by_bias: Array  # (n, 3) derivative of the pose by the bias of the yaw rate

    @classmethod
    def of(cls, cycles: Sequence[SeenCycle]) -> "Sightings":
        """Return the detections of cycles up to `FOLLOW_RANGE`, with labels for cones."""
        poses, twists = np.array([one.pose for one in cycles]), np.array([one.twist for one in cycles])
        seen = [one.detections for one in cycles]
        t, points = np.array([one.t for one in seen]), np.concatenate([one.points_vehicle for one in seen])
        labels, moved = np.concatenate([one.labels for one in seen]), np.diff(poses[:, :2], axis=0)
        turned, own = t[0] - t, np.repeat(np.arange(len(seen)), [len(one.labels) for one in seen])
        middle = turned[1:] + 0.5 * np.diff(t)
        shift = np.concatenate([np.zeros((1, 2)), np.cumsum(left_of(moved) * middle[:, None], axis=0)])
        table = cls(labels, t[own], points, twists[own], poses[own], np.column_stack([shift, turned])[own])
        return table.where(np.hypot(*points.T) < FOLLOW_RANGE)

    def where(self, rows: IntArray | BoolArray | slice) -> "Sightings":
        return Sightings(*(getattr(self, column.name)[rows] for column in fields(self)))

    def tracked(self, noise: MeasuredNoise) -> "Sightings":
        """Replace the labels by numbers of cones, which are tracked by dead reckoning."""
        rays = replace(noise, along=noise.along or FIRST_ALONG, across=noise.across or FIRST_ACROSS)
        covariances = rays.covariances(self.point, inflated=False)
        assert covariances is not None
        points = to_map(noise.corrected(self.point, self.twist), self.pose)
        cones = Tracks(GATE_LEAST, most=GATE_MOST / GATE_LEAST, sigmas=3.5)
        return replace(self, cone=cones.add(points, rotated(covariances, self.pose[:, 2]), self.cone, self.t))


# --- constants and noise of a sensor of cones --------------------------------------------------------------

PRIOR: Final = np.array([0.1, 0.1, 0.3, 0.3, 0.5, 0.02, 0.02])
"""Prior standard deviations of the constants: errors of the sensor (rad, m, s, -, m), bend of its ranges
(1/m) and bias of the yaw rate (rad/s). Without the bend, yaw, lateral offset and scale would absorb it."""
OF_BEND: Final = SENSOR_SIZE  # index of the bend among the constants
PASSES: Final = 4  # passes over the cycles, each of which tracks the cones again
ROUNDS_FIRST: Final = 5  # alternations of errors, noise and weights in a pass
ROUNDS_AGAIN: Final = 3  # alternations in a pass that starts from measured noise, nearly converged
CLUSTER_TIME: Final = 3.0  # time (s) over which errors of the odometry are correlated
NOISE_HUBER: Final = 2.0  # threshold of Huber's loss (sigmas)
MIN_ROWS: Final = 60  # least number of sightings with a reference from which noise is estimated
NEAR_SHARE: Final = 0.6  # references of a sighting: sightings of its cone within this share of its range
BINS: Final = 8  # largest number of range bins
STAY_TIMES: Final = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0)  # candidate correlation times (s)
LAGS: Final = (0.05, 0.3, 0.6, 1.0, 1.6, 2.5, 4.0)  # edges of the lag bins of the correlation (s)
MODEL_ERROR: Final = 0.05  # relative error of the linear model, one sigma
LEAST_NOISE: Final = (0.02, 0.002)  # least noise along the ray (m) and across it (rad): cones have a size

Rays = tuple[RayNoise, RayNoise]
"""Noise along the ray and across it."""


@dataclass(eq=False)
class _Cones:
    """Sightings of cones with enough of them, sorted by cone, with the linear model `p + A b`, map frame."""

    table: Sightings
    begins: IntArray  # (c,) row of each cone's first sighting
    counts: IntArray  # (c,) number of its sightings
    axes: Array  # (2, n, 2) unit vectors along the ray and across it, map frame
    points: Array  # (n, 2) sightings p in m, map frame by dead reckoning
    ranges: Array  # (n,) measured range of the cone, without noise from the second round on (m)
    columns: Array  # (n, 2, 7) derivatives A by the constants (`PRIOR`)

    def on_axes(self, off: Array, rows: IntArray | slice = slice(None)) -> Array:
        """Return the components (2, k) of offsets (k, 2), map frame, along and across the rays of `rows`."""
        return np.array([(off * axis[rows]).sum(axis=1) for axis in self.axes])

    def sigmas(self, noise: Rays) -> Array:
        """Return the standard deviations (2, n) of the sightings along and across their rays, in m."""
        return np.array([one.sigmas(self.ranges) for one in noise])


def _cones(sightings: Sightings) -> _Cones | None:
    """Return the cones seen at least five times in motion, or None if they are too few."""
    speed = np.hypot(sightings.twist[:, 0], sightings.twist[:, 1])
    moving = speed > MIN_SPEED_SHARE * np.median(speed) if len(speed) else np.zeros(0, bool)
    count = np.bincount(sightings.cone[moving]) if moving.any() else np.zeros(1, np.intp)
    chosen = np.flatnonzero(moving)
    chosen = chosen[count[sightings.cone[chosen]] >= 5]
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


def line_through(ranges: Array, sigma: Array) -> Array:
    """Minimize `sum ((a + b r) / sigma - 1)^2` over `a, b >= 0` for sigmas (k,) at ranges r (k,)."""
    columns = np.stack([np.ones(len(ranges)), ranges], axis=1) / sigma[:, None]
    line = np.linalg.lstsq(columns, np.ones(len(sigma)), rcond=None)[0]
    if (line >= 0.0).all():
        return np.asarray(line)
    share = columns.sum(axis=0) / (columns**2).sum(axis=0)  # of either alone
    best = int(((share * columns - 1.0) ** 2).sum(axis=0).argmin())
    return np.asarray(share * (np.arange(2) == best))


def _staying(
    i: IntArray, j: IntArray, lag: Array, place: IntArray, off: Array, reference: Array, sigma: Array
) -> tuple[float, float]:
    """Return share of the variance and correlation time (s) of the correlated part of errors `off` (k,)."""
    whitened, own = np.clip(off / sigma, -3.0, 3.0), reference / sigma**2
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


def _noise_by_range(cones: _Cones, errors: Array, noise: Rays, odometry: Array) -> Rays | None:
    """Return the noise along and across the ray by range, with its correlation; None for too few sightings.

    Sightings are compared with nearer ones of their cone, which are within 0.6 of their range and 6 s, over
    which odometry is trusted. The offsets (2, k) are corrected for the constant errors (7,), and have the
    variances of these references and of the odometry, a random walk (3,) (m, m, rad / sqrt(s)), as well.
    """
    points, sigmas, table = cones.points + cones.columns @ errors, cones.sigmas(noise), cones.table
    weight, values = 1.0 / (sigmas**2).mean(axis=0), np.column_stack([points, *sigmas])
    sought = NEAR_SHARE, 6.0
    rows, references, means = kernels.references(table.cone, table.t, cones.ranges, weight, values, sought)
    if len(rows) < MIN_ROWS:
        return None
    ranges, offsets = cones.ranges[rows], cones.on_axes(points[rows] - means[:, 1:3], rows)
    across = odometry[1] ** 2 + (odometry[2] * ranges) ** 2
    known = np.array([odometry[0] ** 2 * means[:, 0], across * means[:, 0]])
    for axis, one in enumerate(noise):
        known[axis] += means[:, 3 + axis] ** 2 * np.maximum(1.0 / references, one.share)
    # ordered pairs of sightings i, j of one cone with a lag within `LAGS`; they are sorted by cone
    firsts, sizes = runs(table.cone[rows])
    repeats = np.repeat(sizes, sizes)
    i = np.repeat(np.arange(len(rows)), repeats)
    nth = np.arange(len(i)) - np.repeat(np.cumsum(repeats) - repeats, repeats)
    j = np.repeat(np.repeat(firsts, sizes), repeats) + nth
    lag = table.t[rows][j] - table.t[rows][i]
    inside = (lag >= LAGS[0]) & (lag < LAGS[-1])
    pairs = i[inside], j[inside], lag[inside], np.digitize(lag[inside], LAGS)
    order, bins = np.argsort(ranges), np.arange(max(min(BINS, len(rows) // (MIN_ROWS // 2)), 2))
    counts = len(rows) // len(bins) + (bins < len(rows) % len(bins))  # bins of equal count, by range
    begins, found = counts.cumsum() - counts, list[RayNoise]()
    middle = np.add.reduceat(ranges[order], begins) / counts
    floors = (LEAST_NOISE[0], 0.0), (0.0, LEAST_NOISE[1])
    for off, variance, least in zip(offsets, known, floors, strict=True):
        size = np.abs(off[order])
        size = size[np.lexsort((size, np.repeat(bins, counts)))]
        medians = 0.5 * (size[begins + (counts - 1) // 2] + size[begins + counts // 2])
        scatter = (MAD * medians) ** 2
        variances = scatter - np.add.reduceat(variance[order], begins) / counts
        sigma = np.sqrt(np.clip(variances, 0.25 * scatter, 4.0 * scatter))
        line = RayNoise(np.maximum(line_through(middle, sigma), least))
        share, time = _staying(*pairs, off, variance, line.sigmas(ranges))
        share = (len(sizes) * share + 8.0 * 0.5) / (len(sizes) + 8.0)  # a prior of half, worth eight cones
        found.append(replace(line, share=share, time=time))
    return found[0], found[1]


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
        """Find the constants b (7,) by least squares, then noise and weights; the result of the last round.

        The cones' positions, weighted means of `p + A b`, are eliminated. Ranges and derivatives are those at
        positions without noise from then on: noisy ranges would bias the weights towards short sightings and
        shrink the estimated errors.
        """
        walk, noise, table = self._found.odometry * np.sqrt(self._found.interval), self._noise, cones.table
        by_ray, by_side = cones.axes[:, :, :, None] * cones.axes[:, :, None, :]
        along, across = (self._weights / cones.sigmas(noise) ** 2)[:, :, None, None]
        information = along * by_ray + across * by_side
        columns, points, own, vectors = kernels.centred(
            cones.begins, information, cones.columns, cones.points
        )
        covariance = np.asarray(np.linalg.inv(own.sum(axis=0) + np.diag(PRIOR**-2)), np.float64)
        errors = -covariance @ vectors.sum(axis=0)
        middle = np.add.reduceat(table.t, cones.begins) / cones.counts
        spread, off = clustered(middle, vectors + own @ errors, covariance), points + columns @ errors
        seen = table.point - in_vehicle(off, table.pose)
        columns = derivatives_by_constants(table, np.repeat(cones.begins, cones.counts), seen)
        cones = self._cones = replace(cones, ranges=np.hypot(*seen.T), columns=columns)
        self._weights = huber_weights(np.hypot(*(cones.on_axes(off) / cones.sigmas(noise))), NOISE_HUBER) ** 2
        # beyond, only underestimated ranges are in reach; a cone seen only there still has a position
        self._weights[cones.ranges > 0.8 * FOLLOW_RANGE] = 1e-6
        found = _noise_by_range(cones, errors, noise, walk)
        if found is None:
            return self._passed(self._found)
        self._noise, self._rounds = found, self._rounds - 1
        if self._rounds:
            return None
        stamps = np.unique(self._sightings.t)
        counts = int(np.median(cones.counts)), float(np.median(np.diff(stamps)))
        # the constant part of a cone's error shifts its position; only the rest biases the constants
        stays = max(one.inflation_of_slope(*counts) for one in found)
        sigmas = np.sqrt(np.maximum(stays * np.diag(covariance), np.diag(spread)))
        per_cycle = len(self._sightings.t) / len(stamps)
        return self._passed(
            with_detections(self._found, found, errors, sigmas, table.t, (*counts, per_cycle))
        )

    def _passed(self, found: MeasuredNoise) -> MeasuredNoise | None:
        self._passes -= 1
        self._found, self._cones = found, None
        return None if self._passes else found


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
