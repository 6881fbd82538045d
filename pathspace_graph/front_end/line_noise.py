"""Measurement of noise and sensor errors from points of lines, as `measurement` does it from cones.

A point of a line is not met again, but the line is: its points in a small cell lie on a parabola, wherever
they were seen from. What is left across the parabola shows the constant errors and the noise: along the ray
where the ray meets the line steeply, across the ray where it runs beside the line.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
import scipy  # which imports its modules when they are used

from pathspace_graph.copies import Copyable
from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.noise import MeasuredNoise, RayNoise, huber_weights, ray_axes
from pathspace_graph.factors.se2 import left_of, rotations, to_map
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
    line_through,
    runs,
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
    cell = np.floor(
        (to_map(table.point, table.pose) + derivatives_by_constants(table, at, table.point) @ errors) / CELL
    )
    cell = np.column_stack([cell, table.cone])
    order = np.lexsort((table.t, *cell.T))
    cell, t = cell[order], table.t[order]
    new = np.diff(t, prepend=-np.inf) > RECKONED
    new |= (np.diff(cell, axis=0, prepend=np.nan) != 0.0).any(axis=1)
    number = np.cumsum(new) - 1
    ranges = np.hypot(*table.point[order].T)
    begins, counts = runs(number)
    nearest, farthest = np.minimum.reduceat(ranges, begins), np.maximum.reduceat(ranges, begins)
    chosen = ((counts >= 8) & (nearest < NEAR_SHARE * farthest))[number]
    table = replace(table.where(order[chosen]), cone=number[chosen])
    return table, *runs(table.cone)


def fit(
    table: Sightings, errors: Array, noise: Rays, walk: Array
) -> tuple[Sightings, IntArray, Array, Array, Rays] | None:
    """Fit parabolas and constants by least squares, and the noise that is left across the parabolas.

    The odometry walks (3,) by m, m and rad in the root of a second. Returned are the points in cells, the
    number (c,) in each cell, the constants (7,) of `measurement:PRIOR`, their standard deviations, and the
    noise along and across the ray by range; None if too few points determine them. The square of what is left
    has the expectation `(1 - leverage) sum_k share_k (a_k^2 + b_k^2 r^2)`, which is linear in the squares of
    the noise: the shares are those of the directions along and across the ray in the normal, squared.
    """
    table, begins, counts = in_cells(table, errors)
    if len(table.t) < MIN_ROWS:
        return None
    columns = derivatives_by_constants(table, np.repeat(begins, counts), table.point)
    points, ranges = to_map(table.point, table.pose) + columns @ errors, np.hypot(*table.point.T)
    axes = np.einsum("nij,nkj->kni", rotations(table.pose[:, 2]), ray_axes(table.point))
    lag = np.abs(table.t - np.repeat(np.add.reduceat(table.t, begins) / counts, counts))
    drift = lag * np.array([np.full(len(ranges), walk[0] ** 2), walk[1] ** 2 + (walk[2] * ranges) ** 2])
    variances = np.array([one.sigmas(ranges) ** 2 for one in noise]) + drift
    tangents, s, y = _frames(points, 1.0 / variances.sum(axis=0), begins, counts)
    basis = np.stack([np.ones(len(s)), s, s**2], axis=1)
    slopes, weights, cell = np.zeros(len(s)), np.ones(len(s)), np.repeat(np.arange(len(counts)), counts)
    for _ in range(4):  # with the slopes and weights of the step before
        normals = left_of(tangents) - slopes[:, None] * tangents
        shares = np.array([(normals * axis).sum(axis=1) ** 2 for axis in axes])
        variance = (shares * variances).sum(axis=0)
        weight = weights / variance
        rows = np.einsum("ni,nij->nj", normals, columns)
        rows = np.column_stack([rows, y - rows @ errors])
        weighted = basis * weight[:, None]
        normal = np.add.reduceat(weighted[:, :, None] * basis[:, None], begins) + np.diag(SHAPE)
        inverse = np.linalg.inv(normal)
        shape = inverse @ np.add.reduceat(weighted[:, :, None] * rows[:, None], begins)
        rows -= np.einsum("nk,nkj->nj", basis, shape[cell])
        by_errors = rows[:, :-1]
        covariance = np.linalg.inv(by_errors.T @ (by_errors * weight[:, None]) + np.diag(PRIOR**-2))
        found = -covariance @ (by_errors.T @ (weight * rows[:, -1]))
        off = rows @ np.append(found, 1.0)
        q = (shape @ np.append(found, 1.0))[cell]
        slopes = q[:, 1] + 2.0 * q[:, 2] * s
        weights = huber_weights(off / np.sqrt(variance), NOISE_HUBER) ** 2
    scores = np.add.reduceat((weight * off)[:, None] * by_errors, begins)
    leverage = weight * np.einsum("nk,nkl,nl->n", basis, inverse[cell], basis)
    middle = np.add.reduceat(table.t, begins) / counts
    spread = clustered(middle, scores, covariance)
    sigmas = np.sqrt(np.maximum(np.diag(covariance), np.diag(spread)))
    slow, room = (shares * drift).sum(axis=0), np.maximum(1.0 - leverage, 0.1)
    square = np.minimum(off**2 / (room * variance), 9.0) - slow / variance  # few outliers count for the noise
    model = np.concatenate([shares, shares * ranges**2]).T
    squares = scipy.optimize.nnls(model / variance[:, None], square)[0].reshape(2, 2).T
    middle = np.quantile(ranges, (np.arange(BINS) + 0.5) / BINS)
    lines = [line_through(middle, np.sqrt(np.maximum(a + b * middle**2, 1e-8))) for a, b in squares]
    along = RayNoise(np.maximum(lines[0], (LEAST_NOISE[0], 0.0)))
    across = RayNoise(np.maximum(lines[1], (0.0, LEAST_NOISE[1])))
    return table, counts, found, sigmas, (along, across)


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


class LineMeasurement(Copyable):
    """Measurement of noise by points of lines, in steps short enough for a perception cycle."""

    def __init__(self, cycles: Sequence[SeenCycle], found: MeasuredNoise) -> None:
        """Begin with the cycles of a drive, and with what is known: the noise of the odometry at least.

        Points count if they were seen in motion, up to a number that bounds the time of a round.
        """
        table = Sightings.of(cycles)
        least = MIN_SPEED_SHARE * np.median([np.hypot(*one.twist[:2]) for one in cycles])
        table = table.where(np.hypot(*table.twist[:, :2].T) > least)
        self._points = table.where(slice(None, None, max(-(-len(table.t) // 4000), 1)))
        self._found, self._noise = found, (found.along or FIRST_ALONG, found.across or FIRST_ACROSS)
        self._errors, self._rounds = np.zeros(len(PRIOR)), 8
        if found.along is not None:  # nearly converged
            self._errors, self._rounds = np.array([*found.sensor, found.range_bend, 0.0]), 3

    def advance(self) -> MeasuredNoise | None:
        """Find cells, errors, noise and weights in turn; return what was found in the last round."""
        walk = self._found.odometry * np.sqrt(self._found.interval)
        found = fit(self._points, self._errors, self._noise, walk)
        if found is None:
            return self._found
        table, counts, self._errors, sigmas, self._noise = found
        self._rounds -= 1
        if self._rounds:
            return None
        stamps = np.unique(self._points.t)
        period, per_cycle = float(np.median(np.diff(stamps))), len(self._points.t) / len(stamps)
        seen = int(np.median(counts)), period, per_cycle
        return with_detections(self._found, self._noise, self._errors, sigmas, table.t, seen)
