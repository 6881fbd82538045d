"""Measurement of noise and sensor errors from points of lines, as `measurement` does it from cones.

A point of a line is not met again, but the line is: its points in a small cell lie on a parabola, wherever
they were seen from. What is left across the parabola shows the constant errors and the noise: along the ray
where the ray meets the line steeply, across the ray where it runs beside the line.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Final

import numpy as np
import scipy  # which imports its modules when they are used

from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.noise import MeasuredNoise, RayNoise, huber_weights
from pathspace_graph.factors.se2 import left_of, to_map
from pathspace_graph.mapping.tracks import RECKONED

from .measurement import (
    BINS,
    FIRST_ACROSS,
    FIRST_ALONG,
    LEAST_NOISE,
    MIN_ROWS,
    MIN_SPEED_SHARE,
    NEAR_SHARE,
    NOISE_HUBER,
    PRIOR,
    Rays,
    SeenCycle,
    Sightings,
    clustered,
    derivatives_by_constants,
    frequency,
    line_through,
    map_rays,
    on_axes,
    runs,
    sigmas_by_range,
    with_detections,
)

CELL: Final = 4.0  # side of the cells (m) in which a line is a parabola; small ones cut off large errors
SHAPE: Final = np.array([0.0, 0.25, 10.0])
"""Inverse variances of a weak prior of the parabola `q0 + q1 s + q2 s^2`: sigmas of 2 and of 0.3/m."""


def in_cells(table: Sightings, errors: Array) -> tuple[Sightings, IntArray, IntArray]:
    """Return the points in cells with eight at least from near and far, and first row and size (c,) of these.

    Constant errors (7,) are undone. A cell that is seen again later is another one.
    """
    at = np.arange(len(table.t), dtype=np.intp)
    shift = np.tensordot(derivatives_by_constants(table, at, table.point), errors, 1)
    x, y = np.floor((to_map(table.point, table.pose) + shift) / CELL).astype(np.intp).T
    cell = ((table.cone << 20) + y << 20) + x  # one number, as no drive is 2^19 cells long
    order, new = np.argsort(cell, kind="stable"), np.ones(len(cell), bool)  # in order of time in each cell
    new[1:] = (np.diff(cell[order]) != 0) | (np.diff(table.t[order]) > RECKONED)
    number = np.cumsum(new) - 1
    ranges = np.hypot(*table.point[order].T)
    begins, counts = runs(number)
    nearest, farthest = np.minimum.reduceat(ranges, begins), np.maximum.reduceat(ranges, begins)
    chosen = ((counts >= 8) & (nearest < NEAR_SHARE * farthest))[number]
    table = replace(table.where(order[chosen]), cone=number[chosen])
    return table, *runs(table.cone)


def _frames(points: Array, weight: Array, begins: IntArray, counts: IntArray) -> tuple[Array, Array, Array]:
    """Return the direction (n, 2) of each point's cell, and its places (n,) along and across it (m)."""
    total = np.add.reduceat(weight, begins)
    off = points - np.repeat(
        np.add.reduceat(points * weight[:, None], begins) / total[:, None], counts, axis=0
    )
    xx, xy, yy = (
        np.add.reduceat(weight * a * b, begins)
        for a, b in ((off.T[0], off.T[0]), off.T, (off.T[1], off.T[1]))
    )
    angle = np.repeat(0.5 * np.arctan2(2.0 * xy, xx - yy), counts)
    tangents = np.column_stack([np.cos(angle), np.sin(angle)])
    return tangents, (off * tangents).sum(axis=1), (off * left_of(tangents)).sum(axis=1)


def _fitted(squares: Array, shares: Array, ranges: Array) -> Rays:
    """Fit `sum_k share_k (a_k^2 + b_k^2 r^2)` to squares (n,) of residuals at ranges r (n,).

    The shares (2, n) are those of the noise along and across the ray.
    """
    model = np.concatenate([shares, shares * ranges**2])
    variances = scipy.optimize.nnls(model.T, squares)[0].reshape(2, 2).T
    at = np.quantile(ranges, (np.arange(BINS) + 0.5) / BINS)
    along, across = (line_through(at, np.sqrt(np.maximum(a + b * at**2, 1e-8))) for a, b in variances)
    along, across = np.maximum(along, (LEAST_NOISE[0], 0.0)), np.maximum(across, (0.0, LEAST_NOISE[1]))
    return RayNoise(along), RayNoise(across)


