"""The system that a fixed-lag smoother solves: the window, the prior, and which variables are active.

In each cycle the stale factors of the window are linearized again. `graph.hessian(ordering)` and one dense
Cholesky factor give the step and the joint covariance.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic

import gtsam
import numpy as np
from numpy.typing import NDArray

from .chain import Follower, InactiveChain
from .gaussian import (
    FactoredSystem,
    as_rows,
    cholesky,
    factorize,
    graph_of,
    marginalize,
    normal_equations,
    solve,
    sparse_marginal,
)
from .inactive import InactiveMap
from .keys import (
    POSE_LETTER,
    SENSOR_LETTER,
)
from .odometry import predicted_covariance
from .rows import Rows
from .submaps import Submaps
from .user_factors import UserFactors
from .variables import Layout
from .window import M_co, WindowFactors

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


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
    sigmas_calibrations: tuple[float, ...]
    """Prior standard deviations of the calibrations: scale error (-) and yaw-rate bias (rad/s) of the
    odometry, and five of the sensor where they are estimated."""
    calibrations: tuple[float, ...] = ()
    """Prior means of the same; zero by default."""
    max_poses: int = 400
    """The window holds at most this number of poses."""
    relative: bool = False
    """While the loop is open, each part of the map is known in the frame of a pose beside it. The rows of the
    map must not change under a rigid motion of all variables."""


@dataclass(frozen=True, eq=False)
class HeldMap:
    """Holds what was known of a closed map when its gauge was held, as the most that is claimed of it."""

    keys: IntArray
    """(k,) These are the keys of all its points."""
    covariance: Array
    """(2k, 2k) This was their joint covariance (m^2)."""

    def claimed(self, joint: Array) -> Array:
        """Returns the covariance (q, q) of variables, given the joint one (2k + q, 2k + q) with the map's.

        The variables y follow the map m by `A = Sigma_ym Sigma_mm^-1`. With D what the readings since then
        have taken off the map's covariance, the result is `Sigma_yy + A D A'`.
        """
        n = len(self.covariance)
        now, mixed, own = joint[:n, :n], joint[:n, n:], joint[n:, n:]
        by_map = np.linalg.solve(now, mixed).T
        values, vectors = np.linalg.eigh(self.covariance - now)
        root = by_map @ (vectors * np.sqrt(np.maximum(values, 0.0)))
        return np.asarray(own + root @ root.T)


class WindowSystem(Generic[M_co]):
    """Holds the variables, the factors of the window and the prior, and solves for the active variables."""

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
        sigmas = np.array(settings.sigmas_calibrations)
        self.calibration_prior: tuple[Array, Array] = (
            np.resize(settings.calibrations or 0.0, len(sigmas)),
            sigmas,
        )
        """Means and standard deviations of the priors of the calibrations, (2,) or (7,)."""
        self.held: HeldMap | None = None
        """This is what was known of a closed map when its gauge was held; it is None before."""
        self.epoch = 0
        """This counts the changes of the prior other than the marginalization of a pose."""

    # --- sizes -------------------------------------------------------------------------------------------

    @property
    def first_cycle(self) -> int:
        """Returns the perception cycle of the oldest pose in the window."""
        return self.variables.first_cycle

    @property
    def next_cycle(self) -> int:
        """Returns the number of the next perception cycle, counted from 0."""
        return self.first_cycle + len(self.times)

    @property
    def layout(self) -> Layout:
        """Returns the columns of the active variables, which a step solves for."""
        return self.inactive.active(self.variables.layout)

    @property
    def chain(self) -> InactiveChain | None:
        """Returns the inactive part of an open map; it is None where parts are in the map frame."""
        return self.inactive if isinstance(self.inactive, InactiveChain) else None

    @property
    def _cycles(self) -> IntArray:
        """Returns the perception cycles of the window."""
        return np.arange(self.first_cycle, self.next_cycle)

    # --- the graph ---------------------------------------------------------------------------------------

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

    # --- covariances -------------------------------------------------------------------------------------

    def last_covariance(self, keys: IntArray) -> Array:
        """Returns the joint covariance (q, q) of variables (k,) in the last step, in their order."""
        assert self.last_step is not None
        return self.last_step.covariance(keys)

    def covariance(self, keys: IntArray) -> Array:
        """Returns the joint covariance (q, q) of variables (k,) at the estimate, without damping.

        It is in the order of the keys, with poses as (x, y, theta) in the map frame (m, m, rad). Once a map
        is held, no more is claimed of it than was known then.
        """
        if self.held is None:
            return self._covariance(keys)
        return self.held.claimed(self._covariance(np.concatenate([self.held.keys, keys])))

    def _covariance(self, keys: IntArray) -> Array:
        """Returns the joint covariance (q, q) of variables (k,) by the readings alone."""
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
