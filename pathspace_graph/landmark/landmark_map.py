"""The landmarks as the engine sees them: two rows a reading, and ties while the loop closes, on keys."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.landmark import landmark_residuals
from pathspace_graph.factors.noise import huber_weights, whiteners
from pathspace_graph.graph.keys import POINT, POSE, landmark_keys, pose_keys
from pathspace_graph.graph.rows import Rows
from pathspace_graph.graph.smoother import FixedLagSmoother
from pathspace_graph.settings.mapper import MapperSettings

from .state import LandmarkDetections, LandmarkState

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


class LandmarkMap:
    """Landmarks, the readings of the poses in the window, and the rows that both make."""

    slid = False
    """No landmark is ever inactive."""

    def __init__(self, settings: MapperSettings) -> None:
        self.settings = settings
        self.state = LandmarkState()
        """The landmarks, and all variables."""
        self.variables = self.state.variables
        self.detections = LandmarkDetections()
        """Readings of the poses in the window."""
        self.ties: IntArray = np.zeros((0, 2), np.intp)
        """(k, 2) numbers of landmarks that are held together while the loop closes."""
        self.became: dict[int, int] = {}
        """Number of each landmark that was merged away, and of the one that it became."""

    def changed(self) -> IntArray:
        """(k,) cycles whose readings in use have changed since they were linearized last."""
        return self.detections.cycle[self.detections.changed]

    def rows(self, cycles: IntArray) -> list[Rows]:
        """Two rows for each reading in use of some cycles."""
        wanted = np.zeros(len(self.variables.poses), bool)
        wanted[cycles - self.variables.first_cycle] = True
        chosen = self.detections.used & wanted[self.detections.cycle - self.variables.first_cycle]
        return [landmark_rows(self.state, self.detections, np.flatnonzero(chosen), self.settings.gate.huber)]

    def linearized(self, cycles: IntArray) -> None:
        """The rows of these cycles are those of the graph from now on."""
        self.detections.changed[:] = False

    @property
    def structure(self) -> object:
        """Another object where other landmarks are tied than before."""
        return self.ties

    def gauge(self, whole: bool) -> list[Rows]:
        """Readings alone hold the landmarks."""
        return []

    def linear_gauge(self, whole: bool) -> list[Rows]:
        """`(l_i - l_j) / sigma_merge` of the landmarks that are tied, two rows each."""
        if len(self.ties) == 0:
            return []
        sigma = self.settings.landmark.sigma_merge
        tied = self.state.landmarks[self.state.positions(self.ties)]
        axes = np.concatenate([np.eye(POINT), -np.eye(POINT)], axis=1) / sigma
        keys = np.repeat(landmark_keys(self.ties), POINT, axis=0)
        residual = (tied[:, 0] - tied[:, 1]).ravel() / sigma
        return [Rows(keys, np.tile(axes, (len(self.ties), 1)), residual, keys[:, 0])]

    def all_active(self) -> None:
        """Every landmark is active, always."""

    def leave(self, cycle: int) -> None:
        """The pose of a cycle, the window's oldest, has left with its readings."""
        self.detections.keep_from(cycle + 1)

    def merge(self, first: IntArray, second: IntArray) -> None:
        """Landmarks at positions `first` (k,) have become those at `second` (k,), with readings and votes."""
        state = self.state
        gone, kept = state.numbers[first], state.numbers[second]
        self.detections.merge(gone, kept)
        np.add.at(state.votes, second, state.votes[first])
        stays = np.ones(len(state), bool)
        stays[first] = False
        state.keep(stays)
        self.ties = np.zeros((0, 2), np.intp)
        self.became.update(zip(gone.tolist(), kept.tolist(), strict=True))


LandmarkSmoother: TypeAlias = FixedLagSmoother[LandmarkMap]
"""The engine on landmarks."""


def landmark_rows(
    state: LandmarkState, detections: LandmarkDetections, chosen: IntArray, huber: float
) -> Rows:
    """`w W (R^T (l - t) - z)` of readings (m,) that are of a landmark, `W' W = K^-1`.

    w is the root of each row's own Huber weight.
    """
    cycles, numbers = detections.cycle[chosen], detections.landmark[chosen]
    points = state.landmarks[state.positions(numbers)]
    seen = landmark_residuals(state.variables.poses_at(cycles), points, detections.point[chosen])
    white = whiteners(detections.covariance[chosen])
    residual = np.einsum("mij,mj->mi", white, seen.residual)
    weight = np.sqrt(huber_weights(residual, huber))
    jacobian = white @ np.concatenate([seen.by_pose, seen.by_landmark], axis=2)
    return two_rows(cycles, numbers, jacobian * weight[:, :, None], residual * weight)


def two_rows(cycles: IntArray, numbers: IntArray, jacobian: Array, residual: Array) -> Rows:
    """Jacobian (m, 2, 5) and residual (m, 2) as rows on [pose | landmark], owned by the cycles (m,)."""
    keys = np.stack([pose_keys(cycles), landmark_keys(numbers)], axis=1)
    flat = jacobian.reshape(-1, POSE + POINT)
    return Rows(np.repeat(keys, POINT, axis=0), flat, residual.ravel(), np.repeat(cycles, POINT))
