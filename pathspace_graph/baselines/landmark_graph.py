"""The Hungarian landmark graph: cones are points in the same fixed-lag smoother as the curves, or in a batch.

The loop closes when enough of the recent landmarks are landmarks of the beginning. Their joint covariance
tests a set of pairs as a whole (joint compatibility, Neira and Tardos 2001).
"""

from dataclasses import replace
from itertools import pairwise
from typing import ClassVar, Final

import numpy as np
from scipy.spatial import KDTree

from pathspace_graph.batch.association import insert_drive
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.noise import KnownNoise
from pathspace_graph.factors.residuals import chi2_quantile, landmark_residuals
from pathspace_graph.front_end.front_end import Reading
from pathspace_graph.graph.elimination import Elimination
from pathspace_graph.graph.gaussian import upper_root
from pathspace_graph.graph.smoother import FixedLagSmoother, restart, set_prior
from pathspace_graph.graph.variables import ONE_DRIVE, POINT, POSE
from pathspace_graph.io.log import Log
from pathspace_graph.io.map import Map
from pathspace_graph.io.results import BatchRun, VehicleState
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.laps import LapCounter
from pathspace_graph.loop.drive import DriveRecord
from pathspace_graph.mapping import motion as motions
from pathspace_graph.mapping.motion import known_noise, predict, vehicle_state
from pathspace_graph.mapping.path import DrivenPath
from pathspace_graph.mapping.tracks import FORGET_AFTER, Tracks, nearest_within
from pathspace_graph.run import CycleResult, Readings, Stopwatch, settings_dict, solved, split_odometry
from pathspace_graph.settings.mapper import MapperSettings, known_settings

from . import landmarks

MIN_PAIRS: Final = 4  # least number of pairs that close the loop, a third of them of each colour


