"""The Hungarian landmark graph over a whole log: all poses and landmarks, with iterated associations."""

from dataclasses import replace
from itertools import pairwise
from typing import ClassVar, Final

import numpy as np
from scipy.spatial import KDTree

from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.noise import KnownNoise
from pathspace_graph.factors.residuals import landmark_residuals
from pathspace_graph.graph.elimination import Elimination
from pathspace_graph.graph.variables import POINT, POSE
from pathspace_graph.io.log import Log
from pathspace_graph.io.results import BatchRun
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.laps import LapCounter
from pathspace_graph.mapping.motion import known_noise
from pathspace_graph.mapping.tracks import Tracks
from pathspace_graph.run import settings_dict, solved, split_odometry
from pathspace_graph.settings.mapper import MapperSettings, known_settings

from . import landmark_association as association
from .landmark_association import MATCH_GATE, find_duplicates
from .landmark_fixed_lag import LandmarkFixedLag
from .landmark_map import UNASSOCIATED, LandmarkDetections, LandmarkState, LandmarkSystem, point_map

LANDMARK_BATCH: Final = "landmark-batch"  # name of the estimator on the command line
MAX_ROUNDS: Final = 10  # largest number of rounds of association
SETTLED_SHARE: Final = 1e-3  # largest share of detections that change their landmark in the last round
MAX_STEPS: Final = 80  # largest number of steps in a round
GAIN_TOLERANCE: Final = 1e-6  # largest relative gain of the last step


class LandmarkBatch:
    """Maps cones as points with all poses of a log, from the online run of `LandmarkFixedLag` on."""

    READS: ClassVar = LandmarkFixedLag.READS

    def __init__(
        self, settings: MapperSettings | None = None, odometry_sigma: Array | KnownNoise | None = None
    ) -> None:
        self.settings = known_settings(settings)
        self.odometry_sigma = odometry_sigma
        known_noise(odometry_sigma)  # check it early

    def solve(self, log: Log) -> BatchRun:
        return solved(self._solve, log)

    def _solve(self, log: Log) -> BatchRun:
        noise = known_noise(self.odometry_sigma)
        system, state = start_landmarks(log, LandmarkSystem.of_log(log, self.settings, noise), noise)
        system.optimize(state)
        for _ in range(MAX_ROUNDS):
            converged = self._refresh(system, state) <= SETTLED_SHARE * len(system.detections)
            system.optimize(state)
            if converged:
                break
        return self._result(system, state, converged)

    def _refresh(self, system: LandmarkSystem, state: LandmarkState) -> int:
        detections, before, known = system.detections, system.detections.landmark.copy(), len(state)
        again = Reassociation(state, system, self.settings)
        again.run()
        gone, kept = find_duplicates(state, known, again.problem.joint, self.settings)
        detections.merge(state.numbers[gone], state.numbers[kept])
        remove_rare(state, detections, self.settings.growth.sightings)
        return int((before != detections.landmark).sum())

    def _result(self, system: LandmarkSystem, state: LandmarkState, converged: bool) -> BatchRun:
        laps, problem, poses = LapCounter(), system.eliminated(state), state.variables.poses.copy()
        for pose in poses:
            laps.update(pose)
        return BatchRun(
            estimator=LANDMARK_BATCH,
            settings=settings_dict(self.settings),
            map=point_map(state.landmarks, state.labels, problem.joint(state.keys), laps.completed > 0),
            trajectory_t=system.chain.stamps,
            trajectory=poses,
            cycles=(),
            laps=laps.completed,
            converged=converged,
            noise=system.noise,
        )


def start_landmarks(
    log: Log, system: LandmarkSystem, noise: KnownNoise
) -> tuple[LandmarkSystem, LandmarkState]:
    """Return the last map of the online run, with each pose and association as of its end in the window."""
    online = LandmarkFixedLag(system.settings, noise)
    for odometry, cycle in split_odometry(log):
        online.update(odometry, cycle)
    state = online.whole_drive(system.detections)
    sigma = np.array(online.inflated.odometry.sigmas)
    chain = replace(system.chain, calibration_sigma=sigma)  # priors at the end of the online run
    return replace(system, settings=online.inflated, chain=chain), state


