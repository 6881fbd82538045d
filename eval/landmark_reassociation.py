"""Between two rounds of the landmark batch: which landmarks there are, and which reading is of which."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from pathspace_graph.factors.landmark import landmark_residuals
from pathspace_graph.factors.projection import to_map
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.settings import MapperSettings
from pathspace_graph.sightings import Sightings

from .landmark_association import NONE, PLANE, Gates, associate, compatible, kept_costs, squared_mahalanobis
from .landmark_sightings import near_pairs, one_cone, sighted_by
from .landmark_state import LandmarkReadings, LandmarkState
from .landmark_system import JointCovariance

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]


class Reassociation:
    """The Hungarian assignment of every cycle anew, and new landmarks of what is left."""

    def __init__(
        self,
        state: LandmarkState,
        readings: LandmarkReadings,
        covariance: JointCovariance,
        settings: MapperSettings,
        stamps: Array,
    ) -> None:
        self.state, self.readings, self.covariance = state, readings, covariance
        self.settings, self.stamps = settings, stamps
        self.gates = Gates.of_probabilities(settings.landmark.match, settings.landmark.create)
        self.points = to_map(readings.point, state.poses[readings.slot])

    def run(self) -> None:
        """Readings are of the landmarks that the assignment says; those of none may make new ones."""
        free = self._assign()
        self._create(free)

    def _assign(self) -> IntArray:
        """Every cycle's assignment; gives the readings that are of no landmark."""
        readings = self.readings
        rows, landmarks, distances = self._near()
        cost = self._costs(rows, landmarks)
        held = readings.used[rows] & (readings.landmark[rows] == landmarks)
        cost = kept_costs(cost, held, self.gates)
        recolour(self.state, readings.label, rows, landmarks, cost, self.gates.match)
        readings.used[:] = False
        readings.landmark[:] = NONE
        free = np.ones(len(readings), bool)
        starts = np.searchsorted(readings.slot[rows], np.arange(len(self.stamps) + 1))
        for begin, end in pairwise(starts.tolist()):
            self._assign_cycle(rows[begin:end], landmarks[begin:end], cost[begin:end], free)
        # what is on a landmark in the other colour, or would be merged with one, isn't a new one
        known = (cost < self.gates.match) | (distances < self.settings.growth.merge_radius)
        free[rows[known]] = False
        return np.flatnonzero(free & ~readings.used)

    def _assign_cycle(self, rows: IntArray, landmarks: IntArray, cost: Array, free: BoolArray) -> None:
        """The assignment of one cycle's pairs (k,); `free` (R,) keeps which readings may be new."""
        own, i = np.unique(rows, return_inverse=True)
        candidates, j = np.unique(landmarks, return_inverse=True)
        table = np.full((len(own), len(candidates)), np.inf)
        table[i, j] = cost
        table[~compatible(self.readings.label[own], self.state.labels[candidates])] = np.inf
        found = associate(table, self.gates)
        matched = found.landmark != NONE
        self.readings.take(own[matched], candidates[found.landmark[matched]])
        free[own] = found.new

    def _near(self) -> tuple[IntArray, IntArray, Array]:
        """(k,) readings, ascending, landmarks and distances (m) of all pairs that are roughly near."""
        points, tree = KDTree(self.points), KDTree(self.state.landmarks)
        pairs = points.sparse_distance_matrix(tree, self.settings.landmark.rough, output_type="coo_matrix")
        order = np.argsort(pairs.row, kind="stable")
        return pairs.row[order].astype(np.intp), pairs.col[order].astype(np.intp), pairs.data[order]

    def _costs(self, rows: IntArray, landmarks: IntArray) -> Array:
        """(k,) squared Mahalanobis distances of pairs."""
        state, readings = self.state, self.readings
        slot = readings.slot[rows]
        r = landmark_residuals(state.poses[slot], state.landmarks[landmarks], readings.point[rows])
        spread = self.covariance.predicted(slot, landmarks, r.by_pose, r.by_landmark)
        return squared_mahalanobis(r.residual, spread + readings.covariance[rows])

    def _create(self, free: IntArray) -> None:
        """New landmarks where readings of none come together, as online."""
        readings = self.readings
        for label in BOUNDARIES:
            own = free[readings.label[free] == label]
            points = self._confirmed(own)
            which, sighted = sighted_by(self.points[own], readings.slot[own], points, self.settings.growth)
            first = len(self.state.labels)
            self.state.add_landmarks(points, np.full(len(points), label, np.intp))
            readings.take(own[which], first + sighted)

    def _confirmed(self, rows: IntArray) -> Array:
        """(k, 2) what was sighted often enough, m, map frame; in a batch nothing is forgotten."""
        readings, sightings = self.readings, Sightings(replace(self.settings.growth, forget_after=np.inf))
        variances = np.trace(readings.covariance[rows], axis1=1, axis2=2)
        found = [np.zeros((0, PLANE))]
        for slot in np.unique(readings.slot[rows]):
            now = readings.slot[rows] == slot
            sightings.add(self.points[rows[now]], variances[now], float(self.stamps[slot]))
            confirmed = sightings.confirmed()
            found.append(sightings.points[confirmed])
            sightings.remove(confirmed)
        return np.concatenate(found)


def recolour(
    state: LandmarkState, labels: IntArray, rows: IntArray, landmarks: IntArray, cost: Array, gate: float
) -> None:
    """Each landmark has the colour of most readings that it explains: pairs (k,) of reading and landmark."""
    inside = cost < gate
    state.votes = np.zeros_like(state.votes)
    state.vote(labels[rows[inside]], landmarks[inside])


def merge_duplicates(
    state: LandmarkState, readings: LandmarkReadings, covariance: JointCovariance, settings: MapperSettings
) -> None:
    """Landmarks of one colour that one cone explains become one; those just made have no covariance yet."""
    known = covariance.landmarks.shape[0]
    first, second = near_pairs(state.landmarks[:known], state.labels[:known], settings.growth.merge_radius)
    blocks = covariance.landmarks
    spread = blocks[first, :, first] + blocks[second, :, second]
    spread = spread - blocks[first, :, second] - blocks[second, :, first]
    offset = state.landmarks[first] - state.landmarks[second]
    same = one_cone(first, second, offset, spread, settings.landmark)
    target = np.arange(len(state.labels))
    target[first[same]] = second[same]
    readings.landmark = np.where(readings.used, target[readings.landmark], readings.landmark)


def drop_rare(state: LandmarkState, readings: LandmarkReadings, fewest: int) -> None:
    """Landmarks with fewer readings than `fewest` are taken out, and those readings are of none."""
    counts = np.bincount(readings.landmark[readings.used], minlength=len(state.labels))
    stays = counts >= fewest
    gone = readings.used & ~stays[np.where(readings.used, readings.landmark, 0)]
    readings.used[gone] = False
    readings.landmark[gone] = NONE
    index = np.cumsum(stays) - 1
    readings.landmark[readings.used] = index[readings.landmark[readings.used]]
    state.keep(stays)
