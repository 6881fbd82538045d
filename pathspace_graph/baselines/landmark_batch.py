"""The Hungarian landmark graph over a whole log: all poses and landmarks, with iterated associations."""

from dataclasses import replace
from itertools import pairwise
from typing import ClassVar

import numpy as np
from scipy.spatial import KDTree

from pathspace_graph.factors.arrays import Array, IntArray
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
from .landmark_association import MATCH_GATE
from .landmark_fixed_lag import LandmarkFixedLag
from .landmark_map import UNASSOCIATED, LandmarkDetections, LandmarkState, LandmarkSystem, point_map


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
        """Optimize the map of the online run, and associate anew until hardly any detection changes."""
        noise = known_noise(self.odometry_sigma)
        system = LandmarkSystem.of_log(log, self.settings, noise)
        online = LandmarkFixedLag(system.settings, noise)
        for odometry, cycle in split_odometry(log):
            online.update(odometry, cycle)
        detections, state = system.detections, online.whole_drive(system.detections)
        sigma = np.array(online.inflated.odometry.sigmas)  # priors at the end of the online run
        chain = replace(system.chain, calibration_sigma=sigma)
        system = replace(system, settings=online.inflated, chain=chain)
        system.optimize(state)
        converged, rounds = False, 0
        while not converged and rounds < 10:
            before, known, problem = detections.landmark.copy(), len(state), system.eliminated(state)
            reassociate(system, state, problem, self.settings)
            gone, kept = association.find_duplicates(state, known, problem.joint, self.settings)
            detections.merge(state.numbers[gone], state.numbers[kept])
            remove_rare(state, detections, self.settings.growth.sightings)
            converged = int((before != detections.landmark).sum()) <= 1e-3 * len(detections)
            system.optimize(state)
            rounds += 1
        laps, problem, poses = LapCounter(), system.eliminated(state), state.variables.poses.copy()
        for pose in poses:
            laps.update(pose)
        return BatchRun(
            estimator="landmark-batch",
            settings=settings_dict(self.settings),
            map=point_map(state.landmarks, state.labels, problem.joint(state.keys), laps.completed > 0),
            trajectory_t=system.chain.stamps,
            trajectory=poses,
            cycles=(),
            laps=laps.completed,
            converged=converged,
            noise=system.noise,
        )


def reassociate(
    system: LandmarkSystem, state: LandmarkState, problem: Elimination, settings: MapperSettings
) -> None:
    """Assign the detections of every cycle once more, by the covariances of the eliminated problem.

    Each landmark takes the label of most detections in its gate. Detections that no landmark explains create
    landmarks, at tracks with enough of them.
    """
    detections, stamps, growth = system.detections, system.chain.stamps, settings.growth
    points_map = detections.points_map(slice(None), state.variables)
    pairs = KDTree(points_map).sparse_distance_matrix(
        KDTree(state.landmarks), association.ROUGH_GATE, output_type="coo_matrix"
    )
    order = np.argsort(pairs.row, kind="stable")
    rows, landmarks = pairs.row[order].astype(np.intp), pairs.col[order].astype(np.intp)
    cycles = detections.cycle[rows]
    poses = state.variables.poses_at(cycles)
    r = landmark_residuals(poses, state.landmarks[landmarks], detections.point[rows])
    jacobian = np.concatenate([r.by_pose, r.by_landmark], axis=2)
    spread = predicted_covariances(problem, cycles, state.keys[landmarks], jacobian)
    cost = association.squared_mahalanobis(r.residual, spread + detections.covariance[rows])
    held = detections.landmark[rows] == state.numbers[landmarks]
    cost = association.hysteresis_costs(cost, held)
    inside = cost < MATCH_GATE
    state.votes = np.zeros_like(state.votes)
    state.vote(detections.label[rows[inside]], state.numbers[landmarks[inside]])
    detections.landmark[:] = UNASSOCIATED
    free = np.ones(len(detections), bool)
    starts = np.searchsorted(cycles, np.arange(len(stamps) + 1))
    for begin, end in pairwise(starts.tolist()):
        detected, i = np.unique(rows[begin:end], return_inverse=True)
        candidates, j = np.unique(landmarks[begin:end], return_inverse=True)
        table = np.full((len(detected), len(candidates)), np.inf)
        table[i, j] = cost[begin:end]
        same_label = association.compatible(detections.label[detected], state.labels[candidates])
        table[~same_label] = np.inf
        landmark, free[detected] = association.assign(table)
        matched = landmark != UNASSOCIATED
        detections.take(detected[matched], state.numbers[candidates[landmark[matched]]])
    # do not create landmarks that one with another label explains, or that would be merged
    free[rows[inside | (pairs.data[order] < growth.merge_radius)]] = False
    new = np.flatnonzero(free & ~detections.used)
    covariances = detections.covariances_map(new, state.variables)
    tracks = Tracks(growth.merge_radius, np.inf)
    tracks.add(points_map[new], covariances, detections.label[new], stamps[detections.cycle[new]])
    for label in BOUNDARIES:
        rows = new[detections.label[new] == label]
        points = tracks.points[tracks.confirmed(label, growth.sightings)]
        chosen, landmark = association.associate_created(
            points_map[rows], detections.cycle[rows], points, growth
        )
        numbers = state.add(points, np.full(len(points), label, np.intp))
        detections.take(rows[chosen], numbers[landmark])


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
