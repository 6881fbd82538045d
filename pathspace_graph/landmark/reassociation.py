"""Between two rounds of the landmark batch: which landmarks there are, and which reading is of which."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from pathspace_graph.factors.landmark import landmark_residuals
from pathspace_graph.factors.se2 import to_map
from pathspace_graph.graph.elimination import Elimination
from pathspace_graph.graph.keys import POINT, POSE
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.mapping.tentative import TentativeTracks
from pathspace_graph.settings.mapper import MapperSettings

from .association import NONE, PLANE, Gates, associate, compatible, kept_costs, squared_mahalanobis
from .state import LandmarkDetections, LandmarkState
from .tentative import detected_by

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]


class Reassociation:
    """The Hungarian assignment of every cycle anew, and new landmarks of what is left."""

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
        self.gates = Gates.of_probabilities(settings.landmark.match, settings.landmark.create)
        self.points = to_map(detections.point, state.variables.poses_at(detections.cycle))

    def run(self) -> None:
        """Readings are of the landmarks that the assignment says; those of none may make new ones."""
        free = self._assign()
        self._create(free)

    def _assign(self) -> IntArray:
        """Every cycle's assignment; gives the readings that are of no landmark."""
        detections = self.detections
        rows, landmarks, distances = self._near()
        cost = self._costs(rows, landmarks)
        held = detections.landmark[rows] == self.state.numbers[landmarks]
        cost = kept_costs(cost, held, self.gates)
        recolour(self.state, detections.label, rows, landmarks, cost, self.gates.match)
        detections.landmark[:] = NONE
        free = np.ones(len(detections), bool)
        starts = np.searchsorted(detections.cycle[rows], np.arange(len(self.stamps) + 1))
        for begin, end in pairwise(starts.tolist()):
            self._assign_cycle(rows[begin:end], landmarks[begin:end], cost[begin:end], free)
        # what is on a landmark in the other colour, or would be merged with one, isn't a new one
        known = (cost < self.gates.match) | (distances < self.settings.growth.merge_radius)
        free[rows[known]] = False
        return np.flatnonzero(free & ~detections.used)

    def _assign_cycle(self, rows: IntArray, landmarks: IntArray, cost: Array, free: BoolArray) -> None:
        """The assignment of one cycle's pairs (k,); `free` (R,) keeps which readings may be new."""
        own, i = np.unique(rows, return_inverse=True)
        candidates, j = np.unique(landmarks, return_inverse=True)
        table = np.full((len(own), len(candidates)), np.inf)
        table[i, j] = cost
        table[~compatible(self.detections.label[own], self.state.labels[candidates])] = np.inf
        found = associate(table, self.gates)
        matched = found.landmark != NONE
        self.detections.take(own[matched], self.state.numbers[candidates[found.landmark[matched]]])
        free[own] = found.new

    def _near(self) -> tuple[IntArray, IntArray, Array]:
        """(k,) readings, ascending, landmarks and distances (m) of all pairs that are roughly near."""
        points, tree = KDTree(self.points), KDTree(self.state.landmarks)
        pairs = points.sparse_distance_matrix(tree, self.settings.landmark.rough, output_type="coo_matrix")
        order = np.argsort(pairs.row, kind="stable")
        return pairs.row[order].astype(np.intp), pairs.col[order].astype(np.intp), pairs.data[order]

    def _costs(self, rows: IntArray, landmarks: IntArray) -> Array:
        """(k,) squared Mahalanobis distances of pairs."""
        state, detections = self.state, self.detections
        cycles, poses = detections.cycle[rows], state.variables.poses_at(detections.cycle[rows])
        r = landmark_residuals(poses, state.landmarks[landmarks], detections.point[rows])
        jacobian = np.concatenate([r.by_pose, r.by_landmark], axis=2)
        spread = predicted(self.problem, cycles, state.keys[landmarks], jacobian)
        return squared_mahalanobis(r.residual, spread + detections.covariance[rows])

    def _create(self, free: IntArray) -> None:
        """New landmarks where readings of none come together, as online."""
        detections = self.detections
        for label in BOUNDARIES:
            own = free[detections.label[free] == label]
            points = self._confirmed(own)
            which, observed = detected_by(
                self.points[own], detections.cycle[own], points, self.settings.growth
            )
            numbers = self.state.add(points, np.full(len(points), label, np.intp))
            detections.take(own[which], numbers[observed])

    def _confirmed(self, rows: IntArray) -> Array:
        """(k, 2) what was sighted often enough, m, map frame; in a batch nothing is forgotten."""
        detections, tentative = (
            self.detections,
            TentativeTracks(replace(self.settings.growth, forget_after=np.inf)),
        )
        variances = np.trace(detections.covariance[rows], axis1=1, axis2=2)
        found = [np.zeros((0, PLANE))]
        for cycle in np.unique(detections.cycle[rows]):
            now = detections.cycle[rows] == cycle
            tentative.add(self.points[rows[now]], variances[now], float(self.stamps[cycle]))
            confirmed = tentative.confirmed()
            found.append(tentative.points[confirmed])
            tentative.remove(confirmed)
        return np.concatenate(found)


def recolour(
    state: LandmarkState, labels: IntArray, rows: IntArray, landmarks: IntArray, cost: Array, gate: float
) -> None:
    """Each landmark has the colour of most readings that it explains: pairs (k,) of reading and landmark."""
    inside = cost < gate
    state.votes = np.zeros_like(state.votes)
    state.vote(labels[rows[inside]], state.numbers[landmarks[inside]])


def predicted(problem: Elimination, cycles: IntArray, keys: IntArray, jacobian: Array) -> Array:
    """`J Sigma J'` (m, 2, 2) of what the poses of cycles (m,) see of landmarks (m,), cross terms included.

    J (m, 2, 5) is by [pose | landmark].
    """
    own = problem.map.columns(keys)[:, None] + np.arange(POINT)
    seer = POSE * cycles[:, None] + np.arange(POSE)
    joint = np.empty((len(cycles), POSE + POINT, POSE + POINT))
    joint[:, :POSE, :POSE] = problem.pose_marginals[cycles]
    joint[:, :POSE, POSE:] = problem.cross_covariance[seer[:, :, None], own[:, None, :]]
    joint[:, POSE:, :POSE] = np.swapaxes(joint[:, :POSE, POSE:], 1, 2)
    joint[:, POSE:, POSE:] = problem.map_covariance[own[:, :, None], own[:, None, :]]
    return np.asarray(jacobian @ joint @ np.swapaxes(jacobian, 1, 2))


def drop_rare(state: LandmarkState, detections: LandmarkDetections, fewest: int) -> None:
    """Landmarks with fewer readings than `fewest` are taken out, and those readings are of none."""
    counts = np.bincount(state.positions(detections.landmark[detections.used]), minlength=len(state))
    gone = counts < fewest
    detections.landmark[np.isin(detections.landmark, state.numbers[gone])] = NONE
    state.variables.remove(state.keys[gone])
    state.keep(~gone)
