"""The turn of a map about the start, which remains of an error in the heading of its beginning.

The frame of a map is fixed by the first pose, so the map as a whole can only be turned about it. Of all
errors of a map this one has the longest lever, and its beginning alone decides it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from pathspace_graph.factors.se2 import rotation
from pathspace_graph.io.log import Truth
from pathspace_graph.io.map import Map, MapBoundary, SplineBoundary
from pathspace_graph.labels import BOUNDARIES

from .curves import mapped_points
from .table1 import MISSED_DISTANCE

Array = NDArray[np.float64]

STEP: Final = 1.0
"""Points of a reference map are at most this far apart (m)."""
MOST_ROUNDS: Final = 50
"""The points are paired with the map at most this often."""
TOLERANCE: Final = 1e-9
"""The turn is found where a round changes it by less than this (rad)."""


@dataclass(frozen=True)
class Turn:
    """Holds how far a map is turned about the start."""

    angle: float
    """The map is turned to the left by this angle (rad); it is NaN where nothing of it can be compared."""
    sigma: float
    """The map's joint covariance claims this standard deviation (rad) of it; it is NaN where the map has
    none."""

    @property
    def nees(self) -> float:
        """Returns the squared angle by its claimed variance; its mean is 1 where the covariance is honest."""
        return (self.angle / self.sigma) ** 2 if self.sigma > 0.0 else float("nan")


@dataclass(frozen=True, eq=False)
class _Rows:
    """Holds the offsets of points from a map along the map's normals, and what they depend on."""

    error: Array
    """These are the offsets n . (p - S) (r,) in m."""
    lever: Array
    """These are the derivatives n . J p (r,) in m/rad of the offsets by the angle of the points."""
    gradient: Array
    """This is the derivative (2m,) of `sum lever n . S` by the points of the map's boundaries."""


def turn_from_truth(track: Map, truth: Truth) -> Turn:
    """Returns the turn of a map from the true cones."""
    return turn(track, {label: truth.cones[truth.cone_labels == label] for label in BOUNDARIES})


def turn_from_map(track: Map, reference: Map) -> Turn:
    """Returns the turn of a map from another one, whose curves are taken every `STEP` metres."""
    return turn(track, {label: mapped_points(at, STEP) for label, at in reference.boundaries.items()})


def turn(track: Map, points: Mapping[int, Array]) -> Turn:
    """Returns the angle a that minimizes `sum (n . (R(a) p - S))^2` over points (k, 2) by their label.

    S is the foot point of R(a) p on the map's own boundary, found anew in every round, and n is the normal
    there; a landmark has both axes for normals. Points farther than 3 m from the map, and those beyond the
    ends of an open curve, don't count. The angle is linear in the map's points near the solution, so their
    joint covariance gives its variance.
    """
    angle, rows = 0.0, _rows(track, points, 0.0)
    for _ in range(MOST_ROUNDS):
        moment = float(rows.lever @ rows.lever)
        if moment == 0.0:
            return Turn(float("nan"), float("nan"))
        change = -float(rows.lever @ rows.error) / moment
        angle += change
        rows = _rows(track, points, angle)
        if abs(change) < TOLERANCE:
            break
    return Turn(angle, _sigma(rows, track.joint_covariance))


def _sigma(rows: _Rows, joint_covariance: Array | None) -> float:
    """Returns the standard deviation of `sum lever n . S / sum lever^2`."""
    if joint_covariance is None:
        return float("nan")
    variance = float(rows.gradient @ joint_covariance @ rows.gradient)
    return float(np.sqrt(variance)) / float(rows.lever @ rows.lever)


def _rows(track: Map, points: Mapping[int, Array], angle: float) -> _Rows:
    """Returns the rows of all boundaries, with the points turned by an angle (rad)."""
    error, lever, gradient = [np.zeros(0)], [np.zeros(0)], [np.zeros(0)]
    for label, boundary in sorted(track.boundaries.items()):
        turned = points.get(label, np.zeros((0, 2))) @ rotation(angle).T
        if len(turned) == 0 or boundary.size == 0:
            gradient.append(np.zeros(2 * boundary.size))
            continue
        point, normal, position, basis = near_pairs(boundary, turned)
        error.append(np.einsum("rd,rd->r", normal, point - position))
        lever.append(normal[:, 1] * point[:, 0] - normal[:, 0] * point[:, 1])
        gradient.append((basis.T @ (lever[-1][:, None] * normal)).ravel())
    return _Rows(*(np.concatenate(parts) for parts in (error, lever, gradient)))


def near_pairs(boundary: MapBoundary, points: Array) -> tuple[Array, Array, Array, Array]:
    """Returns points (r, 2) near a boundary, and there its normal, its position (r, 2) and basis (r, m)."""
    if isinstance(boundary, SplineBoundary):
        feet = boundary.spline.foot_points(points)
        near = feet.interior & (np.abs(feet.distance) <= MISSED_DISTANCE)
        basis = boundary.spline.basis_matrix(feet.u[near])
        return points[near], feet.normal_unit[near], feet.position[near], basis
    distance, nearest = KDTree(boundary.points).query(points)
    paired = np.flatnonzero(distance <= MISSED_DISTANCE)
    both = np.repeat(np.asarray(nearest, np.intp)[paired], 2)
    axes = np.tile(np.eye(2), (len(paired), 1))
    return np.repeat(points[paired], 2, axis=0), axes, boundary.points[both], np.eye(boundary.size)[both]
