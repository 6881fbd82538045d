"""What the mapper is timed beside: GTSAM's ISAM2 on landmarks, given every association.

That is what a user would write instead of the mapper: a pose for each cycle, a point for each cone, odometry
factors between poses, and a bearing-range factor for each detection. All factors are GTSAM's own, in C++; its
parameters are the defaults. `update` and the newest pose are timed; building the graph is not.
"""

import time
from collections.abc import Iterator

import gtsam
import numpy as np

from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.noise import ray_sigmas
from pathspace_graph.factors.se2 import compose, to_map
from pathspace_graph.io.log import Detections, Log, Odometry
from pathspace_graph.mapping.motion import integrate_odometry
from pathspace_graph.run import split_odometry

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
