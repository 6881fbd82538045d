"""Associates detections with landmarks: the Hungarian assignment on Mahalanobis distances, with two gates."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.stats import chi2

from pathspace_graph.factors.landmark import landmark_residuals
from pathspace_graph.factors.se2 import to_map
from pathspace_graph.factors.sensor import by_sensor
from pathspace_graph.graph.keys import POINT
from pathspace_graph.labels import UNKNOWN
from pathspace_graph.settings.comparison import LandmarkSettings
from pathspace_graph.settings.growth import GrowthSettings

from .landmark_map import LandmarkSmoother, two_rows
from .state import AMBIGUOUS, UNASSOCIATED

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]

HELD_MARGIN = 1e-9
"""The cost of a held pair is reduced to this share below the match gate. Exactly at the gate, round-off in
the sums of an assignment would decide whether the pair is kept."""


@dataclass(frozen=True, eq=False)
class Association:
    """Holds the landmark of each detection of one perception cycle."""

    landmark: IntArray
    """(m,) Each entry is the column of the landmark of a detection, or UNASSOCIATED."""
    new: BoolArray
    """(m,) Each entry tells whether a detection lies beyond the create gate of every compatible landmark."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """Holds what the newest pose should detect, in the vehicle frame."""

    landmarks: IntArray
    """(k,) These are the positions of the landmarks in the state."""
    points_vehicle: Array
    """(k, 2) Each row is the place where a landmark should be detected, in m."""
    covariances: Array
    """(k, 2, 2) Each block is the covariance `H Sigma H'` of such a place, in m^2."""


@dataclass(frozen=True)
class Gates:
    """Holds two gates on squared Mahalanobis distances with two degrees of freedom."""

    match: float
    """A detection may be associated with a landmark below this distance."""
    create: float
    """A detection may create a landmark if it is above this distance from every compatible landmark."""

    @staticmethod
    @cache
    def of(settings: LandmarkSettings) -> Gates:
        """Returns the chi-square quantiles of the two probabilities in the settings."""
        return Gates(float(chi2.ppf(settings.match, POINT)), float(chi2.ppf(settings.create, POINT)))


# --- the assignment --------------------------------------------------------------------------------------


def associate(cost: Array, gates: Gates) -> Association:
    """Minimizes `sum_ij cost_ij` over one-to-one assignments; an unassigned detection costs the match gate.

    cost (m, n) holds the squared Mahalanobis distances of all m detections of a cycle to n landmarks. It is
    infinite where the labels are not compatible. Both m and n may be zero.
    """
    landmark = np.full(len(cost), UNASSOCIATED, np.intp)
    rows, columns = linear_sum_assignment(np.minimum(cost, gates.match))
    chosen = cost[rows, columns] < gates.match
    landmark[rows[chosen]] = columns[chosen]
    return Association(landmark, np.asarray((cost > gates.create).all(axis=1)))


def squared_mahalanobis(innovations: Array, covariances: Array) -> Array:
    """Returns `r' S^-1 r` (...,) of innovations (..., 2) with covariances (..., 2, 2), in closed form."""
    x, y = innovations[..., 0], innovations[..., 1]
    xx, xy, yy = covariances[..., 0, 0], covariances[..., 0, 1], covariances[..., 1, 1]
    return np.asarray((yy * x * x - 2.0 * xy * x * y + xx * y * y) / (xx * yy - xy * xy))


def pair_costs(points: Array, covariances: Array, predicted: Array, predicted_covariances: Array) -> Array:
    """Returns the squared Mahalanobis distances (m, n) with `S_ij = H_j Sigma H_j' + K_i`, vehicle frame.

    points (m, 2) and covariances K (m, 2, 2) are those of the detections. predicted (n, 2) and
    predicted_covariances `H Sigma H'` (n, 2, 2) are those of the landmarks. Sigma is the joint covariance of
    pose and landmark, so it contains the cross terms.
    """
    innovations = predicted[None] - points[:, None]
    return squared_mahalanobis(innovations, predicted_covariances[None] + covariances[:, None])


def hysteresis_costs(cost: Array, held: BoolArray, gates: Gates) -> Array:
    """Returns the costs, where pairs that are `held` already stay in the match gate up to the create gate.

    With the strict gate in every round, detections at the edge would change their association forever. The
    covariance of a detection grows with its range. So a repeated cut on both sides of the gate would also
    favour detections that are measured too far away.
    """
    inside = (1.0 - HELD_MARGIN) * gates.match
    return np.where(held & (cost < gates.create), np.minimum(cost, inside), cost)


def compatible(labels: IntArray, landmark_labels: IntArray) -> BoolArray:
    """Returns for each pair (m, n) whether the detection has the landmark's label or an unknown one."""
    return np.asarray((labels[:, None] == landmark_labels[None]) | (labels == UNKNOWN)[:, None])