class LandmarkFixedLag(landmarks.OnlineBaseline):
    """Maps cones as points: predict, associate, create, update, close, marginalize.

    Window, odometry and robust weights are those of `FixedLagMapper`; each detection has a landmark instead
    of a curve.
    """

    READS: ClassVar = (
        *landmarks.FRONT_END,
        "lag",
        "max_poses",
        "open_lap",
        "relinearize",
        "steps",
        "steps_grown",
    )

    def _begin(self) -> None:
        self.smoother = FixedLagSmoother(
            motions.smoother_settings(self.settings), landmarks.LandmarkMap(self.settings)
        )
        self.smoother.window.exact = True
        self.path = DrivenPath()
        growth = self.settings.growth
        self.tentative = Tracks(growth.merge_radius, FORGET_AFTER)
        self.inflated = self.settings  # settings with the present priors of the calibrations
        self.closed = False
        self.record = DriveRecord()
        self._left: list[tuple[Array, IntArray]] = []
        """Poses (k, 3) that left the window, and landmarks (m,) of their detections, as of then."""
        self._last_detected: Array = np.zeros(
            0
        )  # path length at each landmark's last detection, by number (m)
        self._last_check = 0.0

    def _process(self, reading: Reading, watch: Stopwatch) -> CycleResult:
        motion, detections, smoother = reading.motion, reading.detections, self.smoother
        table, state = smoother.map.detections, smoother.map.state
        if not self.closed:
            self.record.measured(reading)
        predict(smoother, self.path, motion, detections.t)
        watch.lap("predict")
        new = smoother.map.add(detections, smoother.next_cycle - 1, motion.odometry.twist)
        eligible = np.ones(len(state), bool)
        if not self.closed and self._near_start():  # a single detection of an old landmark is ambiguous
            eligible = ~self._old()
        landmarks.associate_newest(smoother, new, eligible)
        watch.lap("associate")
        created = self._create(new, detections.t)
        watch.lap("create")
        for _ in range(self.settings.steps_grown if created else self.settings.steps):
            smoother.step()
        if not self.closed:
            self.inflated = motions.inflate_priors(
                smoother, self.inflated, reading.sensor_doubted, reading.measured
            )
        watch.lap("update")
        self._close(reading)
        watch.lap("close")
        first, poses = smoother.first_cycle, smoother.variables.poses
        cycle, landmark = table.cycle, table.landmark
        smoother.marginalize()
        left = smoother.first_cycle - first
        if left:
            self._left.append((poses[:left].copy(), landmark[cycle < smoother.first_cycle].copy()))
        watch.lap("marginalize")
        used = int((table.used & (table.cycle == smoother.next_cycle - 1)).sum())
        pose, sizes = smoother.variables.poses[-1].copy(), landmarks.landmark_counts(state.labels)
        return CycleResult(detections.t, pose, sizes, used, self.closed, watch.laps)

    def _create(self, new: slice, t: float) -> bool:
        """Add landmarks at confirmed tracks; they get the detections of the window that created them."""
        detections, state, variables = (
            self.smoother.map.detections,
            self.smoother.map.state,
            self.smoother.variables,
        )
        created, tentative, growth = False, self.tentative, self.settings.growth
        rows = new.start + np.flatnonzero(detections.landmark[new] == landmarks.UNASSOCIATED)
        covariances = detections.covariances_map(rows, variables)
        tentative.add(detections.points_map(rows, variables), covariances, detections.label[rows], t)
        for label in BOUNDARIES:
            confirmed = tentative.confirmed(label, growth.sightings)
            if len(confirmed) == 0:
                continue
            points = tentative.points[confirmed].copy()
            rows = np.flatnonzero(
                (detections.label == label) & (detections.landmark == landmarks.UNASSOCIATED)
            )
            points_map = detections.points_map(rows, variables)
            chosen, landmark = landmarks.associate_created(points_map, detections.cycle[rows], points, growth)
            held, landmark = np.unique(landmark, return_inverse=True)
            numbers = state.add(points[held], np.full(len(held), label, np.intp))[landmark]
            detections.take(rows[chosen], numbers)
            state.vote(detections.label[rows[chosen]], numbers)
            tentative.remove(confirmed)
            created = True
        return created

    def _near_start(self) -> bool:
        return self.path.near_beginning(self.smoother.variables.poses[-1], self.settings.closing)

    def _old(self) -> BoolArray:
        last_detected = self._last_detected[self.smoother.map.state.numbers]
        return np.asarray(last_detected < self.path.length - 40.0)  # m driven without a detection

    def whole_drive(self, detections: landmarks.LandmarkDetections) -> landmarks.LandmarkState:
        """Associate the detections of all cycles, and return the map with all poses.

        Each association and pose is as of its end in the window.
        """
        track, variables = self.smoother.map, self.smoother.variables
        state, final = landmarks.LandmarkState(), np.arange(track.state.next_number)
        for gone, kept in sorted(track.merged_into.items()):  # ascending, so that `kept` is already final
            final[gone] = final[kept]
        landmark = np.concatenate([*(landmark for _, landmark in self._left), track.detections.landmark])
        rows = np.flatnonzero(landmark >= 0)
        detections.take(rows, final[landmark[rows]])
        state.add(track.state.landmarks, track.state.labels, track.state.numbers)
        state.votes, state.next_number = track.state.votes, track.state.next_number
        poses = np.concatenate([*(poses for poses, _ in self._left), variables.poses])
        insert_drive(state.variables, variables.calibrations, poses)
        return state

    def _close(self, reading: Reading) -> None:
        """Close the loop, or merge duplicates after closure, every few metres."""
        detections, state, length = self.smoother.map.detections, self.smoother.map.state, self.path.length
        detected = np.unique(detections.landmark[detections.used])
        unknown = np.zeros(state.next_number - len(self._last_detected))
        self._last_detected = np.append(self._last_detected, unknown)
        self._last_detected[detected] = length
        if length - self._last_check < self.settings.closing.check_interval:
            return
        self._last_check = length
        if self.closed:
            self._merge(
                *landmarks.find_duplicates(state, len(state), self.smoother.last_covariance, self.settings)
            )
        elif self._near_start() and self.record.unsolvable is None:
            reach = self.settings.closing.radius_after(length)
            recent, old = state.positions(detected), np.flatnonzero(self._old())
            pairs = detect_loop(self.smoother, recent, old, reach)
            if pairs is not None:
                self._merge(*pairs)
                self._solve_drive(reading)
                self.closed, self.smoother.window.exact = True, False

    def _solve_drive(self, reading: Reading) -> None:
        """Replace the map by the optimum of the whole drive, and the prior by its marginal."""
        smoother, first, noise = self.smoother, self.smoother.first_cycle, self.front_end.noise_used
        drive = self.record.lap(first, None, (), self.inflated, reading.noise)
        detections = landmarks.LandmarkDetections.of_drives([drive.detections], ONE_DRIVE)
        system = landmarks.LandmarkSystem(detections, drive.chain, self.inflated, noise)
        solved = self.whole_drive(detections)
        system.optimize(solved)
        restart(smoother, first)
        variables = smoother.variables
        variables.values = solved.variables.values[solved.variables.layout.entries(variables.keys)]
        keys, mean, information = system.marginal(solved, first)
        set_prior(smoother, keys, mean, upper_root(information))
        for _ in range(self.settings.closing.iterations):
            smoother.step()

    def _merge(self, gone: IntArray, kept: IntArray) -> None:
        if len(gone):
            numbers = self.smoother.map.state.numbers
            np.maximum.at(self._last_detected, numbers[kept], self._last_detected[numbers[gone]])
            landmarks.merge(self.smoother, gone, kept)

    def map(self, with_covariance: bool = True) -> Map:
        state = self.smoother.map.state
        if with_covariance and len(state):
            joint = self.smoother.last_covariance(state.keys)
            return landmarks.point_map(state.landmarks, state.labels, joint, self.closed)
        return landmarks.point_map(state.landmarks, state.labels, None, self.closed)

    def window_poses(self) -> Array:
        return self.smoother.variables.poses.copy()

    def readings(self) -> Readings:
        table, state = self.smoother.map.detections, self.smoother.map.state
        rows = np.flatnonzero(table.cycle == self.smoother.next_cycle - 1)
        used = table.used[rows]
        points = table.points_map(rows, self.smoother.variables)
        feet = np.full(points.shape, np.nan)
        feet[used] = state.landmarks[state.positions(table.landmark[rows[used]])]
        return Readings(points, table.label[rows], used, feet)

    def vehicle_state(self) -> VehicleState:
        return vehicle_state(self.smoother)


