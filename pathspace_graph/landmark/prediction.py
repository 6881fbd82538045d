"""Where the newest pose should see the landmarks, by the joint uncertainty of all; and what it saw."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.landmark import landmark_residuals
from pathspace_graph.factors.se2 import to_map

from .association import NONE, PLANE, Gates, associate, compatible, pair_costs
from .landmark_map import LandmarkSmoother, two_rows
from .state import LEFT_OUT

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Prediction:
    """What the newest pose should see."""

    landmarks: IntArray
    """(k,) positions."""
    points: Array
    """(k, 2) vehicle frame, m."""
    covariances: Array
    """(k, 2, 2) `H Sigma H'`, m^2."""


def assign(smoother: LandmarkSmoother, new: slice, eligible: BoolArray) -> None:
    """Decide which landmark each of the newest pose's readings is of; those that are of one are in use.

    eligible (n,): landmarks that they may be of.
    """
    detections, state, settings = smoother.map.detections, smoother.map.state, smoother.map.settings.landmark
    rows = np.arange(new.start, new.stop)
    candidates = nearby(smoother, rows, settings.rough)
    seen = predict(smoother, candidates[eligible[candidates]])
    gates, numbers = Gates.of_probabilities(settings.match, settings.create), state.numbers[seen.landmarks]
    any_colour = pair_costs(
        detections.point[rows], detections.covariance[rows], seen.points, seen.covariances
    )
    may_be = compatible(detections.label[rows], state.labels[seen.landmarks])
    found = associate(np.where(may_be, any_colour, np.inf), gates)
    matched = found.landmark != NONE
    detections.take(rows[matched], numbers[found.landmark[matched]])
    explained = (any_colour < gates.match).any(axis=1)  # in the wrong colour, maybe: that makes no new one
    detections.landmark[rows[~matched & (~found.new | explained)]] = LEFT_OUT
    if explained.any():
        state.vote(detections.label[rows[explained]], numbers[any_colour[explained].argmin(axis=1)])


def nearby(smoother: LandmarkSmoother, rows: IntArray, rough: float) -> IntArray:
    """Landmarks within `rough` (m) of any of these readings."""
    detections = smoother.map.detections
    points = to_map(detections.point[rows], smoother.variables.poses_at(detections.cycle[rows]))
    offset = points[:, None] - smoother.map.state.landmarks[None]
    return np.flatnonzero((np.hypot(offset[..., 0], offset[..., 1]) < rough).any(axis=0))


def predict(smoother: LandmarkSmoother, landmarks: IntArray) -> Prediction:
    """`H_j Sigma H_j'` of landmarks (k,) and the newest pose, Sigma their joint covariance in the last step.

    Zero before the first step.
    """
    state, k = smoother.map.state, len(landmarks)
    poses, nowhere = np.tile(smoother.variables.poses[-1], (k, 1)), np.zeros((k, PLANE))
    seen = landmark_residuals(poses, state.landmarks[landmarks], nowhere)
    if smoother.last_step is None or k == 0:
        return Prediction(landmarks, seen.residual, np.zeros((k, PLANE, PLANE)))
    jacobian = np.concatenate([seen.by_pose, seen.by_landmark], axis=2)
    rows = two_rows(np.full(k, smoother.next_cycle - 1), state.numbers[landmarks], jacobian, nowhere)
    return Prediction(landmarks, seen.residual, smoother.predicted_covariance(rows, together=PLANE))
