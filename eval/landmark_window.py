"""The landmark graph's window: the mapper's own smoother, with points in place of curves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from pathspace_graph.factors.landmark import landmark_residuals, whiteners
from pathspace_graph.factors.odometry import (
    CALIBRATION_SIZE,
    IntegratedOdometry,
    compose,
    integrate_twists,
)
from pathspace_graph.factors.projection import huber_weights
from pathspace_graph.linearizer import odometry_rows
from pathspace_graph.log import Detections, Odometry
from pathspace_graph.segments import History
from pathspace_graph.settings import MapperSettings
from pathspace_graph.smoother import TIME_TOLERANCE
from pathspace_graph.window import POSE, Prior, Rows, accumulate, cholesky, schur_leave, solve

from .landmark_association import PLANE
from .landmark_state import LandmarkReadings, LandmarkState

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


def landmark_rows(state: LandmarkState, readings: LandmarkReadings, settings: MapperSettings) -> Rows:
    """`w W (R^T (l - t) - z)` of every reading in use: two rows each, columns [pose | landmark].

    `W' W = K^-1`; w the root of each row's own Huber weight.
    """
    used = np.flatnonzero(readings.used)
    slots, landmarks = readings.slot[used], readings.landmark[used]
    rows = landmark_residuals(state.poses[slots], state.landmarks[landmarks], readings.point[used])
    w = whiteners(readings.covariance[used])
    residual = np.einsum("mij,mj->mi", w, rows.residual)
    weight = np.sqrt(huber_weights(residual, settings.gate.huber))
    jacobian = w @ np.concatenate([rows.by_pose, rows.by_landmark], axis=2) * weight[:, :, None]
    columns = np.column_stack([state.pose_columns(slots), PLANE * landmarks, PLANE * landmarks + 1])
    return Rows(np.repeat(columns, PLANE, axis=0), jacobian.reshape(-1, 5), (residual * weight).ravel())


def tie_rows(state: LandmarkState, ties: IntArray, sigma: float) -> Rows:
    """`(l_i - l_j) / sigma` of landmarks (k, 2) that are the same, two rows each."""
    first, second = (PLANE * ties[:, None, :] + np.arange(PLANE)[:, None]).reshape(-1, 2).T
    residual = (state.landmarks[ties[:, 0]] - state.landmarks[ties[:, 1]]).ravel()
    jacobian = np.tile([1.0, -1.0], (len(residual), 1)) / sigma
    return Rows(np.column_stack([first, second]), jacobian, residual / sigma)


@dataclass
class LandmarkStep:
    """What the last Gauss-Newton step solved, for gates and for what leaves the window."""

    groups: list[Rows]
    """Rows of the window without the prior; less the poses that have left since."""
    point: Array
    """State that they were linearized at; less the same poses."""
    factor: Array
    """Lower Cholesky factor of the system, poses that have left since included."""
    dropped: int = 0
    """Poses that have left the window since."""


class LandmarkSmoother:
    """Gauss-Newton over every landmark and the last few seconds of poses; what left them is a prior.

    The mapper's smoother with all of the map in its system: the same odometry factors, calibration, lag,
    linear algebra and history for closing the loop.
    """

    def __init__(self, settings: MapperSettings) -> None:
        self.settings = settings
        self.state = LandmarkState()
        """Landmarks, calibration and poses."""
        self.readings = LandmarkReadings()
        """Readings of the poses in the window."""
        self.times: list[float] = []
        """Stamp (s) of each pose in the window."""
        self.odometry: list[IntegratedOdometry] = []
        """Between each pose of the window and the next."""
        self.first_cycle = 0
        """Perception cycle of the oldest pose in the window."""
        sigma = np.array([settings.odometry.sigma_scale, settings.odometry.sigma_bias])
        self.prior = Prior(np.diag(sigma**-2.0), np.zeros(CALIBRATION_SIZE), np.zeros(CALIBRATION_SIZE))
        """On the state as far as the newest pose that shares a factor with one that left."""
        self.history: History | None = None
        """The same prior stretch by stretch, while the loop is open."""
        self.last_step: LandmarkStep | None = None
        """None before the first."""
        self.ties: IntArray = np.zeros((0, 2), np.intp)
        """(k, 2) landmarks held together while the loop closes."""
        self.merged: dict[int, int] = {}
        """Number of each landmark that was merged away, and of the one that it became."""

    # --- what comes in -----------------------------------------------------------------------------------

    def drive(self, odometry: Odometry, t: float, sigma: Array) -> Array:
        """Predict the pose (3,) at t (s) by the calibrated twists since the newest one; and give it.

        sigma (3,) of a twist reading (m/s, m/s, rad/s).
        """
        integrated = integrate_twists(np.diff(np.append(odometry.t, t)), odometry.twist, sigma)
        error = rotation(integrated.delta[2]) @ integrated.calibration_jacobian @ self.state.calibration
        if self.times:
            self.odometry.append(integrated)
            pose = compose(self.state.poses[-1], integrated.delta - error)
        else:
            pose = compose(np.zeros(3), integrated.delta - error)
            self._begin(pose, integrated.covariance)
        self.state.append_pose(pose)
        self.times.append(t)
        return pose

    def _begin(self, pose: Array, covariance: Array) -> None:
        """The prior of the first pose (3,), with the odometry's covariance since the first stamp."""
        start, q = self.settings.odometry, len(self.prior.point)
        sigmas = np.array([start.sigma_start, start.sigma_start, start.sigma_start_heading])
        self.prior.widen(q, pose)
        self.prior.information[q:, q:] = np.linalg.inv(covariance + np.diag(sigmas) ** 2)
        self.history = History(self.prior, self.settings.closing.keyframe_interval)

    def add_readings(self, detections: Detections) -> slice:
        """Readings of the newest pose, none in use yet; gives their rows."""
        return self.readings.append(detections, len(self.times) - 1)

    def add_landmarks(self, points: Array, labels: IntArray) -> IntArray:
        """New landmarks (k, 2) of which the prior knows nothing; gives their indices (k,)."""
        state, count = self.state, len(self.state.labels)
        index, values = state.map_size, points.ravel()
        state.add_landmarks(points, labels)
        self.prior.widen(index, values)
        if self.history is not None:
            self.history.widen(index, values)
        return np.arange(count, count + len(labels))

    # --- Gauss-Newton ------------------------------------------------------------------------------------

    def linearize(self) -> list[Rows]:
        """Whitened rows of everything in the window but the prior, at the current estimate."""
        groups = [landmark_rows(self.state, self.readings, self.settings)]
        if self.odometry:
            groups.append(odometry_rows(self.state, self.odometry))
        if len(self.ties):
            groups.append(tie_rows(self.state, self.ties, self.settings.landmark.sigma_merge))
        return groups

    def _normal_equations(self, groups: list[Rows]) -> tuple[Array, Array]:
        hessian, descent = accumulate(groups, len(self.state.vector))
        q = len(self.prior.point)
        hessian[:q, :q] += self.prior.information
        descent[:q] += self.prior.descent_at(self.state.vector)
        return hessian, descent

    def step(self) -> None:
        """One step, relinearized at the current estimate; readings hold the landmarks, none is damped."""
        groups, point = self.linearize(), self.state.vector
        hessian, descent = self._normal_equations(groups)
        factor = cholesky(hessian, overwrite=True)
        self.last_step = LandmarkStep(groups, point, factor)
        self.state.vector = point + solve(factor, descent)

    # --- what leaves -------------------------------------------------------------------------------------

    def marginalize(self) -> None:
        """Poses older than the lag leave into the prior."""
        while len(self.times) > 1 and self.times[-1] - self.times[0] > self.settings.lag + TIME_TOLERANCE:
            self._marginalize_oldest()

    def _marginalize_oldest(self) -> None:
        """`L <- H_bb - H_ba H_aa^-1 H_ab` over the prior and every row that touches the oldest pose."""
        step, low, q = self.last_step, self.state.pose_column(0), len(self.prior.point)
        assert step is not None
        halves = [rows.split(low, low + POSE) for rows in step.groups]
        touching = [leaving for leaving, _ in halves]
        size = max(low + 2 * POSE, q, *(rows.reach for rows in touching))
        hessian, descent = accumulate(touching, size)
        if self.history is not None:
            self.history.leave(hessian, descent, step.point[:size], *self.state.control_ids())
        hessian[:q, :q] += self.prior.information
        descent[:q] += self.prior.descent_at(step.point)
        information, gradient = schur_leave(hessian, descent, low, low + POSE)
        leaving = np.s_[low : low + POSE]
        self.prior = Prior(information, gradient, np.delete(step.point[:size], leaving))
        step.point = np.delete(step.point, leaving)
        step.groups = [staying.without(low, low + POSE) for _, staying in halves]
        step.dropped += 1
        self._forget_oldest()

    def _forget_oldest(self) -> None:
        self.state.drop_oldest_pose()
        self.readings.drop_oldest_pose()
        self.times.pop(0)
        self.odometry.pop(0)
        self.first_cycle += 1

    # --- uncertainty -------------------------------------------------------------------------------------

    def covariance(self, landmarks: IntArray) -> Array:
        """(2 k, 2 k) joint covariance of landmarks (k,) in the last step, m^2."""
        assert self.last_step is not None
        factor = self.last_step.factor
        columns = (PLANE * landmarks[:, None] + np.arange(PLANE)).ravel()
        unit = np.zeros((len(factor), len(columns)), order="F")
        unit[columns, np.arange(len(columns))] = 1.0
        half, _ = lapack.dtrtrs(factor, unit, lower=1, overwrite_b=1)
        return np.asarray(half.T @ half)


def rotation(theta: float) -> Array:
    """(3, 3) a pose's own tangent to the map frame's (x, y, theta)."""
    c, s = np.cos(theta), np.sin(theta)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