class JointCompatibility:
    """Test of sets of pairs by the joint Gaussian of recent and old landmarks, all sigmas times `scale`."""

    def __init__(
        self, smoother: landmarks.LandmarkSmoother, recent: IntArray, old: IntArray, scale: float
    ) -> None:
        state = smoother.map.state
        self.recent, self.old = recent, old
        both = np.concatenate([recent, old])
        self.mean = state.landmarks[both].copy()
        self.covariance = scale**2 * smoother.last_covariance(state.keys[both])
        self.same_label = state.labels[recent][:, None] == state.labels[old][None]

    def distances(self, mean: Array, covariance: Array) -> Array:
        """Squared Mahalanobis distances (k, n) of all pairs, infinite for different labels."""
        k = len(self.recent)
        spread = landmarks.difference_covariances(covariance, np.arange(k)[:, None], np.arange(k, len(mean)))
        squared = landmarks.squared_mahalanobis(mean[:k, None] - mean[None, k:], spread)
        return np.where(self.same_label, squared, np.inf)

    def conditioned(self, mean: Array, covariance: Array, i: int, j: int) -> tuple[Array, Array]:
        """Condition the Gaussian on recent landmark i being old landmark j, by a Kalman update."""
        a, b = POINT * i, POINT * (len(self.recent) + j)
        cross = covariance[:, a : a + POINT] - covariance[:, b : b + POINT]
        spread = cross[a : a + POINT] - cross[b : b + POINT] + landmarks.SIGMA_MERGE**2 * np.eye(POINT)
        gain = np.linalg.solve(spread, cross.T).T
        innovation = mean[i] - mean[len(self.recent) + j]
        return mean - (gain @ innovation).reshape(-1, POINT), covariance - gain @ cross.T

    def grow(self, i: int, j: int, gate: float) -> tuple[list[tuple[int, int]], float]:
        """Grow a set of pairs from (i, j) by best pairs in the gate; return it and its squared distance."""
        mean, covariance, total = self.mean, self.covariance, 0.0
        distances = self.distances(mean, covariance)
        free = np.ones(distances.shape, bool)
        chosen: list[tuple[int, int]] = []
        while distances[i, j] < gate:
            chosen.append((i, j))
            total += float(distances[i, j])
            free[i], free[:, j] = False, False
            mean, covariance = self.conditioned(mean, covariance, i, j)
            distances = np.where(free, self.distances(mean, covariance), np.inf)
            i, j = divmod(int(distances.argmin()), distances.shape[1])
        return chosen, total