def measured_by_lines(cycles: Sequence[SeenCycle], found: MeasuredNoise) -> Iterator[MeasuredNoise | None]:
    """Measure noise and constants in steps short enough for a perception cycle: None after each, then both.

    Start with the cycles of a drive and an estimate, which has the noise of the odometry at least. Points
    count if they were seen in motion, up to a number that bounds the time of a step. Each round finds cells,
    then parabolas and constants by least squares, and the noise that is left across the parabolas. The square
    of what is left has the expectation `(1 - leverage) sum_k share_k (a_k^2 + b_k^2 r^2)`: the shares are
    those of the directions along and across the ray in the normal, squared.
    """
    table, walk = Sightings.of(cycles), found.odometry * np.sqrt(found.interval)
    least = MIN_SPEED_SHARE * np.median([np.hypot(*one.twist[:2]) for one in cycles])
    moving = np.flatnonzero(np.hypot(*table.twist[:, :2].T) > least)
    seen = table.where(moving[:: max(-(-len(moving) // 4000), 1)])
    noise, again = (found.along or FIRST_ALONG, found.across or FIRST_ACROSS), found.along is not None
    errors = np.array([*found.sensor, found.range_bend, 0.0]) if again else np.zeros(len(PRIOR))
    for _ in range(3 if again else 8):  # nearly converged, or not
        yield None
        table, begins, counts = in_cells(seen, errors)
        if len(table.t) < MIN_ROWS:
            yield found
            return
        columns = derivatives_by_constants(table, np.repeat(begins, counts), table.point)
        points = to_map(table.point, table.pose) + np.tensordot(columns, errors, 1)
        axes, ranges = map_rays(table), np.hypot(*table.point.T)
        middle = np.add.reduceat(table.t, begins) / counts
        drift = np.array([np.full(len(ranges), walk[0] ** 2), walk[1] ** 2 + (walk[2] * ranges) ** 2])
        drift *= np.abs(table.t - np.repeat(middle, counts))
        variances = sigmas_by_range(noise, ranges) ** 2 + drift
        tangents, s, y = _frames(points, 1.0 / variances.sum(axis=0), begins, counts)
        basis, start = np.stack([np.ones(len(s)), s, s**2], axis=1), errors
        slopes, weights = np.zeros(len(s)), np.ones(len(s))
        for _ in range(4):  # with the slopes and weights of the iteration before
            normals = left_of(tangents) - slopes[:, None] * tangents
            shares = on_axes(normals, axes) ** 2
            variance = (shares * variances).sum(axis=0)
            weight = weights / variance
            weighted, rows = basis * weight[:, None], np.einsum("ni,nij->nj", normals, columns)
            rows = np.column_stack([rows, y - rows @ start])
            normal = np.add.reduceat(weighted[:, :, None] * basis[:, None], begins) + np.diag(SHAPE)
            inverse = np.linalg.inv(normal)
            shape = inverse @ np.add.reduceat(weighted[:, :, None] * rows[:, None], begins)
            rows -= np.einsum("nk,nkj->nj", basis, np.repeat(shape, counts, axis=0))
            by_errors = rows[:, :-1]
            covariance = np.linalg.inv(by_errors.T @ (by_errors * weight[:, None]) + np.diag(PRIOR**-2))
            errors = -covariance @ (by_errors.T @ (weight * rows[:, -1]))
            off = rows @ np.append(errors, 1.0)
            q = np.repeat(shape @ np.append(errors, 1.0), counts, axis=0)
            slopes = q[:, 1] + 2.0 * q[:, 2] * s
            weights = huber_weights(off / np.sqrt(variance), NOISE_HUBER) ** 2
        leverage = weight * np.einsum("nk,nkl,nl->n", basis, np.repeat(inverse, counts, axis=0), basis)
        slow, room = (shares * drift).sum(axis=0), np.maximum(1.0 - leverage, 0.1)
        square = np.minimum(off**2 / (room * variance), 9.0) - slow / variance  # outliers hardly count here
        noise = _fitted(square, shares / variance, ranges)
    spread = clustered(middle, np.add.reduceat((weight * off)[:, None] * by_errors, begins), covariance)
    sigmas = np.sqrt(np.maximum(np.diag(covariance), np.diag(spread)))
    yield with_detections(found, noise, errors, sigmas, table.t, frequency(seen.t, counts))
