"""The fixed-lag smoother: a window of factors on the map and the last few seconds of poses.

In each cycle the stale rows of the window are linearized again and added to the Hessian of the prior, and one
dense Cholesky factor gives the step and the joint covariance. Then the oldest pose is eliminated, and the
graph that remains is the prior. GTSAM's own fixed-lag smoothers freeze the linearization point of every
variable that a marginal touches, which here is the whole map.
"""

from collections.abc import Sequence
from typing import Final, Generic, Self

import gtsam
import numpy as np

from pathspace_graph.copies import shallow
from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.linear import keys_of_factor, linear_factor
from pathspace_graph.factors.odometry import IntegratedOdometry
from pathspace_graph.factors.se2 import compose

from .gaussian import (
    FactoredSystem,
    HeldMap,
    absolute_factor,
    as_rows,
    calibration_factors,
    cholesky,
    factorize,
    graph_of,
    jacobian_factor,
    marginalize,
    merge_variables,
    remove_information,
    solve,
    sparse_marginal,
)
from .inactive import Attached, InactiveChain, InactiveMap
from .rows import Rows, at_values, calibrated_delta, newton_system, predicted_covariance, stacked_factor
from .variables import (
    CALIBRATION_KEY,
    NO_KEYS,
    POSE,
    POSE_LETTER,
    SENSOR_LETTER,
    Layout,
    pose_key,
    pose_keys,
    sizes,
)
from .window import M_co, MapRows, SmootherSettings, UserFactors, WindowFactors, check_factors, values_of

NO_INFORMATION: Final = 1e-10  # a factor that removes less of a variance than this share says nothing
TIME_TOLERANCE: Final = 1e-9  # by which a pose must be older than the lag (s), since stamps have round-off