def detect_loop(
    smoother: landmarks.LandmarkSmoother, recent: IntArray, old: IntArray, reach: float
) -> tuple[IntArray, IntArray] | None:
    """Find pairs (k,) of recent and old landmarks, within `reach` (m), of one cone each.

    They are the best hypothesis; None if it is ambiguous or too small. The score of a hypothesis is one gate
    for each pair, less its squared distance.
    """
    state = smoother.map.state
    old = old[nearest_within(state.landmarks[old], state.landmarks[recent], reach)[1]]
    if len(recent) < MIN_PAIRS or len(old) < MIN_PAIRS:
        return None
    gate = landmarks.MATCH_GATE
    test = JointCompatibility(smoother, recent, old, 1.5)  # vehicle and landmarks are too certain
    seeds = np.argwhere(test.distances(test.mean, test.covariance) < gate)
    if len(seeds) == 0:
        return None
    hypotheses = [test.grow(int(i), int(j), gate) for i, j in seeds]
    scores = [len(pairs) * gate - distance for pairs, distance in hypotheses]
    pairs, distance = hypotheses[int(np.argmax(scores))]
    others = [s for s, (other, _) in zip(scores, hypotheses, strict=True) if set(other).isdisjoint(pairs)]
    if max(scores) - max(others, default=0.0) < 2.0 * gate:  # by two pairs
        return None
    i, j = np.array(pairs, np.intp).T
    labels = state.labels[recent[i]]
    enough = all((labels == label).sum() >= MIN_PAIRS // 3 for label in BOUNDARIES)
    fits = distance < chi2_quantile(landmarks.CREATE, POINT * len(labels))
    return (recent[i], old[j]) if enough and len(labels) >= MIN_PAIRS and fits else None


# --- the Hungarian landmark graph over a whole log: all poses and landmarks, with iterated associations -


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
        system = landmarks.LandmarkSystem.of_log(log, self.settings, noise)
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
            gone, kept = landmarks.find_duplicates(state, known, problem.joint, self.settings)
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
            map=landmarks.point_map(
                state.landmarks, state.labels, problem.joint(state.keys), laps.completed > 0
            ),
            trajectory_t=system.chain.stamps,
            trajectory=poses,
            cycles=(),
            laps=laps.completed,
            converged=converged,
            noise=system.noise,
        )


def reassociate(
    system: landmarks.LandmarkSystem,
    state: landmarks.LandmarkState,
    problem: Elimination,
    settings: MapperSettings,
) -> None:
    """Assign the detections of every cycle once more, by the covariances of the eliminated problem.

    Each landmark takes the label of most detections in its gate. Detections that no landmark explains create
    landmarks, at tracks with enough of them.
    """
    detections, stamps, growth = system.detections, system.chain.stamps, settings.growth
    points_map = detections.points_map(slice(None), state.variables)
    pairs = KDTree(points_map).sparse_distance_matrix(
        KDTree(state.landmarks), landmarks.ROUGH_GATE, output_type="coo_matrix"
    )
    order = np.argsort(pairs.row, kind="stable")
    rows, nearby = pairs.row[order].astype(np.intp), pairs.col[order].astype(np.intp)
    cycles = detections.cycle[rows]
    poses = state.variables.poses_at(cycles)
    r = landmark_residuals(poses, state.landmarks[nearby], detections.point[rows])
    jacobian = np.concatenate([r.by_pose, r.by_landmark], axis=2)
    spread = predicted_covariances(problem, cycles, state.keys[nearby], jacobian)
    cost = landmarks.squared_mahalanobis(r.residual, spread + detections.covariance[rows])
    held = detections.landmark[rows] == state.numbers[nearby]
    cost = landmarks.hysteresis_costs(cost, held)
    inside = cost < landmarks.MATCH_GATE
    state.votes = np.zeros_like(state.votes)
    state.vote(detections.label[rows[inside]], state.numbers[nearby[inside]])
    detections.landmark[:] = landmarks.UNASSOCIATED
    free = np.ones(len(detections), bool)
    starts = np.searchsorted(cycles, np.arange(len(stamps) + 1))
    for begin, end in pairwise(starts.tolist()):
        detected, i = np.unique(rows[begin:end], return_inverse=True)
        candidates, j = np.unique(nearby[begin:end], return_inverse=True)
        table = np.full((len(detected), len(candidates)), np.inf)
        table[i, j] = cost[begin:end]
        same_label = landmarks.compatible(detections.label[detected], state.labels[candidates])
        table[~same_label] = np.inf
        landmark, free[detected] = landmarks.assign(table)
        matched = landmark != landmarks.UNASSOCIATED
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
        chosen, landmark = landmarks.associate_created(
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


def remove_rare(
    state: landmarks.LandmarkState, detections: landmarks.LandmarkDetections, fewest: int
) -> None:
    """Remove landmarks with fewer detections than `fewest`; their detections become unassociated."""
    counts = np.bincount(state.positions(detections.landmark[detections.used]), minlength=len(state))
    gone = counts < fewest
    detections.landmark[np.isin(detections.landmark, state.numbers[gone])] = landmarks.UNASSOCIATED
    state.variables.remove(state.keys[gone])
    state.keep(~gone)
