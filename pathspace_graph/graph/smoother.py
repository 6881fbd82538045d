"""The fixed-lag smoother: a window of GTSAM factors on the map and the last few seconds of poses.

In each cycle the stale factors of the window are linearized again. `graph.hessian(ordering)` and one dense
Cholesky factor give the step and the joint covariance. Then the oldest pose is eliminated, and the graph that
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

from .chain import Follower, InactiveChain
from .gaussian import (
    FactoredSystem,
    as_hessian_factor,
    as_rows,
    cholesky,
    factorize,
    graph_of,
    jacobian_factor,
    marginalize,
    merge_variables,
    normal_equations,
    remove_information,
    solve,
    sparse_marginal,
    substitute_points,
)
from .inactive import InactiveMap
from .keys import (
    CALIBRATION_KEY,
    POINT,
    POSE,
    POSE_LETTER,
    SENSOR_KEY,
    SENSOR_LETTER,
    are_poses,
    indices,
    name,
    pose_key,
    pose_keys,
)
from .odometry import calibrated_delta
from .rows import Rows
from .submaps import Submaps
from .uncertainty import predicted_covariance
from .user_factors import UserFactors
from .variables import Layout
from .window import M_co, WindowFactors

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]

TIME_TOLERANCE = 1e-9
"""A pose leaves once it is older than the lag by more than this time (s), since stamps have round-off."""


@dataclass(frozen=True)
class SmootherSettings:
    """Settings of the fixed-lag smoother."""

    lag: float
    """Poses stay in the window for this time (s)."""
    tolerances: tuple[float, float]
    """Factors are linearized again where a point or a position has moved by the first tolerance (m), or a
    heading by the second (rad)."""
    keyframe_interval: float
    """The keyframes of the submaps are this length of path (m) apart."""
    sigma_calibration: tuple[float, float]
    """These are the prior sigmas of the calibration: scale error (-) and bias of the yaw rate (rad/s)."""
    sigma_sensor: tuple[float, ...] = ()
    """These are the prior sigmas of the sensor's calibration, none where it is not estimated."""
    relative: bool = False
    """While the loop is open, each part of the map is known in the frame of a pose beside it. The rows of the
    map must not change under a rigid motion of all variables."""