class FixedLagSmoother(Generic[M_co]):
    """Window, prior and inactive part of a map: solves for the active variables, cycle by cycle."""

    def __init__(self, settings: SmootherSettings, map_rows: M_co) -> None:
        self.settings, self.map, self.variables = settings, map_rows, map_rows.variables
        self.times: list[float] = []  # stamps (s) of the poses in the window
        self.window = WindowFactors(map_rows, settings.tolerances)
        self.user_factors = UserFactors()
        self.inactive: InactiveMap = InactiveChain()  # variables that a cycle does not solve for
        self.attached: list[Attached] = []  # what moves with the open map
        self.last_step: FactoredSystem | None = None  # damped system of the last Gauss-Newton step
        self.held: HeldMap | None = None  # what was known of a closed map when its gauge was held
        sigmas = np.array(settings.sigmas_calibrations)
        self.calibration_prior = np.resize(settings.calibrations or 0.0, len(sigmas)), sigmas
        """Means and standard deviations of the priors of the calibrations, (2,) or (7,)."""
        self.variables.insert_calibrations(self.calibration_prior[0])
        self.prior = graph_of(*calibration_factors(self.variables, *self.calibration_prior))
        """Information from everything that has left the window."""

    def copy(self) -> Self:
        """Return a smoother that can go on independently; `attached` is left to its owner."""
        other = shallow(self)
        other.map = self.map.copy()
        other.variables = other.map.variables
        other.times = self.times.copy()
        other.window = self.window.copy()
        other.window.map, other.window.variables = other.map, other.variables
        other.user_factors = shallow(self.user_factors)
        other.inactive = self.inactive.copy()
        return other

    @property
    def first_cycle(self) -> int:
        return self.variables.first_cycle

    @property
    def next_cycle(self) -> int:
        return self.first_cycle + len(self.times)

    @property
    def cycles(self) -> IntArray:
        """Return the cycles (P,) whose poses are in the window."""
        return np.arange(self.first_cycle, self.next_cycle)

    @property
    def layout(self) -> Layout:
        """Return the columns of the active variables, which a step solves for."""
        return self.inactive.active(self.variables.layout)[0]

    @property
    def chain(self) -> InactiveChain | None:
        """Return the inactive part of an open map; None where parts are in the map frame."""
        return self.inactive if isinstance(self.inactive, InactiveChain) else None

    # --- expand: new poses, factors and measurements -----------------------------------------------------

    def predict(
        self, t: float, odometry: IntegratedOdometry, sigmas_start: tuple[float, float, float]
    ) -> Array:
        """Add and return the pose (3,) at t (s), predicted by the calibrated odometry since the newest one.

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
        """Add the first pose (3,) with its covariance (3, 3), in the map frame."""
        self.variables.insert(pose_keys(np.array([self.next_cycle])), pose)
        self.add_pose_prior(self.next_cycle, covariance)
        self.times.append(t)

    def add_pose(self, t: float, pose: Array, odometry: IntegratedOdometry) -> None:
        """Add the next pose (3,) at t (s), and the odometry that leads to it."""
        self.window.extend(self.next_cycle - 1, odometry)
        self.variables.insert(pose_keys(np.array([self.next_cycle])), pose)
        self.times.append(t)

    def add_pose_prior(self, cycle: int, covariance: Array) -> None:
        """Add a prior to the pose of a cycle at its present value, with a covariance (3, 3), map frame."""
        root = np.asarray(np.linalg.cholesky(np.linalg.inv(covariance)).T, np.float64)
        self.prior = graph_of(self.prior, absolute_factor(pose_keys(np.array([cycle])), root, self.variables))

    def check_factors(self, factors: Sequence[gtsam.NonlinearFactor]) -> None:
        check_factors(factors, self.variables, self.next_cycle)

    def informative(self, factors: Sequence[gtsam.NonlinearFactor]) -> list[gtsam.NonlinearFactor]:
        """Return the user's factors, after their check, without those that say nothing.

        With `A d - b` for a linearized factor and Sigma for the covariance of its variables, it says nothing
        where `trace(A Sigma A')`, the largest share of a variance that it removes, is next to round-off. Such
        a factor would still switch off what `add_factors` does. After the first one nothing is left to lose.
        """
        if self.user_factors.given:
            return list(factors)
        return [one for one in factors if self._information_gain(one) > NO_INFORMATION]

    def _information_gain(self, factor: gtsam.NonlinearFactor) -> float:
        """Return `trace(A Sigma A')`; the pose of the next cycle counts with a metre and a radian."""
        linear = factor.linearize(values_of(factor, self.next_cycle, self.variables))
        if linear is None:
            return 0.0
        keys, A = keys_of_factor(linear), np.array(linear.jacobian()[0])
        is_known = keys != pose_key(self.next_cycle)
        by_known = A[:, np.repeat(is_known, sizes(keys))]
        covariance = self.covariance(keys[is_known]) if is_known.any() else np.zeros((0, 0))
        gain = np.einsum("ij,jk,ik->", by_known, covariance, by_known)
        return float(gain + (A**2).sum() - (by_known**2).sum())

    def add_factors(self, factors: Sequence[gtsam.NonlinearFactor]) -> bool:
        """Add the user's factors on any variables, and on the pose of the next cycle, after their check.

        They may be absolute, so an open map gets a frame of its own. Inactive variables of a factor become
        active. Return whether the map was without such a frame.
        """
        had_chain = self.chain is not None
        self.user_factors.add(factors)
        if had_chain or np.isin(self.user_factors.keys, self.inactive.keys).any():
            self.reactivate()
        return had_chain

    def set_calibration_priors(self, mean: Array, sigma: Array) -> None:
        """Give the priors of the calibrations other means and standard deviations, (2,) or (7,).

        Calibrations are never eliminated, so their priors can be exchanged exactly.
        """
        before = self.calibration_prior
        if (mean == before[0]).all() and (sigma == before[1]).all():
            return
        self.calibration_prior = mean, sigma
        negative = [factor.negate() for factor in calibration_factors(self.variables, *before)]
        self.prior = graph_of(self.prior, *calibration_factors(self.variables, mean, sigma), *negative)

    def measure_bias(self, value: float, sigma: float) -> None:
        """Add a measurement of the yaw rate's bias (rad/s), which a vehicle at rest makes."""
        keys, row = np.array([CALIBRATION_KEY]), np.array([[0.0, 1.0 / sigma]])
        measured = absolute_factor(keys, row, self.variables, np.array([0.0, value]))
        self.prior = graph_of(self.prior, measured)

    def add_to_prior(self, groups: Sequence[Rows]) -> None:
        """Add rows at values of zero to the prior, each group as a factor."""
        factors = (stacked_factor([at_values(rows, self.variables)], self.variables) for rows in groups)
        self.prior = graph_of(self.prior, *(factor for found in factors for factor in found))

    # --- update: Gauss-Newton ----------------------------------------------------------------------------

    def step(self, sigma_step: float | None = None) -> None:
        """Take one Gauss-Newton step; `sigma_step` (m) damps it as a prior on the motion of map points."""
        negative_gradient = self.factorize(sigma_step)
        assert self.last_step is not None
        _, entries = self.inactive.active(self.variables.layout)
        self.variables.values[entries] += solve(self.last_step.factor, negative_gradient)
        self.map.correct()

    def factorize(self, sigma_step: float | None = None) -> Array:
        """Factor the system of a step into `last_step`, and return the negative gradient (n,).

        SingularSystemError where the system is not positive definite.
        """
        while not self.window.relinearize(self.cycles, self.inactive.keys) and len(self.inactive):
            self.activate(self.inactive.newest)  # rare: a detection has moved to where the map is inactive
        user = self.user_factors.linearized(self.variables)
        layout, entries = self.inactive.active(self.variables.layout)
        held = self.chain.hold(self.variables) if self.chain is not None else []
        graph = graph_of(self.prior, *user, *held) if user or held else self.prior
        change = self.variables.change(entries)
        hessian, negative_gradient = newton_system(graph, self.window.measured, layout, change)
        if sigma_step is not None:
            points = np.arange(layout.block(SENSOR_LETTER).stop, layout.block(POSE_LETTER).start)
            hessian[points, points] += sigma_step**-2
        self.last_step = FactoredSystem(layout, cholesky(hessian))
        return negative_gradient

    def linear_graph(self, whole: bool = False) -> gtsam.GaussianFactorGraph:
        """Return the window and its prior, linearized at the variables' values, and change nothing.

        The unknowns are `value - reference`. If `whole`, inactive variables, up to date, are among them.
        """
        if not whole:
            prior = self.absolute_prior()
        elif self.chain is not None:
            prior = self.chain.joint(self.prior, self.variables)
        else:
            prior = self.inactive.joint_prior(self.prior)
        fresh = self.window.fresh(self.cycles)
        return graph_of(prior, *fresh, *self.user_factors.linearized(self.variables))

    def absolute_prior(self) -> gtsam.GaussianFactorGraph:
        """Return the prior of the active variables in the map frame; the inactive ones must be up to date."""
        if self.chain is None or len(self.chain) == 0:
            return self.prior
        return self.chain.marginal(self.prior, self.variables)

    # --- covariances -------------------------------------------------------------------------------------

    def last_covariance(self, keys: IntArray) -> Array:
        """Return the joint covariance (q, q) of variables (k,) in the last step, in their order."""
        assert self.last_step is not None
        return self.last_step.covariance(keys)

    def covariance(self, keys: IntArray) -> Array:
        """Return the joint covariance (q, q) of variables (k,), in their order, at the estimate, undamped.

        Once a map is held, no more is claimed of it than was known then.
        """
        if self.held is None:
            return self._covariance(keys)
        return self.held.claimed(self._covariance(np.concatenate([self.held.keys, keys])))

    def _covariance(self, keys: IntArray) -> Array:
        """Return the joint covariance (q, q) of variables (k,) by the detections alone."""
        whole = bool(np.isin(keys, self.inactive.keys).any())
        if whole or self.chain is not None:
            self.refresh()
        if whole and self.chain is not None:
            marginal = sparse_marginal(self.linear_graph(True), keys)
            return factorize(marginal, Layout(np.sort(keys))).covariance(keys)
        if whole:
            return factorize(self.linear_graph(whole), self.variables.layout).covariance(keys)
        graph = graph_of(self.absolute_prior(), *self.user_factors.linearized(self.variables))
        layout, fresh = self.layout, self.window.fresh_rows(self.cycles)
        hessian, _ = newton_system(graph, fresh, layout, np.zeros(layout.size))
        return FactoredSystem(layout, cholesky(hessian)).covariance(keys)

    def predicted_covariance(self, rows: Rows, together: int = 1) -> Array:
        """Return `rows.predicted_covariance` (m / k, k, k) of every k = `together` rows in the last step."""
        assert self.last_step is not None
        newest = self.variables.poses[-2:], self.window.odometry, self.next_cycle - 1
        return predicted_covariance(self.last_step, rows, *newest, together)

    # --- simplify the system: marginalize poses, deactivate map points -----------------------------------

    def marginalize(self, held_from: int | None = None) -> None:
        """Marginalize poses that are older than the lag, or too many; the cycles from `held_from` on stay."""
        lag, most = self.settings.lag + TIME_TOLERANCE, self.settings.max_poses
        while len(self.times) > 1 and (self.times[-1] - self.times[0] > lag or len(self.times) > most):
            if self.first_cycle == held_from:
                return
            self._marginalize_oldest()

    def _marginalize_oldest(self) -> None:
        """Marginalize the oldest pose, or keep it as a keyframe if inactive variables depend on it."""
        cycle, key = self.first_cycle, pose_key(self.first_cycle)
        user = self.user_factors.remove(np.array([key]), self.variables)
        factors = graph_of(self.window.pop(cycle), *user)
        self.prior = graph_of(self.prior, factors)
        self.variables.first_cycle += 1
        if key not in self.inactive.anchors:
            self.prior = marginalize(self.prior, np.array([key]))
            self.variables.remove(np.array([key]))
        self.drop_oldest(cycle)

    def drop_oldest(self, cycle: int) -> None:
        """Drop what the window holds of the oldest pose, that of a cycle."""
        self.times.pop(0)
        self.window.odometry.drop_first()
        self.map.drop_cycle(cycle)

    def deactivate(self, keys: IntArray) -> None:
        """Deactivate active map points (k,) on which the window has no factor."""
        if len(keys) == 0:
            return
        prior = graph_of(self.prior, *self.user_factors.remove(keys, self.variables))
        keyframes = self.variables.keyframes
        if self.chain is not None:
            self.prior = self.chain.attach(prior, keys, self.variables)
        else:
            self.prior = self.inactive.push(prior, keys, keyframes)
        self.variables.remove(keyframes)
        self.window.drop(self.inactive.keys)  # a factor linearized earlier may still hold one of them

    def transform_to_origin(self) -> None:
        """Update the inactive variables, and move an open map so that the drive began at the origin."""
        if self.chain is None or len(self.chain) == 0:
            self.refresh()
            return
        self.prior = self.chain.transform_to_origin(self.prior, self.variables, self.attached)
        self.window.relinearize(self.cycles, self.inactive.keys)

    def refresh(self) -> None:
        self.inactive.refresh(self.variables)

    def activate(self, keys: IntArray) -> None:
        """Make map points (k,) active, and at least all that depend on them."""
        if self.chain is None:
            self.reactivate()
            return
        if not self.chain.holds(keys):
            return
        self.refresh()
        while self.chain.holds(keys):
            back = self.chain.newest
            self.prior = graph_of(as_rows(graph_of(self.prior, self.chain.detach(self.variables))))
            self.map.activate(back)

    def reactivate(self) -> None:
        """Make all variables active, and marginalize the poses that are older than the window."""
        chain = self.chain
        if chain is None and len(self.inactive) == 0:
            return
        self.transform_to_origin()
        if chain is not None:  # its anchors become keyframes
            self.prior = graph_of(self.prior, *(chain.detach(self.variables) for _ in range(len(chain))))
        else:
            self.prior = self.inactive.joint_prior(self.prior)
        self.inactive = InactiveMap()
        keyframes = self.variables.keyframes
        self.prior = marginalize(self.prior, keyframes)
        self.variables.remove(keyframes)
        self.map.activate_all()

    def remove_information(self, keys: IntArray) -> None:
        """Remove what the prior says about map points (k,), which become active."""
        self.activate(keys)
        now = self.variables.change(self.variables.layout.entries(keys))
        self.prior = remove_information(self.prior, Layout(keys), now)


