"""Measurement of noise and sensor errors from odometry and detections alone, without a map.

Cones stand still. Over a few seconds odometry is good enough to lay the sightings of one cone on each other.
What is left depends on range, motion and time: constant errors of the sensor shift all sightings by known
derivatives, noise scatters them, and errors that stay with a cone scatter its sightings together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from pathspace_graph.factors.measured_noise import MeasuredNoise, RayNoise
from pathspace_graph.factors.noise import huber_weights
from pathspace_graph.factors.se2 import left_of, rotations, to_map
from pathspace_graph.factors.sensor import RANGE, SENSOR_SIZE, by_sensor

from .sightings import MAD, MAX_RANGE, MIN_SPEED_SHARE, SeenCycle, Sightings, TwistRecord, follow

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]

DRIFT: Final = np.array([0.05, 0.05, 0.0017])
"""Assumed drift of any odometry (m, m, rad per root of s): 0.5 m and 0.9 degrees after 90 s.

It cannot be measured on an open drive: a cone stays in view for some 3 s, in which an error of the speed of
less than 0.05 m/s is lost in the noise of its detections."""
PRIOR: Final = np.array([0.1, 0.1, 0.3, 0.3, 0.5, 0.02])
"""Weak priors of the sensor's errors (rad, m, s, -, m) and of the yaw rate's bias (rad/s), one sigma."""
FIRST_ALONG: Final = (0.1, 0.04)
FIRST_ACROSS: Final = (0.05, 0.016)
"""Noise that the iteration begins with: m and m/m, then m and rad."""
PASSES: Final = 4
"""Number of times that cones are followed."""
ROUNDS: Final = 5
"""Number of times that errors, noise and weights are found in turn."""
STRETCH: Final = 3.0
"""Time (s) over which errors of the odometry are alike."""
COUNTED: Final = 0.8
"""Cones beyond this share of `MAX_RANGE` hardly count: they are followed only where they seem nearer."""
HARDLY: Final = 1e-6
"""Weight of their sightings. It is not zero, so that a cone seen only there still has a place."""
HUBER: Final = 2.0
MIN_COUNT: Final = 5
"""A cone counts with this number of sightings."""
MIN_ROWS: Final = 60
"""Noise of detections is told from this number of sightings with a reference."""
NEAR: Final = 0.6
"""The reference of a sighting are those of the same cone from less than this share of its range."""
NEAR_TIME: Final = 6.0
"""They are at most this time (s) away, for which odometry is trusted."""
BINS: Final = 8
TIMES: Final = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
"""Correlation times that are tried (s)."""
LAGS: Final = (0.05, 0.3, 0.6, 1.0, 1.6, 2.5, 4.0)
"""Edges of the lags at which correlation is measured (s)."""
MODEL_ERROR: Final = 0.05
"""Share of an error that the linear model may be wrong by, one sigma."""
FIRST_SHARE: Final = 0.5
"""Share of a cone's error that stays with it, as long as hardly any cone says otherwise."""
FIRST_CONES: Final = 8.0
"""That counts as much as this number of cones."""
LEAST: Final = (0.02, 0.002)
"""Least noise along the ray (m) and across it (rad): a cone is no point."""


# --- errors of the sensor --------------------------------------------------------------------------------


@dataclass(eq=False)
class _Cones:
    """Sightings of cones seen often enough, sorted by cone, with their linear model `p + A b` in the map."""

    table: Sightings
    begins: IntArray
    ranges: Array
    """(n,) Range of the cone (m)."""
    ray: Array
    """(n, 2) Unit vector along the ray, map frame."""
    side: Array
    points: Array
    columns: Array
    """(n, 2, 6) Derivatives by the sensor's errors and by the bias of the yaw rate."""

    def seen_at(self, errors: Array, off: Array) -> _Cones:
        """Return the sightings with the ranges of their cones, as errors (6,) leave them `off` (n, 2).

        Weights by a measured range would prefer sightings that came out too short.
        """
        arm = self.points + self.columns @ errors - off - self.table.pose[:, :2]
        return replace(self, ranges=np.maximum(np.hypot(*arm.T), np.finfo(float).tiny))

    def sums(self, values: Array) -> Array:
        """Return the sum of values (n, ...) over each cone."""
        return np.asarray(np.add.reduceat(values, self.begins, axis=0))

    def spread(self, values: Array) -> Array:
        """Return values (c, ...) of the cones for each of their sightings."""
        return np.repeat(values, np.diff(np.append(self.begins, len(self.ranges))), axis=0)


