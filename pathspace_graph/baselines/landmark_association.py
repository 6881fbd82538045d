"""Association of detections with landmarks by Hungarian assignment, and of landmarks of one cone."""

from collections.abc import Callable
from typing import Final

import numpy as np
import scipy  # imports its modules on first use

from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.residuals import chi2_quantile, landmark_residuals
from pathspace_graph.factors.sensor import by_sensor
from pathspace_graph.graph.smoother import merge_points
from pathspace_graph.graph.variables import POINT
from pathspace_graph.labels import UNKNOWN
from pathspace_graph.mapping.tracks import nearest_within
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.settings.online import GrowthSettings

from .landmark_map import AMBIGUOUS, SIGMA_MERGE, UNASSOCIATED, LandmarkSmoother, LandmarkState, two_rows

ROUGH_GATE: Final = 5.0  # largest distance of a tested landmark from a detection of the cycle (m)
CREATE: Final = 0.99  # probability of the gates outside of which a detection may be new
MATCH_GATE: Final = chi2_quantile(0.95, POINT)  # gate of a match (squared Mahalanobis distance)
CREATE_GATE: Final = chi2_quantile(CREATE, POINT)  # gate outside of which a detection may be new


def assign(cost: Array) -> tuple[IntArray, BoolArray]:
    """Minimize `sum_ij cost_ij` over one-to-one assignments; an unassigned detection costs the match gate.

    cost (m, n) are squared Mahalanobis distances of detections to landmarks, infinite for other labels.
    Return the column (m,) of each landmark, or UNASSOCIATED, and whether detections (m,) may create one.
    """
    landmark = np.full(len(cost), UNASSOCIATED, np.intp)
    rows, columns = scipy.optimize.linear_sum_assignment(np.minimum(cost, MATCH_GATE))
    chosen = cost[rows, columns] < MATCH_GATE
    landmark[rows[chosen]] = columns[chosen]
    return landmark, np.asarray((cost > CREATE_GATE).all(axis=1))


def squared_mahalanobis(innovations: Array, covariances: Array) -> Array:
    """Compute `r' S^-1 r` (...,) for innovations (..., 2) with covariances (..., 2, 2), in closed form."""
    x, y = innovations[..., 0], innovations[..., 1]
    xx, xy, yy = covariances[..., 0, 0], covariances[..., 0, 1], covariances[..., 1, 1]
    return np.asarray((yy * x * x - 2.0 * xy * x * y + xx * y * y) / (xx * yy - xy * xy))


def pair_costs(points: Array, covariances: Array, predicted: Array, predicted_covariances: Array) -> Array:
    """Squared Mahalanobis distances (m, n) of detections (m, 2) and predicted ones (n, 2).

    Their covariances are (m, 2, 2) and (n, 2, 2).
    """
    innovations = predicted[None] - points[:, None]
    return squared_mahalanobis(innovations, predicted_covariances[None] + covariances[:, None])


def hysteresis_costs(cost: Array, held: BoolArray) -> Array:
    """Keep previous (`held`) pairs in the match gate up to the create gate, so that they do not flip."""
    inside = (1.0 - 1e-9) * MATCH_GATE  # against round-off
    return np.where(held & (cost < CREATE_GATE), np.minimum(cost, inside), cost)


def compatible(labels: IntArray, landmark_labels: IntArray) -> BoolArray:
    """Whether the detection of each pair (m, n) has the landmark's label or an unknown one."""
    return np.asarray((labels[:, None] == landmark_labels[None]) | (labels == UNKNOWN)[:, None])


def associate_newest(smoother: LandmarkSmoother, new: slice, eligible: BoolArray) -> None:
    """Associate the rows `new` of the newest pose with eligible (n,) landmarks.

    A detection between the gates becomes AMBIGUOUS. So does a detection in the match gate of a landmark with
    another label, and votes for its own label.
    """
    detections, state = smoother.map.detections, smoother.map.state
    rows = np.arange(new.start, new.stop)
    points = detections.points_map(rows, smoother.variables)
    near = nearest_within(state.landmarks, points, ROUGH_GATE)[1]
    landmarks = np.flatnonzero(near & eligible)
    numbers = state.numbers[landmarks]
    predicted = predicted_points(smoother, landmarks)
    any_label = pair_costs(detections.point[rows], detections.covariance[rows], *predicted)
    same_label = compatible(detections.label[rows], state.labels[landmarks])
    landmark, is_new = assign(np.where(same_label, any_label, np.inf))
    matched = landmark != UNASSOCIATED
    detections.take(rows[matched], numbers[landmark[matched]])
    explained = (any_label < MATCH_GATE).any(axis=1)
    detections.landmark[rows[~matched & (~is_new | explained)]] = AMBIGUOUS
    if explained.any():
        state.vote(detections.label[rows[explained]], numbers[any_label[explained].argmin(axis=1)])