# --- online ----------------------------------------------------------------------------------------------


def associate_newest(
    smoother: LandmarkSmoother, new: slice, eligible: BoolArray, cycle: int | None = None
) -> None:
    """Associates the rows `new` of the newest pose with landmarks, and puts the associated ones to use.

    Late rows are of the pose of an earlier `cycle`.

    Only landmarks whose entry in `eligible` (n,) is set take part. A detection between the gates becomes
    AMBIGUOUS. So does one in the match gate of a landmark with another label, since it must not create a
    second landmark for the same cone. It is a vote for its own label.
    """
    detections, state, settings = smoother.map.detections, smoother.map.state, smoother.map.settings.landmark
    rows = np.arange(new.start, new.stop)
    candidates = nearby(smoother, rows, settings.rough)
    prediction = predict(smoother, candidates[eligible[candidates]], cycle)
    gates, numbers = Gates.of(settings), state.numbers[prediction.landmarks]
    any_label = pair_costs(
        detections.point[rows], detections.covariance[rows], prediction.points_vehicle, prediction.covariances
    )
    same_label = compatible(detections.label[rows], state.labels[prediction.landmarks])
    found = associate(np.where(same_label, any_label, np.inf), gates)
    matched = found.landmark != UNASSOCIATED
    detections.take(rows[matched], numbers[found.landmark[matched]])
    explained = (any_label < gates.match).any(axis=1)
    detections.landmark[rows[~matched & (~found.new | explained)]] = AMBIGUOUS
    if explained.any():
        state.vote(detections.label[rows[explained]], numbers[any_label[explained].argmin(axis=1)])


def nearby(smoother: LandmarkSmoother, rows: IntArray, radius: float) -> IntArray:
    """Returns the positions of the landmarks within `radius` (m) of any of these detections."""
    detections = smoother.map.detections
    points = to_map(detections.point[rows], smoother.variables.poses_at(detections.cycle[rows]))
    offset = points[:, None] - smoother.map.state.landmarks[None]
    return np.flatnonzero((np.hypot(offset[..., 0], offset[..., 1]) < radius).any(axis=0))


def predict(smoother: LandmarkSmoother, landmarks: IntArray, cycle: int | None = None) -> Prediction:
    """Predicts the detections of landmarks (k,), given by position, from the pose of a cycle.

    It is the newest pose by default.

    The covariance is `H_j Sigma H_j'`, where Sigma is the joint covariance of pose and landmark in the last
    step. It is zero before the first step.
    """
    state, k = smoother.map.state, len(landmarks)
    cycles = np.full(k, smoother.next_cycle - 1 if cycle is None else cycle)
    poses, zero = smoother.variables.poses_at(cycles), np.zeros((k, POINT))
    expected = landmark_residuals(poses, state.landmarks[landmarks], zero)
    if smoother.last_step is None or k == 0:
        return Prediction(landmarks, expected.residual, np.zeros((k, POINT, POINT)))
    columns = len(smoother.variables.sensor)
    sensor = by_sensor(expected.residual, np.tile(smoother.map.twist, (k, 1)))[:, :, :columns]
    jacobian = np.concatenate([expected.by_pose, -sensor, expected.by_landmark], axis=2)
    rows = two_rows(cycles, state.numbers[landmarks], jacobian, zero)
    return Prediction(landmarks, expected.residual, smoother.predicted_covariance(rows, together=POINT))


# --- new landmarks ---------------------------------------------------------------------------------------


def associate_created(
    points: Array, cycles: IntArray, landmarks: Array, settings: GrowthSettings
) -> tuple[IntArray, IntArray]:
    """Returns the rows of the detections that belong to new landmarks (k, 2), and the landmark of each.

    points (m, 2) are the detections in the map frame, and cycles (m,) are their perception cycles. A
    detection belongs to the nearest landmark if that is within the merge radius. Only the nearest detection
    of each cycle belongs to a landmark.
    """
    if len(points) == 0 or len(landmarks) == 0:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    offset = points[:, None] - landmarks[None]
    distances = np.hypot(offset[..., 0], offset[..., 1])
    nearest = distances.argmin(axis=1)
    distance = distances[np.arange(len(points)), nearest]
    rows = np.argsort(distance, kind="stable")
    rows = rows[distance[rows] < settings.merge_radius]
    _, first = np.unique(np.column_stack([cycles[rows], nearest[rows]]), axis=0, return_index=True)
    chosen = rows[first]
    return chosen, nearest[chosen]