def _cones(sightings: Sightings) -> _Cones | None:
    speed = np.hypot(sightings.twist[:, 0], sightings.twist[:, 1])
    moving = speed > MIN_SPEED_SHARE * np.median(speed) if len(speed) else np.zeros(0, bool)
    count = np.bincount(sightings.cone[moving]) if moving.any() else np.zeros(1, np.intp)
    chosen = np.flatnonzero(moving)
    chosen = chosen[count[sightings.cone[chosen]] >= MIN_COUNT]
    if len(chosen) < MIN_ROWS:
        return None
    table = sightings.where(chosen[np.argsort(sightings.cone[chosen], kind="stable")])
    begins = np.flatnonzero(np.diff(table.cone, prepend=-1))
    ranges = np.maximum(np.hypot(*table.point.T), np.finfo(float).tiny)
    turn = rotations(table.pose[:, 2])
    ray = np.einsum("nij,nj->ni", turn, table.point / ranges[:, None])
    points = to_map(table.point, table.pose)
    turning = table.by_bias[:, :2] + table.by_bias[:, 2:] * left_of(points - table.pose[:, :2])
    sensor = np.einsum("nij,njk->nik", turn, by_sensor(table.point, table.twist))
    columns = np.concatenate([sensor, turning[:, :, None]], axis=2)
    return _Cones(table, begins, ranges, ray, left_of(ray), points, columns)


def _information(cones: _Cones, along: RayNoise, across: RayNoise, weights: Array) -> Array:
    """Return the information (n, 2, 2) of each sighting, map frame."""
    by_ray = cones.ray[:, :, None] * cones.ray[:, None, :] / (along.sigmas(cones.ranges) ** 2)[:, None, None]
    by_side = cones.side[:, :, None] * cones.side[:, None, :]
    by_side /= (across.sigmas(cones.ranges) ** 2)[:, None, None]
    return np.asarray((by_ray + by_side) * weights[:, None, None])


def _solve(cones: _Cones, information: Array, errors: Array, off: Array) -> tuple[Array, Array, Array, Array]:
    """Return errors b (6,), their covariance twice, and what is left (n, 2) of each sighting about its cone.

    It is a Gauss-Newton step from errors (6,) that leave `off` (n, 2). The places of the cones, which are the
    weighted means of `p + A b`, are eliminated. The noise is that of measured detections, so what is left of
    a corrected one counts as `M^-1 r` (`factors.sensor:by_range`): or else a smaller world would fit better.
    The covariances are that of independent sightings, and `_clustered`.
    """
    total = np.linalg.inv(cones.sums(information))
    mean_columns = total @ cones.sums(information @ cones.columns)
    mean_points = (total @ cones.sums(information @ cones.points[:, :, None]))[:, :, 0]
    columns = cones.columns - cones.spread(mean_columns)
    points = cones.points - cones.spread(mean_points)
    slopes = columns.copy()
    slopes[:, :, RANGE.start] += off
    slopes[:, :, RANGE.start + 1] += cones.side * ((cones.side * off).sum(axis=1) / cones.ranges)[:, None]
    weighted = information @ slopes
    prior = np.diag(PRIOR**-2)
    covariance = np.linalg.inv(np.einsum("nik,nil->kl", slopes, weighted) + prior)
    left = points + columns @ errors
    errors = errors - covariance @ (np.einsum("nik,ni->k", weighted, left) + prior @ errors)
    left = points + columns @ errors
    scores = cones.sums(np.einsum("nik,ni->nk", weighted, left))
    return errors, covariance, _clustered(cones, scores, covariance), left


def _clustered(cones: _Cones, scores: Array, covariance: Array) -> Array:
    """Return the covariance (6, 6) of the errors by how much the stretches of the drive disagree.

    With the scores g (c, 6) of the cones summed over stretches of `STRETCH` seconds it is `P (sum g g') P`
    (White's estimator for clusters). Errors of the odometry, which all cones share, are in it.
    """
    middle = cones.sums(cones.table.t) / np.diff(np.append(cones.begins, len(cones.ranges)))
    _, stretch = np.unique(np.floor(middle / STRETCH), return_inverse=True)
    count = int(stretch.max()) + 1
    summed = np.zeros((count, scores.shape[1]))
    np.add.at(summed, stretch, scores)
    return np.asarray(covariance @ (summed.T @ summed) @ covariance * count / max(count - 1, 1))


