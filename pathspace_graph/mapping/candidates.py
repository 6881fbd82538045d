"""Candidates for the extension of a boundary, and the chain of them that the path's order allows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.settings.growth import GrowthSettings

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]

SIDES = {LEFT: 1.0, RIGHT: -1.0}
"""Each boundary lies where the signed distance from the path (left positive) has this sign."""


@dataclass(frozen=True, eq=False)
class Candidates:
    """Holds the points that a boundary may be extended through."""

    points: Array
    """(n, 2) Each row holds a position (x, y) in m, map frame."""
    indices: IntArray
    """(n,) Each candidate has this index among the tentative tracks, or among a cycle's detections."""
    stations: Array
    """(n,) Each candidate lies beside the path at this station (path length, m)."""
    sides: Array
    """(n,) Each candidate has this distance from the path (m), positive on the boundary's own side."""

    def where(self, chosen: IntArray | NDArray[np.bool_]) -> Candidates:
        """Returns the chosen candidates, in the given order if they are chosen by index."""
        return Candidates(
            self.points[chosen], self.indices[chosen], self.stations[chosen], self.sides[chosen]
        )


@dataclass(frozen=True, eq=False)
class End:
    """Holds where the confirmed part of a curve ends."""

    position: Array
    """(2,) The end has this position (x, y) in m, map frame."""
    station: float
    """The end lies beside the path at this station (m)."""
    side: float
    """The end has this distance from the path (m), positive on the boundary's own side."""


def chain(found: Candidates, settings: GrowthSettings, end: End | None) -> IntArray:
    """Returns the indices of the candidates, sorted by station, that may follow one another.

    A candidate i may follow the end of the curve if `side_i <= side_end + lateral_change + lateral_rate
    (s_i - s_end)`; without a curve the first candidate takes the place of the end. No candidate allows the
    next one more than that, or a row would be left for the next lane's, step by step. Of candidates at about
    the same station only those nearest to the path remain: a second row behind the first belongs to another
    stretch of the track.
    """
    in_front = np.flatnonzero(
        in_front_row(found.stations, found.sides, settings.beside, settings.lateral_gap)
    )
    if len(in_front) == 0:
        return in_front
    first = in_front[0]
    station, side = (found.stations[first], found.sides[first]) if end is None else (end.station, end.side)
    room = settings.lateral_change + settings.lateral_rate * (found.stations[in_front] - station)
    return np.asarray(in_front[found.sides[in_front] <= side + room])


def in_front_row(stations: Array, sides: Array, beside: float, gap: float) -> NDArray[np.bool_]:
    """Returns which points are in the row nearest to the path, from their stations and sides (n,), in m.

    A point is behind that row if another one is less than `beside` (m) from it along the path, and nearer to
    the path by more than `gap` (m).
    """
    near = np.abs(stations - stations[:, None]) < beside
    return np.asarray(~(near & (sides < sides[:, None] - gap)).any(axis=1))
