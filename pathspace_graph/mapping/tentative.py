"""Tentative tracks: cones that no curve explains yet."""

from collections.abc import Mapping
from typing import Final, Self

import numpy as np

from pathspace_graph.copies import shallow
from pathspace_graph.factors import _kernels as kernels
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.se2 import move_points, rotated
from pathspace_graph.settings.online import GrowthSettings

MERGE_CHI: Final = 2.5  # gate of a smeared detection about a track, in sigmas of both together
MERGE_MOST: Final = 2.0  # largest such gate, in merge radii: the next cone of the row is farther away
RESTORED: Final = 0.3  # standard deviation of a cone that is taken back from a curve (m)
MAX_TRACKS: Final = 1000  # largest number of tracks of a label; the oldest ones are dropped


class TentativeTracks:
    """Cones of one label as points, each merged from the detections within a radius."""

    def __init__(self, settings: GrowthSettings) -> None:
        self.settings = settings
        self.points: Array = np.zeros((0, 2))  # (n, 2) weighted means of the detections in m, map frame
        self.information: Array = np.zeros((0, 2, 2))  # (n, 2, 2) sums of the inverse covariances (1/m^2)
        self.counts: IntArray = np.zeros(0, np.intp)  # (n,) number of detections
        self.last_t: Array = np.zeros(0)  # (n,) stamp of the newest detection (s)

    def copy(self) -> Self:
        """Return an independent copy; no attribute is changed in place."""
        return shallow(self)

    def add(self, points: Array, covariances: Array, t: float) -> None:
        """Add detections (m, 2) with covariances (m, 2, 2), seen at t (s), to their tracks or to new ones.

        A detection belongs to the nearest track, by the smaller of its distances in `merge_radius` and in
        sigmas: far sightings of one cone are smeared along their rays. Tracks older than `forget_after` are
        dropped.
        """
        self._keep(self.last_t > t - self.settings.forget_after)
        if len(points) == 0:
            return
        gate = (self.settings.merge_radius, MERGE_MOST, MERGE_CHI)
        tracks = kernels.merged(
            (self.points, self.information, self.counts, self.last_t), points, covariances, t, gate
        )
        self.points, self.information, self.counts, self.last_t = tracks
        self._keep(newest_of(self.last_t, MAX_TRACKS))

    def confirmed(self) -> IntArray:
        """Indices of the tracks with enough detections."""
        return np.flatnonzero(self.counts >= self.settings.sightings)

    def variances(self, indices: IntArray) -> Array:
        """Mean variance (k,) of tracks over all directions (m^2): half the trace of their covariance."""
        return np.asarray(0.5 * np.trace(np.linalg.inv(self.information[indices]), axis1=1, axis2=2))

    def sigmas(self, indices: IntArray) -> Array:
        """Standard deviation (k,) of tracks in their worst direction (m)."""
        a, b, d = self.information[indices].reshape(-1, 4)[:, [0, 1, 3]].T
        return np.asarray((0.5 * (a + d) - np.hypot(0.5 * (a - d), b)) ** -0.5)

    def remove(self, indices: IntArray) -> None:
        keep = np.ones(len(self.counts), bool)
        keep[indices] = False
        self._keep(keep)

    def restore(self, points: Array, t: float) -> None:
        """Add confirmed tracks at points (k, 2), last seen at t (s)."""
        self.points = np.concatenate([self.points, points])
        known = np.tile(np.eye(2) / RESTORED**2, (len(points), 1, 1))
        self.information = np.concatenate([self.information, known])
        self.counts = np.append(self.counts, np.full(len(points), self.settings.sightings))
        self.last_t = np.append(self.last_t, np.full(len(points), t))

    def move(self, motion: Array) -> None:
        """Move all tracks by a rigid motion (3,) of the map frame."""
        self.points = move_points(motion, self.points)
        self.information = rotated(self.information, np.full(len(self.points), motion[2]))

    def clear(self) -> None:
        self._keep(np.zeros(len(self.counts), bool))

    def _keep(self, keep: BoolArray) -> None:
        if not keep.all():
            self.points, self.information = self.points[keep], self.information[keep]
            self.counts, self.last_t = self.counts[keep], self.last_t[keep]


def merged_in_turn(
    points: Array, covariances: Array, settings: GrowthSettings
) -> tuple[Array, Array, IntArray]:
    """Merge detections (m, 2) with covariances (m, 2, 2) of one label as `TentativeTracks.add` does.

    Return points (n, 2), information (n, 2, 2) and numbers of detections (n,) of the cones.
    """
    gate = (settings.merge_radius, MERGE_MOST, MERGE_CHI)
    places, information, counts, _ = kernels.merged_in_turn(points, covariances, gate)
    return places, information, counts


def add_by_label(
    tracks: Mapping[int, TentativeTracks], labels: IntArray, points: Array, covariances: Array, t: float
) -> None:
    """Add detections (m, 2), map frame, with labels (m,) and covariances (m, 2, 2), seen at t (s)."""
    for label, of_label in tracks.items():
        chosen = labels == label
        of_label.add(points[chosen], covariances[chosen], t)


def newest_of(stamps: Array, most: int) -> BoolArray:
    """Select the newest of stamps (n,), at most `most` of them."""
    keep = np.ones(len(stamps), bool)
    if len(stamps) > most:
        keep[np.argsort(stamps, kind="stable")[:-most]] = False
    return keep


def nearest_within(points: Array, known: Array, radius: float) -> tuple[IntArray, BoolArray]:
    """Return the index (m,) of the nearest known point to each point (m, 2), and whether within a radius."""
    if len(known) == 0:
        return np.zeros(len(points), np.intp), np.zeros(len(points), bool)
    offset = points[:, None, :] - known[None, :, :]
    distance = np.hypot(offset[:, :, 0], offset[:, :, 1])
    nearest = distance.argmin(axis=1)
    return nearest, distance[np.arange(len(points)), nearest] < radius
