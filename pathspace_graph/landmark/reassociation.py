"""Refreshes the associations between two rounds of the landmark batch, and creates or removes landmarks."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from pathspace_graph.factors.landmark import landmark_residuals
from pathspace_graph.factors.se2 import rotated, to_map
from pathspace_graph.graph.elimination import Elimination
from pathspace_graph.graph.keys import POINT, POSE
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.mapping.tentative import TentativeTracks
from pathspace_graph.settings.mapper import MapperSettings

from .association import (
    Gates,
    associate,
    associate_created,
    compatible,
    hysteresis_costs,
    squared_mahalanobis,
)
from .state import UNASSOCIATED, LandmarkDetections, LandmarkState

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]


class Reassociation:
    """Repeats the Hungarian assignment of every cycle, and creates landmarks from unassociated detections.

    `problem` is the linear problem at the state, and `stamps` (P,) are those of the cycles (s).
    """

    def __init__(
        self,
        state: LandmarkState,
        detections: LandmarkDetections,
        problem: Elimination,
        settings: MapperSettings,
        stamps: Array,
    ) -> None:
        self.state, self.detections, self.problem = state, detections, problem
        self.settings, self.stamps = settings, stamps
        self.gates = Gates.of(settings.landmark)
        self.points_map = to_map(detections.point, state.variables.poses_at(detections.cycle))

    def run(self) -> None:
        """Sets the landmark of every detection, and adds new landmarks to the state."""
        self._create(self._assign())

    def _assign(self) -> IntArray:
        """Assigns every cycle anew, and returns the rows of detections that may create landmarks."""
        detections = self.detections
        rows, landmarks, distances = self._nearby_pairs()
        cost = self._costs(rows, landmarks)
        held = detections.landmark[rows] == self.state.numbers[landmarks]
        cost = hysteresis_costs(cost, held, self.gates)
        relabel(self.state, detections.label, rows, landmarks, cost, self.gates.match)
        detections.landmark[:] = UNASSOCIATED
        free = np.ones(len(detections), bool)
        starts = np.searchsorted(detections.cycle[rows], np.arange(len(self.stamps) + 1))
        for begin, end in pairwise(starts.tolist()):
            self._assign_cycle(rows[begin:end], landmarks[begin:end], cost[begin:end], free)
        # a landmark with another label explains it, or one that a new landmark would be merged with
        known = (cost < self.gates.match) | (distances < self.settings.growth.merge_radius)
        free[rows[known]] = False
        return np.flatnonzero(free & ~detections.used)

    def _assign_cycle(self, rows: IntArray, landmarks: IntArray, cost: Array, free: BoolArray) -> None:
        """Assigns one cycle, given its pairs (k,), and sets in `free` (R,) which detections may be new."""
        own, i = np.unique(rows, return_inverse=True)
        candidates, j = np.unique(landmarks, return_inverse=True)
        table = np.full((len(own), len(candidates)), np.inf)
        table[i, j] = cost
        table[~compatible(self.detections.label[own], self.state.labels[candidates])] = np.inf
        found = associate(table, self.gates)
        matched = found.landmark != UNASSOCIATED
        self.detections.take(own[matched], self.state.numbers[candidates[found.landmark[matched]]])
        free[own] = found.new

    def _nearby_pairs(self) -> tuple[IntArray, IntArray, Array]:
        """Returns the detections (k,), ascending, landmarks and distances (m) of pairs in the rough gate."""
        points, tree = KDTree(self.points_map), KDTree(self.state.landmarks)
        pairs = points.sparse_distance_matrix(tree, self.settings.landmark.rough, output_type="coo_matrix")
        order = np.argsort(pairs.row, kind="stable")
        return pairs.row[order].astype(np.intp), pairs.col[order].astype(np.intp), pairs.data[order]

    def _costs(self, rows: IntArray, landmarks: IntArray) -> Array:
        """Returns the squared Mahalanobis distances (k,) of pairs."""
        state, detections = self.state, self.detections
        cycles, poses = detections.cycle[rows], state.variables.poses_at(detections.cycle[rows])
        r = landmark_residuals(poses, state.landmarks[landmarks], detections.point[rows])
        jacobian = np.concatenate([r.by_pose, r.by_landmark], axis=2)
        spread = predicted_covariances(self.problem, cycles, state.keys[landmarks], jacobian)
        return squared_mahalanobis(r.residual, spread + detections.covariance[rows])

    def _create(self, free: IntArray) -> None:
        """Adds landmarks where enough of the detections `free` (m,) lie together, as the online run does."""
        detections = self.detections
        for label in BOUNDARIES:
            own = free[detections.label[free] == label]
            points, cycles = self._confirmed(own), detections.cycle[own]
            rows, landmark = associate_created(self.points_map[own], cycles, points, self.settings.growth)
            numbers = self.state.add(points, np.full(len(points), label, np.intp))
            detections.take(own[rows], numbers[landmark])

    def _confirmed(self, rows: IntArray) -> Array:
        """Returns the tracks (k, 2) with enough of these detections, map frame, m; a batch forgets none."""
        detections = self.detections
        tentative = TentativeTracks(replace(self.settings.growth, forget_after=np.inf))
        poses = self.state.variables.poses_at(detections.cycle[rows])
        covariances = rotated(detections.covariance[rows], poses[:, 2])
        found = [np.zeros((0, POINT))]
        for cycle in np.unique(detections.cycle[rows]):
            now = detections.cycle[rows] == cycle
            tentative.add(self.points_map[rows[now]], covariances[now], float(self.stamps[cycle]))
            confirmed = tentative.confirmed()
            found.append(tentative.points[confirmed])
            tentative.remove(confirmed)
        return np.concatenate(found)


def relabel(
    state: LandmarkState, labels: IntArray, rows: IntArray, landmarks: IntArray, cost: Array, gate: float
) -> None:
    """Gives each landmark the label of most detections in its gate, by pairs (k,) of rows and landmarks."""
    inside = cost < gate
    state.votes = np.zeros_like(state.votes)
    state.vote(labels[rows[inside]], state.numbers[landmarks[inside]])


def predicted_covariances(problem: Elimination, cycles: IntArray, keys: IntArray, jacobian: Array) -> Array:
    """Returns `J Sigma J'` (m, 2, 2) of landmarks with keys (m,), as detected from the poses of cycles (m,).

    J (m, 2, 5) is the derivative by [pose | landmark], and Sigma contains their cross terms.
    """
    landmark = problem.map.columns(keys)[:, None] + np.arange(POINT)
    pose = POSE * cycles[:, None] + np.arange(POSE)
    joint = np.empty((len(cycles), POSE + POINT, POSE + POINT))
    joint[:, :POSE, :POSE] = problem.pose_marginals[cycles]
    joint[:, :POSE, POSE:] = problem.cross_covariance[pose[:, :, None], landmark[:, None, :]]
    joint[:, POSE:, :POSE] = np.swapaxes(joint[:, :POSE, POSE:], 1, 2)
    joint[:, POSE:, POSE:] = problem.map_covariance[landmark[:, :, None], landmark[:, None, :]]
    return np.asarray(jacobian @ joint @ np.swapaxes(jacobian, 1, 2))


def remove_rare(state: LandmarkState, detections: LandmarkDetections, fewest: int) -> None:
    """Removes landmarks with fewer detections than `fewest`; those detections become unassociated."""
    counts = np.bincount(state.positions(detections.landmark[detections.used]), minlength=len(state))
    gone = counts < fewest
    detections.landmark[np.isin(detections.landmark, state.numbers[gone])] = UNASSOCIATED
    state.variables.remove(state.keys[gone])
    state.keep(~gone)
