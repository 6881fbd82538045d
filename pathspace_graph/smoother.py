"""The fixed-lag smoother: Gauss-Newton over the whole map and the last few seconds of poses."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from pathspace_graph.factors.odometry import CALIBRATION_SIZE, IntegratedOdometry

from .far import Far, Parting
from .linearizer import (
    FootParameters,
    add_smoothness,
    normal_equations,
    odometry_rows,
    reading_rows,
    spacing_rows,
)
from .log import Detections
from .pose_factors import PoseFactors
from .readings import Readings
from .segments import History
from .settings import MapperSettings
from .state import State
from .window import POSE, Prior, Rows, accumulate, cholesky, schur_leave, solve, without

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]

TIME_TOLERANCE = 1e-9
"""A pose leaves where it is older than the lag by more than this (s): stamps are sums of decimals."""


@dataclass
class Step:
    """What the last Gauss-Newton step solved, for gating and for what leaves the window."""

    groups: list[Rows]
    """Rows of the window without the prior, on the system's entries; less the poses that have left since."""
    point: Array
    """Its values that they were linearized at; less the same poses."""
    factor: Array
    """Lower Cholesky factor of the damped system, poses that have left since included."""
    position: IntArray
    """Place in it of each entry of x that was there, -1 where it was far."""
    poses: int
    """First entry in it of the window's poses."""
    dropped: int = 0
    """Poses that have left the window since."""


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
        """On the system as far as the newest pose that shares a factor with one that left."""
        self.far = Far()
        """What it doesn't say of control points that are far."""
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
        """New control points (k, 2) at index `at`, a boundary's end, of which the prior knows nothing."""
        state, values = self.state, points.ravel()
        column, place = state.offset(label) + 2 * at, state.near_block(label).start + 2 * at
        if label in state.narrowed:
            near = state.narrowed[label]
            place = state.near_block(label).start + 2 * len(near)
            state.narrowed[label] = np.append(near, at + np.arange(len(points)))
        state.insert(column, values)
        self.far.shift(column, len(values))
        self.prior.widen(place, values)
        if self.history is not None:
            self.history.widen(place, values)

    def forget(self, label: int, first: int) -> None:
        """Nothing that left the window says anything of a boundary's control points from an index on."""
        self.join()
        self._cut_history()
        block = self.state.block(label)
        self.prior.forget(np.arange(block.start + 2 * first, block.stop))
        if self.history is not None:
            self.history.forget(label, first)

    # --- Gauss-Newton ------------------------------------------------------------------------------------

    def linearize(self) -> list[Rows]:
        """Whitened rows of everything in the window but the prior, on the system's entries."""
        return self._linearize()[0]

    def _linearize(self) -> tuple[list[Rows], FootParameters | None]:
        """The same, and the foot points that it found."""
        state, groups, feet = self.state, [], None
        if state.boundaries:
            rows, feet = reading_rows(state, self.readings, self.settings)
            groups += [rows, spacing_rows(state, self.settings.gauge.sigma_spacing)]
        if self.odometry:
            groups.append(odometry_rows(state, self.odometry))
        if len(self.factors):
            groups += self.factors.rows(state.poses, self.first_cycle, state.pose_column(0))
        if state.whole:
            return groups, feet
        position = state.position
        groups = [rows.at(position) for rows in groups]
        if (feet and feet.cut_off) or (groups[0].columns < 0).any():
            self.join()  # a reading has slid to where the map is far: rare, since the near part is generous
            return self._linearize()
        return groups, feet

    def step(self, sigma_step: float) -> None:
        """One step, relinearized at the current estimate; a control point moves `sigma_step` (m) freely."""
        groups, feet = self._linearize()
        if feet is not None:
            self.readings.u[feet.rows] = feet.u
        state, system = self.state, self.state.system
        point = state.vector[system]
        hessian, descent = normal_equations(groups, self.prior, state, point)
        damped = np.arange(state.near_size)
        hessian[damped, damped] += sigma_step**-2
        factor = cholesky(hessian, overwrite=True)
        first_pose = len(system) - POSE * len(self.times)
        self.last_step = Step(groups, point, factor, state.position, first_pose)
        state.vector[system] += solve(factor, descent)

    def settle(self) -> None:
        """A step while the loop is being closed, where control points may move farther."""
        self.step(self.settings.closing.sigma_step)

    # --- what is far -------------------------------------------------------------------------------------

    def part(self, near: dict[int, IntArray]) -> None:
        """Only the control points `near` (k,) of each boundary, now near too, stay in the system.

        Nothing happens where none leaves, or a user's factor ties the prior to more than the oldest pose.
        """
        state = self.state
        old, begin = state.system, state.near_size + CALIBRATION_SIZE
        oldest = begin + POSE * state.keyframes + np.arange(POSE)
        if len(self.prior.point) != oldest[-1] + 1 or sum(map(len, near.values())) == state.near_size // 2:
            return
        self._cut_history()
        hessian, descent = self._gauge(len(self.prior.point))
        place = state.position
        state.narrowed = near
        staying = place[state.system[: state.near_size + CALIBRATION_SIZE]]
        leaving = np.setdiff1d(np.arange(begin), staying)
        kept_hessian, kept_descent = self._gauge(len(staying))
        hessian[np.ix_(staying, staying)] -= kept_hessian
        descent[staying] -= kept_descent
        frontal, stay = np.append(leaving, np.arange(begin, oldest[0])), np.append(staying, oldest)
        order = np.concatenate([frontal, stay])
        parting = Parting(
            frontal=frontal,
            stays=stay,
            columns=old[np.concatenate([leaving, staying])],
            frontals=len(leaving),
            left=self.far.anchor if state.keyframes else None,
            anchor=self.first_cycle,
            hessian=hessian[np.ix_(order, order)],
            descent=descent[order],
        )
        point = state.vector[old[: len(self.prior.point)]]
        here = Prior(self.prior.information, self.prior.descent_at(point), point)
        self.prior = self.far.push(here, parting)
        state.drop_keyframes()

    def _gauge(self, size: int) -> tuple[Array, Array]:
        """(size, size), (size,) normal equations of the weak priors between near control points."""
        state = self.state
        x, position = state.vector[state.system[: state.near_size]], state.position
        spacing = spacing_rows(state, self.settings.gauge.sigma_spacing)
        hessian, descent = accumulate([spacing.at(position)], size)
        add_smoothness(hessian, descent, state, x)
        return hessian, descent

    def refresh(self) -> None:
        """Bring the control points that are far up to date."""
        begin = self.state.pose_column(0) - POSE * self.state.keyframes
        self.far.refresh(self.state.vector, self.state.vector[begin : begin + POSE])

    def join(self) -> None:
        """All control points come back into the system."""
        state = self.state
        if state.whole:
            return
        self._cut_history()
        lead = state.map_size + CALIBRATION_SIZE
        anchors = self.far.refresh(state.vector, state.vector[lead : lead + POSE])
        near = state.system[: state.near_size + CALIBRATION_SIZE]
        prior = self.far.joined(self.prior, near, state.vector, lead, anchors)
        window = len(self.prior.point) - len(near) - POSE * state.keyframes
        end = len(prior.point) - window
        if end > lead:  # anchors that have left the window
            information, gradient = schur_leave(prior.information, prior.gradient, lead, end)
            prior = Prior(information, gradient, without(prior.point, lead, end, 0))
        self.prior = prior
        self.far = Far()
        state.narrowed = {}
        state.drop_keyframes()

    def whole(self) -> Smoother:
        """A copy of the estimate with all control points in the system; it shares what was measured."""
        if self.state.whole:
            return self
        other = copy(self)
        other.state = copy(self.state)
        other.state.vector = self.state.vector.copy()
        other.history = None
        other.join()
        return other

    def _cut_history(self) -> None:
        """The segment under way ends, since its control points are no longer the system's."""
        if self.history is not None:
            self.history.cut(*self.state.control_ids())

    # --- what leaves -------------------------------------------------------------------------------------

    def marginalize(self) -> None:
        """Poses older than the lag leave into the prior."""
        while len(self.times) > 1 and self.times[-1] - self.times[0] > self.settings.lag + TIME_TOLERANCE:
            self._marginalize_oldest()

    def _marginalize_oldest(self) -> None:
        """`L <- H_bb - H_ba H_aa^-1 H_ab` over the prior and every row that touches the oldest pose.

        It stays, as a keyframe, where far control points hang on it.
        """
        step, state = self.last_step, self.state
        assert step is not None
        low = state.near_size + CALIBRATION_SIZE + POSE * state.keyframes
        halves = [rows.split(low, low + POSE) for rows in step.groups]
        touching = [leaving for leaving, _ in halves]
        size = max(low + 2 * POSE, len(self.prior.point), *(rows.reach for rows in touching))
        hessian, descent = accumulate(touching, size)
        self._remember(hessian, descent, step.point[:size])
        q = len(self.prior.point)
        hessian[:q, :q] += self.prior.information
        descent[:q] += self.prior.descent_at(step.point)
        if self.far.anchor == self.first_cycle:
            self.prior = Prior(hessian, descent, step.point[:size])
            step.groups = [staying for _, staying in halves]
            state.keep_oldest_pose()
        else:
            information, gradient = schur_leave(hessian, descent, low, low + POSE)
            self.prior = Prior(information, gradient, without(step.point[:size], low, low + POSE, 0))
            step.point = without(step.point, low, low + POSE, 0)
            step.groups = [staying.without(low, low + POSE) for _, staying in halves]
            state.drop_oldest_pose()
        step.dropped += 1
        self._forget_oldest()

    def _remember(self, hessian: Array, descent: Array, point: Array) -> None:
        """The history is told of what leaves; of the pose that far control points hang on it has its own."""
        if self.history is None:
            return
        state = self.state
        low = state.near_size + CALIBRATION_SIZE
        if state.keyframes:
            high = low + POSE
            hessian = without(without(hessian, low, high, 0), low, high, 1)
            descent, point = without(descent, low, high, 0), without(point, low, high, 0)
        self.history.leave(hessian, descent, point, *state.control_ids())

    def _forget_oldest(self) -> None:
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
        whole = self.whole()
        factor = whole._undamped_factor()
        half, _ = lapack.dtrtrs(factor, np.eye(len(factor), whole.state.map_size), lower=1)
        return np.asarray(half.T @ half)

    def _undamped_factor(self) -> Array:
        groups, state = self.linearize(), self.state
        system = state.vector[state.system]
        return cholesky(normal_equations(groups, self.prior, state, system)[0], overwrite=True)
