import numpy as np

from pathspace_graph import Detections, Map, MapperSettings, Odometry, PointBoundary
from pathspace_graph.factors.noise import KnownNoise
from pathspace_graph.factors.se2 import compose, to_map
from pathspace_graph.labels import BOUNDARIES, LEFT, RIGHT
from pathspace_graph.mapping.motion import integrate_odometry
from pathspace_graph.run import CycleResult

SIGMA = 0.5
"""Each landmark claims this standard deviation (m) in x and in y."""


class DeadReckoning:
    """Map of each detected cone where the integrated odometry puts it."""

    READS = ("growth.merge_radius",)

    def __init__(self, settings: MapperSettings, noise: KnownNoise) -> None:
        self.settings = settings
        self.odometry_sigma = noise.odometry
        self.pose = np.zeros(3)
        self.landmarks = {label: np.zeros((0, 2)) for label in BOUNDARIES}

    def update(self, odometry: Odometry, detections: Detections) -> CycleResult:
        """Move the pose by the odometry since the last cycle, then map what was detected now."""
        moved = integrate_odometry(odometry, detections.t, self.odometry_sigma)
        self.pose = compose(self.pose, moved.delta)
        points_map = to_map(detections.points_vehicle, np.tile(self.pose, (len(detections.labels), 1)))
        for point, label in zip(points_map, detections.labels, strict=True):
            if label in self.landmarks:
                self._add(point, label)
        sizes = (len(self.landmarks[LEFT]), len(self.landmarks[RIGHT]))
        return CycleResult(detections.t, self.pose.copy(), sizes, len(points_map), closed=False)

    def _add(self, point: np.ndarray, label: int) -> None:
        """Add a landmark, unless one of its colour is there already."""
        known = self.landmarks[label]
        if len(known) == 0 or np.hypot(*(known - point).T).min() > self.settings.growth.merge_radius:
            self.landmarks[label] = np.vstack([known, point])

    def map(self) -> Map:
        """Return the map as it stands, a copy."""
        boundaries = {
            label: PointBoundary(points.copy(), SIGMA**2 * np.eye(2 * len(points)))
            for label, points in self.landmarks.items()
            if len(points)
        }
        return Map(closed=False, boundaries=boundaries)
