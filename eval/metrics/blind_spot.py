"""A blind spot: the stretch where a landmark map misses most cones that a spline passes by."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from pathspace_graph.io.log import Truth
from pathspace_graph.io.map import Map
from pathspace_graph.labels import BOUNDARIES

from .table1 import MISSED_DISTANCE, cone_distances

Array = NDArray[np.float64]

DISTANCES: Final = (MISSED_DISTANCE, 2.0, 1.0)
"""A blind spot is looked for at each of these (m)."""
_SEVERAL: Final = 2
"""Cones in a row that make a better example than one alone."""
_FAR: Final = 10.0
"""A cone farther (m) than this from any landmark is as good as one at this distance."""


@dataclass(frozen=True, eq=False)
class BlindSpot:
    """A stretch of the track, and the true cones in it that maps miss."""

    centre: Array
    """(2,) m, map frame."""
    half_size: tuple[float, float]
    """Half width and half height (m)."""
    distance: float
    """A cone with nothing mapped within this (m) is missed."""
    cones: int
    """True cones in sight."""
    missed: tuple[Array, ...]
    """Of each map, the missed cones in sight (k, 2)."""


def find_blind_spot(
    truth: Truth, spline_map: Map, landmark_map: Map, half_size: tuple[float, float] = (17.0, 13.0)
) -> BlindSpot | None:
    """Where the landmark map misses the most cones that the spline map doesn't; None where it misses none.

    Missed: d > 3 m as in the paper's table, 2 m or 1 m, the farthest at which several are in sight at once,
    or any at all. Of equals the one where the cones are farthest from their nearest landmark in sum.
    """
    cones = truth.cones[np.isin(truth.cone_labels, BOUNDARIES)]
    distances = [cone_distances(track, truth) for track in (spline_map, landmark_map)]
    best: BlindSpot | None = None
    for distance in DISTANCES:
        bridged = (distances[0] <= distance) & (distances[1] > distance)
        if bridged.any():
            centre = _densest(cones[bridged], np.minimum(distances[1][bridged], _FAR), half_size)
            spot = _spot(cones, distances, centre, half_size, distance)
            if len(spot.missed[1]) >= _SEVERAL:
                return spot
            best = best or spot
    return best


def _densest(points: Array, weights: Array, half_size: tuple[float, float]) -> Array:
    """Middle (2,) of the points (k, 2) in sight from that one which sees most of them, then most weight."""
    scaled = points / np.array(half_size)
    seen = KDTree(scaled).query_ball_point(scaled, 1.0, p=np.inf)
    best = max(seen, key=lambda members: (len(members), float(weights[members].sum())))
    together: Array = points[best]
    return np.asarray(0.5 * (together.min(axis=0) + together.max(axis=0)))


def _spot(
    cones: Array, distances: list[Array], centre: Array, half_size: tuple[float, float], distance: float
) -> BlindSpot:
    inside = (np.abs(cones - centre) <= half_size).all(axis=1)
    missed = tuple(cones[inside & (d > distance)] for d in distances)
    return BlindSpot(centre, half_size, distance, int(inside.sum()), missed)