Smoother = FixedLagSmoother[MapRows]

STIFFNESS: Final = 1e4  # information about a gauge that is held, by that from measurements


# --- other map points ------------------------------------------------------------------------------------


def merge_points(smoother: Smoother, removed: IntArray, kept: IntArray) -> None:
    """Merge map points `removed` (k,) into points `kept` (k,), which keep their values.

    The map's rows must be on the kept keys afterwards.
    """
    variables, user = smoother.variables, smoother.user_factors.remove(removed, smoother.variables)
    reference, layout = variables.reference, variables.layout
    offset = reference[layout.entries(kept)] - reference[layout.entries(removed)]
    smoother.prior = merge_variables(graph_of(smoother.prior, *user), removed, kept, offset)
    variables.remove(removed)
    smoother.window.clear()


def place_again(smoother: Smoother, keys: IntArray, points: Array, sigma: float) -> None:
    """Move map points (k,) of a closed map to `points` (k, 2), and forget what was known of them.

    They have a prior with a standard deviation sigma (m) about their new places.
    """
    smoother.remove_information(keys)
    variables = smoother.variables
    variables.values[variables.layout.entries(keys)] = points.ravel()
    root = np.eye(points.size) / sigma
    smoother.prior = graph_of(smoother.prior, absolute_factor(keys, root, variables))
    smoother.window.clear()


