"""Tracks: cones as points, each merged from its detections; and orange cones, which belong to no boundary."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import ClassVar, Final, Self

import numpy as np
from scipy.cluster.vq import kmeans2
from scipy.linalg import block_diag
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from pathspace_graph.copies import Copyable, shallow
from pathspace_graph.factors import _kernels as kernels
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.se2 import compose, move_points, rotated, to_map
from pathspace_graph.io.log import Detections
from pathspace_graph.io.map import PointBoundary
from pathspace_graph.labels import LEFT, NAMES, POINTS, RIGHT
from pathspace_graph.mapping.detections import DetectionColumns
from pathspace_graph.settings.mapper import GrowthSettings

MERGE_SIGMAS: Final = 2.5  # gate of a smeared detection about a track, in sigmas of both together
MERGE_MOST: Final = 2.0  # largest such gate, in merge radii: the next cone of the row is farther away
RESTORED: Final = 0.3  # standard deviation of a cone that is taken back from a curve (m)
MAX_TRACKS: Final = 2000  # largest number of tracks; the oldest ones are dropped
KNOWN_SIGMA: Final = 0.4  # largest standard deviation, in any direction, of a track that is in the map (m)
FORGET_AFTER: Final = 6.0  # time without a detection after which a tentative track is dropped (s)
RECKONED: Final = 3.0  # time without a detection over which dead reckoning keeps the place of a cone (s)


class Tracks(Copyable):
    """Table of cones in one frame.

    Tracks without a detection for `memory` (s) are dropped, and the oldest of too many. None are if it is
    infinite.
    """

    def __init__(
        self,
        radius: float = GrowthSettings.merge_radius,
        memory: float = RECKONED,
        *,
        most: float = MERGE_MOST,
        sigmas: float = MERGE_SIGMAS,
        by_label: bool = True,
    ) -> None:
        self.points: Array = np.zeros((0, 2))  # (n, 2) weighted means of the detections in m
        self.information: Array = np.zeros((0, 2, 2))  # (n, 2, 2) sums of the inverse covariances (1/m^2)
        self.votes: IntArray = np.zeros((0, len(NAMES)), np.intp)  # (n, 5) number of detections by label
        self.last_t: Array = np.zeros(0)  # (n,) stamp of the newest detection (s)
        self.numbers: IntArray = np.zeros(0, np.intp)  # (n,) ascending; a track keeps its number
        self._next, self._memory = 0, memory
        self._gate = (radius, most, sigmas, memory, by_label)

    def add(self, points: Array, covariances: Array, labels: IntArray, t: float | Array) -> IntArray:
        """Add detections (m, 2) with covariances (m, 2, 2) and labels (m,); return numbers (m,) of tracks.

        t (s) is one stamp or ascending ones (m,). A detection belongs to the nearest earlier track within the
        radius, or else to the nearest in sigmas of both: far sightings of one cone are smeared along their
        rays. The others of a stamp begin a track each. With `by_label`, a track has detections of one label.
        """
        now, numbers = float(np.max(np.asarray(t, float), initial=-np.inf)), np.zeros(0, np.intp)
        if len(points):
            stamps = np.broadcast_to(t, len(points))
            known = self.points, self.information, self.votes, self.last_t, self.numbers
            columns, numbers = kernels.merged(
                known, points, covariances, labels, stamps, self._next, self._gate
            )
            self.points, self.information, self.votes, self.last_t, self.numbers = columns
            self._next = max(self._next, int(self.numbers[-1]) + 1)
        keep = self.last_t > now - self._memory
        if len(keep) > MAX_TRACKS and self._memory < np.inf:
            keep[np.argsort(self.last_t, kind="stable")[:-MAX_TRACKS]] = False
        self._keep(keep)
        return numbers

    @property
    def counts(self) -> IntArray:
        """Number of detections (n,)."""
        return np.asarray(self.votes.sum(axis=1))

    def confirmed(self, label: int, sightings: int) -> IntArray:
        """Indices of the tracks with enough detections of a label."""
        return np.flatnonzero(self.votes[:, label] >= sightings)

    def undisputed(self, indices: IntArray, label: int) -> BoolArray:
        """Whether tracks (k,) of a boundary have as many detections as those of the other one around.

        A sensor that sometimes confuses colours detects the true one more often.
        """
        offset = self.points[indices, None] - self.points
        near = np.hypot(offset[..., 0], offset[..., 1]) < self._gate[0]
        return np.asarray(self.votes[indices, label] >= near @ self.votes[:, LEFT + RIGHT - label])

    def variances(self, indices: IntArray) -> Array:
        """Mean variance (k,) of tracks over all directions (m^2): half the trace of their covariance."""
        return np.asarray(0.5 * np.trace(np.linalg.inv(self.information[indices]), axis1=1, axis2=2))

    def sigmas(self, indices: IntArray) -> Array:
        """Standard deviation (k,) of tracks in their worst direction (m)."""
        a, b, d = self.information[indices].reshape(-1, 4)[:, [0, 1, 3]].T
        return np.asarray((0.5 * (a + d) - np.hypot(0.5 * (a - d), b)) ** -0.5)

    def remove(self, indices: IntArray) -> None:
        keep = np.ones(len(self.numbers), bool)
        keep[indices] = False
        self._keep(keep)

    def restore(self, points: Array, label: int, count: int, t: float) -> None:
        """Add tracks at points (k, 2) with `count` detections of a label each, the last one at t (s)."""
        known, votes = np.tile(np.eye(2) / RESTORED**2, (len(points), 1, 1)), np.zeros(len(NAMES), np.intp)
        votes[label] = count
        self.points = np.concatenate([self.points, points])
        self.information = np.concatenate([self.information, known])
        self.votes = np.concatenate([self.votes, np.tile(votes, (len(points), 1))])
        self.last_t = np.append(self.last_t, np.full(len(points), t))
        self.numbers = np.append(self.numbers, self._next + np.arange(len(points)))
        self._next += len(points)

    def move(self, motion: Array) -> None:
        """Move all tracks by a rigid motion (3,) of their frame."""
        self.points = move_points(motion, self.points)
        self.information = rotated(self.information, np.full(len(self.points), motion[2]))

    def clear(self) -> None:
        self._keep(np.zeros(len(self.numbers), bool))

    def _keep(self, keep: BoolArray) -> None:
        if not keep.all():
            self.points, self.information, self.votes = (
                self.points[keep],
                self.information[keep],
                self.votes[keep],
            )
            self.last_t, self.numbers = self.last_t[keep], self.numbers[keep]


def nearest_within(points: Array, known: Array, radius: float) -> tuple[IntArray, BoolArray]:
    """Return the index (m,) of the nearest known point to each point (m, 2), and whether within a radius."""
    if len(known) == 0:
        return np.zeros(len(points), np.intp), np.zeros(len(points), bool)
    offset = points[:, None, :] - known[None, :, :]
    distance = np.hypot(offset[:, :, 0], offset[:, :, 1])
    nearest = distance.argmin(axis=1)
    return nearest, distance[np.arange(len(points)), nearest] < radius


def linked(points: Array, apart: float) -> list[IntArray]:
    """Group points (n, 2) by single linkage at distances up to `apart` (m); return indices (k,) by group."""
    pairs = KDTree(points).query_pairs(apart, output_type="ndarray") if len(points) else np.zeros((0, 2), int)
    graph = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(points), len(points)))
    count, group = connected_components(graph, directed=False)
    return [np.flatnonzero(group == number) for number in range(count)]


# --- orange cones -------------------------------------------------------------------------------------------


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
