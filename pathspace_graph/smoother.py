"""The fixed-lag smoother: Gauss-Newton over the whole map and the last few seconds of poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from pathspace_graph.factors.odometry import CALIBRATION_SIZE, IntegratedOdometry

from .linearizer import FootParameters, normal_equations, odometry_rows, reading_rows, spacing_rows
from .log import Detections
from .pose_factors import PoseFactors
from .readings import Readings
from .segments import History
from .settings import MapperSettings
from .state import State
from .window import POSE, Prior, Rows, accumulate, cholesky, schur_leave, solve, without

Array = NDArray[np.float64]

TIME_TOLERANCE = 1e-9
"""A pose leaves where it is older than the lag by more than this (s): stamps are sums of decimals."""


@dataclass
class Step:
    """What the last Gauss-Newton step solved, for gating and for what leaves the window."""

    groups: list[Rows]
    """Rows of the window without the prior."""
    point: Array
    """State that they were linearized at."""
    factor: Array
    """Lower Cholesky factor of the damped system."""
    dropped: int = 0
    """Poses that are in the factor and have left the window since."""


class Smoother:
    """State, what was measured in the window, and the prior that stands for all that has left it."""

    def __init__(self, settings: MapperSettings) -> None:
        self.settings = settings
        self.state = State()
        """Control points, calibration and poses."""
        self.readings = Readings()
        """Readings of the poses in the window."""
        self.times: list[float] = []
        """Stamp (s) of each pose in the window."""
        self.odometry: list[IntegratedOdometry] = []
        """Between each pose of the window and the next."""
        self.factors = PoseFactors()
        """The user's own."""
        self.first_cycle = 0
        """Perception cycle of the oldest pose in the window."""
        sigma = np.array([settings.odometry.sigma_scale, settings.odometry.sigma_bias])
        self.prior = Prior(np.diag(sigma**-2.0), np.zeros(CALIBRATION_SIZE), np.zeros(CALIBRATION_SIZE))
        """On the state as far as the newest pose that shares a factor with one that left."""
        self.history: History | None = None
        """The same prior stretch by stretch, while the loop is open and the user gave no factors."""
        self.last_step: Step | None = None
        """None before the first."""

    # --- what comes in -----------------------------------------------------------------------------------

    @property
    def next_cycle(self) -> int:
        """Number of the perception cycle that comes next, from 0."""
        return self.first_cycle + len(self.times)

    def begin(self, t: float, pose: Array, covariance: Array) -> None:
        """The first pose (3,), with its covariance (3, 3) in the map frame."""
        self._append_pose(t, pose)
        q = len(self.prior.point)
        information = np.zeros((q + POSE, q + POSE))
        information[:q, :q] = self.prior.information
        information[q:, q:] = np.linalg.inv(covariance)
        gradient = np.append(self.prior.gradient, np.zeros(POSE))
        self.prior = Prior(information, gradient, np.append(self.prior.point, pose))
        self.history = History(self.prior, self.settings.closing.keyframe_interval)

    def follow(self, t: float, pose: Array, odometry: IntegratedOdometry) -> None:
        """The next pose (3,), and how it was reached."""
        self._append_pose(t, pose)
        self.odometry.append(odometry)

    def _append_pose(self, t: float, pose: Array) -> None:
        self.state.append_pose(pose)
        self.times.append(t)

    def add_factors(self, factors: Sequence[gtsam.NonlinearFactor]) -> None:
        """The user's factors, on poses in the window and the one of the cycle that comes next.

        They may be absolute, which no segment of the history can be: it is given up, and when the loop
        closes, the prior stays linearized where it is.
        """
        if factors:
            self.factors.add(factors, self.first_cycle, self.next_cycle)
            self.history = None

    def add_readings(self, detections: Detections) -> slice:
        """Readings of the newest pose, none in use yet; gives their rows."""
        return self.readings.append(detections, len(self.times) - 1)

    def insert_control_points(self, label: int, at: int, points: Array) -> None:
        """New control points (k, 2) at index `at` of a boundary's, of which the prior knows nothing."""
        index, values = self.state.offset(label) + 2 * at, points.ravel()
        self.state.insert(index, values)
        self.prior.widen(index, values)
        if self.history is not None:
            self.history.widen(index, values)

    # --- Gauss-Newton ------------------------------------------------------------------------------------

    def linearize(self) -> list[Rows]:
        """Whitened rows of everything in the window but the prior, at the current estimate."""
        return self._linearize()[0]

    def _linearize(self) -> tuple[list[Rows], list[FootParameters]]:
        """The same, and the foot points that it found."""
        state, groups, feet = self.state, [], []
        for label in state.boundaries:
            rows, foot = reading_rows(state, self.readings, label, self.settings)
            groups += [rows, spacing_rows(state, label, self.settings.gauge.sigma_spacing)]
            feet.append(foot)
        if self.odometry:
            groups.append(odometry_rows(state, self.odometry))
        if len(self.factors):
            groups += self.factors.rows(state.poses, self.first_cycle, state.pose_column(0))
        return groups, feet

    def step(self, sigma_step: float) -> None:
        """One step, relinearized at the current estimate; a control point moves `sigma_step` (m) freely."""
        groups, feet = self._linearize()
        for foot in feet:
            self.readings.u[foot.rows] = foot.u
        hessian, descent = normal_equations(groups, self.prior, self.state)
        damped = np.arange(self.state.map_size)
        hessian[damped, damped] += sigma_step**-2
        factor = cholesky(hessian, overwrite=True)
        self.last_step = Step(groups, self.state.vector, factor)
        self.state.vector = self.state.vector + solve(factor, descent)

    # --- what leaves -------------------------------------------------------------------------------------

    def marginalize(self) -> None:
        """Poses older than the lag leave into the prior."""
        while len(self.times) > 1 and self.times[-1] - self.times[0] > self.settings.lag + TIME_TOLERANCE:
            self._marginalize_oldest()

    def _marginalize_oldest(self) -> None:
        """`L <- H_bb - H_ba H_aa^-1 H_ab` over the prior and every row that touches the oldest pose."""
        step, state = self.last_step, self.state
        assert step is not None
        low = state.pose_column(0)
        halves = [rows.split(low, low + POSE) for rows in step.groups]
        touching = [leaving for leaving, _ in halves]
        size = max(low + 2 * POSE, len(self.prior.point), *(rows.reach for rows in touching))
        hessian, descent = accumulate(touching, size)
        if self.history is not None:
            self.history.leave(hessian, descent, step.point[:size], *state.control_ids())
        q = len(self.prior.point)
        hessian[:q, :q] += self.prior.information
        descent[:q] += self.prior.descent_at(step.point)
        information, gradient = schur_leave(hessian, descent, low, low + POSE)
        self.prior = Prior(information, gradient, without(step.point[:size], low, low + POSE, 0))
        step.point = without(step.point, low, low + POSE, 0)
        step.groups = [staying for _, staying in halves]
        step.dropped += 1
        self._forget_oldest()

    def _forget_oldest(self) -> None:
        self.state.drop_oldest_pose()
        self.readings.drop_oldest_pose()
        self.factors.drop(self.first_cycle)
        self.times.pop(0)
        self.odometry.pop(0)
        self.first_cycle += 1

    # --- uncertainty -------------------------------------------------------------------------------------

    def pose_covariance(self) -> Array:
        """(3, 3) marginal covariance of the newest pose (x, y, theta), map frame (m, m, rad), not damped."""
        factor = self._undamped_factor()
        half, _ = lapack.dtrtrs(factor, np.eye(len(factor), POSE, POSE - len(factor)), lower=1)
        return np.asarray(half.T @ half)

    def map_covariance(self) -> Array:
        """(n, n) joint covariance of the control points of both boundaries together (m^2), not damped."""
        factor = self._undamped_factor()
        half, _ = lapack.dtrtrs(factor, np.eye(len(factor), self.state.map_size), lower=1)
        return np.asarray(half.T @ half)

    def _undamped_factor(self) -> Array:
        return cholesky(normal_equations(self.linearize(), self.prior, self.state)[0], overwrite=True)
