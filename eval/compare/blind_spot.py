"""A blind spot: the stretch where a landmark map misses most of the cones that a spline passes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from pathspace_graph.eval.metrics.table1 import MISSED_DISTANCE, cone_distances
from pathspace_graph.io.log import Truth
from pathspace_graph.io.map import Map
from pathspace_graph.labels import BOUNDARIES

Array = NDArray[np.float64]

DISTANCES: Final = (MISSED_DISTANCE, 2.0, 1.0)
"""A cone is missed if nothing is mapped within this distance (m); the distances are tried in this order."""
_MIN_CONES: Final = 2
"""A stretch is a good example if at least this many cones are missed there."""
_MAX_WEIGHT: Final = 10.0
"""Cones farther than this (m) from any landmark all have the same weight."""


@dataclass(frozen=True, eq=False)
class BlindSpot:
    """A blind spot holds a stretch of the track, and the true cones in it that maps miss."""

    centre: Array
    """The centre of the stretch is at (x, y) in m, map frame."""
    half_size: tuple[float, float]
    """The stretch has this half width and half height (m)."""
    distance: float
    """A cone is missed if nothing is mapped within this distance (m)."""
    cones: int
    """The stretch has this many true cones."""
    missed: tuple[Array, ...]
    """Each map has the positions (k, 2) of the cones that it misses in the stretch."""


def find_blind_spot(
    truth: Truth, spline_map: Map, landmark_map: Map, half_size: tuple[float, float] = (17.0, 13.0)
) -> BlindSpot | None:
    """Returns the stretch where the landmark map misses the most cones that the spline map doesn't.

    The cones are missed at the largest of `DISTANCES` at which a stretch misses several cones, else at the
    largest at which any cone is missed. It is None where none is missed at any. Among equal stretches the one
    is chosen whose cones have the largest total distance from their nearest landmarks.
    """
    cones = truth.cones[np.isin(truth.cone_labels, BOUNDARIES)]
    distances = [cone_distances(track, truth) for track in (spline_map, landmark_map)]
    best: BlindSpot | None = None
    for distance in DISTANCES:
        bridged = (distances[0] <= distance) & (distances[1] > distance)
        if bridged.any():
            centre = _densest(cones[bridged], np.minimum(distances[1][bridged], _MAX_WEIGHT), half_size)
            spot = _spot(cones, distances, centre, half_size, distance)
            if len(spot.missed[1]) >= _MIN_CONES:
                return spot
            best = best or spot
    return best


def _densest(points: Array, weights: Array, half_size: tuple[float, float]) -> Array:
    """Returns the centre (2,) of the points (k, 2) around the one with most neighbours, then most weight."""
    scaled = points / np.array(half_size)
    neighbours = KDTree(scaled).query_ball_point(scaled, 1.0, p=np.inf)
    best = max(neighbours, key=lambda members: (len(members), float(weights[members].sum())))
    chosen: Array = points[best]
    return np.asarray(0.5 * (chosen.min(axis=0) + chosen.max(axis=0)))


def _spot(
    cones: Array, distances: list[Array], centre: Array, half_size: tuple[float, float], distance: float
) -> BlindSpot:
    inside = (np.abs(cones - centre) <= half_size).all(axis=1)
    missed = tuple(cones[inside & (d > distance)] for d in distances)
    return BlindSpot(centre, half_size, distance, int(inside.sum()), missed)
