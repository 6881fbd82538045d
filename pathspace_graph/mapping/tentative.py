"""Tentative tracks: cones that no curve or landmark explains yet, confirmed after enough detections."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.se2 import move_points
from pathspace_graph.settings.growth import GrowthSettings

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


class TentativeTracks:
    """Holds cones of one label as points, merges detections within a radius, and counts them."""

    def __init__(self, settings: GrowthSettings) -> None:
        self.settings = settings
        self.points: Array = np.zeros((0, 2))
        """(n, 2) Each row is the weighted mean of a track's detections in m, map frame."""
        self.weights: Array = np.zeros(0)
        """(n,) Each track has this information (1/m^2): the sum of its detections' inverse variances."""
        self.counts: IntArray = np.zeros(0, np.intp)
        """(n,) Each track has this number of detections."""
        self.last_t: Array = np.zeros(0)
        """(n,) Each track was last seen at this stamp (s)."""

    def add(self, points: Array, variances: Array, t: float) -> None:
        """Adds detections (m, 2) at t (s), each with a scalar variance (m,), to the nearest or to new tracks.

        Tracks that were not seen for `forget_after` seconds are removed first.
        """
        self._keep(self.last_t > t - self.settings.forget_after)
        if len(points) == 0:
            return
        nearest, near = nearest_within(points, self.points, self.settings.merge_radius)
        for row in np.flatnonzero(near):
            i, w = nearest[row], 1.0 / variances[row]
            self.weights[i] += w
            self.points[i] += (points[row] - self.points[i]) * w / self.weights[i]
            self.counts[i] += 1
            self.last_t[i] = max(self.last_t[i], t)  # a late detection makes no track older
        new = ~near
        self.points = np.concatenate([self.points, points[new]])
        self.weights = np.concatenate([self.weights, 1.0 / variances[new]])
        self.counts = np.concatenate([self.counts, np.ones(int(new.sum()), np.intp)])
        self.last_t = np.concatenate([self.last_t, np.full(int(new.sum()), t)])
        self._keep(newest_of(self.last_t, self.settings.max_tracks))

    def confirmed(self) -> IntArray:
        """Returns the indices of the tracks with enough detections."""
        return np.flatnonzero(self.counts >= self.settings.sightings)

    def variances(self, indices: IntArray) -> Array:
        """Returns the variance (k,) of tracks in any direction (m^2): half the trace of their covariance."""
        return 0.5 / self.weights[indices]

    def remove(self, indices: IntArray) -> None:
        """Removes tracks by index."""
        keep = np.ones(len(self.counts), bool)
        keep[indices] = False
        self._keep(keep)

    def restore(self, points: Array, t: float) -> None:
        """Adds confirmed tracks at points (k, 2), last seen at t (s)."""
        self.points = np.concatenate([self.points, points])
        self.weights = np.append(self.weights, np.ones(len(points)))
        self.counts = np.append(self.counts, np.full(len(points), self.settings.sightings))
        self.last_t = np.append(self.last_t, np.full(len(points), t))

    def move(self, motion: Array) -> None:
        """Moves all tracks by a rigid motion (3,) of the map frame."""
        self.points = move_points(motion, self.points)

    def clear(self) -> None:
        """Removes all tracks."""
        self._keep(np.zeros(len(self.counts), bool))

    def _keep(self, keep: NDArray[np.bool_]) -> None:
        if not keep.all():
            self.points, self.weights = self.points[keep], self.weights[keep]
            self.counts, self.last_t = self.counts[keep], self.last_t[keep]


def newest_of(stamps: Array, most: int) -> NDArray[np.bool_]:
    """Returns which (n,) of the stamps (n,) are among the newest ones, of which there are at most `most`."""
    keep = np.ones(len(stamps), bool)
    if len(stamps) > most:
        keep[np.argsort(stamps, kind="stable")[:-most]] = False
    return keep


def nearest_within(points: Array, known: Array, radius: float) -> tuple[IntArray, NDArray[np.bool_]]:
    """Returns the nearest of the known points (n, 2) to each point (m, 2), and whether it is within a radius.

    The first result (m,) is an index, which means nothing where no point is known.
    """
    if len(known) == 0:
        return np.zeros(len(points), np.intp), np.zeros(len(points), bool)
    offset = points[:, None, :] - known[None, :, :]
    distance = np.hypot(offset[:, :, 0], offset[:, :, 1])
    nearest = distance.argmin(axis=1)
    return nearest, distance[np.arange(len(points)), nearest] < radius
