"""Contradictions: cones that are seen again and again where the closed map has none of their colour."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from pathspace_graph.factors.se2 import rotated, to_map
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.mapping.curve_map import CurveSmoother
from pathspace_graph.mapping.tentative import TentativeTracks
from pathspace_graph.settings.health import MendingSettings
from pathspace_graph.settings.mapper import MapperSettings

from .finding import KnownLoop, Loop

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Stretch:
    """A stretch of a boundary is where cones of its colour stand in a row beside its curve."""

    label: int
    """This is the boundary."""
    cones: Array
    """(k, 2) The cones are at these points in m, map frame, in no order."""


class Contradictions:
    """Collects the detections that no curve of a closed map explains, by label."""

    def __init__(self, settings: MapperSettings) -> None:
        self.settings: MendingSettings = settings.mending
        own = replace(settings.growth, sightings=self.settings.sightings, forget_after=self.settings.memory)
        self._tracks = {label: TentativeTracks(own) for label in BOUNDARIES}

    def observe(self, smoother: CurveSmoother, known: KnownLoop, new: slice, t: float) -> None:
        """Adds the new coloured detections, seen at t (s), that are not in use, or are used beside a gap."""
        detections, rows = smoother.map.detections, np.arange(new.start, new.stop)
        unexplained = ~detections.used[new]
        for label in known.with_gaps():
            own = rows[detections.boundary[new] == label]
            unexplained[own - new.start] |= ~known.is_mapped(label, detections.u[own])
        rows = rows[unexplained]
        if len(rows) == 0:
            return
        poses = smoother.variables.poses_at(detections.cycle[rows])
        points = to_map(detections.point[rows], poses)
        covariances = rotated(detections.covariance[rows], poses[:, 2])
        for label, tracks in self._tracks.items():
            own = detections.label[rows] == label
            tracks.add(points[own], covariances[own], t)

    def clear(self) -> None:
        """Forgets everything, because the map or the pose was replaced."""
        for tracks in self._tracks.values():
            tracks.clear()

    def stretches(self, loop: Loop, t: float) -> list[Stretch]:
        """Returns the stretches whose cones contradict the curves of the loop, or stand in a gap.

        There are none until the vehicle has passed all of them at t (s), and has not seen their cones for a
        while. It does not pass a very long one as a whole.
        """
        found, settings = list[Stretch](), self.settings
        for label, tracks in self._tracks.items():
            chosen = tracks.confirmed()
            if len(chosen) < settings.cones:
                continue
            chosen = chosen[_is_new(loop, label, tracks.points[chosen], settings.beside)]
            chosen = chosen[self._undisputed(label, chosen)]
            points, passed = tracks.points[chosen], tracks.last_t[chosen] < t - settings.settle
            for row in in_rows(points, settings.row):
                if len(row) < settings.cones:
                    continue
                if not passed[row].all() and passed[row].sum() < settings.most:
                    return []
                found.append(Stretch(label, points[row[passed[row]]]))
        return found

    def _undisputed(self, label: int, chosen: IntArray) -> BoolArray:
        """Returns which tracks (k,) were seen more often than those of the other colour at the same place."""
        own, (other,) = self._tracks[label], (self._tracks[b] for b in BOUNDARIES if b != label)
        apart = np.hypot(*(own.points[chosen, None] - other.points).transpose(2, 0, 1))
        rival = np.where(apart < other.settings.merge_radius, other.counts, 0).max(axis=1, initial=0)
        return np.asarray(own.counts[chosen] > rival)


def _is_new(loop: Loop, label: int, points: Array, beside: float) -> BoolArray:
    """Returns which points (k, 2) of a colour are farther than this (m) from all curves, or in a gap."""
    new = loop.beside_gaps(np.full(len(points), label), points)
    new |= loop.curves[label].query(points)[0] > beside
    for number, curve in loop.curves.items():
        if number != label:
            new &= curve.query(points)[0] > beside
    return new


def in_rows(points: Array, apart: float) -> list[IntArray]:
    """Returns the groups (k,) of points (n, 2), by index, whose neighbours are at most this far apart (m)."""
    if len(points) == 0:
        return []
    pairs = KDTree(points).sparse_distance_matrix(KDTree(points), apart)
    count, group = connected_components(pairs, directed=False)
    return [np.flatnonzero(group == number) for number in range(count)]
