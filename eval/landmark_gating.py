"""Where the newest pose should see the landmarks, by the joint uncertainty of all; and what it saw."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from pathspace_graph.factors.landmark import landmark_residuals
from pathspace_graph.factors.odometry import CALIBRATION_SIZE
from pathspace_graph.factors.projection import to_map
from pathspace_graph.window import POSE

from .landmark_association import NONE, PLANE, Gates, associate, compatible, pair_costs
from .landmark_state import LEFT_OUT
from .landmark_window import LandmarkSmoother, rotation

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Prediction:
    """What the newest pose should see."""

    landmarks: IntArray
    """(k,) indices."""
    points: Array
    """(k, 2) vehicle frame, m."""
    covariances: Array
    """(k, 2, 2) `H Sigma H'`, m^2."""


def assign(smoother: LandmarkSmoother, new: slice, eligible: BoolArray) -> None:
    """Decide which landmark each of the newest pose's readings is of; those that are of one are in use.

    eligible (n,): landmarks that they may be of.
    """
    readings, state, settings = smoother.readings, smoother.state, smoother.settings.landmark
    rows = np.arange(new.start, new.stop)
    candidates = nearby(smoother, rows, settings.rough)
    seen = predict(smoother, candidates[eligible[candidates]])
    gates = Gates.of_probabilities(settings.match, settings.create)
    any_colour = pair_costs(readings.point[rows], readings.covariance[rows], seen.points, seen.covariances)
    may_be = compatible(readings.label[rows], state.labels[seen.landmarks])
    found = associate(np.where(may_be, any_colour, np.inf), gates)
    matched = found.landmark != NONE
    readings.take(rows[matched], seen.landmarks[found.landmark[matched]])
    explained = (any_colour < gates.match).any(axis=1)  # in the wrong colour, maybe: that makes no new one
    readings.landmark[rows[~matched & (~found.new | explained)]] = LEFT_OUT
    if explained.any():
        state.vote(readings.label[rows[explained]], seen.landmarks[any_colour[explained].argmin(axis=1)])


def nearby(smoother: LandmarkSmoother, rows: IntArray, rough: float) -> IntArray:
    """Landmarks within `rough` (m) of any of these readings."""
    readings, state = smoother.readings, smoother.state
    points = to_map(readings.point[rows], state.poses[readings.slot[rows]])
    offset = points[:, None] - state.landmarks[None]
    return np.flatnonzero((np.hypot(offset[..., 0], offset[..., 1]) < rough).any(axis=0))


def predict(smoother: LandmarkSmoother, landmarks: IntArray) -> Prediction:
    """`H_j Sigma H_j'` of landmarks (k,) and the newest pose, Sigma their joint covariance.

    Sigma is that of the last step, which the newest pose wasn't part of: it is reached through its odometry,
    `g_last = g dx_now/dx_last`, `g_calibration = -g R G`, plus the odometry's own noise.
    """
    step, state = smoother.last_step, smoother.state
    k, pose = len(landmarks), smoother.state.poses[-1]
    rows = landmark_residuals(np.tile(pose, (k, 1)), state.landmarks[landmarks], np.zeros((k, PLANE)))
    if step is None or k == 0:
        return Prediction(landmarks, rows.residual, np.zeros((k, PLANE, PLANE)))
    odometry, turn = smoother.odometry[-1], rotation(pose[2])
    local = rows.by_pose @ turn
    by_last = rows.by_pose.copy()
    dx, dy = pose[:2] - state.poses[-2, :2]
    by_last[:, :, 2] += rows.by_pose[:, :, 1] * dx - rows.by_pose[:, :, 0] * dy
    gradient = np.zeros((len(step.factor), k, PLANE), order="F")
    j = np.arange(k)
    for axis in range(PLANE):
        gradient[PLANE * landmarks + axis, j] = rows.by_landmark[:, :, axis]
    map_size = state.map_size
    calibration = slice(map_size, map_size + CALIBRATION_SIZE)
    gradient[calibration] = np.moveaxis(-local @ odometry.calibration_jacobian, 2, 0)
    last = len(step.factor) - POSE
    gradient[last:] = np.moveaxis(by_last, 2, 0)
    half, _ = lapack.dtrtrs(step.factor, gradient.reshape(len(gradient), -1), lower=1)
    half = half.reshape(gradient.shape)
    covariances = np.einsum("nki,nkj->kij", half, half)
    covariances += local @ odometry.covariance @ np.swapaxes(local, 1, 2)
    return Prediction(landmarks, rows.residual, covariances)
