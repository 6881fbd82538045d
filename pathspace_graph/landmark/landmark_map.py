"""The landmark map as the engine sees it: two rows for each detection, on the keys of pose and landmark."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.landmark import landmark_residuals
from pathspace_graph.factors.noise import huber_weights, whiteners
from pathspace_graph.factors.sensor import restored
from pathspace_graph.front_end.late import LateDetections
from pathspace_graph.graph.keys import POINT, POSE, SENSOR_KEY, landmark_keys, pose_keys
from pathspace_graph.graph.rows import Rows
from pathspace_graph.graph.smoother import FixedLagSmoother
from pathspace_graph.io.log import Detections
from pathspace_graph.settings.mapper import MapperSettings

from .state import LandmarkDetections, LandmarkState

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]

NO_PAIRS: IntArray = np.zeros((0, 2), np.intp)


class LandmarkMap:
    """Holds the landmarks and the detections of the window, and linearizes their residuals."""

    reached_inactive = False
    """No landmark is ever inactive."""

    def __init__(self, settings: MapperSettings) -> None:
        self.settings = settings
        self.state = LandmarkState()
        """These are the landmarks and all variables."""
        self.variables = self.state.variables
        self.detections = LandmarkDetections()
        """These are the detections from the poses in the window."""
        self.twist: Array = np.zeros(POSE)
        """(3,) The vehicle moved with this twist at the newest detections, in m/s, m/s and rad/s."""
        self.loop_pairs: IntArray = NO_PAIRS
        """(k, 2) Each row holds the numbers of two landmarks that are held together while the loop closes."""
        self.merged_into: dict[int, int] = {}
        """This maps the number of each landmark that was merged to the number of the one that was kept."""

    def add(self, detections: Detections, cycle: int, twist: Array) -> slice:
        """Adds the detections of the newest cycle, corrected by the sensor's calibration; returns their rows.

        The vehicle moved with this twist (3,), in m/s, m/s and rad/s.
        """
        self.twist = twist
        rows = self.detections.append(detections, cycle, twist)
        self.correct()
        return rows

    def add_late(self, late: LateDetections) -> slice:
        """Adds late detections to those of their pose, corrected by the sensor's calibration."""
        rows = self.detections.append(late.detections, late.cycle, late.twist)
        self.correct()
        return rows

    def changed(self) -> IntArray:
        """Returns the cycles (k,) whose detections in use have changed since they were linearized last."""
        return self.detections.cycle[self.detections.changed]

    def rows(self, cycles: IntArray) -> list[Rows]:
        """Returns two rows for each detection in use of some cycles."""
        chosen = self.detections.used & self.detections.in_cycles(cycles)
        return [landmark_rows(self.state, self.detections, np.flatnonzero(chosen), self.settings.gate.huber)]

    def correct(self) -> None:
        """Corrects the detections by the present calibration of the sensor."""
        self.detections.correct(self.variables.sensor)

    def linearized(self, cycles: IntArray) -> None:
        """Notes that the graph holds the present rows of these cycles."""
        self.detections.mark_linearized()

    @property
    def structure(self) -> object:
        """Returns another object whenever other landmarks are held together than before."""
        return self.loop_pairs

    def gauge(self, whole: bool) -> list[Rows]:
        """Returns no rows, since the detections alone hold the landmarks."""
        return []

    def linear_gauge(self, whole: bool) -> list[Rows]:
        """Returns `(l_i - l_j) / sigma_merge`, two rows for each loop pair."""
        if len(self.loop_pairs) == 0:
            return []
        sigma = self.settings.landmark.sigma_merge
        pairs = self.state.landmarks[self.state.positions(self.loop_pairs)]
        axes = np.concatenate([np.eye(POINT), -np.eye(POINT)], axis=1) / sigma
        keys = np.repeat(landmark_keys(self.loop_pairs), POINT, axis=0)
        residual = (pairs[:, 0] - pairs[:, 1]).ravel() / sigma
        return [Rows(keys, np.tile(axes, (len(pairs), 1)), residual, keys[:, 0])]

    def activate(self, keys: IntArray) -> None:
        """Does nothing, since every landmark is always active."""

    def activate_all(self) -> None:
        """Does nothing, since every landmark is always active."""

    def drop_cycle(self, cycle: int) -> None:
        """Removes the detections of a cycle, whose pose was the oldest of the window."""
        self.detections.keep_from(cycle + 1)

    def merge(self, gone: IntArray, kept: IntArray) -> None:
        """Moves the detections and votes of landmarks `gone` (k,) to `kept` (k,), both given by position."""
        state = self.state
        gone_numbers, kept_numbers = state.numbers[gone], state.numbers[kept]
        self.detections.merge(gone_numbers, kept_numbers)
        np.add.at(state.votes, kept, state.votes[gone])
        stays = np.ones(len(state), bool)
        stays[gone] = False
        state.keep(stays)
        self.loop_pairs = NO_PAIRS
        self.merged_into.update(zip(gone_numbers.tolist(), kept_numbers.tolist(), strict=True))


LandmarkSmoother: TypeAlias = FixedLagSmoother[LandmarkMap]
"""This is the engine on a landmark map."""


def landmark_rows(
    state: LandmarkState, detections: LandmarkDetections, chosen: IntArray, huber: float
) -> Rows:
    """Returns the rows `w W (R^T (l - t) - z)` of associated detections (m,), with `W' W = K^-1`.

    The factor w is the square root of each row's own Huber weight. The detections z are corrected by the
    sensor's calibration, and the residuals are those of measured ones (`factors.sensor:restored`).
    """
    cycles, numbers = detections.cycle[chosen], detections.landmark[chosen]
    points = state.landmarks[state.positions(numbers)]
    sensor = state.variables.sensor
    seen = detections.corrected(chosen, sensor)
    predicted = landmark_residuals(state.variables.poses_at(cycles), points, seen)
    measured, twists = detections.measured[chosen], detections.twist[chosen]
    inverse, by_calibration = restored(predicted.residual, measured, twists, sensor)
    white = whiteners(detections.covariance[chosen])
    residual = np.einsum("mij,mj->mi", white @ inverse, predicted.residual)
    weight = np.sqrt(huber_weights(residual, huber))
    blocks = inverse @ predicted.by_pose, by_calibration, inverse @ predicted.by_landmark
    jacobian = white @ np.concatenate(blocks, axis=2)
    return two_rows(cycles, numbers, jacobian * weight[:, :, None], residual * weight)


def two_rows(cycles: IntArray, numbers: IntArray, jacobian: Array, residual: Array) -> Rows:
    """Returns Jacobians (m, 2, n) and residuals (m, 2) as rows on [pose | landmark], owned by the cycles.

    The sensor's calibration is between both where the Jacobian has columns for it.
    """
    keys = [pose_keys(cycles), landmark_keys(numbers)]
    if jacobian.shape[2] > POSE + POINT:
        keys.insert(1, np.full(len(cycles), SENSOR_KEY))
    flat = jacobian.reshape(-1, jacobian.shape[2])
    both = np.repeat(np.stack(keys, axis=1), POINT, axis=0)
    return Rows(both, flat, residual.ravel(), np.repeat(cycles, POINT))