# --- another prior ---------------------------------------------------------------------------------------


def hold_motion(smoother: Smoother, keys: IntArray, across: Array) -> None:
    """Hold where a closed map as a whole is, and go on to estimate its shape.

    The rows C `across` (3, 2k) give the rigid motion (x, y, theta) by `C dx`, for moves dx of the points
    (k,), ascending.
    """
    smoother.reactivate()
    known = smoother.covariance(keys)
    information = STIFFNESS * np.linalg.inv(across @ known @ across.T)
    root = np.linalg.cholesky(information).T @ across
    smoother.prior = graph_of(smoother.prior, absolute_factor(keys, root, smoother.variables))
    smoother.held = HeldMap(keys, known)


def forget_poses(smoother: Smoother, first_cycle: int) -> None:
    """Remove the poses before `first_cycle`, and all prior information about where the poses are.

    The later poses keep their odometry, and one of them must be given a prior by `add_pose_prior`.
    """
    smoother.reactivate()
    leaving = pose_keys(np.arange(smoother.first_cycle, first_cycle))
    user = smoother.user_factors.remove(leaving, smoother.variables)
    smoother.prior = marginalize(graph_of(smoother.prior, *user), pose_keys(smoother.cycles))
    _drop_before(smoother, first_cycle)


def restart(smoother: Smoother, first_cycle: int) -> None:
    """Make all variables active, and drop the prior; poses before `first_cycle` leave the window.

    The inactive variables must be up to date. A new prior must be set, on all that remains.
    """
    smoother.map.activate_all()
    smoother.inactive = InactiveMap()
    smoother.held, smoother.prior = None, gtsam.GaussianFactorGraph()
    smoother.variables.remove(smoother.variables.keyframes)
    _drop_before(smoother, first_cycle)


