"""The fixed-lag smoother: a window of GTSAM factors on the map and the last few seconds of poses.

Each cycle, the stale factors of the window are linearized anew, `graph.hessian(ordering)` and one dense
Cholesky factor give the step and the joint uncertainty, and the oldest pose is eliminated; the graph that
remains is the prior. GTSAM's own fixed-lag smoothers freeze the linearization point of every variable that a
marginal touches, which here is the whole map.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic

import gtsam
import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.odometry import IntegratedOdometry
from pathspace_graph.factors.se2 import compose

from .gaussian import (
    cholesky,
    covariance,
    covariance_of,
    eliminate,
    graph_of,
    half_solve,
    jacobian_factor,
    marginalize,
    merge_variables,
    normal_equations,
    remove_information,
    solve,
)
from .inactive import InactiveMap
from .keys import (
    CALIBRATION_KEY,
    CALIBRATION_LETTER,
    POINT,
    POSE,
    POSE_LETTER,
    are_poses,
    indices,
    name,
    pose_key,
    pose_keys,
)
from .odometry import calibrated_delta, through_odometry
from .rows import Rows
from .submaps import Submaps
from .user_factors import UserFactors
from .variables import Layout
from .window import M_co, WindowFactors

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]

TIME_TOLERANCE = 1e-9
"""A pose leaves where it is older than the lag by more than this (s): stamps are sums of decimals."""


@dataclass(frozen=True)
class SmootherSettings:
    """What the window is told."""

    lag: float
    """Time (s) that poses stay in the window."""
    tolerances: tuple[float, float]
    """Of relinearization: of points and positions (m) and of headings (rad)."""
    keyframe_interval: float
    """Path (m) between the keyframes of the submaps."""
    sigma_calibration: tuple[float, float]
    """Prior of the calibration: scale error (-), bias of the yaw rate (rad/s), one sigma."""


@dataclass(frozen=True, eq=False)
class Step:
    """What the last Gauss-Newton step solved."""

    layout: Layout
    """Columns of its variables."""
    factor: Array
    """(n, n) lower Cholesky factor of the damped system."""


class FixedLagSmoother(Generic[M_co]):
    """Variables, what was measured in the window, and the prior that stands for all that has left it."""

    def __init__(self, settings: SmootherSettings, track: M_co) -> None:
        self.settings = settings
        self.map = track
        """The map, and the readings of the poses in the window."""
        self.variables = track.variables
        self.times: list[float] = []
        """Stamp (s) of each pose in the window."""
        self.window = WindowFactors(track, settings.tolerances)
        """The factors of the poses in the window, and their odometry."""
        self.user_factors = UserFactors()
        """The user's own."""
        self.prior = gtsam.GaussianFactorGraph()
        """What is known from all that has left the window."""
        self.inactive = InactiveMap()
        """What is known of the variables that are not solved for in a cycle."""
        self.submaps: Submaps | None = None
        """The same prior stretch by stretch, while the loop is open and the user gave no factors."""
        self.last_step: Step | None = None
        """None before the first."""
        self._active: tuple[Layout, int] | None = None
        self._layout = Layout(np.zeros(0, np.intp))
        self.epoch = 0
        """How often the prior was made anew by anything but a pose that left."""
        self._begin_calibration()

    # --- what comes in -----------------------------------------------------------------------------------

    @property
    def first_cycle(self) -> int:
        """Perception cycle of the oldest pose in the window."""
        return self.variables.first_cycle

    @property
    def next_cycle(self) -> int:
        """Number of the perception cycle that comes next, from 0."""
        return self.first_cycle + len(self.times)

    def _begin_calibration(self) -> None:
        key, sigma = np.array([CALIBRATION_KEY]), np.array(self.settings.sigma_calibration)
        self.variables.insert(key, np.zeros(POINT))
        self.prior.push_back(jacobian_factor(key, np.diag(1.0 / sigma), np.zeros(POINT)))

    def predict(
        self, t: float, odometry: IntegratedOdometry, sigmas_start: tuple[float, float, float]
    ) -> Array:
        """The pose (3,) at t (s), predicted by the calibrated odometry since the newest one; and gives it.

        The drive starts at (0, 0, 0) with standard deviations `sigmas_start` (m, m, rad).
        """
        delta = calibrated_delta(odometry, self.variables.calibration)
        if self.times:
            pose = compose(self.variables.poses[-1], delta)
            self.add_pose(t, pose, odometry)
        else:
            pose = compose(np.zeros(POSE), delta)
            self.add_first_pose(t, pose, odometry.covariance + np.diag(sigmas_start) ** 2)
        return pose

    def add_first_pose(self, t: float, pose: Array, sigma: Array) -> None:
        """The first pose (3,), with its covariance (3, 3) in the map frame."""
        key = pose_keys(np.array([self.next_cycle]))
        self.variables.insert(key, pose)
        self.times.append(t)
        root = np.linalg.cholesky(np.linalg.inv(sigma)).T
        self.prior.push_back(jacobian_factor(key, root, np.zeros(POSE)))
        self.submaps = Submaps(graph_of(self.prior), self.settings.keyframe_interval)

    def add_pose(self, t: float, pose: Array, odometry: IntegratedOdometry) -> None:
        """The next pose (3,), and how it was reached."""
        self.window.of_cycle.pop(self.next_cycle - 1, None)
        self.variables.insert(pose_keys(np.array([self.next_cycle])), pose)
        self.times.append(t)
        self.window.odometry.append(odometry)

    def add_factors(self, factors: Sequence[gtsam.NonlinearFactor]) -> None:
        """The user's factors, on any variable, and on the pose of the cycle that comes next.

        On poses they may be absolute, which no submap can be: submaps are given up then, and when the loop
        closes, the prior stays linearized where it is. Inactive variables that a factor holds become active.
        """
        if not factors:
            return
        window = (
            f"poses in the window, {name(pose_key(self.first_cycle))} to {name(pose_key(self.next_cycle))}"
        )
        expected = f"{window}, of control points and of the calibration"
        if self.user_factors.add(factors, self._is_known, expected):
            self.submaps = None
        if np.isin(self.user_factors.keys, self.inactive.keys).any():
            self.reactivate()

    def _is_known(self, key: int) -> bool:
        cycle = int(indices(np.array(key)))
        if are_poses(np.array(key)):
            return self.first_cycle <= cycle <= self.next_cycle
        return bool(self.variables.layout.positions(np.array(key)) >= 0)

    def remove_information(self, keys: IntArray) -> None:
        """Removes all prior information about map points."""
        self.reactivate()
        self.epoch += 1
        now = self.variables.change(self.variables.layout.entries(keys))
        self.prior = remove_information(self.prior, Layout(keys), now)
        if self.submaps is not None:
            self.submaps.remove_information(keys, self.variables)

    # --- the graph ---------------------------------------------------------------------------------------

    @property
    def layout(self) -> Layout:
        """Columns of the active variables: the system that a step solves."""
        known = self._active
        if known is None or known[0] is not self.variables.layout or known[1] != len(self.inactive):
            self._layout = self._new_layout()
            self._active = self.variables.layout, len(self.inactive)
        return self._layout

    def _new_layout(self) -> Layout:
        if len(self.inactive.keys) == 0:
            return self.variables.layout
        active = np.ones(len(self.variables.keys), bool)
        active[self.variables.layout.positions(self.inactive.keys)] = False
        return Layout(self.variables.keys[active])

    def linear_graph(self, whole: bool = False) -> gtsam.GaussianFactorGraph:
        """The window and its prior, all linearized at the variables' values; nothing changes.

        Its unknowns are `value - reference`, poses (x, y, theta) in the map frame. `whole`: of the inactive
        variables too, which are to be up to date.
        """
        own = self.window.fresh(self._cycles, whole)
        prior = self.inactive.joined(self.prior) if whole else self.prior
        return graph_of(prior, *own, *self.user_factors.linearized(self.variables, whole))

    @property
    def _cycles(self) -> IntArray:
        return np.arange(self.first_cycle, self.next_cycle)

    # --- Gauss-Newton ------------------------------------------------------------------------------------

    def step(self, sigma_step: float | None = None) -> None:
        """One Gauss-Newton step; where given, a map point moves `sigma_step` (m) freely, which damps it."""
        negative_gradient = self.factorize(sigma_step)
        assert self.last_step is not None
        entries = self.variables.layout.entries(self.last_step.layout.keys)
        self.variables.values[entries] += solve(self.last_step.factor, negative_gradient)

    def factorize(self, sigma_step: float | None = None) -> Array:
        """The step's system and its Cholesky factor; gives the negative gradient (n,). No variable moves."""
        if not self.window.relinearize(self._cycles, self.inactive.members):
            self.reactivate()  # a reading has slid to where the map is inactive: rare, since there is room
            self.window.relinearize(self._cycles, self.inactive.members)
        user, layout = self.user_factors.linearized(self.variables), self.layout
        graph = graph_of(self.prior, *self.window.linear, *user)
        hessian, vector = normal_equations(graph, layout)
        negative_gradient = vector - hessian @ self.variables.change(
            self.variables.layout.entries(layout.keys)
        )
        if sigma_step is not None:
            first, last = layout.block(CALIBRATION_LETTER).stop, layout.block(POSE_LETTER).start
            points = np.arange(first, last)
            hessian[points, points] += sigma_step**-2
        self.last_step = Step(layout, cholesky(hessian))
        return negative_gradient

    # --- what is inactive --------------------------------------------------------------------------------

    def deactivate(self, keys: IntArray) -> None:
        """Map points (k,), active up to now, that nothing in the window touches leave the system."""
        if len(keys) == 0:
            return
        shared = [*self.window.weak_on(keys), *self.user_factors.set_aside(keys, self.variables)]
        held = self.user_factors.leave(keys, self.variables)
        keyframes = self.variables.keyframes
        self._cut_submap()
        prior = graph_of(self.prior, *held)
        self.prior = self.inactive.push(prior, keys, keyframes, shared)
        self.variables.remove(keyframes)
        self.window.drop(self.inactive.members)  # one that was linearized long ago may hold what it held then

    def _cut_submap(self) -> None:
        """The submap under way ends where other map points are active than before: it stays small."""
        if self.submaps is not None:
            self.submaps.cut(self.variables)

    def refresh(self) -> None:
        """Bring the inactive variables up to date."""
        self.inactive.refresh(self.variables)

    def reactivate(self, with_prior: bool = True) -> None:
        """All variables come back into the system, and what is known of them into the prior.

        Not that where the submaps are to take the prior's place.
        """
        if len(self.inactive) == 0:
            return
        self._cut_submap()
        self.refresh()
        if with_prior:
            self.prior = self.inactive.joined(self.prior)
        self.inactive = InactiveMap()
        self.user_factors.take_back()
        self._drop_keyframes()
        self.map.all_active()

    def _drop_keyframes(self) -> None:
        """The keyframes leave the variables and the prior."""
        keyframes = self.variables.keyframes
        self.prior = marginalize(self.prior, keyframes)
        self.variables.remove(keyframes)

    # --- what leaves -------------------------------------------------------------------------------------

    def marginalize(self) -> None:
        """Poses older than the lag leave into the prior."""
        while len(self.times) > 1 and self.times[-1] - self.times[0] > self.settings.lag + TIME_TOLERANCE:
            self._marginalize_oldest()

    def _marginalize_oldest(self) -> None:
        """The factors of the oldest pose join the prior, and it is eliminated.

        It stays, as a keyframe, where inactive variables hang on it.
        """
        cycle, key = self.first_cycle, pose_key(self.first_cycle)
        held = self.user_factors.leave(np.array([key]), self.variables)
        own = graph_of(self.window.of_cycle.pop(cycle).linear, *held)
        if self.submaps is not None:
            self.submaps.leave(key, own, self.variables)
        self.prior = graph_of(self.prior, own)
        self.variables.first_cycle += 1
        if key not in self.inactive.anchors:
            self.prior = marginalize(self.prior, np.array([key]))
            self.variables.remove(np.array([key]))
        self.times.pop(0)
        self.window.odometry.drop_first()
        self.map.leave(cycle)

    # --- closing -----------------------------------------------------------------------------------------

    def solve_loop(self, iterations: int, sigma_step: float | None) -> None:
        """Solve the whole loop on the graph of its submaps, each relinearized in its own frame.

        The keyframes are variables while it is solved, and are eliminated then. Without submaps (a user's
        factors are absolute) the running prior stays linearized where it is.
        """
        self.reactivate(with_prior=self.submaps is None)
        submaps, self.submaps, self.epoch = self.submaps, None, self.epoch + 1
        if submaps is not None:
            submaps.cut(self.variables)
            submaps.insert_keyframes(self.variables)
        for _ in range(iterations):
            if submaps is not None:
                self.prior = submaps.graph(self.variables)
            self.step(sigma_step)
        self._drop_keyframes()

    def substitute(self, old: IntArray, new: IntArray, points: Array, change: Array, sigma: float) -> None:
        """`c_old = E c_new + N(0, sigma^2)`: map points `points` (k, 2) of new keys take the place of old
        ones.

        E is `change` (n, k). A factor ties both, and the old ones are eliminated: what is known of them goes
        over to the new ones, less what a shift by sigma (m) takes from it.
        """
        self.epoch += 1
        held = self.user_factors.leave(old, self.variables)
        reference = self.variables.reference[self.variables.layout.entries(old)]
        by_point = np.kron(change, np.eye(POINT))
        A = np.concatenate([np.eye(len(reference)), -by_point], axis=1) / sigma
        tie = jacobian_factor(np.append(old, new), A, (by_point @ points.ravel() - reference) / sigma)
        self.prior = eliminate(graph_of(self.prior, *held, tie), old)[1]
        self.variables.remove(old)
        self.variables.insert(new, points.ravel())
        self.window.clear()

    def merge(self, gone: IntArray, kept: IntArray) -> None:
        """Map points `gone` (k,) have become others, `kept` (k,), whose values stay as they are.

        What the prior knows of both it knows of one then, exactly; submaps are not told, so the loop is to be
        closed. The window's rows are to be on the new keys from now on.
        """
        self.epoch += 1
        held, layout = self.user_factors.leave(gone, self.variables), self.variables.layout
        reference = self.variables.reference
        offset = reference[layout.entries(kept)] - reference[layout.entries(gone)]
        self.prior = merge_variables(graph_of(self.prior, *held), gone, kept, offset)
        self.variables.remove(gone)
        self.window.clear()

    # --- uncertainty -------------------------------------------------------------------------------------

    def last_covariance(self, keys: IntArray) -> Array:
        """(q, q) joint covariance of variables (k,) in the last step, in the order of the keys."""
        assert self.last_step is not None
        return covariance_of(self.last_step.factor, self.last_step.layout, keys)

    def covariance(self, keys: IntArray) -> Array:
        """(q, q) joint covariance of variables (k,) at the estimate, undamped, in the order of the keys.

        Poses as (x, y, theta) in the map frame (m, m, rad).
        """
        whole = bool(np.isin(keys, self.inactive.keys).any())
        if whole:
            self.refresh()
        layout = self.variables.layout if whole else self.layout
        return covariance(self.linear_graph(whole), layout, keys)

    def predicted_covariance(self, rows: Rows, together: int = 1) -> Array:
        """`J Sigma J'` (m / k, k, k) of each k rows that stand together, the pose first among their keys.

        Sigma is that of the last step. The newest pose was not part of it: it is reached through its
        odometry. A map point that was inactive has no uncertainty there: its reading waits for the next
        cycle.
        """
        step = self.last_step
        assert step is not None
        gradient, row = np.zeros((step.layout.size, len(rows)), order="F"), np.arange(len(rows))
        columns = rows.columns(step.layout)
        known = columns >= 0
        gradient[columns[known], np.broadcast_to(row[:, None], columns.shape)[known]] = rows.jacobian[known]
        noise, newest = np.zeros((len(rows), POSE)), columns[:, 0] < 0
        if newest.any():
            by_last, by_calibration, noise[newest] = through_odometry(
                rows.jacobian[newest, :POSE], self.variables.poses[-2:], self.window.odometry
            )
            before = pose_keys(np.array([self.next_cycle - 2]))
            gradient[step.layout.entries(before)[:, None], row[newest]] += by_last.T
            calibration = step.layout.block(CALIBRATION_LETTER)
            gradient[calibration, row[newest]] += by_calibration.T
        half = half_solve(step.factor, gradient).T.reshape(-1, together, step.layout.size)
        own = noise.reshape(-1, together, POSE)
        return np.asarray(half @ half.transpose(0, 2, 1) + own @ own.transpose(0, 2, 1))
