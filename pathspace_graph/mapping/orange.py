"""Orange cones: points of the map that belong to no boundary and do not constrain the vehicle's pose.

A drive keeps what it detected of them. They are merged when the map is asked for, by the poses known then: a
place has as many cones as its cycles detect together, and the detections of a cycle are of different ones.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Self

import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from pathspace_graph.copies import shallow
from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.se2 import compose, rotated, to_map
from pathspace_graph.factors.sensor import corrected
from pathspace_graph.io.log import Detections
from pathspace_graph.io.map import PointBoundary
from pathspace_graph.settings.online import GrowthSettings

VAGUE: Final = 0.6  # standard deviation of a detection from which on it tells no number of cones (m)
BESIDE: Final = 1.0  # distance of neighbouring detections of one place (m)
TOGETHER: Final = 0.4  # least share of a place's cycles that detect all its cones: four, with 0.8 each
GATE: Final = 3.5  # largest distance of a detection from its cone (sigmas)
STAYING: Final = 0.05  # share of a detection's variance that no number of detections averages out
MOST_ROUNDS: Final = 30  # of assignment and means, which end much earlier


@dataclass(frozen=True, eq=False)
class Sighting:
    """Orange cones as they were detected in one cycle."""

    cycle: int
    pose: Array  # (3,) pose of the vehicle, map frame
    twist: Array  # (3,) twist of the vehicle (m/s, m/s, rad/s)
    detections: Detections  # detections of orange cones only

    def placed_by(self, known: Sequence[tuple[int, Array]]) -> Self:
        """Take the pose from arrays of poses (P, 3), each with its first cycle; the last one wins."""
        poses = [poses[self.cycle - first] for first, poses in known if 0 <= self.cycle - first < len(poses)]
        return replace(self, pose=poses[-1].copy()) if poses else self


class OrangeSightings:
    """What a drive has detected of orange cones, with the poses as they are known."""

    MOST: Final = 500  # number of kept cycles

    def __init__(self) -> None:
        self.newest: tuple[Sighting, ...] = ()

    def copy(self) -> Self:
        """Return an independent copy; no attribute is changed in place."""
        return shallow(self)

    def add(self, sighting: Sighting) -> None:
        if len(sighting.detections.labels):
            self.newest = (*self.newest[1 - self.MOST :], sighting)

    def place(self, *known: tuple[int, Array]) -> None:
        """Take the poses from arrays of poses (P, 3), each with its first cycle; the last one wins."""
        self.newest = tuple(one.placed_by(known) for one in self.newest)

    def move(self, motion: Array) -> None:
        """Move all poses by a rigid motion (3,) of the map frame."""
        self.newest = tuple(replace(one, pose=compose(motion, one.pose)) for one in self.newest)


def orange_cones(
    sightings: Sequence[Sighting], sensor: Array, settings: GrowthSettings, sigma: float
) -> dict[int, PointBoundary]:
    """Merge detections to cones, by label, given the calibration (5,) or (0,) of the sensor.

    A cone has at least `settings.sightings` detections, and is known to `settings.sigma` (m). The standard
    deviation `sigma` (m) is added to each.
    """
    if not sightings:
        return {}
    counts = [len(one.detections.labels) for one in sightings]
    cycle = np.repeat([one.cycle for one in sightings], counts)
    label = np.concatenate([one.detections.labels for one in sightings])
    poses = np.repeat([one.pose for one in sightings], counts, axis=0)
    twists = np.repeat([one.twist for one in sightings], counts, axis=0)
    measured = np.concatenate([one.detections.points_vehicle for one in sightings])
    points = to_map(corrected(measured, twists, sensor), poses)
    covariances = np.concatenate([one.detections.covariances for one in sightings])
    covariances = rotated(covariances, poses[:, 2])
    clear = np.linalg.eigvalsh(covariances)[:, -1] < VAGUE**2
    found = dict[int, PointBoundary]()
    for own in np.unique(label).tolist():
        means, blocks, rows = list[Array](), list[Array](), np.flatnonzero(clear & (label == own))
        for place in _places(points[rows]):
            at = rows[place]
            for mean, known, count in _cones(cycle[at], points[at], covariances[at]):
                if count >= settings.sightings and np.linalg.eigvalsh(known)[-1] < settings.sigma**2:
                    means.append(mean)
                    blocks.append(known + sigma**2 * np.eye(2))
        if means:
            found[own] = PointBoundary(np.array(means), block_diag(*blocks))
    return found


def _places(points: Array) -> list[IntArray]:
    """Return the rows of points (n, 2) of each place, which `BESIDE` separates from the others."""
    pairs = (
        KDTree(points).query_pairs(BESIDE, output_type="ndarray") if len(points) else np.zeros((0, 2), int)
    )
    graph = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(points), len(points)))
    count, place = connected_components(graph, directed=False)
    return [np.flatnonzero(place == one) for one in range(count)]


def _cones(cycle: IntArray, points: Array, covariances: Array) -> list[tuple[Array, Array, int]]:
    """Return mean (2,), covariance (2, 2) and number of detections of each cone of a place.

    Detections (n,) are assigned to the cones, those of a cycle to different ones, and the cones are the means
    of their detections, in turn. They begin with the clearest cycle that has detected as many.
    """
    _, cycle, counts = np.unique(cycle, return_inverse=True, return_counts=True)
    size = max(k for k in range(1, counts.max() + 1) if (counts >= k).mean() >= TOGETHER)
    information, vague = np.linalg.inv(covariances), np.trace(covariances, axis1=1, axis2=2)
    of_cycle = [np.flatnonzero(cycle == one) for one in range(len(counts))]
    begins = [rows[np.argsort(vague[rows])[:size]] for rows in of_cycle if len(rows) >= size]
    means = points[min(begins, key=lambda rows: float(vague[rows].max()))]
    cone = np.full(len(points), -1)
    for _ in range(MOST_ROUNDS):
        off, before = points[:, None] - means, cone
        square = np.minimum(np.einsum("nki,nij,nkj->nk", off, information, off), GATE**2)
        cone = np.full(len(points), -1)
        for rows in of_cycle:
            row, column = linear_sum_assignment(square[rows])
            inside = square[rows[row], column] < GATE**2
            cone[rows[row[inside]]] = column[inside]
        if (cone == before).all():
            break
        own = [cone == k for k in range(size)]
        sums = [information[one].sum(axis=0) for one in own]
        vectors = [np.einsum("nij,nj->i", information[one], points[one]) for one in own]
        solved = zip(own, sums, vectors, means, strict=True)
        means = np.array([np.linalg.solve(H, v) if one.any() else mean for one, H, v, mean in solved])
    found = []
    for k in np.unique(cone[cone >= 0]).tolist():
        count = int((cone == k).sum())
        single = count * np.linalg.inv(information[cone == k].sum(axis=0))
        found.append((means[k], (1.0 / count + STAYING) * single, count))
    return found
