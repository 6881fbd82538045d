"""Measurement of noise and sensor errors from points of lines, as `measurement` does it from cones.

A point of a line is not met again, but the line is: its points in a small cell lie on a parabola, wherever
they were seen from. What is left across the parabola shows the constant errors and the noise: along the ray
where the ray meets the line steeply, across the ray where it runs beside the line.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
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
    LEAST_NOISE,
    MIN_ROWS,
    NEAR_SHARE,
    NOISE_HUBER,
    PRIOR,
    Rays,
    clustered,
    derivatives_by_constants,
    line_through,
    runs,
    with_detections,
)
from .sightings import (
    FIRST_ACROSS,
    FIRST_ALONG,
    MIN_SPEED_SHARE,
    SeenCycle,
    Sightings,
)

CELL: Final = 4.0  # side of the cells (m) in which a line is a parabola; small ones cut off large errors
MOST_POINTS: Final = 4000  # points that are measured on, which bounds the time of a round
FEWEST: Final = 8  # points of a line in a cell
SHAPE: Final = np.array([0.0, 0.25, 10.0])
"""Inverse variances of a weak prior of the parabola `q0 + q1 s + q2 s^2`: sigmas of 2 and of 0.3/m."""
ROUNDS_FIRST: Final = 8  # times that cells, errors, noise and weights are found in turn
ROUNDS_AGAIN: Final = 3  # the same, from what was found before
STEPS: Final = 4  # fits of a round, by the slopes and weights of the one before
CLIPPED: Final = 9.0  # largest whitened square that counts for the noise


@dataclass(frozen=True, eq=False)
class LineFit:
    """Parabolas through the points of each cell, and what is left of the points across them."""

    table: Sightings  # sorted by cell, then by time
    begins: IntArray  # (c,) row of each cell's first point
    counts: IntArray  # (c,) number of its points
    shares: Array  # (2, n) of the directions along and across the ray in the normal, squared
    ranges: Array  # (n,) m
    drift: Array  # (2, n) variances of the odometry along and across the ray since the cell's mean (m^2)
    off: Array  # (n,) from the parabola (m)
    leverage: Array  # (n,) share of each point in the parabola there
    errors: Array  # (7,) constants, see `measurement:PRIOR`
    covariance: Array  # (7, 7) of these, if noise is white
    clustered: Array  # (7, 7) by how much the cells disagree


def sightings_of(cycles: Sequence[SeenCycle]) -> Sightings:
    """Points of lines that were seen in motion, in order of time, with their labels for cells."""
    table = Sightings.of(cycles)
    least = MIN_SPEED_SHARE * np.median([np.hypot(*one.twist[:2]) for one in cycles])
    table = table.where(np.hypot(*table.twist[:, :2].T) > least)
    return table.where(slice(None, None, max(-(-len(table.t) // MOST_POINTS), 1)))


def in_cells(table: Sightings, errors: Array) -> tuple[Sightings, IntArray, IntArray]:
    """Return the points in cells that were seen from near and far, and first row and size (c,) of the cells.

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
    chosen = ((counts >= FEWEST) & (nearest < NEAR_SHARE * farthest))[number]
    table = replace(table.where(order[chosen]), cone=number[chosen])
    return table, *runs(table.cone)


def fit(table: Sightings, errors: Array, noise: Rays, walk: Array) -> LineFit | None:
    """Return parabolas and constants by least squares; None where too few points tell them.

    The odometry walks (3,) by m, m and rad in the root of a second.
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
    for _ in range(STEPS):
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
    return LineFit(table, begins, counts, shares, ranges, drift, off, leverage, found, covariance, spread)


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


def noise_of(found: LineFit, noise: Rays) -> Rays:
    """Return the noise along and across the ray by range, by what is left across the parabolas.

    Its expectation is `(1 - leverage) sum_k share_k (a_k^2 + b_k^2 r^2)`, which is linear in the squares.
    """
    ranges, shares = found.ranges, found.shares
    model = np.concatenate([shares, shares * ranges**2]).T
    drift = (shares * found.drift).sum(axis=0)
    variance = drift + (shares * [one.sigmas(ranges) ** 2 for one in noise]).sum(axis=0)
    room = np.maximum(1.0 - found.leverage, 0.1)
    square = np.minimum(found.off**2 / (room * variance), CLIPPED) - drift / variance
    squares = scipy.optimize.nnls(model / variance[:, None], square)[0].reshape(2, 2).T
    middle = np.quantile(ranges, (np.arange(BINS) + 0.5) / BINS)
    lines = [line_through(middle, np.sqrt(np.maximum(a + b * middle**2, 1e-8))) for a, b in squares]
    least = (LEAST_NOISE[0], 0.0), (0.0, LEAST_NOISE[1])
    along, across = (RayNoise(np.maximum(line, low)) for line, low in zip(lines, least, strict=True))
    return along, across


class LineMeasurement(Copyable):
    """Measurement of noise by points of lines, in steps short enough for a perception cycle."""

    def __init__(self, cycles: Sequence[SeenCycle], found: MeasuredNoise) -> None:
        """Begin with the cycles of a drive, and with what is known: the noise of the odometry at least."""
        self._found, self._points = found, sightings_of(cycles)
        self._errors, self._rounds = np.zeros(len(PRIOR)), ROUNDS_FIRST
        self._noise = found.along or FIRST_ALONG, found.across or FIRST_ACROSS
        if found.along is not None:
            self._rounds = ROUNDS_AGAIN
            self._errors = np.array([*found.sensor, found.range_bend, 0.0])

    def advance(self) -> MeasuredNoise | None:
        """Make the next round; return what was found if it is the last one."""
        walk = self._found.odometry * np.sqrt(self._found.interval)
        found = fit(self._points, self._errors, self._noise, walk)
        if found is None:
            return self._found
        self._errors, self._noise = found.errors, noise_of(found, self._noise)
        self._rounds -= 1
        if self._rounds:
            return None
        sigmas = np.sqrt(np.maximum(np.diag(found.covariance), np.diag(found.clustered)))
        stamps = np.unique(self._points.t)
        count, period = int(np.median(found.counts)), float(np.median(np.diff(stamps)))
        counts = count, period, len(self._points.t) / len(stamps)
        return with_detections(self._found, self._noise, self._errors, sigmas, found.table.t, counts)
