"""Merges landmarks of one cone: finds duplicates by their joint covariance, and makes two landmarks one."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.graph.keys import POINT
from pathspace_graph.settings.comparison import LandmarkSettings
from pathspace_graph.settings.mapper import MapperSettings

from .association import Gates, squared_mahalanobis
from .landmark_map import LandmarkSmoother
from .state import LandmarkState

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


def find_duplicates(
    state: LandmarkState, known: int, covariance: Callable[[IntArray], Array], settings: MapperSettings
) -> tuple[IntArray, IntArray]:
    """Returns the positions (k,) of landmarks, and of the older landmarks of the same cone.

    `covariance` returns the joint covariance of landmarks by their keys. It knows the oldest `known`
    landmarks, and only those are tested.
    """
    newer, older = pairs_within(state.landmarks[:known], state.labels[:known], settings.growth.merge_radius)
    involved, index = np.unique(np.concatenate([newer, older]), return_inverse=True)
    if len(involved) == 0:
        return newer, older
    k, (i, j) = len(involved), index.reshape(2, -1)
    blocks = covariance(state.keys[involved]).reshape(k, POINT, k, POINT)
    spread = blocks[i, :, i] + blocks[j, :, j] - blocks[i, :, j] - blocks[j, :, i]
    offset = state.landmarks[newer] - state.landmarks[older]
    same = compatible_pairs(newer, older, offset, spread, settings.landmark)
    return newer[same], older[same]


def pairs_within(landmarks: Array, labels: IntArray, radius: float) -> tuple[IntArray, IntArray]:
    """Returns the indices (k,) of landmarks, and of older ones of the same label within `radius` (m)."""
    offset = landmarks[:, None] - landmarks[None]
    near = (np.hypot(offset[..., 0], offset[..., 1]) < radius) & (labels[:, None] == labels[None])
    newer, older = np.nonzero(np.tril(near, -1))
    return newer, older


def compatible_pairs(
    newer: IntArray, older: IntArray, offset: Array, covariances: Array, settings: LandmarkSettings
) -> IntArray:
    """Returns the indices of the pairs (k,) that are one cone, by the gate on their Mahalanobis distance.

    offset (k, 2) is the difference of each pair, and covariances (k, 2, 2) are those of the offset. The pairs
    are taken nearest first, and each landmark is in one pair at most.
    """
    distance = squared_mahalanobis(offset, covariances + settings.sigma_merge**2 * np.eye(POINT))
    taken: set[int] = set()
    chosen = []
    for row in np.argsort(distance)[: int((distance < Gates.of(settings).match).sum())].tolist():
        pair = {int(newer[row]), int(older[row])}
        if taken.isdisjoint(pair):
            taken |= pair
            chosen.append(row)
    return np.array(chosen, np.intp)


def merge(smoother: LandmarkSmoother, gone: IntArray, kept: IntArray) -> None:
    """Merges the landmarks at positions `gone` (k,) into those at `kept` (k,), and makes one step.

    The merge is the exact constraint that both are equal, so no information is lost. The step is needed since
    the variables of the last one have changed.
    """
    keys = smoother.map.state.keys
    smoother.merge(keys[gone], keys[kept])
    smoother.map.merge(gone, kept)
    smoother.step()
