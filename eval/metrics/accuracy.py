"""How far a map is from the truth (the paper's Table 1, curves, ghosts), and what its covariance claims."""

from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations
from typing import Final, NamedTuple

import numpy as np
import scipy  # which imports its modules when they are used
from scipy.spatial import KDTree

from pathspace_graph.errors import SettingsError
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.footpoint import FootPoints, foot_points
from pathspace_graph.factors.residuals import greville
from pathspace_graph.factors.se2 import left_of, rotation
from pathspace_graph.io.log import Truth
from pathspace_graph.io.map import Map, MapBoundary, PointBoundary, SplineBoundary
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.laps import lap_end_indices
from pathspace_graph.sim.track import along_polyline, arc_lengths
from pathspace_graph.spline.boundary import crossing_segments
from pathspace_graph.spline.bspline import BSpline

MISSED_DISTANCE: Final = 3.0  # distance from its boundary beyond which a cone is missed (m; Table 1)
GHOST_DISTANCE: Final = 2.0  # distance from its boundary beyond which a mapped point is a ghost (m)
MAPPED_STEP: Final = 0.1  # largest step on a mapped curve (m)
_OVERLAP: Final = 3  # cones beyond the seam that Akima's tangents of a closed curve need


@dataclass(frozen=True, slots=True)
class LapMetrics:
    """One row of the paper's Table 1."""

    lap: int  # number of the lap, from 1; the map is taken as it stood at its end
    rmse: float  # rmse (m) over the cones that aren't missed; NaN where all are
    missed: float  # share (0 to 1) of all true cones that is missed; NaN without true cones
    size: int  # number of control points or landmarks of both boundaries


def lap_metrics(track: Map, truth: Truth, lap: int) -> LapMetrics:
    """Return rmse = sqrt(mean d^2) over true cones with d <= 3 m, and the share of those with d > 3 m."""
    found = cone_errors(track, truth)
    return LapMetrics(lap, found["rmse"], found["missed"], track.size)


def cone_errors(track: Map, truth: Truth) -> dict[str, float]:
    """Return the metrics of the distances d of the true cones, NaN without any.

    In `rmse_capped`, sqrt(mean min(d, 3 m)^2), a missed cone counts as 3 m, so that missing it never pays.
    """
    distances = cone_distances(track, truth)
    count = len(distances)
    return {
        "rmse": root_mean_square(distances[distances <= MISSED_DISTANCE]),
        "missed": mean_of(distances > MISSED_DISTANCE),
        "size_share": track.size / count if count else float("nan"),
        "missed_2m": mean_of(distances > 2.0),
        "missed_1m": mean_of(distances > 1.0),
        "rmse_capped": root_mean_square(np.minimum(distances, MISSED_DISTANCE)),
    }


def cone_distances(track: Map, truth: Truth) -> Array:
    """Return the distance (K,) in m of each true cone from its own mapped boundary, in the truth's order.

    Infinite where that boundary isn't mapped. Cones labelled `unknown` are left out.
    """
    distances = np.full(len(truth.cones), np.inf)
    for label in BOUNDARIES:
        if label in track.boundaries:
            own = truth.cone_labels == label
            distances[own] = boundary_distances(track.boundaries[label], truth.cones[own])
    return distances[np.isin(truth.cone_labels, BOUNDARIES)]


def boundary_distances(boundary: MapBoundary, points_map: Array) -> Array:
    """Return the distance (k,) in m of each point (k, 2) from the spline, or from the nearest landmark."""
    if isinstance(boundary, SplineBoundary):
        feet = closest_points(boundary.spline, points_map)
        return np.asarray(np.linalg.norm(points_map - feet.position, axis=1))
    if boundary.size == 0:
        return np.full(len(points_map), np.inf)
    return np.asarray(KDTree(boundary.points).query(points_map)[0])


def closest_points(spline: BSpline, points_map: Array) -> FootPoints:
    """Return the closest point of the whole curve to each point (k, 2).

    Exact, except where two stretches are equally near to about the sagitta of the grid.
    """
    low, high = spline.domain
    step = (high - low) / (64 * (len(spline.breaks) - 1))  # about 0.1 m
    lows, highs = np.full(len(points_map), low), np.full(len(points_map), high)
    return foot_points(spline.tables, spline.control_points, points_map, lows, highs, step)


