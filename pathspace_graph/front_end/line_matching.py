"""Points of lines: scan matching that draws them to the line beside them.

The line is that of the recent points about a detection: their weighted mean, and the direction in which they
are spread most. Only the distance across it counts, so what a line cannot tell, the way along it, stays open.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.noise import huber_weights
from pathspace_graph.factors.se2 import left_of, rotation, to_map
from pathspace_graph.io.log import Detections

MOST_DOUBLINGS: Final = 1 << 6  # of the side of a cell
MOST_CELLS: Final = 1 << 20  # in a row of cells, which is more than any sensor sees
MERGE_CELL: Final = 1.0  # side of the cells (m) in which points are merged: 5 mm beside an arc of 9 m
MERGE_RANGE: Final = 12.0
"""Range (m) beyond which the side doubles, and doubles again at each double of it.

Noise grows with the range, so a sensor that sees three times as far needs hardly more points."""
LINE_REACH: Final = 1.5  # reach of a line by that of a cone: its points are spread over the gap of points
LEAST_POINTS: Final = 2.0  # least sum of weights of the points that tell a line
LEAST_SPREAD: Final = 0.3  # least standard deviation of these along the line, by the reach
LEAST_SHAPE: Final = 4.0  # least ratio of their variances along and across it: others are no line
LEAST_INSIDE: Final = 0.5  # most distance along the line from the mean of its points, by the reach
LINE_HELD: Final = np.array([0.1, 10.0, 1.0]) ** 2
"""Variances (m^2, m^2, rad^2) about the start, vehicle frame: the way along the lines is not searched for."""
LINES_ALIKE: Final = np.array([1.0, 0.03, 0.003]) ** 2
"""Variances (m^2, m^2, rad^2) of errors that all points of a match share, vehicle frame: nothing is known
along the lines, and they are taken for straight."""
HEADING_TOLD: Final = 0.05  # standard deviation of the heading (rad) up to which lines hold the pose


def merged(line: Detections) -> Detections:
    """Return the means of the points of lines that share label and cell."""
    doublings = np.maximum(np.frexp(np.hypot(*line.points_vehicle.T) / MERGE_RANGE)[1], 0)
    side = np.ldexp(MERGE_CELL, doublings)
    column, row = np.floor(line.points_vehicle.T / side).astype(np.intp)
    keys = ((line.labels * MOST_DOUBLINGS + doublings) * MOST_CELLS + column) * MOST_CELLS + row
    _, first, cell, counts = np.unique(keys, return_index=True, return_inverse=True, return_counts=True)
    points = _means(line.points_vehicle, cell, counts)
    covariances = _means(line.covariances.reshape(-1, 4), cell, counts) / counts[:, None]
    return Detections(line.t, points, covariances.reshape(-1, 2, 2), line.labels[first])


def _means(values: Array, cell: IntArray, counts: IntArray) -> Array:
    return np.column_stack([np.bincount(cell.ravel(), column) for column in values.T]) / counts[:, None]


class Seen(NamedTuple):
    """Detections of a cycle as they are matched."""

    points: Array  # (m, 2) corrected, vehicle frame (m)
    variances: Array  # (m,) of one coordinate (m^2)

    def where(self, chosen: BoolArray) -> "Seen":
        return Seen(self.points[chosen], self.variances[chosen])


class MatchLimits(NamedTuple):
    """Limits of a match, as `scan_matching` has them for cones."""

    farthest: float  # distance in reaches from which on a remembered detection has no weight
    huber: float  # whitened distance beyond which a weight is reduced
    sigma: float  # added to a detection's (m)
    fewest: int  # least number of matched detections that tell a motion


class Targets(NamedTuple):
    """Lines beside placed detections."""

    off: Array  # (m, 2) from the mean of the recent points to each detection (m)
    weights: Array  # (m,) sums of the weights of these points
    normals: Array  # (m, 2) unit vectors across the line
    matched: BoolArray  # (m,) whether there is a line


def targets_on_lines(placed: Array, recent: Array, reach: float, farthest: float) -> Targets:
    """Return the lines beside placed points (m, 2), by recent points (n, 2) within a reach (m)."""
    centre = placed.mean(axis=0)  # about which the moments are summed, or their differences would vanish
    near, points = placed - centre, recent - centre
    x, y = points.T
    square = (near**2).sum(axis=1)[:, None] + (points**2).sum(axis=1) - 2.0 * near @ points.T
    beside, weight = square < (farthest * reach) ** 2, np.zeros(square.shape)
    weight[beside] = np.exp(-0.5 * square[beside] / reach**2)
    total = np.maximum(weight.sum(axis=1), np.finfo(float).tiny)
    means = weight @ np.column_stack([x, y, x * x, x * y, y * y]) / total[:, None]
    mean, (xx, xy, yy) = means[:, :2], means[:, 2:].T
    xx, xy, yy = xx - mean[:, 0] ** 2, xy - mean[:, 0] * mean[:, 1], yy - mean[:, 1] ** 2
    off = near - mean
    middle, half = 0.5 * (xx + yy), np.hypot(0.5 * (xx - yy), xy)
    direction = 0.5 * np.arctan2(2.0 * xy, xx - yy)
    tangents = np.column_stack([np.cos(direction), np.sin(direction)])
    along, across = middle + half, np.maximum(middle - half, 0.0)
    matched = (total > LEAST_POINTS) & (along > (LEAST_SPREAD * reach) ** 2) & (along > LEAST_SHAPE * across)
    matched &= np.abs((off * tangents).sum(axis=1)) < LEAST_INSIDE * reach
    return Targets(off, total, left_of(tangents), matched)


@dataclass(frozen=True, eq=False)
class LineMatch:
    """Points of a cycle beside recent ones."""

    recent: Array  # (k, 2) recent points (m)
    seen: Seen
    limits: MatchLimits

    def found(self, start: Array, reaches: Sequence[float]) -> tuple[Array, Array, BoolArray, float]:
        """Lay the detections on the recent points by Gauss-Newton steps from a pose (3,), one for each reach.

        The result is the pose (3,), its information (3, 3), which detections were matched, and the sum of
        their whitened squares.
        """
        pose, turn = start.copy(), np.eye(3)  # from the vehicle's frame at the start
        turn[:2, :2] = rotation(start[2])
        held = turn @ np.diag(1.0 / LINE_HELD) @ turn.T
        for reach in reaches:
            hessian, gradient, *_ = self._system(pose, reach)
            pose = pose - np.linalg.solve(hessian + held, gradient + held @ (pose - start))
        hessian, _, matched, square = self._system(pose, reaches[-1])
        if matched.sum() < self.limits.fewest:
            return pose, np.zeros((3, 3)), matched, square
        covariance = np.linalg.inv(hessian + held) + turn @ np.diag(LINES_ALIKE) @ turn.T
        return pose, np.asarray(np.linalg.inv(covariance)), matched, square

    def squares(self, pose: Array, reach: float) -> tuple[Array, BoolArray]:
        """Whitened squares (m,) of the detections at a pose (3,), and which of them are matched."""
        targets, _, squares = self._misfit(pose, reach)
        return squares, targets.matched

    def _misfit(self, pose: Array, reach: float) -> tuple[Targets, Array, Array]:
        """Targets at a pose (3,), and variances and whitened squares (m,) of the detections."""
        placed = to_map(self.seen.points, pose[None])
        targets = targets_on_lines(placed, self.recent, LINE_REACH * reach, self.limits.farthest)
        weights = np.where(targets.matched, targets.weights, 1.0)
        variances = self.seen.variances * (1.0 + 1.0 / weights) + self.limits.sigma**2
        squares = (targets.off * targets.normals).sum(axis=1) ** 2 / variances
        return targets, np.asarray(variances), np.asarray(squares)

    def _system(self, pose: Array, reach: float) -> tuple[Array, Array, BoolArray, float]:
        """Hessian (3, 3) and gradient (3,) of half the sum of squares, which are matched, and the sum."""
        targets, variances, square = self._misfit(pose, reach)
        weights = huber_weights(np.sqrt(square), self.limits.huber) * targets.matched / variances
        n = targets.normals
        information = n[:, :, None] * n[:, None, :] * weights[:, None, None]
        arm = left_of(to_map(self.seen.points, pose[None]) - pose[:2])
        jacobian = np.concatenate([np.tile(np.eye(2), (len(arm), 1, 1)), arm[:, :, None]], axis=2)
        weighted = information @ jacobian
        hessian = np.einsum("mij,mik->jk", jacobian, weighted)
        gradient = np.einsum("mij,mi->j", weighted, targets.off)
        return hessian, gradient, targets.matched, float(np.where(targets.matched, square, 0.0).sum())