def predicted_points(smoother: LandmarkSmoother, landmarks: IntArray) -> tuple[Array, Array]:
    """Predict detections of landmarks (k,), by position, from the newest pose.

    They (k, 2) are in m, vehicle frame, with covariances `H_j Sigma H_j'` (k, 2, 2). Sigma is the covariance
    of pose and landmark in the last step, and zero before the first one.
    """
    state, k = smoother.map.state, len(landmarks)
    cycles = np.full(k, smoother.next_cycle - 1)
    poses, zero = smoother.variables.poses_at(cycles), np.zeros((k, POINT))
    expected = landmark_residuals(poses, state.landmarks[landmarks], zero)
    if smoother.last_step is None or k == 0:
        return expected.residual, np.zeros((k, POINT, POINT))
    columns = len(smoother.variables.sensor)
    sensor = by_sensor(expected.residual, np.tile(smoother.map.twist, (k, 1)))[:, :, :columns]
    jacobian = np.concatenate([expected.by_pose, -sensor, expected.by_landmark], axis=2)
    rows = two_rows(cycles, state.numbers[landmarks], jacobian, zero)
    return expected.residual, smoother.predicted_covariance(rows, together=POINT)


def associate_created(
    points: Array, cycles: IntArray, landmarks: Array, settings: GrowthSettings
) -> tuple[IntArray, IntArray]:
    """Return the rows of detections (m, 2) that belong to new landmarks (k, 2), and the landmark of each.

    A detection belongs to the nearest landmark within the merge radius, if it is the nearest of its cycle.
    """
    if len(points) == 0 or len(landmarks) == 0:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    nearest, near = nearest_within(points, landmarks, settings.merge_radius)
    rows = np.argsort(np.hypot(*(points - landmarks[nearest]).T), kind="stable")
    rows = rows[near[rows]]
    _, first = np.unique(np.column_stack([cycles[rows], nearest[rows]]), axis=0, return_index=True)
    chosen = rows[first]
    return chosen, nearest[chosen]


def find_duplicates(
    state: LandmarkState, known: int, covariance: Callable[[IntArray], Array], settings: MapperSettings
) -> tuple[IntArray, IntArray]:
    """Find duplicates: the positions (k,) of landmarks, and of older landmarks of the same cone.

    Of the pairs of one label in the merge radius and the match gate, the nearest ones are taken, each
    landmark once.
    """
    points, labels = state.landmarks[:known], state.labels[:known]
    distance = np.hypot(*np.moveaxis(points[:, None] - points[None], 2, 0))
    near = (distance < settings.growth.merge_radius) & (labels[:, None] == labels[None])
    newer, older = np.nonzero(np.tril(near, -1))
    involved, index = np.unique(np.concatenate([newer, older]), return_inverse=True)
    if len(involved) == 0:
        return newer, older
    spread = difference_covariances(covariance(state.keys[involved]), *index.reshape(2, -1))
    squared = squared_mahalanobis(points[newer] - points[older], spread)
    taken, chosen = set[int](), list[int]()
    for row in np.argsort(squared)[: int((squared < MATCH_GATE).sum())].tolist():
        pair = {int(newer[row]), int(older[row])}
        if taken.isdisjoint(pair):
            taken |= pair
            chosen.append(row)
    return newer[chosen], older[chosen]


def difference_covariances(joint: Array, i: IntArray, j: IntArray) -> Array:
    """Covariances (..., 2, 2) of the differences of points i and j (...,), plus that of `SIGMA_MERGE`."""
    blocks = joint.reshape(len(joint) // POINT, POINT, -1, POINT)
    spread = blocks[i, :, i] + blocks[j, :, j] - blocks[i, :, j] - blocks[j, :, i]
    return np.asarray(spread + SIGMA_MERGE**2 * np.eye(POINT))


def merge(smoother: LandmarkSmoother, gone: IntArray, kept: IntArray) -> None:
    """Merge the landmarks at positions `gone` (k,) into those at `kept` (k,), and take one step."""
    keys = smoother.map.state.keys
    merge_points(smoother, keys[gone], keys[kept])
    smoother.map.merge(gone, kept)
    smoother.step()
