"""The paper's baseline: a cubature Kalman filter over the pose and landmarks, with Hungarian association.

The paper gives it "a similarly structured state and overall implementation style", and the Mahalanobis
distance as the cost of the assignment. What it doesn't say was chosen so that it isn't weaker than it has to
be: the gates are the landmark graph's (match, create, between: leave out); colours are respected; a reading
makes a landmark once the same thing was seen `ckf.sightings` times, since our sensor, unlike their front
end, has false detections (1: every reading beyond the gate makes one, as the description has it). The
odometry's constant errors are in its state too. There is no merging and no closing: ghosts stay, as the paper
says of it, and where the drift of a lap is more than the cones' distance, a whole lap of them may.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from pathspace_graph.factors.odometry import integrate_twists
from pathspace_graph.factors.projection import to_map
from pathspace_graph.graph.keys import POSE
from pathspace_graph.io.log import Detections, Odometry
from pathspace_graph.io.map import Map, PointBoundary
from pathspace_graph.labels import BOUNDARIES, LEFT, RIGHT
from pathspace_graph.mapping.belief import PLANE, Belief, point_columns, to_vehicle_rows
from pathspace_graph.mapping.tentative import TentativeTracks
from pathspace_graph.run import CycleResult, Stopwatch
from pathspace_graph.settings.mapper import ODOMETRY_SIGMA, MapperSettings

from .association import NONE, Association, Gates, associate, compatible, pair_costs

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


class LandmarkCkf:
    """Maps cones as points: predict, associate, update, create.

    `odometry_sigma` (3,): standard deviation of a twist reading (m/s, m/s, rad/s).
    """

    def __init__(self, settings: MapperSettings | None = None, odometry_sigma: Array | None = None) -> None:
        self.settings = settings or MapperSettings()
        self.odometry_sigma = np.array(ODOMETRY_SIGMA if odometry_sigma is None else odometry_sigma, float)
        self.belief = Belief.at_start(self.settings.odometry)
        """`x = [pose | calibration | landmarks]`."""
        self.labels: IntArray = np.zeros(0, np.intp)
        """(n,) colour of each landmark."""
        self.tentative = {label: TentativeTracks(self.settings.growth) for label in BOUNDARIES}
        """What isn't a landmark yet."""

    def update(self, odometry: Odometry, detections: Detections) -> CycleResult:
        """One perception cycle: the twists since the last one, and what was detected now."""
        watch = Stopwatch()
        durations = np.diff(np.append(odometry.t, detections.t))
        self.belief.predict(integrate_twists(durations, odometry.twist, self.odometry_sigma))
        watch.lap("predict")
        found = self._associate(detections)
        watch.lap("associate")
        self._correct(detections, found.landmark)
        watch.lap("update")
        self._create(detections, found.new)
        watch.lap("create")
        left, right = (int((self.labels == label).sum()) for label in (LEFT, RIGHT))
        used = int((found.landmark != NONE).sum())
        return CycleResult(detections.t, self.belief.pose.copy(), (left, right), used, False, watch.laps)

    def _associate(self, detections: Detections) -> Association:
        """The assignment over the landmarks that are near any reading, on the joint uncertainty."""
        settings, m = self.settings.landmark, len(detections.labels)
        near = self._near(detections)
        predicted, covariances = self._predicted(near)
        cost = pair_costs(detections.points_vehicle, detections.covariances, predicted, covariances)
        cost[~compatible(detections.labels, self.labels[near])] = np.inf
        found = associate(cost, Gates.of_probabilities(settings.match, settings.create))
        matched = found.landmark != NONE
        landmark = np.full(m, NONE, np.intp)
        landmark[matched] = near[found.landmark[matched]]
        return Association(landmark, found.new)

    def _near(self, detections: Detections) -> IntArray:
        """Landmarks that any reading of the cycle may be of, by far."""
        points = to_map(detections.points_vehicle, np.tile(self.belief.pose, (len(detections.labels), 1)))
        offset = self.belief.points[:, None] - points[None]
        distance = np.hypot(offset[..., 0], offset[..., 1]).min(axis=1, initial=np.inf)
        return np.flatnonzero(distance < self.settings.landmark.rough)

    def _predicted(self, landmarks: IntArray) -> tuple[Array, Array]:
        """Where the vehicle should see landmarks (k,): (k, 2), and (k, 2, 2) by the joint covariance."""
        k = len(landmarks)
        if k == 0:
            return np.zeros((0, PLANE)), np.zeros((0, PLANE, PLANE))
        seen = self.belief.seen(landmarks)
        blocks = seen.covariance.reshape(k, PLANE, k, PLANE)
        return seen.mean.reshape(k, PLANE), blocks[np.arange(k), :, np.arange(k)]

    def _correct(self, detections: Detections, landmark: IntArray) -> None:
        """One Kalman update with every reading that is of a landmark."""
        rows = np.flatnonzero(landmark != NONE)
        if len(rows) == 0:
            return
        columns = np.concatenate([np.arange(POSE), point_columns(landmark[rows])])
        noise = block_diag(*detections.covariances[rows])
        measured = detections.points_vehicle[rows].ravel()
        self.belief.update(columns, lambda x: to_vehicle_rows(x[:, :POSE], x[:, POSE:]), measured, noise)

    def _create(self, detections: Detections, new: NDArray[np.bool_]) -> None:
        """What is beyond the gate of every landmark, and was seen often enough, is a landmark."""
        points = to_map(detections.points_vehicle, np.tile(self.belief.pose, (len(detections.labels), 1)))
        variances = np.trace(detections.covariances, axis1=1, axis2=2)
        chosen = [np.zeros(0, np.intp)]
        for label, tentative in self.tentative.items():
            rows = np.flatnonzero(new & (detections.labels == label))
            tentative.add(points[rows], variances[rows], detections.t)
            often = np.flatnonzero(tentative.counts >= self.settings.ckf.sightings)
            offset = points[rows][:, None] - tentative.points[often][None]
            distance = np.hypot(offset[..., 0], offset[..., 1])
            if distance.size:
                nearest = np.unique(distance.argmin(axis=0)[distance.min(axis=0) < self._radius])
                chosen.append(rows[nearest])
                tentative.remove(often[distance.min(axis=0) < self._radius])
        rows = np.concatenate(chosen)
        if len(rows):
            self.belief.observe(detections.points_vehicle[rows], detections.covariances[rows])
            self.labels = np.concatenate([self.labels, detections.labels[rows]])

    @property
    def _radius(self) -> float:
        return self.settings.growth.merge_radius

    def map(self) -> Map:
        """The map as it stands, with the joint covariance of each boundary's landmarks."""
        boundaries = {}
        for label in BOUNDARIES:
            of = np.flatnonzero(self.labels == label)
            if len(of):
                columns = point_columns(of)
                joint = self.belief.covariance[np.ix_(columns, columns)]
                boundaries[label] = PointBoundary(self.belief.points[of].copy(), joint)
        return Map(False, boundaries)
