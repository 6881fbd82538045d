"""Ghosts, which are mapped where no true boundary is, and landmarks that are mapped more than once."""

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
    """Holds what counts as a ghost."""

    distance: float = 2.0
    """A mapped point farther than this (m) from the true boundary of its own colour is a ghost. The default
    exceeds the drift of a map whose loop is closed, but not the width of the narrowest lane (3 m)."""


@dataclass(frozen=True, slots=True)
class Ghosts:
    """Holds what is mapped but doesn't exist, on both boundaries together."""

    landmarks: int
    """This many landmarks have no true boundary near."""
    metres: float
    """Mapped curves have no true boundary near over this length (m)."""
    share: float
    """Ghosts are this share of all landmarks and points of curves; it is NaN where nothing is mapped."""
    duplicates: int
    """This many landmarks are nearest to a true cone that already has one."""


def ghosts(track: Map, truth: Truth, settings: GhostSettings | None = None) -> Ghosts:
    """Returns the landmarks p and the length of curve with min_q |p - q| > distance, q on the true curve.

    The true curve is that of the same boundary. A boundary without any true cone is a ghost as a whole.
    """
    settings = settings or GhostSettings()
    landmarks = duplicates = 0
    metres, all_ghosts = 0.0, []
    for label, boundary in track.boundaries.items():
        is_ghost = _is_ghost(mapped_points(boundary), true_curve(truth, label), settings.distance)
        all_ghosts.append(is_ghost)
        if isinstance(boundary, SplineBoundary):
            metres += float(np.mean(is_ghost)) * boundary.spline.length()
        else:
            landmarks += int(is_ghost.sum())
            duplicates += _duplicates(boundary, truth.cones[truth.cone_labels == label], settings.distance)
    return Ghosts(landmarks, metres, _share(all_ghosts), duplicates)


def _is_ghost(points: Array, curve_true: Array, distance: float) -> NDArray[np.bool_]:
    """Returns which points (k, 2) are ghosts."""
    if len(curve_true) == 0 or len(points) == 0:
        return np.ones(len(points), dtype=bool)
    return np.asarray(KDTree(curve_true).query(points)[0] > distance)


def _share(all_ghosts: list[NDArray[np.bool_]]) -> float:
    pooled = np.concatenate([np.zeros(0, dtype=bool), *all_ghosts])
    return float(np.mean(pooled)) if len(pooled) else float("nan")


def _duplicates(boundary: PointBoundary, cones: Array, distance: float) -> int:
    """Returns how many landmarks within `distance` of their nearest cone share it with an earlier one."""
    if len(cones) == 0 or boundary.size == 0:
        return 0
    distances, nearest = KDTree(cones).query(boundary.points)
    matched = np.asarray(nearest)[np.asarray(distances) <= distance]
    return int(len(matched) - len(np.unique(matched)))
