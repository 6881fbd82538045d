"""Whether a covariance is honest: NEES of the map, errors at the true cones, turn and scale."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy  # which imports its modules when they are used
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist

from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.residuals import greville
from pathspace_graph.factors.se2 import left_of, rotation
from pathspace_graph.io.log import Truth
from pathspace_graph.io.map import Map, MapBoundary, PointBoundary, SplineBoundary

from .accuracy import MISSED_DISTANCE, closest_points, cones_of, mean_of, true_curve


def map_nees(track: Map, truth: Truth) -> float:
    """Return the normalized estimation error squared (NEES) `e' P^-1 e` of a map by its degrees of freedom.

    P is the covariance that the map holds: 1 is honest, more overconfident, less too cautious (Bar-Shalom, Li
    and Kirubarajan, Estimation with Applications to Tracking and Navigation, section 5.4). NaN where P is
    singular, or nothing is to be compared.

    A curve's error is its signed distance to the true curve, at as many places as it has degrees of freedom
    across itself; that of landmarks is their offset in the plane. The map that a user gets is judged, so
    every estimator is judged alike. A map holds no covariance between its boundaries, so errors that they
    share (above all its heading) count twice: the mean over many runs is right, but it spreads
    more widely than a chi-squared one.

    The covariance is that of small errors. A turn of the whole map by a degree moves its far side by a metre
    along the boundary, whose bends would then count as errors of shape. So the truth is laid on the map by
    its turn, and that of a closed map by its size too; both then count to first order. An open map hardly
    shows its size.
    """
    found = similarity_from_truth(track, truth, 2 if track.closed else 1)
    laid = np.nan_to_num([*(one.value for one in found), 0.0][:2])
    truth_laid = aligned(truth, *laid)
    value, dof = 0.0, 0
    for label, boundary in track.boundaries.items():
        if isinstance(boundary, SplineBoundary):
            error, covariance = curve_errors(boundary, true_curve(truth_laid, label), laid)
        else:
            error, covariance = landmark_errors(boundary, cones_of(truth_laid, label), laid)
        try:
            value += float(error @ cho_solve(cho_factor(covariance), error)) if len(error) else 0.0
        except np.linalg.LinAlgError:
            return float("nan")
        dof += len(error)
    return value / dof if dof else float("nan")


def curve_errors(boundary: SplineBoundary, curve_laid: Array, laid: Array) -> tuple[Array, Array]:
    """Return errors e_j (k,) in m and their covariance N B Sigma B' N' (k, k) in m^2.

    `e_j = n_j . (q_j - p_j - [J p_j, p_j] laid)` with the place p_j = S(u_j), its unit normal n_j, and the
    nearest point q_j of the true curve (n, 2), which was `laid` (2,) on the map by a turn (rad) and the
    logarithm of a scale about the start. J turns by 90 degrees to the left. A row for each control point, at
    its Greville abscissa u_j, so that the covariance is regular; abscissae beyond the ends of an open curve
    become one row at the end.
    """
    spline = boundary.spline
    if len(curve_laid) == 0:
        return np.zeros(0), np.zeros((0, 0))
    u = greville(spline.knots, spline.degree)[: spline.size]
    low, high = spline.domain
    u = low + np.mod(u - low, high - low) if spline.periodic else np.unique(np.clip(u, low, high))
    normal, position = spline.normal_unit(u), spline.evaluate(u)
    nearest = curve_laid[KDTree(curve_laid).query(position)[1]]
    moved = laid[0] * left_of(position) + laid[1] * position
    error = np.einsum("kd,kd->k", normal, nearest - position - moved)
    design = np.einsum("km,kd->kmd", spline.basis_matrix(u), normal).reshape(len(u), -1)
    return error, design @ boundary.covariance @ design.T


def landmark_errors(boundary: PointBoundary, cones_laid: Array, laid: Array) -> tuple[Array, Array]:
    """Return errors (2 k,) in m over x0, y0, x1, ..., and their covariance (2 k, 2 k) in m^2.

    The error of a landmark p with the cone c is `c - p - [J p, p] laid`, as `curve_errors` has it. Landmarks
    and cones (n, 2) are paired with the smallest total distance. A pair more than 3 m apart is left out: it
    is a missed cone and a ghost, not an error.
    """
    distances = cdist(boundary.points, cones_laid) if len(cones_laid) and boundary.size else np.zeros((0, 0))
    landmark, cone = scipy.optimize.linear_sum_assignment(np.minimum(distances, MISSED_DISTANCE))
    paired = distances[landmark, cone] <= MISSED_DISTANCE
    landmark, cone = landmark[paired], cone[paired]
    columns = (2 * landmark[:, None] + np.arange(2)).ravel()
    points = boundary.points[landmark]
    moved = laid[0] * left_of(points) + laid[1] * points
    error = (cones_laid[cone] - points - moved).ravel()
    return error, boundary.covariance[np.ix_(columns, columns)]


def consistency_at_cones(track: Map, truth: Truth) -> dict[str, float]:
    """Return the share of the cones with |error| <= 2 sigma, and the mean of (error / sigma)^2.

    The mean leaves correlations out: 1 is honest. Both are NaN without cones.
    """
    errors, sigmas = normal_errors(track, truth)
    inside = mean_of(np.abs(errors) <= 2.0 * sigmas)
    return {"inside": inside, "normalized_error": mean_of((errors / sigmas) ** 2)}


def normal_errors(track: Map, truth: Truth) -> tuple[Array, Array]:
    """Return e = n . (cone - S(u)), sigma = sqrt(n' B Sigma B' n) at the foot points u of k true cones, m.

    Only splines count. Missed cones count as the large errors that they are.
    """
    errors, sigmas = [np.zeros(0)], [np.zeros(0)]
    for label, boundary in track.boundaries.items():
        if isinstance(boundary, SplineBoundary):
            feet = closest_points(boundary.spline, cones_of(truth, label))
            errors.append(feet.distance)
            sigmas.append(boundary.spline.normal_sigma(feet.u, boundary.covariance))
    return np.concatenate(errors), np.concatenate(sigmas)


def with_marginals(track: Map) -> Map:
    """Return the splines of a map with their control points' own covariances and no cross terms.

    The paper's squared basis (State Uncertainty): `B blockdiag(Sigma) B' = sum_j beta_j(u)^2 Sigma_jj`.
    """
    splines = {k: b for k, b in track.boundaries.items() if isinstance(b, SplineBoundary)}
    blocks = {label: np.kron(np.eye(b.size), np.ones((2, 2))) for label, b in splines.items()}
    return Map(track.closed, {k: replace(b, covariance=b.covariance * blocks[k]) for k, b in splines.items()})


class Deviation(NamedTuple):
    """Number by which a map as a whole deviates from the truth, whose frame is fixed at the start."""

    value: float  # NaN where nothing can be compared
    sigma: float  # its standard deviation by the map's joint covariance; NaN where the map has none

    @property
    def nees(self) -> float:
        """Return the squared value by its claimed variance; its mean is 1 where the covariance is honest."""
        return (self.value / self.sigma) ** 2 if self.sigma > 0.0 else float("nan")


def aligned(truth: Truth, turn: float, scale: float) -> Truth:
    """Return the truth with its cones turned about the start (rad), and `exp(scale)` times as far from it."""
    return replace(truth, cones=np.exp(scale) * truth.cones @ rotation(turn).T)


def similarity_from_truth(track: Map, truth: Truth, count: int = 2) -> list[Deviation]:
    """Return the turn a (rad) and the logarithm b of the map's scale by that of the truth, or a alone.

    They minimize `sum (n . (exp(b) R(a) p - S))^2` over the true cones p. S is the foot point of the moved
    cone on the map's own boundary, found anew in every round, and n is the normal there; a landmark has both
    axes for normals. Cones farther than 3 m from the map, and those beyond the ends of an open curve, don't
    count. Near the solution both are linear in the map's points, whose joint covariance gives their variance.
    """
    motion, (error, lever, gradient) = np.zeros(2), _rows(track, truth)
    for _ in range(50):
        if len(error) == 0 or np.linalg.matrix_rank(lever[:, :count]) < count:
            return [Deviation(float("nan"), float("nan"))] * count
        change = np.linalg.lstsq(lever[:, :count], -error)[0]
        motion[:count] += change
        error, lever, gradient = _rows(track, aligned(truth, *motion))
        if np.abs(change).max() < 1e-9:
            break
    J, joint = lever[:, :count], track.joint_covariance
    by_points = np.linalg.solve(J.T @ J, gradient[:, :count].T)
    variances = np.full(count, np.nan) if joint is None else np.diag(by_points @ joint @ by_points.T)
    return [Deviation(*pair) for pair in zip(motion.tolist(), np.sqrt(variances).tolist(), strict=False)]


def _rows(track: Map, truth: Truth) -> tuple[Array, Array, Array]:
    """Return the offsets of true cones p from the map, and two derivatives.

    The offsets are n . (p - S) (r,) in m, their derivatives by turn and scale n . [J p, p] (r, 2) in m. The
    third is the derivative (2m, 2) of `sum lever n . S` by the points of the map's boundaries.
    """
    error, lever, gradient = [np.zeros(0)], [np.zeros((0, 2))], [np.zeros((0, 2))]
    for label, boundary in sorted(track.boundaries.items()):
        cones = cones_of(truth, label)
        if len(cones) == 0 or boundary.size == 0:
            gradient.append(np.zeros((2 * boundary.size, 2)))
            continue
        point, normal, position, basis = near_pairs(boundary, cones)
        error.append(np.einsum("rd,rd->r", normal, point - position))
        by_turn = normal[:, 1] * point[:, 0] - normal[:, 0] * point[:, 1]
        lever.append(np.column_stack([by_turn, np.einsum("rd,rd->r", normal, point)]))
        gradient.append(np.einsum("rm,rc,rd->mdc", basis, lever[-1], normal).reshape(-1, 2))
    return np.concatenate(error), np.concatenate(lever), np.concatenate(gradient)


def near_pairs(boundary: MapBoundary, points: Array) -> tuple[Array, Array, Array, Array]:
    """Return points (r, 2) near a boundary, and there its normal, its position (r, 2) and basis (r, m)."""
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
