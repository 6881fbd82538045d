"""The fixed-lag smoother: a window of GTSAM factors on the map and the last few seconds of poses.

In each cycle the system of the window is solved. Then the oldest pose is eliminated, and the graph that
remains is the prior. GTSAM's own fixed-lag smoothers freeze the linearization point of every variable that a
marginal touches, which here is the whole map.
"""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.odometry import IntegratedOdometry
from pathspace_graph.factors.se2 import compose

from .gaussian import (
    as_hessian_factor,
    graph_of,
    jacobian_factor,
    marginalize,
    merge_variables,
    remove_information,
    substitute_points,
)
from .inactive import InactiveMap
from .keys import (
    CALIBRATION_KEY,
    POINT,
    POSE,
    are_poses,
    indices,
    name,
    pose_key,
    pose_keys,
)
from .odometry import calibrated_delta
from .submaps import Submaps
from .system import HeldMap, SmootherSettings, WindowSystem
from .user_factors import check_factors
from .variables import Layout
from .window import M_co

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]

STIFFNESS = 1e4
"""A gauge that is held has this number of times its information."""
TIME_TOLERANCE = 1e-9
"""A pose leaves once it is older than the lag by more than this time (s), since stamps have round-off."""


class FixedLagSmoother(WindowSystem[M_co]):
    """Adds poses to the system of the window, marginalizes the oldest, and closes the loop."""

    def __init__(self, settings: SmootherSettings, map_rows: M_co) -> None:
        super().__init__(settings, map_rows)
        self._begin_calibration()

    # --- new variables and factors -----------------------------------------------------------------------

    def _begin_calibration(self) -> None:
        self.variables.insert_calibrations(self.calibration_prior[0])
        self.prior = graph_of(self.prior, *self._calibration_factors(*self.calibration_prior))

    def believe_calibrations(self, mean: Array, sigma: Array) -> None:
        """Give the priors of the calibrations other means and standard deviations, (2,) or (7,).

        Calibrations are never eliminated, so their priors are terms of the sum, and are exchanged exactly.
        """
        before = self.calibration_prior
        if (mean == before[0]).all() and (sigma == before[1]).all():
            return
        after = self._calibration_factors(mean, sigma)
        negative = [factor.negate() for factor in self._calibration_factors(*before)]
        self.calibration_prior, self.epoch = (mean, sigma), self.epoch + 1
        self.prior = graph_of(self.prior, *after, *negative)
        if self.submaps is not None:
            self.submaps.first = graph_of(self.submaps.first, *after, *negative)

    def _calibration_factors(self, mean: Array, sigma: Array) -> list[gtsam.GaussianConditional]:
        """Return the factor `(b - mean) / sigma` of the calibration of the odometry, and of the sensor."""
        factors = []
        for key in self.variables.calibration_keys:
            keys = np.array([key])
            entries = self.variables.layout.entries(keys)
            root = np.diag(1.0 / sigma[entries])
            factors.append(
                jacobian_factor(keys, root, root @ (mean[entries] - self.variables.reference[entries]))
            )
        return factors

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

    def check_factors(self, factors: Sequence[gtsam.NonlinearFactor]) -> None:
        """Raises a SettingsError for the first of a user's factors that cannot be used; nothing changes."""
        if factors:
            window = f"{name(pose_key(self.first_cycle))} to {name(pose_key(self.next_cycle))}"
            expected = f"poses in the window, {window}, of control points and of the calibration"
            check_factors(factors, self._is_known, expected, self._values_of)

    def _values_of(self, keys: IntArray) -> gtsam.Values:
        """Returns the values of known keys; the pose of the next cycle is where the newest one is."""
        next_key = pose_key(self.next_cycle)
        values = self.variables.gtsam_values(keys[keys != next_key])
        if next_key in keys:
            values.insert(next_key, gtsam.Pose2(*self.variables.poses[-1]) if self.times else gtsam.Pose2())
        return values

    def add_factors(self, factors: Sequence[gtsam.NonlinearFactor]) -> None:
        """Adds the user's factors on any variables, and on the pose of the next cycle, after their check.

        Factors on poses may be absolute, which a submap cannot be. So submaps are dropped then, and the prior
        keeps its linearization point when the loop closes. Inactive variables of a factor become active.
        """
        if not factors:
            return
        if self.user_factors.add(factors):
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

    # --- marginalization ---------------------------------------------------------------------------------

    def marginalize(self, held_from: int | None = None) -> None:
        """Marginalizes poses that are older than the lag, or too many.

        The cycles from `held_from` on stay.
        """
        lag, most = self.settings.lag + TIME_TOLERANCE, self.settings.max_poses
        while len(self.times) > 1 and (self.times[-1] - self.times[0] > lag or len(self.times) > most):
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

    def hold_gauge(self, keys: IntArray, across: Array) -> None:
        """Holds where a closed map as a whole is, by its points (k,) in ascending order.

        The rows C `across` (3, 2k) give the rigid motion (x, y, theta) by `C dx`, for moves dx of the points.
        It is held at the present estimate, where the shape of the map goes on to be estimated.
        """
        self.reactivate()
        known = self.covariance(keys)
        information = STIFFNESS * np.linalg.inv(across @ known @ across.T)
        root = np.linalg.cholesky(information).T @ across
        now = self.variables.change(self.variables.layout.entries(keys))
        self.prior = graph_of(self.prior, jacobian_factor(keys, root, root @ now))
        self.held, self.epoch = HeldMap(keys, known), self.epoch + 1

    def restart(self, first_cycle: int, removed: IntArray, added: IntArray, points: Array) -> None:
        """Replaces map points `removed` (n,) by `added` (k,) at `points` (k, 2), and drops the prior.

        Poses before `first_cycle` leave the window, and what is known of them is dropped as well. The window
        keeps its later poses with their odometry. A new prior must be set, on all that remains.
        """
        self.epoch, self.submaps, self.inactive = self.epoch + 1, None, InactiveMap()
        self.held = None
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
