"""Ghosts: what is mapped where no boundary is, and what is mapped more than once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from pathspace_graph.io.log import Truth
from pathspace_graph.io.map import Map, PointBoundary, SplineBoundary
from pathspace_graph.settings.checked import Positive

from .curves import mapped_points, true_curve

Array = NDArray[np.float64]


@dataclass(frozen=True)
class GhostSettings(Positive):
    """What counts as a ghost."""

    distance: float = 2.0
    """Something mapped farther (m) than this from the true boundary of its own colour is a ghost: more than
    the drift of a map whose loop is closed, less than the width of the narrowest lane (3 m)."""


@dataclass(frozen=True, slots=True)
class Ghosts:
    """What is mapped but isn't there, of both boundaries together."""

    landmarks: int
    """Mapped landmarks with no true boundary near."""
    metres: float
    """Length (m) of the mapped curves with no true boundary near."""
    share: float
    """The same as a share of all landmarks and all mapped length; NaN where nothing is mapped."""
    duplicates: int
    """Landmarks beyond the first of each true cone: one cone mapped more than once."""


def ghosts(track: Map, truth: Truth, settings: GhostSettings | None = None) -> Ghosts:
    """Landmarks p, and the length of curve, with min_q |p - q| > distance, q on the true curve of its colour.

    A boundary that has no true cones at all is a ghost as a whole.
    """
    settings = settings or GhostSettings()
    landmarks = duplicates = 0
    metres, shares = 0.0, []
    for label, boundary in track.boundaries.items():
        away = _away(mapped_points(boundary), true_curve(truth, label), settings.distance)
        shares.append(away)
        if isinstance(boundary, SplineBoundary):
            metres += float(np.mean(away)) * boundary.spline.length()
        else:
            landmarks += int(away.sum())
            duplicates += _duplicates(boundary, truth.cones[truth.cone_labels == label], settings.distance)
    return Ghosts(landmarks, metres, _share(shares), duplicates)


def _away(points: Array, true: Array, distance: float) -> NDArray[np.bool_]:
    """Which points (k, 2) are ghosts."""
    if len(true) == 0 or len(points) == 0:
        return np.ones(len(points), dtype=bool)
    return np.asarray(KDTree(true).query(points)[0] > distance)


def _share(away: list[NDArray[np.bool_]]) -> float:
    together = np.concatenate([np.zeros(0, dtype=bool), *away])
    return float(np.mean(together)) if len(together) else float("nan")


def _duplicates(boundary: PointBoundary, cones: Array, distance: float) -> int:
    """Landmarks within `distance` of their nearest cone whose cone has another one already."""
    if len(cones) == 0 or boundary.size == 0:
        return 0
    apart, nearest = KDTree(cones).query(boundary.points)
    near = np.asarray(nearest)[np.asarray(apart) <= distance]
    return int(len(near) - len(np.unique(near)))
