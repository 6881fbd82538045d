"""Landmarks that come into being where one thing was sighted often, and go where two are one cone."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.settings.comparison import LandmarkSettings
from pathspace_graph.settings.mapper import GrowthSettings, MapperSettings

from .association import PLANE, Gates, squared_mahalanobis
from .state import LandmarkState

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


def detected_by(
    points: Array, cycles: IntArray, landmarks: Array, settings: GrowthSettings
) -> tuple[IntArray, IntArray]:
    """Which of the readings (m, 2), map frame, made new landmarks (k, 2): rows, and the landmark of each.

    Those within the merge radius, each of the nearest landmark, and of each cycle's (m,) the nearest.
    """
    if len(points) == 0 or len(landmarks) == 0:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    offset = points[:, None] - landmarks[None]
    distances = np.hypot(offset[..., 0], offset[..., 1])
    nearest = distances.argmin(axis=1)
    distance = distances[np.arange(len(points)), nearest]
    rows = np.argsort(distance, kind="stable")
    rows = rows[distance[rows] < settings.merge_radius]
    _, first = np.unique(np.column_stack([cycles[rows], nearest[rows]]), axis=0, return_index=True)
    chosen = rows[first]
    return chosen, nearest[chosen]


def duplicates(
    state: LandmarkState, known: int, covariance: Callable[[IntArray], Array], settings: MapperSettings
) -> tuple[IntArray, IntArray]:
    """Positions (k,) of landmarks and of older ones of their colour, so near that one cone explains both.

    `covariance` gives the joint one of landmarks by their keys; it knows the oldest `known` landmarks.
    """
    first, second = near_pairs(state.landmarks[:known], state.labels[:known], settings.growth.merge_radius)
    involved, index = np.unique(np.concatenate([first, second]), return_inverse=True)
    if len(involved) == 0:
        return first, second
    k, (i, j) = len(involved), index.reshape(2, -1)
    blocks = covariance(state.keys[involved]).reshape(k, PLANE, k, PLANE)
    spread = blocks[i, :, i] + blocks[j, :, j] - blocks[i, :, j] - blocks[j, :, i]
    offset = state.landmarks[first] - state.landmarks[second]
    same = one_cone(first, second, offset, spread, settings.landmark)
    return first[same], second[same]


def near_pairs(landmarks: Array, labels: IntArray, radius: float) -> tuple[IntArray, IntArray]:
    """Indices (k,) of landmarks and of older ones of the same colour within `radius` (m)."""
    offset = landmarks[:, None] - landmarks[None]
    near = (np.hypot(offset[..., 0], offset[..., 1]) < radius) & (labels[:, None] == labels[None])
    newer, older = np.nonzero(np.tril(near, -1))
    return newer, older


def one_cone(
    first: IntArray, second: IntArray, offset: Array, spread: Array, settings: LandmarkSettings
) -> IntArray:
    """Which pairs (k,) are one cone, by `offset` (k, 2) and its covariance (k, 2, 2): nearest first, each
    landmark in one pair at most."""
    distance = squared_mahalanobis(offset, spread + settings.sigma_merge**2 * np.eye(PLANE))
    gate = Gates.of_probabilities(settings.match, settings.create).match
    taken: set[int] = set()
    chosen = []
    for row in np.argsort(distance)[: int((distance < gate).sum())].tolist():
        pair = {int(first[row]), int(second[row])}
        if taken.isdisjoint(pair):
            taken |= pair
            chosen.append(row)
    return np.array(chosen, np.intp)