def mean_of(values: Array | BoolArray) -> float:
    return float(np.mean(values)) if len(values) else float("nan")


def root_mean_square(values: Array) -> float:
    """Return sqrt(mean v^2); NaN without values."""
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else float("nan")


def cones_of(truth: Truth, label: int) -> Array:
    """Return the true cones (k, 2) of one boundary, m."""
    return np.asarray(truth.cones[truth.cone_labels == label])


@lru_cache(maxsize=16)  # asked for by every map and every curve of a log, as are the functions below
def true_lap_ends(truth: Truth) -> IntArray:
    """Return the index of the true pose (k,) at which each lap ends; cached, and not to be written to."""
    return lap_end_indices(truth.poses)


@lru_cache(maxsize=16)
def true_curve(truth: Truth, label: int, step: float = 0.02) -> Array:
    """Return points (k, 2) in m, at most `step` apart, on the curve through the true cones of a boundary.

    Akima's cubic over chord lengths, in driving order: it passes through every cone and, unlike a natural
    spline, doesn't overshoot where their spacing changes. It is closed where the true path completes a lap.
    The array is cached and must not be written to.
    """
    cones = cones_in_order(truth, label)
    if len(cones) < 2:
        return cones
    closed = len(cones) > _OVERLAP and len(true_lap_ends(truth)) > 0
    nodes = np.concatenate([cones[-_OVERLAP:], cones, cones[: _OVERLAP + 1]]) if closed else cones
    nodes = nodes[np.append(True, np.linalg.norm(np.diff(nodes, axis=0), axis=1) > 0.0)]
    length = arc_lengths(nodes)
    low, high = (length[_OVERLAP], length[-_OVERLAP - 1]) if closed else (length[0], length[-1])
    samples = np.linspace(low, high, int(np.ceil((high - low) / step)) + 1)
    return np.asarray(scipy.interpolate.Akima1DInterpolator(length, nodes)(samples), dtype=float)


@lru_cache(maxsize=16)
def cones_in_order(truth: Truth, label: int) -> Array:
    """Return the true cones (k, 2) of one boundary in driving order; cached like `true_curve`.

    Sorted by the nearest point of the true path's first lap, or as in the file where that gives the shorter
    polygon (inside a hairpin several cones share a nearest point) or there is no true path.
    """
    cones = cones_of(truth, label)
    if len(truth.poses) < 2 or len(cones) == 0:
        return cones
    ends = true_lap_ends(truth)
    path = truth.poses[: ends[0] + 1 if len(ends) else None, :2]
    length = arc_lengths(path)
    samples = np.linspace(0.0, length[-1], int(np.ceil(length[-1] / 0.1)) + 1)  # every 0.1 m
    nearest = np.asarray(KDTree(along_polyline(samples, length, path)).query(cones)[1])
    by_path: Array = cones[np.argsort(nearest, kind="stable")]
    return min(cones, by_path, key=lambda of: np.linalg.norm(of - np.roll(of, 1, axis=0), axis=1).sum())


def mapped_points(boundary: MapBoundary, step: float = MAPPED_STEP) -> Array:
    """Return points (k, 2) in m on a curve, equal lengths of at most `step` apart, or the landmarks.

    The array may be shared and must not be written to.
    """
    return _along(boundary.spline, step) if isinstance(boundary, SplineBoundary) else boundary.points


@lru_cache(maxsize=4)  # several metrics ask for the same points
def _along(spline: BSpline, step: float) -> Array:
    length = spline.length()
    count = max(int(np.ceil(length / step - 1e-9)), 1)  # round-off makes no further one
    return spline.evaluate(spline.parameters_at((np.arange(count) + 0.5) * length / count))