# --- noise of the detections -----------------------------------------------------------------------------


@dataclass(eq=False)
class _Residuals:
    """What is left of far sightings about nearer ones of the same cone, after the constant errors."""

    rows: IntArray
    offsets: Array
    """(k, 2) Along the ray and across it, m."""
    reference: Array
    """(k, 2) Variance of the reference and of the odometry in between, along and across (m^2)."""


def _residuals(cones: _Cones, errors: Array, noise: tuple[RayNoise, RayNoise], odometry: Array) -> _Residuals:
    """Return the residuals of sightings against nearer ones.

    `odometry` is the drift (3,) by root of s that white noise of the twists makes.
    """
    i, j = pairs(cones.table.cone)
    t, ranges = cones.table.t, cones.ranges
    near = (ranges[j] < NEAR * ranges[i]) & (np.abs(t[j] - t[i]) < NEAR_TIME)
    i, j = i[near], j[near]
    rows, begins, counts = np.unique(i, return_index=True, return_counts=True)
    enough = counts >= 2
    if not enough.any():
        return _Residuals(np.zeros(0, np.intp), np.zeros((0, 2)), np.zeros((0, 2)))
    points = cones.points + cones.columns @ errors
    isotropic = 0.5 * (noise[0].sigmas(ranges) ** 2 + noise[1].sigmas(ranges) ** 2)

    def mean(values: Array) -> Array:
        """Return the weighted mean of values (p, ...) of the pairs over the references of each row."""
        weight = (1.0 / isotropic[j]).reshape(-1, *[1] * (values.ndim - 1))
        return np.asarray(np.add.reduceat(weight * values, begins) / np.add.reduceat(weight, begins))

    lag = mean(np.abs(t[j] - t[i]))
    off = points[rows] - mean(points[j])
    offsets = np.stack([(off * cones.ray[rows]).sum(axis=1), (off * cones.side[rows]).sum(axis=1)], axis=1)
    known = np.stack(
        [odometry[0] ** 2 * lag, (odometry[1] ** 2 + (odometry[2] * ranges[rows]) ** 2) * lag], 1
    )
    for axis, one in enumerate(noise):
        known[:, axis] += mean(one.sigmas(ranges[j])) ** 2 * np.maximum(1.0 / counts, one.share)
    return _Residuals(rows[enough], offsets[enough], known[enough])


def pairs(groups: IntArray) -> tuple[IntArray, IntArray]:
    """Return all ordered pairs of rows of one group, by index; groups (n,) of equal number are neighbours."""
    begins = np.flatnonzero(np.diff(groups, prepend=-1))
    counts = np.diff(np.append(begins, len(groups)))
    repeats = np.repeat(counts, counts)
    i = np.repeat(np.arange(len(groups)), repeats)
    nth = np.arange(len(i)) - np.repeat(np.cumsum(repeats) - repeats, repeats)
    return i, np.repeat(np.repeat(begins, counts), repeats) + nth