def _drop_before(smoother: Smoother, first_cycle: int) -> None:
    """Remove the poses before a cycle, and all factors of the window."""
    leaving = np.arange(smoother.first_cycle, first_cycle)
    smoother.user_factors.remove(pose_keys(leaving), smoother.variables)
    for cycle in leaving.tolist():
        smoother.drop_oldest(cycle)
    smoother.variables.first_cycle = first_cycle
    smoother.variables.remove(pose_keys(leaving))
    smoother.window.clear()


def set_prior(smoother: Smoother, keys: IntArray, mean: Array, root: Array, far: IntArray = NO_KEYS) -> None:
    """Set the prior to a Gaussian of ascending keys (k,) with mean (n,) and information `R' R`.

    The columns of the root R (n, n) are by the map points `far`, ascending, and then by the other keys. It is
    upper triangular if there are any: these become inactive.
    """
    order, count = np.concatenate([far, np.setdiff1d(keys, far)]), int(sizes(far).sum())
    change = mean - smoother.variables.reference[smoother.variables.layout.entries(keys)]
    right = root @ change[Layout(keys).entries(order)]
    if len(far):
        leaving = linear_factor(order, sizes(order), root[:count], right[:count], len(far))
        smoother.inactive.add(leaving, far)
    near = jacobian_factor(order[len(far) :], root[count:, count:], right[count:])
    smoother.prior = graph_of(gtsam.HessianFactor(graph_of(near)))


def exchange_calibration_priors(smoother: Smoother, included: tuple[Array, Array]) -> None:
    """Exchange the calibrations' priors that a new prior includes for those that the smoother has now."""
    present, smoother.calibration_prior = smoother.calibration_prior, included
    smoother.set_calibration_priors(*present)
