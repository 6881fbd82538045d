"""Measurement of noise and sensor errors from odometry and detections alone, without a map.

Cones are static, and odometry is accurate over a few seconds, so the sightings of a cone should coincide.
Their residuals depend on range, motion and time: constant errors of the sensor shift all sightings by known
derivatives, white noise scatters them, and correlated errors shift the sightings of one cone together.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from math import comb
from typing import Final

import numpy as np

from pathspace_graph.factors import _kernels as kernels
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.noise import SURE, MeasuredNoise, RayNoise, huber_weights, rays
from pathspace_graph.factors.se2 import compose, in_vehicle, left_of, rotated, se2_exp, to_map
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


def twist_noise(*parts: Odometry) -> tuple[Array, float] | None:
    """Return the noise (k, 3) of a twist by differences of second to fourth order, and their interval (s).

    The noise by order k is the scaled median absolute difference over `sqrt(binomial(2 k, k))`. The least is
    the white noise; it is not white if orders disagree. None for too few twists.
    """
    odometry = without_repeats(parts)
    twists, orders = odometry.twist.T, list[Array]()
    if len(odometry.t) < MIN_TWISTS:
        return None
    speeds = np.hypot(twists[0], twists[1])
    inside = drives = speeds > MIN_SPEED_SHARE * np.median(speeds)
    for k in (1, 2, 3, 4):
        inside, twists = inside[:-1] & drives[k:], np.diff(twists)
        if k > 1 and inside.sum() >= MIN_TWISTS // 2:
            differences = np.abs(twists[:, inside])
            orders.append(MAD * np.median(differences, axis=1) / np.sqrt(comb(2 * k, k)))
    return (np.array(orders), float(np.median(np.diff(odometry.t)))) if orders else None


# --- sightings of cones ----------------------------------------------------------------------------------

FOLLOW_RANGE: Final = 30.0  # largest range of a tracked cone (m): few cones beyond are seen from near later
GATE_MOST: Final = 3.0  # largest distance of a sighting of a cone (m); a narrow gate would cut off the noise
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
        turned, near = t[0] - t, np.flatnonzero(np.hypot(*points.T) < FOLLOW_RANGE)
        middle = turned[1:] + 0.5 * np.diff(t)
        shift = np.concatenate([np.zeros((1, 2)), np.cumsum(left_of(moved) * middle[:, None], axis=0)])
        own = np.repeat(np.arange(len(seen)), [len(one.labels) for one in seen])[near]
        by_bias = np.column_stack([shift, turned])[own]
        return cls(labels[near], t[own], points[near], twists[own], poses[own], by_bias)

    def where(self, rows: IntArray | BoolArray | slice) -> "Sightings":
        return Sightings(*(getattr(self, column.name)[rows] for column in fields(self)))

    def tracked(self, noise: MeasuredNoise) -> "Sightings":
        """Replace the labels by numbers of cones, which are tracked by dead reckoning."""
        rays = replace(noise, along=noise.along or FIRST_ALONG, across=noise.across or FIRST_ACROSS)
        covariances = rays.covariances(self.point, inflated=False)
        assert covariances is not None
        points = to_map(noise.corrected(self.point, self.twist), self.pose)
        cones = Tracks(0.4, most=GATE_MOST / 0.4, sigmas=3.5)
        return replace(self, cone=cones.add(points, rotated(covariances, self.pose[:, 2]), self.cone, self.t))


# --- constants and noise of a sensor of cones --------------------------------------------------------------

PRIOR: Final = np.array([0.1, 0.1, 0.3, 0.3, 0.5, 0.02, 0.02])
"""Prior standard deviations of the constants: errors of the sensor (rad, m, s, -, m), bend of its ranges
(1/m) and bias of the yaw rate (rad/s). Without the bend, yaw, lateral offset and scale would absorb it."""
OF_BEND: Final = SENSOR_SIZE  # index of the bend among the constants
PASSES: Final = 4  # passes over the cycles, each of which tracks the cones again
ROUNDS: Final = (5, 3)  # alternations in a pass, and in one that starts from measured noise
NOISE_HUBER: Final = 2.0  # threshold of Huber's loss (sigmas)
MIN_ROWS: Final = 60  # least number of sightings with a reference from which noise is estimated
NEAR_SHARE: Final = 0.6  # references of a sighting: sightings of its cone within this share of its range
BINS: Final = 8  # largest number of range bins
STAY_TIMES: Final = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0)  # candidate correlation times (s)
LAGS: Final = (0.05, 0.3, 0.6, 1.0, 1.6, 2.5, 4.0)  # edges of the lag bins of the correlation (s)
MODEL_ERROR: Final = 0.05  # relative error of the linear model, one sigma
MOST_AT_ONCE: Final = 1000  # largest number of sightings of which a round of a pass is one step
LEAST_NOISE: Final = (0.02, 0.002)  # least noise along the ray (m) and across it (rad): cones have a size

Rays = tuple[RayNoise, RayNoise]
"""Noise along the ray and across it."""


def derivatives_by_constants(table: Sightings, first: IntArray, seen: Array) -> Array:
    """Return the derivatives (n, 2, 7) by the constants of sightings at points `seen` (n, 2), vehicle frame.

    The bias of the yaw rate counts from the first sighting of each cone or cell, at rows `first` (n,).
    """
    return kernels.by_constants(seen, table.twist, table.pose, table.by_bias, first, BENDS_FROM)


def runs(groups: IntArray) -> tuple[IntArray, IntArray]:
    """Return the first row (c,) and the size (c,) of each group; equal groups (n,) are adjacent."""
    begins = np.flatnonzero(np.diff(groups, prepend=groups[:1] - 1))
    return begins, np.diff(np.append(begins, len(groups)))


def clustered(middle: Array, scores: Array, covariance: Array) -> Array:
    """Return the cluster-robust covariance `P (sum g g') P` (7, 7) of the constants (White's estimator).

    g sums the scores (c, 7) of the cones seen in a stretch of 3 seconds, by the mean stamp `middle` (c,) of
    each cone, in s. So it includes the errors of the odometry, which are correlated over such a time.
    """
    _, stretch = np.unique(np.floor(middle / 3.0), return_inverse=True)
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


def _pairs(t: Array, begins: IntArray, counts: IntArray) -> tuple[IntArray, IntArray, Array, IntArray]:
    """Ordered pairs of sightings of one cone with a lag within `LAGS`: indices (p,), lag (s), its bin.

    The sightings, at stamps (n,), are sorted by cone: its first row is in `begins` (c,), their number in
    `counts` (c,).
    """
    rows = np.arange(len(t))
    later = np.repeat(begins + counts, counts) - rows - 1  # number of later sightings of the cone of each
    i = np.repeat(rows, later)
    j = np.arange(len(i)) + np.repeat(rows + 1 - (np.cumsum(later) - later), later)
    lag = t[j] - t[i]
    inside = np.flatnonzero((lag >= LAGS[0]) & (lag < LAGS[-1]))
    lag = lag[inside]
    return i[inside], j[inside], lag, np.sum([lag >= edge for edge in LAGS], axis=0)


def _noise_by_range(
    table: Sightings,
    ranges: Array,
    axes: Array,
    points: Array,
    noise: Rays,
    odometry: Array,
    pairs: tuple[IntArray, IntArray, Array, IntArray],
) -> Rays | None:
    """Return the noise along and across the ray by range, with its correlation; None for too few sightings.

    Sightings at `points` (n, 2), map frame, are corrected for the constant errors. They are compared with
    nearer ones of their cone, which are within 0.6 of their range and 6 s, over which odometry is trusted.
    The offsets have the variances of these references and of the odometry, a random walk (3,) (m, m, rad /
    sqrt(s)), as well.
    """
    sigmas = sigmas_by_range(noise, ranges)
    weight, values = 1.0 / (sigmas**2).mean(axis=0), np.column_stack([points, *sigmas])
    sought = NEAR_SHARE, 6.0
    rows, references, means = kernels.references(table.cone, table.t, ranges, weight, values, sought)
    if len(rows) < MIN_ROWS:
        return None
    cones, ranges = len(runs(table.cone[rows])[0]), ranges[rows]
    offsets = on_axes(points[rows] - means[:, 1:3], axes.take(rows, axis=1))
    across = odometry[1] ** 2 + (odometry[2] * ranges) ** 2
    known = np.array([odometry[0] ** 2 * means[:, 0], across * means[:, 0]])
    for axis, one in enumerate(noise):
        known[axis] += means[:, 3 + axis] ** 2 * np.maximum(1.0 / references, one.share)
    # those of the pairs that have references, and how many have each lag
    number = np.full(len(table.t), -1)
    number[rows] = np.arange(len(rows))
    i, j = number[pairs[0]], number[pairs[1]]
    both = np.flatnonzero((i >= 0) & (j >= 0))
    i, j, lag, place = i[both], j[both], pairs[2][both], pairs[3][both]
    of_lag = np.bincount(place, minlength=len(LAGS))
    enough = np.flatnonzero(of_lag >= MIN_ROWS // 2)
    lags, roots = np.bincount(place, lag)[enough] / of_lag[enough], np.sqrt(of_lag[enough])
    model = np.exp(-lags / np.array(STAY_TIMES)[:, None])  # correlations by lag, a row for each time
    # bins of equal count, by range
    order, bins = np.argsort(ranges), max(min(BINS, len(rows) // (MIN_ROWS // 2)), 2)
    counts = len(rows) // bins + (np.arange(bins) < len(rows) % bins)
    begins, found = counts.cumsum() - counts, list[RayNoise]()
    middle = np.add.reduceat(ranges[order], begins) / counts
    size = np.full((bins, counts[0]), np.inf)
    floors = (LEAST_NOISE[0], 0.0), (0.0, LEAST_NOISE[1])
    for off, variance, least in zip(offsets, known, floors, strict=True):
        size[np.arange(counts[0]) < counts[:, None]] = np.abs(off[order])
        size.sort(axis=1)
        medians = 0.5 * (size[range(bins), (counts - 1) // 2] + size[range(bins), counts // 2])
        scatter = (MAD * medians) ** 2
        variances = scatter - np.add.reduceat(variance[order], begins) / counts
        sigma = np.sqrt(np.clip(variances, 0.25 * scatter, 4.0 * scatter))
        line = RayNoise(np.maximum(line_through(middle, sigma), least))
        share, time = 0.0, 1.0  # of the correlated part
        if len(enough):
            sigma = line.sigmas(ranges)
            whitened, own = np.clip(off / sigma, -3.0, 3.0), variance / sigma**2
            scale = max(float((whitened**2 - own).mean()), 0.25)
            product = (whitened[i] * whitened[j] - 0.5 * (own[i] + own[j])) / scale
            correlations = np.bincount(place, product)[enough] / of_lag[enough]
            shares = np.clip((roots * model) @ correlations / (roots * model**2).sum(axis=1), 0.0, 1.0)
            best = int((roots * (correlations - shares[:, None] * model) ** 2).sum(axis=1).argmin())
            share, time = float(shares[best]), STAY_TIMES[best]
        share = (cones * share + 8.0 * 0.5) / (cones + 8.0)  # a prior of half, worth eight cones
        found.append(replace(line, share=share, time=time))
    return found[0], found[1]


def measured_by_cones(cycles: Sequence[SeenCycle], found: MeasuredNoise) -> Iterator[MeasuredNoise | None]:
    """Measure noise and constants in steps short enough for a perception cycle: None after each, then both.

    Start with the cycles of a drive and an estimate, which has the noise of the odometry at least. Each pass
    tracks the cones with the estimate so far, then alternates between constants, noise and weights.
    """
    sightings, walk = Sightings.of(cycles), found.odometry * np.sqrt(found.interval)
    for k in range(1 if found.along else PASSES):
        if k or len(sightings.t) > MOST_AT_ONCE:
            yield None
        table = _of_cones(sightings.tracked(found))
        if len(table.t) < MIN_ROWS:
            continue
        if len(table.t) > MOST_AT_ONCE:
            yield None
        begins, counts = runs(table.cone)
        first, pairs = np.repeat(begins, counts), _pairs(table.t, begins, counts)
        axes = map_rays(table)
        squares = axes[:, :, :, None] * axes[:, :, None, :]
        points, ranges = to_map(table.point, table.pose), np.hypot(*table.point.T)
        columns = derivatives_by_constants(table, first, table.point)
        noise, weights = (found.along or FIRST_ALONG, found.across or FIRST_ACROSS), np.ones(len(ranges))
        for _ in range(ROUNDS[found.along is not None]):
            yield None
            # Find the constants b by least squares on the linear model `p + A b` of the sightings. The
            # cones' positions, weighted means of it, are eliminated.
            information = np.einsum("an,anij->nij", weights / sigmas_by_range(noise, ranges) ** 2, squares)
            columns, off, own, vectors = kernels.centred(begins, information, columns, points)
            covariance = np.asarray(np.linalg.inv(own.sum(axis=0) + np.diag(PRIOR**-2)), np.float64)
            errors = -covariance @ vectors.sum(axis=0)
            off = off + np.tensordot(columns, errors, 1)
            # Ranges and derivatives are those at positions without noise from now on: noisy ranges would bias
            # the weights towards short sightings and shrink the estimated errors.
            seen = table.point - in_vehicle(off, table.pose)
            ranges, columns = np.hypot(*seen.T), derivatives_by_constants(table, first, seen)
            weights = (
                huber_weights(np.hypot(*(on_axes(off, axes) / sigmas_by_range(noise, ranges))), NOISE_HUBER)
                ** 2
            )
            # beyond, only underestimated ranges are in reach; a cone seen only there still has a position
            weights[ranges > 0.8 * FOLLOW_RANGE] = 1e-6
            if len(ranges) > MOST_AT_ONCE:
                yield None
            at = points + np.tensordot(columns, errors, 1)
            by_range = _noise_by_range(table, ranges, axes, at, noise, walk, pairs)
            if by_range is None:
                break
            noise = by_range
        else:
            middle, often = np.add.reduceat(table.t, begins) / counts, frequency(sightings.t, counts)
            spread = clustered(middle, vectors + own @ errors, covariance)
            # the constant part of a cone's error shifts its position; only the rest biases the constants
            stays = max(one.inflation_of_slope(*often[:2]) for one in noise)
            sigmas = np.sqrt(np.maximum(stays * np.diag(covariance), np.diag(spread)))
            found = with_detections(found, noise, errors, sigmas, table.t, often)
    yield found


def _of_cones(sightings: Sightings) -> Sightings:
    """Return the sightings in motion of the cones with at least five of them, sorted by cone."""
    speed = np.hypot(sightings.twist[:, 0], sightings.twist[:, 1])
    moving = np.flatnonzero(speed > MIN_SPEED_SHARE * np.median(speed)) if len(speed) else np.zeros(0, int)
    cone = sightings.cone[moving]
    enough = (np.bincount(cone, minlength=1) >= 5)[cone]
    return sightings.where(moving[enough][np.argsort(cone[enough], kind="stable")])


def map_rays(table: Sightings) -> Array:
    """Unit vectors (2, n, 2) along the rays and across them, map frame."""
    ray = to_map(rays(table.point)[1], table.pose * [0.0, 0.0, 1.0])
    return np.array([ray, left_of(ray)])


def on_axes(off: Array, axes: Array) -> Array:
    """Components (2, n) of offsets (n, 2) along and across the rays, given their unit vectors (2, n, 2)."""
    return np.asarray(axes[:, :, 0] * off[:, 0] + axes[:, :, 1] * off[:, 1])


def sigmas_by_range(noise: Rays, ranges: Array) -> Array:
    """Standard deviations (2, n) of sightings at ranges (n,) along and across their rays, in m."""
    return np.array([one.sigmas(ranges) for one in noise])


def frequency(t: Array, counts: IntArray) -> tuple[int, float, float]:
    """Detections per cone or cell (median of `counts` (c,)), time between cycles (s), detections per cycle.

    The stamps (n,) in s are those of all detections.
    """
    stamps = np.unique(t)
    return int(np.median(counts)), float(np.median(np.diff(stamps))), len(t) / len(stamps)


def with_detections(
    found: MeasuredNoise,
    noise: Rays,
    errors: Array,
    sigmas: Array,
    t: Array,
    often: tuple[int, float, float],
) -> MeasuredNoise:
    """Return `found` with the noise of detections at stamps t (n,), constants (7,) and `frequency`."""
    sigmas = np.hypot(sigmas, MODEL_ERROR * np.abs(errors))
    is_bent = np.abs(errors[OF_BEND]) > SURE * sigmas[OF_BEND]
    count, period, per_cycle = often
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