class FixedLagSmoother(Generic[M_co]):
    """Holds the variables, the factors of the window, and the prior from everything that has left it."""

    def __init__(self, settings: SmootherSettings, map_rows: M_co) -> None:
        self.settings = settings
        """These are the settings of the window."""
        self.map = map_rows
        """This is the map, with the detections of the poses in the window."""
        self.variables = map_rows.variables
        """These are all variables, active and inactive."""
        self.times: list[float] = []
        """These are the stamps (s) of the poses in the window."""
        self.window = WindowFactors(map_rows, settings.tolerances)
        """These are the factors of the poses in the window, and their odometry."""
        self.user_factors = UserFactors()
        """These are the user's own factors."""
        self.prior = gtsam.GaussianFactorGraph()
        """The prior holds the information from everything that has left the window."""
        self.inactive = InactiveChain() if settings.relative else InactiveMap()
        """These are the variables that a cycle does not solve for."""
        self.followers: list[Follower] = []
        """These are moved together with the open map."""
        self.submaps: Submaps | None = None
        """These hold the prior in submaps, while the loop is open and the user gave no factors on poses."""
        self.last_step: FactoredSystem | None = None
        """The last Gauss-Newton step solved this damped system; it is None before the first step."""
        self.calibration_sigma: Array = np.array([*settings.sigma_calibration, *settings.sigma_sensor])
        """The priors of the calibrations have these standard deviations, (2,) or (7,)."""
        self.epoch = 0
        """This counts the changes of the prior other than the marginalization of a pose."""
        self._begin_calibration()

    # --- new variables and factors -----------------------------------------------------------------------

    @property
    def first_cycle(self) -> int:
        """Returns the perception cycle of the oldest pose in the window."""
        return self.variables.first_cycle

    @property
    def next_cycle(self) -> int:
        """Returns the number of the next perception cycle, counted from 0."""
        return self.first_cycle + len(self.times)

    def _begin_calibration(self) -> None:
        own = (CALIBRATION_KEY, self.settings.sigma_calibration), (SENSOR_KEY, self.settings.sigma_sensor)
        for key, sigma in own:
            if len(sigma):
                keys, zero = np.array([key]), np.zeros(len(sigma))
                self.variables.insert(keys, zero)
                self.prior.push_back(jacobian_factor(keys, np.diag(1.0 / np.array(sigma)), zero))

    def widen_calibrations(self, sigma: Array) -> None:
        """Gives the priors of the calibrations other standard deviations, (2,) or (7,).

        Calibrations are never eliminated, so their priors are terms of the sum, and are exchanged exactly.
        """
        if (sigma == self.calibration_sigma).all():
            return
        keys, zero = self.variables.calibration_keys, np.zeros(len(sigma))
        before, after = (
            jacobian_factor(keys, np.diag(1.0 / one), zero) for one in (self.calibration_sigma, sigma)
        )
        self.calibration_sigma, self.epoch = sigma, self.epoch + 1
        self.prior = graph_of(self.prior, after, before.negate())
        if self.submaps is not None:
            self.submaps.first = graph_of(self.submaps.first, after, before.negate())

    def measure_bias(self, value: float, sigma: float) -> None:
        """Adds a measurement of the yaw rate's bias (rad/s), which a vehicle at rest makes."""
        keys, row = np.array([CALIBRATION_KEY]), np.array([[0.0, 1.0 / sigma]])
        reference = self.variables.reference[self.variables.layout.entries(keys)]
        measured = jacobian_factor(keys, row, row @ (np.array([0.0, value]) - reference))
        self.prior, self.epoch = graph_of(self.prior, measured), self.epoch + 1
        if self.submaps is not None:
            self.submaps.first = graph_of(self.submaps.first, measured)

    def predict(
        self, t: float, odometry: IntegratedOdometry, sigmas_start: tuple[float, float, float]
    ) -> Array:
        """Adds and returns the pose (3,) at t (s), predicted by the calibrated odometry since the newest one.

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

    def add_first_pose(self, t: float, pose: Array, covariance: Array) -> None:
        """Adds the first pose (3,) with its covariance (3, 3), in the map frame."""
        key = pose_keys(np.array([self.next_cycle]))
        self.variables.insert(key, pose)
        self.times.append(t)
        root = np.linalg.cholesky(np.linalg.inv(covariance)).T
        self.prior.push_back(jacobian_factor(key, root, np.zeros(POSE)))
        self.submaps = Submaps(graph_of(self.prior), self.settings.keyframe_interval)

    def add_pose(self, t: float, pose: Array, odometry: IntegratedOdometry) -> None:
        """Adds the next pose (3,) at t (s), and the odometry that leads to it."""
        self.window.of_cycle.pop(self.next_cycle - 1, None)
        self.variables.insert(pose_keys(np.array([self.next_cycle])), pose)
        self.times.append(t)
        self.window.odometry.append(odometry)

    def add_factors(self, factors: Sequence[gtsam.NonlinearFactor]) -> None:
        """Adds the user's factors on any variables, and on the pose of the next cycle.

        Factors on poses may be absolute, which a submap cannot be. So submaps are dropped then, and the prior
        keeps its linearization point when the loop closes. Inactive variables of a factor become active.
        SettingsError where a key is not known.
        """
        if not factors:
            return
        window = (
            f"poses in the window, {name(pose_key(self.first_cycle))} to {name(pose_key(self.next_cycle))}"
        )
        expected = f"{window}, of control points and of the calibration"
        if self.user_factors.add(factors, self._is_known, expected):
            self.submaps = None
        if self.chain is not None or np.isin(self.user_factors.keys, self.inactive.keys).any():
            self.reactivate()

    def _is_known(self, key: int) -> bool:
        """Returns whether a user's factor may hold a key."""
        cycle = int(indices(np.array(key)))
        if are_poses(np.array(key)):
            return self.first_cycle <= cycle <= self.next_cycle
        return bool(self.variables.layout.positions(np.array(key)) >= 0)

    def remove_information(self, keys: IntArray) -> None:
        """Removes all prior information about map points."""
        self.activate(keys)
        self.epoch += 1
        now = self.variables.change(self.variables.layout.entries(keys))
        self.prior = remove_information(self.prior, Layout(keys), now)
        if self.submaps is not None:
            self.submaps.remove_information(keys, self.variables)

    # --- the graph ---------------------------------------------------------------------------------------

    @property
    def layout(self) -> Layout:
        """Returns the columns of the active variables, which a step solves for."""
        return self.inactive.active(self.variables.layout)

    def linear_graph(self, whole: bool = False) -> gtsam.GaussianFactorGraph:
        """Returns the window and its prior, linearized at the variables' values, and changes nothing.

        The unknowns are `value - reference`, with poses (x, y, theta) in the map frame. If `whole`, the graph
        is also on the inactive variables, which must be up to date.
        """
        if self.chain is not None:
            prior = self.chain.joint(self.prior, self.variables) if whole else self.absolute_prior()
            return graph_of(prior, *self.window.fresh(self._cycles, False))
        own = self.window.fresh(self._cycles, whole)
        prior = self.inactive.joint_prior(self.prior) if whole else self.prior
        return graph_of(prior, *own, *self.user_factors.linearized(self.variables, whole))

    def absolute_prior(self) -> gtsam.GaussianFactorGraph:
        """Returns the prior of the active variables in the map frame.

        The inactive variables must be up to date.
        """
        if self.chain is None or len(self.chain) == 0:
            return self.prior
        return self.chain.marginal(self.prior, self.variables)

    @property
    def _cycles(self) -> IntArray:
        """Returns the perception cycles of the window."""
        return np.arange(self.first_cycle, self.next_cycle)

    # --- Gauss-Newton ------------------------------------------------------------------------------------

    def step(self, sigma_step: float | None = None) -> None:
        """Takes one Gauss-Newton step; `sigma_step` (m) damps it as a prior on the motion of map points."""
        negative_gradient = self.factorize(sigma_step)
        assert self.last_step is not None
        entries = self.variables.layout.entries(self.last_step.layout.keys)
        self.variables.values[entries] += solve(self.last_step.factor, negative_gradient)
        self.map.correct()

    def factorize(self, sigma_step: float | None = None) -> Array:
        """Factors the system of a step into `last_step`, and returns the negative gradient (n,).

        No variable moves. SingularSystemError where the system is not positive definite.
        """
        while not self.window.relinearize(self._cycles, self.inactive.members) and len(self.inactive):
            self.activate(self.inactive.newest)  # rare: a detection has moved to where the map is inactive
        user, layout = self.user_factors.linearized(self.variables), self.layout
        held = self.chain.hold(self.variables) if self.chain is not None else []
        graph = graph_of(self.prior, *self.window.linear, *user, *held)
        hessian, vector = normal_equations(graph, layout)
        now = self.variables.change(self.variables.layout.entries(layout.keys))
        negative_gradient = vector - hessian @ now
        if sigma_step is not None:
            first, last = layout.block(SENSOR_LETTER).stop, layout.block(POSE_LETTER).start
            points = np.arange(first, last)
            hessian[points, points] += sigma_step**-2
        self.last_step = FactoredSystem(layout, cholesky(hessian))
        return negative_gradient

    # --- inactive variables ------------------------------------------------------------------------------

    def deactivate(self, keys: IntArray) -> None:
        """Deactivates active map points (k,) on which the window has no factor."""
        if len(keys) == 0:
            return
        shared = [*self.window.weak_on(keys), *self.user_factors.deactivate(keys, self.variables)]
        user = self.user_factors.remove(keys, self.variables)
        keyframes = self.variables.keyframes
        self._finish_submap()
        if self.chain is not None:
            self.prior = self.chain.attach(self.prior, keys, shared, self.variables)
        else:
            self.prior = self.inactive.push(graph_of(self.prior, *user), keys, keyframes, shared)
        self.variables.remove(keyframes)
        self.window.drop(self.inactive.members)  # a factor linearized earlier may still hold one of them

    def _finish_submap(self) -> None:
        """Finishes the current submap, so that it stays small when other map points become active."""
        if self.submaps is not None:
            self.submaps.finish(self.variables)
            if self.chain is not None and len(self.chain):
                anchor = int(self.chain.anchors[0])
                self.submaps.hang(anchor, self.variables.of(self.chain.anchors))

    @property
    def chain(self) -> InactiveChain | None:
        """Returns the inactive part of an open map; it is None where parts are in the map frame."""
        return self.inactive if isinstance(self.inactive, InactiveChain) else None

    def carry(self) -> None:
        """Moves an open map so that the drive began at the origin, after its inactive part is updated."""
        if self.chain is None or len(self.chain) == 0:
            return
        self._finish_submap()
        self.prior = self.chain.carry(self.prior, self.variables, self.followers)
        self.window.relinearize(self._cycles, self.inactive.members)

    def activate(self, keys: IntArray) -> None:
        """Makes map points (k,) active, and at least all that depend on them."""
        if self.chain is None:
            self.reactivate()
            return
        if not self.chain.holds(keys):
            return
        self._finish_submap()
        self.refresh()
        self._place_keyframes(self.chain)
        while self.chain.holds(keys):
            back = self.chain.newest
            self.prior = graph_of(as_rows(graph_of(self.prior, self.chain.detach(self.variables))))
            self.map.activate(back)

    def refresh(self) -> None:
        """Updates the inactive variables."""
        self.inactive.refresh(self.variables)

    def reactivate(self, with_prior: bool = True) -> None:
        """Makes all variables active, and returns the information about them to the prior.

        Without `with_prior` the prior is left alone, because the submaps will replace it.
        """
        if self.chain is not None:
            self._unchain(self.chain)
        elif len(self.inactive) == 0:
            return
        else:
            self._finish_submap()
            self.refresh()
            if with_prior:
                self.prior = self.inactive.joint_prior(self.prior)
        self.inactive = InactiveMap()
        self.user_factors.reactivate()
        self._marginalize_keyframes()
        self.map.activate_all()

    def _unchain(self, chain: InactiveChain) -> None:
        """Makes the variables of an open map active; its anchors are keyframes."""
        self.carry()
        self._finish_submap()
        self.refresh()
        self._place_keyframes(chain)
        self.prior = graph_of(self.prior, *(chain.detach(self.variables) for _ in range(len(chain))))

    def _place_keyframes(self, chain: InactiveChain) -> None:
        """Places the keyframes of the submaps beside their anchors, which may be no anchors from now on."""
        if self.submaps is not None:
            anchors = np.union1d(chain.anchors, self.variables.keyframes)
            active = {int(key): self.variables.of(np.array([key])) for key in anchors}
            self.submaps.carry(chain.poses | active)

    def _marginalize_keyframes(self) -> None:
        keyframes = self.variables.keyframes
        self.prior = marginalize(self.prior, keyframes)
        self.variables.remove(keyframes)

    # --- marginalization ---------------------------------------------------------------------------------

    def marginalize(self, held_from: int | None = None) -> None:
        """Marginalizes poses that are older than the lag, but none of the cycles from `held_from` on."""
        while len(self.times) > 1 and self.times[-1] - self.times[0] > self.settings.lag + TIME_TOLERANCE:
            if self.first_cycle == held_from:
                return
            self._marginalize_oldest()

    def _marginalize_oldest(self) -> None:
        """Adds the factors of the oldest pose to the prior, and marginalizes the pose.

        The pose stays as a keyframe where inactive variables depend on it.
        """
        cycle, key = self.first_cycle, pose_key(self.first_cycle)
        user = self.user_factors.remove(np.array([key]), self.variables)
        own = graph_of(self.window.of_cycle.pop(cycle).linear, *user)
        if self.submaps is not None:
            self.submaps.add_pose(key, own, self.variables)
        self.prior = graph_of(self.prior, own)
        self.variables.first_cycle += 1
        if key not in self.inactive.anchors:
            self.prior = marginalize(self.prior, np.array([key]))
            self.variables.remove(np.array([key]))
        self._drop_oldest(cycle)

    def _drop_oldest(self, cycle: int) -> None:
        """Removes the stamp, the odometry and the detections of the oldest pose, which leaves the window."""
        self.times.pop(0)
        self.window.odometry.drop_first()
        self.map.drop_cycle(cycle)

    # --- loop closure and other variables ----------------------------------------------------------------

    def solve_loop(self, iterations: int, sigma_step: float | None) -> None:
        """Optimizes the whole loop on the graph of its submaps, each relinearized in its own frame.

        The keyframes are variables during the optimization, and are marginalized afterwards. Without submaps
        (a user's factors are absolute) the prior keeps its linearization point.
        """
        self.reactivate(with_prior=self.submaps is None)
        submaps, self.submaps, self.epoch = self.submaps, None, self.epoch + 1
        if submaps is not None:
            submaps.finish(self.variables)
            submaps.insert_keyframes(self.variables)
        for _ in range(iterations):
            if submaps is not None:
                self.prior = submaps.graph(self.variables)
            self.step(sigma_step)
        self._marginalize_keyframes()

    def substitute(self, old: IntArray, new: IntArray, points: Array, change: Array, sigma: float) -> None:
        """Replaces map points `old` (n,) by `new` (k,) at `points` (k, 2): `c_old = E c_new + N(0, sigma^2)`.

        E is `change` (n, k). The prior of the old points is carried over, reduced by a shift of sigma (m).
        """
        self.epoch += 1
        user = self.user_factors.remove(old, self.variables)
        reference = self.variables.reference[self.variables.layout.entries(old)]
        offset = np.kron(change, np.eye(POINT)) @ points.ravel() - reference
        self.prior = substitute_points(graph_of(self.prior, *user), old, new, change, offset, sigma)
        self.variables.remove(old)
        self.variables.insert(new, points.ravel())
        self.window.clear()

    def merge(self, removed: IntArray, kept: IntArray) -> None:
        """Merges map points `removed` (k,) into points `kept` (k,), which keep their values.

        The prior is transformed exactly. Submaps are not, so the loop must be closed. The map's rows must be
        on the kept keys from now on.
        """
        self.epoch += 1
        user, layout = self.user_factors.remove(removed, self.variables), self.variables.layout
        reference = self.variables.reference
        offset = reference[layout.entries(kept)] - reference[layout.entries(removed)]
        self.prior = merge_variables(graph_of(self.prior, *user), removed, kept, offset)
        self.variables.remove(removed)
        self.window.clear()

    def restart(self, first_cycle: int, removed: IntArray, added: IntArray, points: Array) -> None:
        """Replaces map points `removed` (n,) by `added` (k,) at `points` (k, 2), and drops the prior.

        Poses before `first_cycle` leave the window, and what is known of them is dropped as well. The window
        keeps its later poses with their odometry. A new prior must be set, on all that remains.
        """
        self.epoch, self.submaps, self.inactive = self.epoch + 1, None, InactiveMap()
        self.prior, keyframes = gtsam.GaussianFactorGraph(), self.variables.keyframes
        leaving = np.arange(self.first_cycle, first_cycle)
        for cycle in leaving.tolist():
            self._drop_oldest(cycle)
        self.variables.first_cycle = first_cycle
        self.variables.remove(np.concatenate([keyframes, pose_keys(leaving), removed]))
        self.variables.insert(added, points.ravel())
        self.window.clear()

    def forget_poses(self, first_cycle: int) -> None:
        """Removes the poses before `first_cycle`, and all prior information about where the poses are.

        The window keeps its later poses with their odometry, and the prior keeps what is known of the map and
        the calibration. A prior must be set for one of the poses, by `add_pose_prior`.
        """
        self.reactivate()
        self.epoch, self.submaps = self.epoch + 1, None
        window, leaving = pose_keys(self._cycles), np.arange(self.first_cycle, first_cycle)
        user = self.user_factors.remove(pose_keys(leaving), self.variables)
        self.prior = marginalize(graph_of(self.prior, *user), window)
        for cycle in leaving.tolist():
            self._drop_oldest(cycle)
        self.variables.first_cycle = first_cycle
        self.variables.remove(pose_keys(leaving))
        self.window.clear()

    def add_pose_prior(self, cycle: int, covariance: Array) -> None:
        """Adds a prior to the pose of a cycle at its present value, with a covariance (3, 3), map frame."""
        key = pose_keys(np.array([cycle]))
        root = np.asarray(np.linalg.cholesky(np.linalg.inv(covariance)).T, np.float64)
        now = self.variables.change(self.variables.layout.entries(key))
        self.prior.push_back(jacobian_factor(key, root, root @ now))

    def set_prior(self, keys: IntArray, mean: Array, information: Array) -> None:
        """Sets the prior to a Gaussian of ascending keys (k,), with mean (n,) and information (n, n)."""
        root = np.asarray(np.linalg.cholesky(information).T, np.float64)
        change = mean - self.variables.reference[self.variables.layout.entries(keys)]
        self.prior = graph_of(as_hessian_factor(graph_of(jacobian_factor(keys, root, root @ change))))

    # --- covariances -------------------------------------------------------------------------------------

    def last_covariance(self, keys: IntArray) -> Array:
        """Returns the joint covariance (q, q) of variables (k,) in the last step, in their order."""
        assert self.last_step is not None
        return self.last_step.covariance(keys)

    def covariance(self, keys: IntArray) -> Array:
        """Returns the joint covariance (q, q) of variables (k,) at the estimate, without damping.

        It is in the order of the keys, with poses as (x, y, theta) in the map frame (m, m, rad).
        """
        whole = bool(np.isin(keys, self.inactive.keys).any())
        if whole or self.chain is not None:
            self.refresh()
        if whole and self.chain is not None:
            marginal = sparse_marginal(self.linear_graph(True), keys)
            return factorize(marginal, Layout(np.sort(keys))).covariance(keys)
        layout = self.variables.layout if whole else self.layout
        return factorize(self.linear_graph(whole), layout).covariance(keys)

    def predicted_covariance(self, rows: Rows, together: int = 1) -> Array:
        """Returns the predicted covariances `J Sigma J'` (m / k, k, k) of every k = `together` rows.

        The pose is the first key of a row, and Sigma is the covariance of the last step. The newest pose was
        not in that step, so it is replaced by its prediction from the pose before. An inactive map point
        contributes nothing.
        """
        assert self.last_step is not None
        newest = self.variables.poses[-2:], self.window.odometry, self.next_cycle - 1
        return predicted_covariance(self.last_step, rows, *newest, together)
