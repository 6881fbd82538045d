"""The paper's baseline: a cubature Kalman filter over the pose and landmarks, with Hungarian association.

The paper describes it as "a similarly structured state and overall implementation style", with the
Mahalanobis distance as the cost of the assignment (section Results). Where it leaves something open, the
choice makes the baseline no weaker than it has to be:

- The gates are those of the landmark graph: match, create, and no decision in between.
- A detection is associated only with a landmark of its own label.
- A track becomes a landmark after `ckf.sightings` detections, because our sensor has false detections and
  the paper's front end has none. With 1, every detection beyond the gate creates one, as in the description.
- The calibration of the odometry is in its state too.

Landmarks are never merged, and the loop never closes. So ghosts stay, as the paper says of its baseline. If
the drift of a lap is larger than the distance between cones, all landmarks of a lap may be ghosts.
"""

import numpy as np
from scipy.linalg import block_diag

from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.noise import KnownNoise
from pathspace_graph.factors.se2 import rotated, to_map
from pathspace_graph.front_end.front_end import FrontEnd
from pathspace_graph.graph.variables import POINT
from pathspace_graph.io.log import Detections, Odometry
from pathspace_graph.io.map import Map
from pathspace_graph.io.results import RunNoise, VehicleState
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.mapping.belief import HEAD, Belief, point_columns
from pathspace_graph.mapping.motion import known_noise
from pathspace_graph.mapping.tentative import TentativeTracks, nearest_within
from pathspace_graph.run import CycleResult, Stopwatch
from pathspace_graph.scale import at_scale
from pathspace_graph.settings.mapper import MapperSettings

from .association import ROUGH, Association, Gates, associate, compatible, pair_costs
from .landmark_map import UNASSOCIATED, landmark_counts, point_map


@at_scale
class LandmarkCkf:
    """Maps cones as points: predict, associate, update, create.

    `odometry_sigma` (3,) is the standard deviation of a twist reading (m/s, m/s, rad/s).
    """

    def __init__(
        self, settings: MapperSettings | None = None, odometry_sigma: Array | KnownNoise | None = None
    ) -> None:
        self.settings = settings or MapperSettings()
        noise = known_noise(odometry_sigma)
        self.odometry_sigma = noise.odometry
        self.front_end = FrontEnd(self.settings, noise)
        self.belief = Belief.at_start(self.settings.odometry, self.settings.calibration)
        """State `x = [pose | calibration | landmarks]`."""
        self.labels: IntArray = np.zeros(0, np.intp)
        """(n,) Labels of the landmarks."""
        self.tentative = {label: TentativeTracks(self.settings.growth) for label in BOUNDARIES}
        """Tracks by label that are not landmarks yet."""

    def update(self, odometry: Odometry, detections: Detections) -> CycleResult:
        """Process one perception cycle: the twists since the last one, and the detections of now.

        A cycle that cannot be used is a ReadingError and changes nothing. So is one that is late, since a
        filter has no earlier pose that could take its detections.
        """
        watch = Stopwatch()
        cycle = self.front_end.admit(odometry, detections)
        reading = self.front_end.update(cycle.odometry, cycle.detections)
        self.belief.follow(reading.motion)
        detections = self.belief.corrected(reading.detections)
        watch.lap("predict")
        found = self._associate(detections)
        watch.lap("associate")
        self._update(detections, found.landmark)
        watch.lap("update")
        self._create(detections, found.new)
        watch.lap("create")
        used, sizes = int((found.landmark != UNASSOCIATED).sum()), landmark_counts(self.labels)
        return cycle.counted(
            CycleResult(detections.t, self.belief.pose.copy(), sizes, used, False, watch.laps)
        )

    def _associate(self, detections: Detections) -> Association:
        """Assign the detections to the nearby landmarks, by the joint covariance of pose and landmarks."""
        points = to_map(detections.points_vehicle, self.belief.pose[None])
        nearby = np.flatnonzero(nearest_within(self.belief.points, points, ROUGH)[1])
        predicted, covariances = self._predict(nearby)
        cost = pair_costs(detections.points_vehicle, detections.covariances, predicted, covariances)
        cost[~compatible(detections.labels, self.labels[nearby])] = np.inf
        found = associate(cost, Gates.of(self.settings.landmark))
        matched = found.landmark != UNASSOCIATED
        landmark = np.full(len(detections.labels), UNASSOCIATED, np.intp)
        landmark[matched] = nearby[found.landmark[matched]]
        return Association(landmark, found.new)

    def _predict(self, landmarks: IntArray) -> tuple[Array, Array]:
        """Return where landmarks (k,) should be detected (k, 2) and covariances (k, 2, 2), vehicle frame."""
        k = len(landmarks)
        if k == 0:
            return np.zeros((0, POINT)), np.zeros((0, POINT, POINT))
        predicted = self.belief.predict_detections(landmarks)
        blocks = predicted.covariance.reshape(k, POINT, k, POINT)
        return predicted.mean.reshape(k, POINT), blocks[np.arange(k), :, np.arange(k)]

    def _update(self, detections: Detections, landmark: IntArray) -> None:
        """Make one Kalman update with all associated detections."""
        rows = np.flatnonzero(landmark != UNASSOCIATED)
        if len(rows) == 0:
            return
        columns = self.belief.measuring_columns(point_columns(landmark[rows]))
        noise = block_diag(*detections.covariances[rows])
        measured = detections.points_vehicle[rows].ravel()
        self.belief.update(columns, self.belief.measuring(landmark[rows]), measured, noise)

    def _create(self, detections: Detections, new: BoolArray) -> None:
        """Add a landmark for each track that has enough detections beyond the gate of every landmark.

        It is placed at the nearest detection of this cycle, and the track is kept if there is none.
        """
        points = to_map(detections.points_vehicle, self.belief.pose[None])
        covariances = rotated(detections.covariances, np.full(len(points), self.belief.pose[2]))
        chosen = [np.zeros(0, np.intp)]
        for label, tentative in self.tentative.items():
            rows = np.flatnonzero(new & (detections.labels == label))
            tentative.add(points[rows], covariances[rows], detections.t)
            confirmed = np.flatnonzero(tentative.counts >= self.settings.ckf.sightings)
            offset = points[rows][:, None] - tentative.points[confirmed][None]
            distance = np.hypot(offset[..., 0], offset[..., 1])
            if distance.size:
                near = distance.min(axis=0) < self.settings.growth.merge_radius
                chosen.append(rows[np.unique(distance.argmin(axis=0)[near])])
                tentative.remove(confirmed[near])
        rows = np.concatenate(chosen)
        if len(rows):
            self.belief.add_points(detections.points_vehicle[rows], detections.covariances[rows])
            self.labels = np.concatenate([self.labels, detections.labels[rows]])

    def map(self) -> Map:
        """Return the map as it stands, with the joint covariance of each boundary's landmarks."""
        return point_map(self.belief.points, self.labels, self.belief.covariance[HEAD:, HEAD:], False)

    def noise_used(self) -> RunNoise:
        """Return the noise that is used now, and what was measured so far."""
        return self.front_end.noise_used

    def vehicle_state(self) -> VehicleState:
        """Return the newest pose and the calibration, with their joint covariance."""
        return self.belief.vehicle_state()

    def outline(self) -> Map:
        """Return a copy of the present map without covariances."""
        return point_map(self.belief.points, self.labels, None, False)
