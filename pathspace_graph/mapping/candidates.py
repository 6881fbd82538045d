"""What a boundary may be led through: sightings that are its own, and follow one another along the way."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.se2 import to_map
from pathspace_graph.labels import LEFT, RIGHT, UNKNOWN
from pathspace_graph.settings.mapper import GrowthSettings

from .curve_map import CurveSmoother

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]

SIDES = {LEFT: 1.0, RIGHT: -1.0}
"""Sign of the signed distance from the path on which each boundary lies."""


@dataclass(frozen=True, eq=False)
class Candidates:
    """Sightings that a boundary may be led through, in the order of the way."""

    points: Array
    """(n, 2) map frame, m."""
    indices: IntArray
    """(n,) their indices among the sightings."""
    stations: Array
    """(n,) path length to each, m."""
    sides: Array
    """(n,) distance from the path to the boundary's own side, m."""

    def where(self, chosen: IntArray | NDArray[np.bool_]) -> Candidates:
        """Some of them."""
        return Candidates(
            self.points[chosen], self.indices[chosen], self.stations[chosen], self.sides[chosen]
        )


@dataclass(frozen=True, eq=False)
class End:
    """The end of a curve, as far as sightings hold it."""

    position: Array
    """(2,) map frame, m."""
    station: float
    """Path length to it, m."""
    side: float
    """Its distance from the path to the boundary's own side, m."""


def undisputed(smoother: CurveSmoother, label: int, points: Array, radius: float) -> NDArray[np.bool_]:
    """Which places (n, 2) have no more readings of the other boundary's label around them than of their own.

    A sensor that takes a cone for one of the other boundary now and then sees it in its true colour oftener.
    Readings in the window count, in use or not, within `radius` (m).
    """
    detections = smoother.map.detections
    rows = np.flatnonzero(detections.label != UNKNOWN)
    seen = to_map(detections.point[rows], smoother.variables.poses_at(detections.cycle[rows]))
    offset = points[:, None] - seen
    near = offset[:, :, 0] ** 2 + offset[:, :, 1] ** 2 < radius**2
    votes = near @ np.where(detections.label[rows] == label, 1, -1)
    return np.asarray(votes >= 0)


def chain(found: Candidates, settings: GrowthSettings, end: End | None) -> IntArray:
    """Indices of those that follow one another: each not much farther from the path than the last.

    `side_i <= side_last + lateral_change + lateral_rate (s_i - s_last)`, from the end of the curve on where
    there is one; and of those at about the same station the one nearest to the path: what is behind another
    row belongs to another stretch of the track.
    """
    chosen: list[int] = []
    last = None if end is None else (end.station, end.side)
    for i, (station, side) in enumerate(zip(found.stations, found.sides, strict=True)):
        beside = np.abs(found.stations - station) < settings.beside
        if (found.sides[beside] < side - settings.lateral_gap).any():
            continue
        if last is not None:
            room = settings.lateral_change + settings.lateral_rate * (station - last[0])
            if side > last[1] + room:
                continue
        chosen.append(i)
        last = (station, side)
    return np.array(chosen, dtype=np.intp)