def boundary_errors(track: Map, truth: Truth) -> dict[str, float]:
    """Return how far the mapped boundaries and the true curves are apart, and what of the map is false.

    `mapped_to_truth` is mean_p min_q |p - q| over mapped points p, large where something false is mapped;
    `truth_to_mapped` is mean_q min_p |q - p| over true points q, large where something true isn't (m). Both
    are over both boundaries together, at points equal lengths apart. Landmarks have nothing in between, so
    the second one charges them for the gaps. It is infinite where a boundary isn't mapped; both are NaN where
    there is nothing to measure from. `ghost_landmarks` and `ghost_metres` of curve have min_q |p - q| > 2 m,
    as has a boundary without any true cone as a whole.
    """
    forth, back, landmarks, metres = [np.zeros(0)], [np.zeros(0)], 0, 0.0
    for label in BOUNDARIES:
        curve, boundary = true_curve(truth, label), track.boundaries.get(label)
        if boundary is None:
            back += [np.full(1, np.inf)] if len(curve) else []
            continue
        points = mapped_points(boundary)
        away = np.asarray(KDTree(curve).query(points)[0]) if len(curve) else np.full(len(points), np.inf)
        if len(curve):
            forth.append(away)
            back.append(boundary_distances(boundary, true_curve(truth, label, MAPPED_STEP)))
        if isinstance(boundary, SplineBoundary):
            metres += float(np.mean(away > GHOST_DISTANCE)) * boundary.spline.length()
        else:
            landmarks += int(np.sum(away > GHOST_DISTANCE))
    distances = {
        "mapped_to_truth": mean_of(np.concatenate(forth)),
        "truth_to_mapped": mean_of(np.concatenate(back)),
    }
    return {**distances, "ghost_landmarks": landmarks, "ghost_metres": metres}


def crossings(track: Map) -> tuple[int, int]:
    """Return how often the curves of a map cross each other, and how often they cross themselves."""
    lines = []
    for boundary in track.boundaries.values():
        if isinstance(boundary, SplineBoundary):
            points = mapped_points(boundary, 0.25)
            lines.append(np.concatenate([points, points[:1]]) if boundary.spline.periodic else points)
    other = sum(len(crossing_segments(*pair)[0]) for pair in combinations(lines, 2))
    return other, sum(len(crossing_segments(line, line)[0]) // 2 for line in lines)


def centre_line_errors(track: Map, truth: Truth) -> dict[str, tuple[Array, Array]]:
    """Return errors of the mapped `centre` line and its `half_width` (n,), and their claimed sigmas (n,), m.

    The normal of each point, 1 m apart, crosses the true boundaries at offsets o_l and o_r: the true centre
    is at their mean, half the width is half their difference. An error is NaN where a true boundary does not
    cross the normal near the mapped one. Empty where the map has no centre line.
    """
    try:
        line = track.centre_line(1.0)
    except SettingsError:
        return {}
    normals = np.column_stack([-np.sin(line.heading), np.cos(line.heading)])
    left, right = (
        _crossings(line.points, normals, offsets, true_curve(truth, label, MAPPED_STEP))
        for label, offsets in zip(BOUNDARIES, (line.width_left, -line.width_right), strict=True)
    )
    width = 0.5 * (left - right - line.width_left - line.width_right)
    width_sigma = 0.5 * (line.width_left_sigma + line.width_right_sigma)
    return {"centre": (0.5 * (left + right), line.points_sigma), "half_width": (width, width_sigma)}


def _crossings(points: Array, normals: Array, expected: Array, curve: Array) -> Array:
    """Return the offsets (n,) at which normals through points (n, 2) cross a curve (k, 2), by its chords.

    Of several crossings it is the one nearest to the expected offset, if not as far off as a missed cone.
    """
    tangents = np.column_stack([normals[:, 1], -normals[:, 0]])
    offsets = np.full(len(points), np.nan)
    for i, (point, tangent, normal) in enumerate(zip(points, tangents, normals, strict=True)):
        relative = curve - point
        ahead = relative @ tangent
        at = np.flatnonzero(ahead[:-1] * ahead[1:] <= 0.0)
        if len(at):
            run = ahead[at] - ahead[at + 1]
            share = np.divide(ahead[at], run, out=np.zeros(len(at)), where=run != 0.0)
            across = (relative[at] + share[:, None] * (relative[at + 1] - relative[at])) @ normal
            nearest = across[np.abs(across - expected[i]).argmin()]
            if abs(nearest - expected[i]) < MISSED_DISTANCE:
                offsets[i] = nearest
    return offsets


# --- what the covariance claims ----------------------------------------------------------------------------


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
            if len(error):
                value += float(error @ scipy.linalg.cho_solve(scipy.linalg.cho_factor(covariance), error))
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
    distances = (
        scipy.spatial.distance.cdist(boundary.points, cones_laid)
        if len(cones_laid) and boundary.size
        else np.zeros((0, 0))
    )
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