class Reassociation:
    """One more Hungarian assignment of every cycle; unassociated detections create landmarks."""

    def __init__(self, state: LandmarkState, system: LandmarkSystem, settings: MapperSettings) -> None:
        self.state, self.detections, self.settings = state, system.detections, settings
        self.problem, self.stamps = system.eliminated(state), system.chain.stamps
        self.points_map = self.detections.points_map(slice(None), state.variables)

    def run(self) -> None:
        detections = self.detections
        rows, landmarks, distances = self._nearby_pairs()
        cost = self._costs(rows, landmarks)
        held = detections.landmark[rows] == self.state.numbers[landmarks]
        cost = association.hysteresis_costs(cost, held)
        relabel(self.state, detections.label, rows, landmarks, cost, MATCH_GATE)
        detections.landmark[:] = UNASSOCIATED
        free = np.ones(len(detections), bool)
        starts = np.searchsorted(detections.cycle[rows], np.arange(len(self.stamps) + 1))
        for begin, end in pairwise(starts.tolist()):
            self._assign_cycle(rows[begin:end], landmarks[begin:end], cost[begin:end], free)
        # do not create landmarks that one with another label explains, or that would be merged
        known = (cost < MATCH_GATE) | (distances < self.settings.growth.merge_radius)
        free[rows[known]] = False
        self._create(np.flatnonzero(free & ~detections.used))

    def _assign_cycle(self, rows: IntArray, landmarks: IntArray, cost: Array, free: BoolArray) -> None:
        detected, i = np.unique(rows, return_inverse=True)
        candidates, j = np.unique(landmarks, return_inverse=True)
        table = np.full((len(detected), len(candidates)), np.inf)
        table[i, j] = cost
        same_label = association.compatible(self.detections.label[detected], self.state.labels[candidates])
        table[~same_label] = np.inf
        landmark, free[detected] = association.assign(table)
        matched = landmark != UNASSOCIATED
        self.detections.take(detected[matched], self.state.numbers[candidates[landmark[matched]]])

    def _nearby_pairs(self) -> tuple[IntArray, IntArray, Array]:
        """Pairs in the rough gate: detections (k,), ascending, landmarks, and distances (m)."""
        points, tree = KDTree(self.points_map), KDTree(self.state.landmarks)
        pairs = points.sparse_distance_matrix(tree, association.ROUGH_GATE, output_type="coo_matrix")
        order = np.argsort(pairs.row, kind="stable")
        return pairs.row[order].astype(np.intp), pairs.col[order].astype(np.intp), pairs.data[order]

    def _costs(self, rows: IntArray, landmarks: IntArray) -> Array:
        state, detections = self.state, self.detections
        cycles, poses = detections.cycle[rows], state.variables.poses_at(detections.cycle[rows])
        r = landmark_residuals(poses, state.landmarks[landmarks], detections.point[rows])
        jacobian = np.concatenate([r.by_pose, r.by_landmark], axis=2)
        spread = predicted_covariances(self.problem, cycles, state.keys[landmarks], jacobian)
        return association.squared_mahalanobis(r.residual, spread + detections.covariance[rows])

    def _create(self, free: IntArray) -> None:
        """Add landmarks at tracks with enough of the free detections (k,), which they get."""
        detections, growth, points = self.detections, self.settings.growth, self.points_map
        covariances = detections.covariances_map(free, self.state.variables)
        stamps, tracks = self.stamps[detections.cycle[free]], Tracks(growth.merge_radius, np.inf)
        tracks.add(points[free], covariances, detections.label[free], stamps)
        for label in BOUNDARIES:
            rows = free[detections.label[free] == label]
            new = tracks.points[tracks.confirmed(label, growth.sightings)]
            chosen, landmark = association.associate_created(
                points[rows], detections.cycle[rows], new, growth
            )
            numbers = self.state.add(new, np.full(len(new), label, np.intp))
            detections.take(rows[chosen], numbers[landmark])


def relabel(
    state: LandmarkState, labels: IntArray, rows: IntArray, landmarks: IntArray, cost: Array, gate: float
) -> None:
    """Give each landmark the label of most detections in its gate, by pairs (k,) of rows and landmarks."""
    inside = cost < gate
    state.votes = np.zeros_like(state.votes)
    state.vote(labels[rows[inside]], state.numbers[landmarks[inside]])


def predicted_covariances(problem: Elimination, cycles: IntArray, keys: IntArray, jacobian: Array) -> Array:
    """Compute `J Sigma J'` (m, 2, 2), J (m, 2, 5) by [pose | landmark], for cycles (m,) and keys (m,)."""
    landmark = problem.map.columns(keys)[:, None] + np.arange(POINT)
    pose = POSE * cycles[:, None] + np.arange(POSE)
    cross = problem.cross_covariance[pose[:, :, None], landmark[:, None, :]]
    own = problem.map_covariance[landmark[:, :, None], landmark[:, None, :]]
    joint = np.block([[problem.pose_marginals[cycles], cross], [np.swapaxes(cross, 1, 2), own]])
    return np.asarray(jacobian @ joint @ np.swapaxes(jacobian, 1, 2))


def remove_rare(state: LandmarkState, detections: LandmarkDetections, fewest: int) -> None:
    """Remove landmarks with fewer detections than `fewest`; their detections become unassociated."""
    counts = np.bincount(state.positions(detections.landmark[detections.used]), minlength=len(state))
    gone = counts < fewest
    detections.landmark[np.isin(detections.landmark, state.numbers[gone])] = UNASSOCIATED
    state.variables.remove(state.keys[gone])
    state.keep(~gone)
