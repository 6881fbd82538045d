"""What the mapper is timed beside: GTSAM's elimination of its window, and GTSAM's ISAM2 on landmarks.

GTSAM is timed on the mapper's graph after a cycle, with the whole map in it and already linearized: neither
linearization nor the building of a graph counts. It does `optimize()` and `marginal(map, calibration, next
pose)`, once each, under the best conditions for it. Prior, weak priors and damping come as one Hessian
factor. The window is solved in each of several orderings, and the time to find an ordering is not counted.
Each call is made once untimed before it is timed.

ISAM2 on landmarks, given every association, is what a user would write instead of the mapper: a pose for each
cycle, a point for each cone, odometry factors between poses, and a bearing-range factor for each detection.
All factors are GTSAM's own, in C++; its parameters are the defaults. `update` and the newest pose are timed;
building the graph is not.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import gtsam
import numpy as np

from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.noise import ray_sigmas
from pathspace_graph.factors.se2 import compose, to_map
from pathspace_graph.graph.gaussian import as_hessian_factor, factors_of, graph_of, jacobian_factor, keys_of
from pathspace_graph.graph.variables import Layout, are_poses
from pathspace_graph.io.log import Detections, Log, Odometry
from pathspace_graph.mapping.motion import integrate_odometry
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.run import split_odometry


@dataclass(frozen=True, eq=False)
class LinearWindow:
    """A window with the whole map, linearized at its estimate."""

    graph: gtsam.GaussianFactorGraph
    """A factor for each cycle, and one for prior, weak priors and damping together."""
    layout: Layout


def linear_window(mapper: FixedLagMapper) -> LinearWindow:
    """Return the window of a mapper between two cycles; the mapper stays as it is."""
    smoother = mapper.smoother
    smoother.refresh()
    factors = factors_of(smoother.linear_graph(whole=True))
    cycles = [factor for factor in factors if _is_of_cycle(factor)]
    priors = [factor for factor in factors if not _is_of_cycle(factor)]
    combined_priors = as_hessian_factor(graph_of(_damping(mapper), *priors))
    graph = graph_of(combined_priors, *cycles)
    return LinearWindow(graph, Layout(keys_of(graph)))  # an open map hangs on poses of its own


def _is_of_cycle(factor: gtsam.GaussianFactor) -> bool:
    """Return whether a factor holds the rows of a cycle; else it is the prior or holds weak priors."""
    has_rows = isinstance(factor, gtsam.JacobianFactor)
    return has_rows and bool(are_poses(np.array(list(factor.keys()), np.intp)).any())


def _damping(mapper: FixedLagMapper) -> gtsam.GaussianFactor:
    keys, variables = mapper.smoother.map.state.map_keys, mapper.smoother.variables
    now, sigma = variables.change(variables.layout.entries(keys)), mapper.settings.sigma_step
    return jacobian_factor(keys, np.eye(len(now)) / sigma, now / sigma)


def orderings(window: LinearWindow) -> dict[str, gtsam.Ordering | None]:
    """Return the orderings that `optimize` may be given: none, COLAMD's, or poses before the rest."""
    keys = window.layout.keys
    shared = ~are_poses(keys)
    return {
        "no ordering given": None,
        "COLAMD given": gtsam.Ordering.ColamdGaussianFactorGraph(window.graph),
        "poses first": gtsam.Ordering(keys[np.argsort(shared, kind="stable")].tolist()),
    }


def marginal_keys(window: LinearWindow) -> list[int]:
    """Return what the marginal prior is on when the oldest pose leaves: map, calibration, next pose."""
    keys = window.layout.keys
    poses = are_poses(keys)
    staying: list[int] = np.append(keys[~poses], keys[poses][1:2]).tolist()
    return staying


def time_gtsam(window: LinearWindow) -> dict[str, tuple[float, float]]:
    """Return the processor times (s) of (`optimize`, `marginal`) by ordering, once each."""
    graph, staying = window.graph, gtsam.KeyVector(marginal_keys(window))
    marginal = _seconds(partial(graph.marginal, staying))
    return {
        name: (_seconds(partial(graph.optimize, *(() if ordering is None else (ordering,)))), marginal)
        for name, ordering in orderings(window).items()
    }