def _ray_noise(cones: _Cones, left: _Residuals, axis: int) -> RayNoise:
    """Return the noise along (axis 0) or across (axis 1) the ray by range, and how long it stays."""
    ranges, off, reference = cones.ranges[left.rows], left.offsets[:, axis], left.reference[:, axis]
    order = np.argsort(ranges)
    bins = np.array_split(order, max(min(BINS, len(order) // (MIN_ROWS // 2)), 2))
    middle = np.array([ranges[one].mean() for one in bins])
    scatter = np.array([(MAD * np.median(np.abs(off[one]))) ** 2 for one in bins])
    known = np.array([reference[one].mean() for one in bins])
    sigma = np.sqrt(np.clip(scatter - known, 0.25 * scatter, 4.0 * scatter))
    (begin, growth), _ = nnls(
        np.stack([np.ones(len(middle)), middle], axis=1) / sigma[:, None], np.ones(len(sigma))
    )
    least = (LEAST[0], 0.0) if axis == 0 else (0.0, LEAST[1])
    found = RayNoise(np.maximum([begin, growth], least))
    share, time = _staying(cones, left, axis, found)
    count = len(np.unique(cones.table.cone[left.rows]))
    share = (count * share + FIRST_CONES * FIRST_SHARE) / (count + FIRST_CONES)
    return replace(found, share=share, time=time)


def _staying(cones: _Cones, left: _Residuals, axis: int, noise: RayNoise) -> tuple[float, float]:
    """Return share and correlation time (s) of the errors of a cone that stay with it."""
    sigma = noise.sigmas(cones.ranges[left.rows])
    whitened = np.clip(left.offsets[:, axis] / sigma, -3.0, 3.0)
    own = left.reference[:, axis] / sigma**2
    cone, t = cones.table.cone[left.rows], cones.table.t[left.rows]
    i, j = pairs(cone)
    lag = t[j] - t[i]
    place = np.digitize(lag, LAGS) - 1
    product = whitened[i] * whitened[j] - 0.5 * (own[i] + own[j])
    scale = max(float((whitened**2 - own).mean()), 0.25)
    enough = [k for k in range(len(LAGS) - 1) if (place == k).sum() >= MIN_ROWS // 2]
    if not enough:
        return 0.0, 1.0
    lags = np.array([lag[place == k].mean() for k in enough])
    correlations = np.array([product[place == k].mean() for k in enough]) / scale
    weights = np.sqrt([(place == k).sum() for k in enough])
    best = (np.inf, 0.0, 1.0)
    for time in TIMES:
        model = np.exp(-lags / time)
        share = float(np.clip((weights * model) @ correlations / ((weights * model) @ model), 0.0, 1.0))
        misfit = float((weights * (correlations - share * model) ** 2).sum())
        best = min(best, (misfit, share, time))
    return best[1], best[2]


# --- all of it -------------------------------------------------------------------------------------------


def measure(
    cycles: Sequence[SeenCycle], twists: TwistRecord, known: MeasuredNoise | None
) -> MeasuredNoise | None:
    """Return the noise that the readings show; None where not even the odometry's is known.

    Cones are followed again with the noise and the errors that were found, from those `known` already on.
    """
    white = twists.white()
    if white is None:
        return None
    sigma, interval = white
    found = known or MeasuredNoise(sigma, DRIFT.copy(), interval)
    found = replace(found, odometry=sigma, interval=interval)
    for _ in range(PASSES if known is None or known.along is None else 1):
        found = _measured(follow(cycles, found), found)
    return found


def _measured(sightings: Sightings, found: MeasuredNoise) -> MeasuredNoise:
    """Return the noise with that of the detections, and the errors of the sensor, if enough cones show it."""
    cones = _cones(sightings)
    if cones is None:
        return found
    stamps = np.unique(sightings.t)
    period = float(np.median(np.diff(stamps)))
    walk = found.odometry * np.sqrt(found.interval)
    noise = RayNoise(np.array(FIRST_ALONG)), RayNoise(np.array(FIRST_ACROSS))
    weights = np.ones(len(cones.ranges))
    errors, off = np.zeros(len(PRIOR)), np.zeros((len(cones.ranges), 2))
    for _ in range(ROUNDS):
        information = _information(cones, *noise, weights)
        errors, covariance, clustered, off = _solve(cones, information, errors, off)
        cones = cones.seen_at(errors, off)
        square = ((off * cones.ray).sum(axis=1) / noise[0].sigmas(cones.ranges)) ** 2
        square += ((off * cones.side).sum(axis=1) / noise[1].sigmas(cones.ranges)) ** 2
        weights = huber_weights(np.sqrt(square), HUBER) ** 2
        weights[cones.ranges > COUNTED * MAX_RANGE] = HARDLY
        left = _residuals(cones, errors, noise, walk)
        if len(left.rows) < MIN_ROWS:
            return found
        noise = _ray_noise(cones, left, 0), _ray_noise(cones, left, 1)
    per_cone = np.diff(np.append(cones.begins, len(cones.ranges)))
    count = int(np.median(per_cone))
    stays = max(one.inflation(count, period) for one in noise)
    sigmas = np.sqrt(np.maximum(stays * np.diag(covariance), np.diag(clustered)))
    return replace(
        found,
        along=noise[0],
        across=noise[1],
        count=count,
        period=period,
        per_cycle=len(sightings.t) / len(stamps),
        sensor=errors[:SENSOR_SIZE],
        sensor_sigma=np.hypot(sigmas, MODEL_ERROR * np.abs(errors))[:SENSOR_SIZE],
        seconds=float(np.sum(np.minimum(np.diff(np.unique(cones.table.t)), 1.0))),
    )
