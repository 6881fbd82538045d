"""Which reading saw which landmark: the Hungarian assignment on Mahalanobis distances, between two gates."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.stats import chi2

from pathspace_graph.labels import UNKNOWN

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]

NONE = -1
"""The landmark of a reading that has none."""
INSIDE = 1e-9
"""How far inside the gate (share of it) a pair that is held is put: at its very edge, round-off in the sums
of an assignment would decide whether it is kept."""
PLANE = 2
"""Degrees of freedom of a reading."""


@dataclass(frozen=True)
class Gates:
    """Squared Mahalanobis distances of a reading in the plane (chi-square with 2 degrees of freedom)."""

    match: float
    """Below it, a reading may be of the landmark."""
    create: float
    """Above it from every landmark, a reading is of none of them; between the two nothing is said."""

    @staticmethod
    @cache
    def of_probabilities(match: float, create: float) -> Gates:
        """The gates that hold a reading of the landmark with these probabilities, as 0.95 and 0.99."""
        return Gates(float(chi2.ppf(match, PLANE)), float(chi2.ppf(create, PLANE)))


@dataclass(frozen=True, eq=False)
class Association:
    """What the readings of one perception cycle are of."""

    landmark: IntArray
    """(m,) column of the landmark that each reading saw, NONE where none."""
    new: BoolArray
    """(m,) whether a reading is beyond the create gate of every landmark that it may be of."""


def associate(cost: Array, gates: Gates) -> Association:
    """`min sum_ij cost_ij` over one-to-one assignments, a reading left alone costing the match gate.

    cost (m, n): squared Mahalanobis distance of m readings, all of one cycle, to n landmarks; infinite where
    a pair can't be (`compatible` says which colours can). Any m and n, zero too.
    """
    landmark = np.full(len(cost), NONE, np.intp)
    rows, columns = linear_sum_assignment(np.minimum(cost, gates.match))
    chosen = cost[rows, columns] < gates.match
    landmark[rows[chosen]] = columns[chosen]
    return Association(landmark, np.asarray((cost > gates.create).all(axis=1)))


def squared_mahalanobis(innovations: Array, covariances: Array) -> Array:
    """`r' S^-1 r` (...,) of innovations (..., 2) with covariances (..., 2, 2), by the closed inverse."""
    x, y = innovations[..., 0], innovations[..., 1]
    xx, xy, yy = covariances[..., 0, 0], covariances[..., 0, 1], covariances[..., 1, 1]
    return np.asarray((yy * x * x - 2.0 * xy * x * y + xx * y * y) / (xx * yy - xy * xy))


def pair_costs(points: Array, covariances: Array, predicted: Array, predicted_covariances: Array) -> Array:
    """`(m, n)` squared Mahalanobis distances with `S_ij = H_j Sigma H_j' + K_i`, in the vehicle frame.

    points (m, 2) and K (m, 2, 2): the readings; predicted (n, 2) and `H Sigma H'` (n, 2, 2): where each
    landmark should be seen, with the *joint* covariance of pose and landmark, cross terms included.
    """
    innovations = predicted[None] - points[:, None]
    return squared_mahalanobis(innovations, predicted_covariances[None] + covariances[:, None])


def kept_costs(cost: Array, held: BoolArray, gates: Gates) -> Array:
    """The costs, with pairs that are `held` already inside the match gate as long as they pass the other one.

    Held to the strict gate anew in every round, readings would come and go at its edge; and since a reading's
    covariance grows with its range, cutting often at both sides would favour those that are too far.
    """
    inside = (1.0 - INSIDE) * gates.match
    return np.where(held & (cost < gates.create), np.minimum(cost, inside), cost)


def compatible(labels: IntArray, landmark_labels: IntArray) -> BoolArray:
    """(m, n) whether a reading's colour may be that of the landmark: the same one, or unknown."""
    return np.asarray((labels[:, None] == landmark_labels[None]) | (labels == UNKNOWN)[:, None])