def _seconds(call: Callable[[], object]) -> float:
    """Return the processor time (s) of the second of two calls."""
    call()
    begin = time.thread_time()
    call()
    return time.thread_time() - begin


# --- landmarks -------------------------------------------------------------------------------------------

FIRST_POSE: tuple[float, float, float] = (1e-3, 1e-3, 1e-4)
"""Standard deviations (m, m, rad) of the first pose, at the origin."""


class ToldLandmarks:
    """ISAM2 over the cycles of a log whose associations are known."""

    def __init__(self, log: Log) -> None:
        """Begin before the first cycle; ValueError where the log has no associations."""
        if log.truth is None or log.truth.associations is None:
            raise ValueError("expected a simulated log, whose associations are known, found one without")
        self.isam = gtsam.ISAM2()
        self._cycles: Iterator[tuple[Odometry, Detections]] = split_odometry(log)
        ends = np.cumsum([len(cycle.labels) for cycle in log.cycles])
        self._cones: Iterator[IntArray] = iter(np.split(log.truth.associations, ends[:-1]))
        self._sigma = log.odometry_sigma
        self._pose: Array = np.zeros(3)
        self._count = 0
        self._seen: set[int] = set()

    def advance(self) -> float:
        """Take the next cycle; return the processor time (s) of its update."""
        odometry, detections = next(self._cycles)
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        key = gtsam.symbol("x", self._count)
        self._add_pose(graph, odometry, detections.t)
        values.insert(key, gtsam.Pose2(*self._pose))
        self._add_detections(graph, values, detections, next(self._cones))
        begin = time.thread_time()
        self.isam.update(graph, values)
        newest = self.isam.calculateEstimatePose2(key)
        seconds = time.thread_time() - begin
        self._pose = np.array([newest.x(), newest.y(), newest.theta()])
        self._count += 1
        return seconds

    def landmarks(self) -> dict[int, Array]:
        """Return the points (2,) of the landmarks (m), map frame, by the number of their cone."""
        estimate = self.isam.calculateEstimate()
        return {cone: estimate.atPoint2(gtsam.symbol("l", cone)) for cone in sorted(self._seen)}

    def _add_pose(self, graph: gtsam.NonlinearFactorGraph, odometry: Odometry, t: float) -> None:
        key = gtsam.symbol("x", self._count)
        if self._count == 0:
            known = gtsam.noiseModel.Diagonal.Sigmas(np.array(FIRST_POSE))
            graph.add(gtsam.PriorFactorPose2(key, gtsam.Pose2(), known))
            return
        motion = integrate_odometry(odometry, t, self._sigma)
        noise = gtsam.noiseModel.Gaussian.Covariance(motion.covariance)
        graph.add(gtsam.BetweenFactorPose2(key - 1, key, gtsam.Pose2(*motion.delta), noise))
        self._pose = compose(self._pose, motion.delta)

    def _add_detections(
        self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, detections: Detections, cones: IntArray
    ) -> None:
        """Add bearing and range of each detection of a cone; false positives are left out."""
        points, key = detections.points_vehicle, gtsam.symbol("x", self._count)
        ranges = np.hypot(*points.T)
        along, across = ray_sigmas(points, detections.covariances).T
        sigmas = np.stack([across / ranges, along], axis=1)
        points_map = to_map(points, self._pose[None])
        for i in np.flatnonzero(cones >= 0).tolist():
            cone = int(cones[i])
            landmark = gtsam.symbol("l", cone)
            if cone not in self._seen:
                self._seen.add(cone)
                values.insert(landmark, points_map[i])
            bearing = gtsam.Rot2.relativeBearing(points[i])
            noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas[i])
            graph.add(gtsam.BearingRangeFactor2D(key, landmark, bearing, ranges[i], noise))
