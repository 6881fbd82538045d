"""The gate, followed cones, scan matching, and the measurement of noise in numpy."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.noise import huber_weights
from pathspace_graph.factors.se2 import left_of, rotation
from pathspace_graph.factors.sensor import SENSOR_SIZE, by_bend, by_sensor
from pathspace_graph.front_end.measurement import OF_BEND, PRIOR, pairs, runs
from pathspace_graph.front_end.sightings import Cones

from .measuring import to_map


def usable(points: Array, covariances: Array, limits: tuple[float, ...]) -> tuple[BoolArray, BoolArray]:
    """Return which points (m, 2) are where a sensor sees, and which covariances (m, 2, 2) are possible."""
    min_range, max_range, asymmetry, determinant, min_sigma, max_sigma = limits
    distance = np.hypot(points[:, 0], points[:, 1])
    near = (distance >= min_range) & (distance <= max_range)
    xx, xy, yx, yy = covariances.reshape(-1, 4).T
    with np.errstate(over="ignore", invalid="ignore"):
        det = xx * yy - xy * yx
        largest = 0.5 * (xx + yy) + np.hypot(0.5 * (xx - yy), xy)
        good = (xx > 0.0) & (yy > 0.0) & (np.abs(xy - yx) <= asymmetry * largest)
        good &= (det > determinant * xx * yy) & (det >= min_sigma**2 * largest)
        good &= largest <= max_sigma**2
    return np.asarray(near), np.asarray(good)


def followed(
    begins: IntArray,
    stamps: Array,
    places: Array,
    points: Array,
    labels: IntArray,
    ranges: Array,
    along: Array,
    across: Array,
    cones: Cones,
    count: int,
    limits: tuple[float, float, float],
) -> tuple[IntArray, Cones, int]:
    """Return the number (m,) of the cone of each detection, or -1, the cones then, and their count so far."""
    numbers, (max_age, *weights) = np.full(len(points), -1), limits
    for k, t in enumerate(stamps.tolist()):
        known, kinds, nearest, last, own = (column[cones[3] > t - max_age] for column in cones)
        rows, size = slice(begins[k], begins[k + 1]), len(own)
        gates = along[rows], across[rows]
        index, known, nearest = _assigned(
            points[rows], labels[rows], ranges[rows], places[k], *gates, known, kinds, nearest, weights
        )
        new, first = np.unique(index[index >= size], return_index=True)
        first = np.flatnonzero(index >= size)[first]
        last[index[(index >= 0) & (index < size)]] = t
        added = points[rows][first], labels[rows][first], ranges[rows][first], np.full(len(new), t)
        columns = (known, kinds, nearest, last, own), (*added, count + np.arange(len(new)))
        known, kinds, nearest, last, own = map(np.concatenate, zip(*columns, strict=True))
        cones, count = (known, kinds, nearest, last, own), count + len(new)
        numbers[rows] = np.append(own, -1)[index]
    return numbers, cones, count


def _assigned(
    points: Array,
    labels: IntArray,
    ranges: Array,
    place: Array,
    along: Array,
    across: Array,
    known: Array,
    known_labels: IntArray,
    nearest: Array,
    weights: Sequence[float],
) -> tuple[IntArray, Array, Array]:
    """Return the cone of each detection at points (m, 2), and places and least ranges of the known cones.

    A detection with gates along and across its ray (m,) from a place (2,) is of the nearest known cone (n,)
    of its label in its gate. The others are new cones from n on, each of the first of those beside it, or -1
    where that one is not a cone of its own. A cone goes to its detections by the weights (`FOLLOWING`).
    """
    index, least, moved = np.full(len(points), -1), nearest.copy(), known.copy()
    if len(known):
        square = _gated_squares(points, known, place, along, across)
        square[labels[:, None] != known_labels] = np.inf
        best = square.argmin(axis=1)
        near = square[np.arange(len(points)), best] < 1.0
        index[near] = best[near]
    rows = np.flatnonzero(index >= 0)
    own, inverse, counts = np.unique(index[rows], return_inverse=True, return_counts=True)
    mean, closest = np.zeros((len(own), 2)), np.full(len(own), np.inf)
    np.add.at(mean, inverse, points[rows] / counts[inverse, None])
    np.minimum.at(closest, inverse, ranges[rows])
    moved[own] += np.where(closest <= nearest[own], *weights)[:, None] * (mean - moved[own])
    least[own] = np.minimum(nearest[own], closest)
    new = np.flatnonzero(index < 0)
    if len(new):
        same = _gated_squares(points[new], points[new], place, along[new], across[new]) < 1.0
        first = (same & (labels[new][:, None] == labels[new])).argmax(axis=1)
        is_first = first == np.arange(len(new))
        number = np.where(is_first, len(known) + np.cumsum(is_first) - 1, -1)
        index[new] = number[first]
    return index, moved, least


def _gated_squares(points: Array, others: Array, place: Array, along: Array, across: Array) -> Array:
    """Return `(a_ij / along_i)^2 + (c_ij / across_i)^2` (m, n) on the rays from a place (2,)."""
    ray = points - place
    ray = ray / np.maximum(np.hypot(ray[:, 0], ray[:, 1]), np.finfo(float).tiny)[:, None]
    off = others - points[:, None]
    a = off[:, :, 0] * ray[:, :1] + off[:, :, 1] * ray[:, 1:]
    c = off[:, :, 1] * ray[:, :1] - off[:, :, 0] * ray[:, 1:]
    return np.asarray((a / along[:, None]) ** 2 + (c / across[:, None]) ** 2)


def matched(
    recent: Array,
    points_vehicle: Array,
    variances: Array,
    start: Array,
    reaches: Sequence[float],
    limits: tuple[float, ...],
) -> tuple[Array, Array, BoolArray, float]:
    """Return the pose (3,) of `match`, and information (3, 3), matches (m,) and cost of its last step."""
    pose, (farthest, min_weight, huber, sigma_cone, min_matched, least_share) = start.copy(), limits
    for reach in reaches:
        points = to_map(points_vehicle, pose[None])
        means, weights = weighted_means(points, recent, reach, farthest)
        matched = weights > min_weight
        off, arm = (points - means)[matched], (points - pose[:2])[matched]
        precision = 1.0 / (variances[matched] * (1.0 + 1.0 / weights[matched]) + sigma_cone**2)
        square = (off * off).sum(axis=1)
        precision *= huber_weights(np.sqrt(square * precision), huber)
        (ax, ay), (ex, ey) = arm.T, off.T
        w, wx, wy = precision.sum(), -(precision @ ay), precision @ ax
        turning = precision @ (ax * ax + ay * ay)
        information = np.array([[w, 0.0, wx], [0.0, w, wy], [wx, wy, turning]])
        gradient = np.array([precision @ ex, precision @ ey, precision @ (ax * ey - ay * ex)])
        if matched.sum() < min_matched:
            break
        regular = information + np.diag(least_share * information.diagonal())
        pose = pose - np.linalg.solve(regular, gradient)
    return pose, information, matched, float(square @ precision)


def weighted_means(points: Array, recent: Array, reach: float, farthest: float) -> tuple[Array, Array]:
    """Return means (m, 2) of recent points by `exp(-d^2 / 2 reach^2)`, and the sums of weights."""
    dx = points[:, 0, None] - recent[:, 0]
    dy = points[:, 1, None] - recent[:, 1]
    square = (dx * dx + dy * dy) / reach**2
    weights = np.where(square < farthest**2, np.exp(-0.5 * square), 0.0)
    total = weights.sum(axis=1)
    return (weights @ recent) / np.maximum(total, np.finfo(float).tiny)[:, None], total


def off_prediction(
    pose: Array, information: Array, excess: float, predicted: Array, covariance: Array
) -> tuple[Array, Array]:
    """Return how far a match, of variance times `excess`, is off a prediction, and its covariance."""
    turn = np.eye(3)
    turn[:2, :2] = rotation(predicted[2]).T
    return turn @ (pose - predicted), turn @ (excess * np.linalg.inv(information)) @ turn.T + covariance


def squared(off: Array, covariance: Array, shifts: Array, errors: Array) -> float:
    """Return `d' (K + S P S')^-1 d` of an offset d (3,) with K (3, 3), S (3, 2) and P (2, 2)."""
    return float(off @ np.linalg.solve(covariance + shifts @ errors @ shifts.T, off))


def learned(
    mean: Array, errors: Array, drift: Array, off: Array, covariance: Array, shifts: Array, share: float
) -> tuple[Array, Array]:
    """Return mean (2,) and covariance (2, 2) of the errors after a measurement that counts by a share."""
    weighted = share * np.linalg.solve(covariance, shifts).T
    known = np.asarray(np.linalg.inv(np.linalg.inv(errors + drift) + weighted @ shifts))
    return mean + known @ weighted @ off, known


def by_constants(
    seen: Array, twists: Array, poses: Array, by_bias: Array, first: IntArray, bends_from: float
) -> Array:
    """Return the derivatives (n, 2, 7) of sightings at points (n, 2), vehicle frame, in the map frame."""
    then, moved = by_bias[first], poses[:, :2] - poses[first, :2]
    c, s = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
    (x, y), (ahead, left) = by_sensor(seen, twists).transpose(1, 0, 2), np.hsplit(seen, 2)
    columns, turned = np.empty((len(seen), 2, len(PRIOR))), by_bias - then
    columns[:, 0, :SENSOR_SIZE], columns[:, 1, :SENSOR_SIZE] = c * x - s * y, s * x + c * y
    in_map = np.concatenate([c * ahead - s * left, s * ahead + c * left], axis=1)
    columns[:, :, OF_BEND] = -by_bend(seen)[:, None] * in_map
    columns[:, :, -1] = turned[:, :2] - then[:, 2:] * left_of(moved) + turned[:, 2:] * left_of(in_map)
    return columns


def centred(
    begins: IntArray, information: Array, columns: Array, points: Array
) -> tuple[Array, Array, Array, Array]:
    """Return columns A (n, 2, 7) and points p (n, 2) less each cone's weighted mean, and its sums."""
    counts = np.diff(np.append(begins, len(points)))
    both = np.concatenate([columns, points[:, :, None]], axis=2)
    total = np.linalg.inv(np.add.reduceat(information, begins))
    both -= np.repeat(total @ np.add.reduceat(information @ both, begins), counts, axis=0)
    columns, points = both[:, :, :-1], both[:, :, -1]
    sums = np.add.reduceat(columns.transpose(0, 2, 1) @ information @ both, begins)
    return columns, points, sums[:, :, :-1], sums[:, :, -1]


def references(
    cone: IntArray, t: Array, ranges: Array, weight: Array, values: Array, sought: tuple[float, float]
) -> tuple[IntArray, IntArray, Array]:
    """Return the rows (k,) of sightings with two references or more, their counts, and means (k, 1 + q)."""
    share, time = sought
    i, j = pairs(cone)
    chosen = (np.abs(t[j] - t[i]) < time) & (ranges[j] < share * ranges[i])
    i, j = i[chosen], j[chosen]
    begins, counts = runs(i)
    rows = i[begins]
    both, total = np.column_stack([np.abs(t[j] - t[i]), values[j]]), np.add.reduceat(weight[j], begins)
    means = np.add.reduceat(weight[j, None] * both, begins) / total[:, None]
    enough = counts >= 2
    return rows[enough], counts[enough], means[enough]
