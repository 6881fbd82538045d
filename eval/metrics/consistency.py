"""Whether a map's uncertainty is honest: its squared error in units of the covariance that it claims."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import linear_sum_assignment
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist
from scipy.stats import chi2

from pathspace_graph.factors.gauge import greville
from pathspace_graph.io.log import Truth
from pathspace_graph.io.map import Map, PointBoundary, SplineBoundary

from .table1 import MISSED_DISTANCE
from .true_curve import true_curve

Array = NDArray[np.float64]

SHARE: Final = 0.95
"""Probability of the interval."""


@dataclass(frozen=True, slots=True)
class Consistency:
    """NEES = e' P^-1 e, chi-squared with `freedom` degrees where the covariance P is honest."""

    nees: float
    """The sum over both boundaries; NaN where a covariance is singular."""
    freedom: int
    """Its degrees of freedom."""

    @property
    def ratio(self) -> float:
        """NEES per degree of freedom: 1 is honest, more is overconfident, less is timid."""
        return self.nees / self.freedom if self.freedom else float("nan")

    @property
    def interval(self) -> tuple[float, float]:
        """Where `ratio` lies with 95 % probability if the covariance is honest."""
        if not self.freedom:
            return float("nan"), float("nan")
        low, high = chi2.interval(SHARE, self.freedom)
        return float(low) / self.freedom, float(high) / self.freedom

    @property
    def honest(self) -> bool:
        """Whether it lies there."""
        low, high = self.interval
        return low <= self.ratio <= high


def map_consistency(track: Map, truth: Truth) -> Consistency:
    """NEES of a map: of each curve across itself, or of the landmarks in the plane.

    The covariance is the one that the map holds, the joint one of each boundary. What the two boundaries err
    in common (the heading of the whole map above all) counts twice, since a map holds no cross terms between
    them: the interval is a little too narrow.
    """
    nees, freedom = 0.0, 0
    for label, boundary in track.boundaries.items():
        if isinstance(boundary, SplineBoundary):
            error, covariance = curve_errors(boundary, true_curve(truth, label))
        else:
            error, covariance = landmark_errors(boundary, truth.cones[truth.cone_labels == label])
        nees += _squared(error, covariance)
        freedom += len(error)
    return Consistency(nees, freedom)


def curve_errors(boundary: SplineBoundary, true: Array) -> tuple[Array, Array]:
    """e_j = n_j . (q_j - S(u_j)) (k,) and N B Sigma B' N' (k, k), a row for each control point.

    u_j: the abscissa at which control point j acts, so that the rows are as many as the curve has freedom
    across itself, and their covariance is regular; those beyond an open curve's ends are one row at the end.
    n_j: the unit normal there, q_j the nearest true point.
    """
    spline = boundary.spline
    if len(true) == 0:
        return np.zeros(0), np.zeros((0, 0))
    u = greville(spline.knots, spline.degree)[: spline.size]
    low, high = spline.domain
    u = low + np.mod(u - low, high - low) if spline.periodic else np.unique(np.clip(u, low, high))
    tangent, position = spline.tangent_unit(u), spline.evaluate(u)
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    nearest = true[KDTree(true).query(position)[1]]
    error = np.einsum("kd,kd->k", normal, nearest - position)
    design = np.einsum("km,kd->kmd", spline.basis_matrix(u), normal).reshape(len(u), -1)
    return error, design @ boundary.covariance @ design.T


def landmark_errors(boundary: PointBoundary, cones: Array) -> tuple[Array, Array]:
    """cone - landmark (2 k,) over x0, y0, x1, ... and their covariance (2 k, 2 k).

    Pairs one to one, of least distance in sum; one more than 3 m apart is a miss and a ghost, not an error.
    """
    apart = cdist(boundary.points, cones) if len(cones) and boundary.size else np.zeros((0, 0))
    landmark, cone = linear_sum_assignment(np.minimum(apart, MISSED_DISTANCE))
    near = apart[landmark, cone] <= MISSED_DISTANCE
    landmark, cone = landmark[near], cone[near]
    columns = (2 * landmark[:, None] + np.arange(2)).ravel()
    error = (cones[cone] - boundary.points[landmark]).ravel()
    return error, boundary.covariance[np.ix_(columns, columns)]


def _squared(error: Array, covariance: Array) -> float:
    """e' P^-1 e; NaN where P isn't positive definite."""
    if len(error) == 0:
        return 0.0
    try:
        return float(error @ cho_solve(cho_factor(covariance), error))
    except np.linalg.LinAlgError:
        return float("nan")
