"""Orange cones: points of the map that belong to no boundary and do not constrain the vehicle's pose.

A drive keeps what it detected of them. They are merged when the map is asked for, by the poses known then: a
place has as many cones as its cycles detect together.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import ClassVar, Final, Self

import numpy as np
from scipy.cluster.vq import kmeans2
from scipy.linalg import block_diag

from pathspace_graph.copies import shallow
from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.se2 import compose, rotated, to_map
from pathspace_graph.io.log import Detections
from pathspace_graph.io.map import PointBoundary
from pathspace_graph.labels import POINTS
from pathspace_graph.mapping.detections import DetectionColumns
from pathspace_graph.mapping.tracks import KNOWN_SIGMA, linked
from pathspace_graph.settings.mapper import GrowthSettings

VAGUE: Final = 0.6  # standard deviation of a detection from which on it tells no number of cones (m)
TOGETHER: Final = 0.4  # least share of a place's cycles that detect all its cones: four, with 0.8 each
STAYING: Final = 0.05  # share of a detection's variance that no number of detections averages out


@dataclass
class OrangeDetections(DetectionColumns):
    """The newest detections of orange cones, with the poses of their cycles as they are known."""

    MOST: ClassVar = 2000  # number of kept detections

    pose: Array = field(default_factory=lambda: np.zeros((0, 3)))  # (m, 3) map frame

    def _clear_associations(self) -> None:
        self.pose = np.zeros((len(self), 3))

    def copy(self) -> Self:
        """Return an independent copy; columns are only replaced."""
        return shallow(self)

    def add(self, detections: Detections, cycle: int, twist: Array, pose: Array) -> None:
        if len(detections.labels):
            self.append(detections, cycle, twist)
            self.place(cycle, pose[None])
            self.keep_from(int(self.cycle[-self.MOST :][0]))

    def place(self, first: int, poses: Array) -> None:
        """Take the poses (k, 3) of the cycles from `first` on."""
        at = self.cycle - first
        known = (at >= 0) & (at < len(poses))
        self.pose = np.array(self.pose)
        self.pose[known] = poses[at[known]]

    def move(self, motion: Array) -> None:
        """Move all poses by a rigid motion (3,) of the map frame."""
        self.pose = compose(motion, self.pose)


def orange_cones(
    seen: OrangeDetections, sensor: Array, settings: GrowthSettings, sigma: float
) -> dict[int, PointBoundary]:
    """Merge detections to cones, by label, given the calibration (5,) or (0,) of the sensor.

    A cone has at least `settings.sightings` detections, and is known to `KNOWN_SIGMA` (m). The standard
    deviation `sigma` (m) is added to each.
    """
    cycle, points = seen.cycle, to_map(seen.corrected(slice(None), sensor), seen.pose)
    covariances = rotated(seen.covariance, seen.pose[:, 2])
    clear = np.linalg.eigvalsh(covariances)[:, -1] < VAGUE**2
    found = dict[int, PointBoundary]()
    for own in POINTS:
        means, blocks, rows = list[Array](), list[Array](), np.flatnonzero(clear & (seen.label == own))
        for place in linked(points[rows], settings.merge_radius):
            at = rows[place]
            for mean, known, count in _cones(cycle[at], points[at], covariances[at]):
                if count >= settings.sightings and np.linalg.eigvalsh(known)[-1] < KNOWN_SIGMA**2:
                    means.append(mean)
                    blocks.append(known + sigma**2 * np.eye(2))
        if means:
            found[own] = PointBoundary(np.array(means), block_diag(*blocks))
    return found


def _cones(cycle: IntArray, points: Array, covariances: Array) -> Iterator[tuple[Array, Array, int]]:
    """Yield mean (2,), covariance (2, 2) and number of detections of each cone of a place.

    There are as many as enough cycles detect. The clusters of the detections (n,) begin with the clearest
    cycle that has detected all.
    """
    _, cycle, counts = np.unique(cycle, return_inverse=True, return_counts=True)
    size = max(k for k in range(1, counts.max() + 1) if (counts >= k).mean() >= TOGETHER)
    vague = np.trace(covariances, axis1=1, axis2=2)
    of_cycle = (np.flatnonzero(cycle == one) for one in np.flatnonzero(counts >= size))
    begins = [rows[np.argsort(vague[rows])[:size]] for rows in of_cycle]
    clearest = points[min(begins, key=lambda rows: float(vague[rows].max()))]
    _, cone = kmeans2(points, np.unique(clearest, axis=0), minit="matrix")
    information = np.linalg.inv(covariances)
    for own in (cone == k for k in np.unique(cone)):
        count, joint = int(own.sum()), np.linalg.inv(information[own].sum(axis=0))
        mean = joint @ np.einsum("nij,nj->i", information[own], points[own])
        yield mean, (1.0 + STAYING * count) * joint, count
