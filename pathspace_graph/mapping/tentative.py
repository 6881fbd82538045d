"""Readings that no curve explains yet: kept until they were seen often enough to be believed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.settings.mapper import GrowthSettings

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


class TentativeTracks:
    """Points (n, 2) in the map frame of one label, merged within a radius and counted."""

    def __init__(self, settings: GrowthSettings) -> None:
        self.settings = settings
        self.points: Array = np.zeros((0, 2))
        """Weighted means, m, map frame."""
        self.weights: Array = np.zeros(0)
        """Information of each, 1/m^2."""
        self.counts: IntArray = np.zeros(0, np.intp)
        """Readings merged in each."""
        self.last_t: Array = np.zeros(0)
        """When each was last seen, s."""

    def add(self, points: Array, variances: Array, t: float) -> None:
        """Merge readings (m, 2), each with a scalar variance (m,), into the nearest sighting or a new one."""
        self._keep(self.last_t > t - self.settings.forget_after)
        if len(points) == 0:
            return
        nearest, near = self._nearest(points)
        for row in np.flatnonzero(near):
            i, w = nearest[row], 1.0 / variances[row]
            self.weights[i] += w
            self.points[i] += (points[row] - self.points[i]) * w / self.weights[i]
            self.counts[i] += 1
            self.last_t[i] = t
        new = ~near
        self.points = np.concatenate([self.points, points[new]])
        self.weights = np.concatenate([self.weights, 1.0 / variances[new]])
        self.counts = np.concatenate([self.counts, np.ones(int(new.sum()), np.intp)])
        self.last_t = np.concatenate([self.last_t, np.full(int(new.sum()), t)])

    def confirmed(self) -> IntArray:
        """Indices of the sightings that were seen often enough."""
        return np.flatnonzero(self.counts >= self.settings.sightings)

    def remove(self, indices: IntArray) -> None:
        """Drop sightings by index."""
        keep = np.ones(len(self.counts), bool)
        keep[indices] = False
        self._keep(keep)

    def restore(self, points: Array, t: float) -> None:
        """Points (k, 2) that were sighted often enough, and are to be again, last at a time (s)."""
        self.points = np.concatenate([self.points, points])
        self.weights = np.append(self.weights, np.ones(len(points)))
        self.counts = np.append(self.counts, np.full(len(points), self.settings.sightings))
        self.last_t = np.append(self.last_t, np.full(len(points), t))

    def clear(self) -> None:
        """Drop all."""
        self._keep(np.zeros(len(self.counts), bool))

    def _nearest(self, points: Array) -> tuple[IntArray, NDArray[np.bool_]]:
        if len(self.points) == 0:
            return np.zeros(len(points), np.intp), np.zeros(len(points), bool)
        offset = points[:, None, :] - self.points[None, :, :]
        distance = np.hypot(offset[:, :, 0], offset[:, :, 1])
        nearest = distance.argmin(axis=1)
        return nearest, distance[np.arange(len(points)), nearest] < self.settings.merge_radius

    def _keep(self, keep: NDArray[np.bool_]) -> None:
        if not keep.all():
            self.points, self.weights = self.points[keep], self.weights[keep]
            self.counts, self.last_t = self.counts[keep], self.last_t[keep]
