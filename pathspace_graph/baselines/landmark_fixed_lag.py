"""The Hungarian landmark graph online: cones are points in the same fixed-lag smoother as the curves.

The loop closes when enough of the recent landmarks are landmarks of the beginning. Their joint covariance
tests a set of pairs as a whole (joint compatibility, Neira and Tardos 2001).
"""

from typing import ClassVar, Final

import numpy as np

from pathspace_graph.batch.association import insert_drive
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.residuals import chi2_quantile
from pathspace_graph.front_end.front_end import Reading
from pathspace_graph.graph.smoother import FixedLagSmoother, restart, set_prior
from pathspace_graph.graph.variables import ONE_DRIVE, POINT
from pathspace_graph.io.map import Map
from pathspace_graph.io.results import VehicleState
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.loop.drive import DriveRecord
from pathspace_graph.mapping import motion as motions
from pathspace_graph.mapping.motion import predict, vehicle_state
from pathspace_graph.mapping.path import DrivenPath
from pathspace_graph.mapping.tracks import FORGET_AFTER, Tracks, nearest_within
from pathspace_graph.run import CycleResult, Readings, Stopwatch

from . import landmark_association as association
from .landmark_association import CREATE, MATCH_GATE, difference_covariances
from .landmark_map import (
    SIGMA_MERGE,
    UNASSOCIATED,
    LandmarkDetections,
    LandmarkMap,
    LandmarkSmoother,
    LandmarkState,
    LandmarkSystem,
    landmark_counts,
    point_map,
)
from .online import FRONT_END, OnlineBaseline

UNSEEN_PATH: Final = 40.0  # path without a detection after which a landmark is old (m)
PRIOR_SCALE: Final = 1.5  # factor of the sigmas of the vehicle and the landmarks, which are too certain
MIN_PAIRS: Final = 4  # least number of pairs that close the loop, a third of them of each colour
MIN_LEAD: Final = 2.0  # least lead of the score over any other set of pairs, in gates


class LandmarkFixedLag(OnlineBaseline):
    """Maps cones as points: predict, associate, create, update, close, marginalize.

    Window, odometry and robust weights are those of `FixedLagMapper`; each detection has a landmark instead
    of a curve.
    """

    READS: ClassVar = (*FRONT_END, "lag", "max_poses", "open_lap", "relinearize", "steps", "steps_grown")

    def _begin(self) -> None:
        self.smoother = FixedLagSmoother(motions.smoother_settings(self.settings), LandmarkMap(self.settings))
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
        association.associate_newest(smoother, new, eligible)
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
        pose, sizes = smoother.variables.poses[-1].copy(), landmark_counts(state.labels)
        return CycleResult(detections.t, pose, sizes, used, self.closed, watch.laps)

    def _create(self, new: slice, t: float) -> bool:
        """Add landmarks at confirmed tracks; they get the detections of the window that created them."""
        detections, state, variables = (
            self.smoother.map.detections,
            self.smoother.map.state,
            self.smoother.variables,
        )
        created, tentative, growth = False, self.tentative, self.settings.growth
        rows = new.start + np.flatnonzero(detections.landmark[new] == UNASSOCIATED)
        covariances = detections.covariances_map(rows, variables)
        tentative.add(detections.points_map(rows, variables), covariances, detections.label[rows], t)
        for label in BOUNDARIES:
            confirmed = tentative.confirmed(label, growth.sightings)
            if len(confirmed) == 0:
                continue
            points = tentative.points[confirmed].copy()
            rows = np.flatnonzero((detections.label == label) & (detections.landmark == UNASSOCIATED))
            points_map = detections.points_map(rows, variables)
            chosen, landmark = association.associate_created(
                points_map, detections.cycle[rows], points, growth
            )
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
        return np.asarray(last_detected < self.path.length - UNSEEN_PATH)

    def whole_drive(self, detections: LandmarkDetections) -> LandmarkState:
        """Associate the detections of all cycles, and return the map with all poses.

        Each association and pose is as of its end in the window.
        """
        track, variables = self.smoother.map, self.smoother.variables
        state, final = LandmarkState(), np.arange(track.state.next_number)
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
                *association.find_duplicates(state, len(state), self.smoother.last_covariance, self.settings)
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
        detections = LandmarkDetections.of_drives([drive.detections], ONE_DRIVE)
        system = LandmarkSystem(detections, drive.chain, self.inflated, noise)
        solved = self.whole_drive(detections)
        system.optimize(solved)
        restart(smoother, first)
        variables = smoother.variables
        variables.values = solved.variables.values[solved.variables.layout.entries(variables.keys)]
        set_prior(smoother, *system.marginal(solved, first))
        for _ in range(self.settings.closing.iterations):
            smoother.step()

    def _merge(self, gone: IntArray, kept: IntArray) -> None:
        if len(gone):
            numbers = self.smoother.map.state.numbers
            np.maximum.at(self._last_detected, numbers[kept], self._last_detected[numbers[gone]])
            association.merge(self.smoother, gone, kept)

    def _map(self, with_covariance: bool) -> Map:
        state = self.smoother.map.state
        if with_covariance and len(state):
            joint = self.smoother.last_covariance(state.keys)
            return point_map(state.landmarks, state.labels, joint, self.closed)
        return point_map(state.landmarks, state.labels, None, self.closed)

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

    def __init__(self, smoother: LandmarkSmoother, recent: IntArray, old: IntArray, scale: float) -> None:
        state = smoother.map.state
        self.recent, self.old = recent, old
        both = np.concatenate([recent, old])
        self.mean = state.landmarks[both].copy()
        self.covariance = scale**2 * smoother.last_covariance(state.keys[both])
        self.same_label = state.labels[recent][:, None] == state.labels[old][None]

    def distances(self, mean: Array, covariance: Array) -> Array:
        """Squared Mahalanobis distances (k, n) of all pairs, infinite for different labels."""
        k = len(self.recent)
        spread = difference_covariances(covariance, np.arange(k)[:, None], np.arange(k, len(mean)))
        squared = association.squared_mahalanobis(mean[:k, None] - mean[None, k:], spread)
        return np.where(self.same_label, squared, np.inf)

    def conditioned(self, mean: Array, covariance: Array, i: int, j: int) -> tuple[Array, Array]:
        """Condition the Gaussian on recent landmark i being old landmark j, by a Kalman update."""
        a, b = POINT * i, POINT * (len(self.recent) + j)
        cross = covariance[:, a : a + POINT] - covariance[:, b : b + POINT]
        spread = cross[a : a + POINT] - cross[b : b + POINT] + SIGMA_MERGE**2 * np.eye(POINT)
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
    smoother: LandmarkSmoother, recent: IntArray, old: IntArray, reach: float
) -> tuple[IntArray, IntArray] | None:
    """Find pairs (k,) of recent and old landmarks, within `reach` (m), of one cone each.

    They are the best hypothesis; None if it is ambiguous or too small. The score of a hypothesis is one gate
    for each pair, less its squared distance.
    """
    state = smoother.map.state
    old = old[nearest_within(state.landmarks[old], state.landmarks[recent], reach)[1]]
    if len(recent) < MIN_PAIRS or len(old) < MIN_PAIRS:
        return None
    gate = MATCH_GATE
    test = JointCompatibility(smoother, recent, old, PRIOR_SCALE)
    seeds = np.argwhere(test.distances(test.mean, test.covariance) < gate)
    if len(seeds) == 0:
        return None
    hypotheses = [test.grow(int(i), int(j), gate) for i, j in seeds]
    scores = [len(pairs) * gate - distance for pairs, distance in hypotheses]
    pairs, distance = hypotheses[int(np.argmax(scores))]
    others = [s for s, (other, _) in zip(scores, hypotheses, strict=True) if set(other).isdisjoint(pairs)]
    if max(scores) - max(others, default=0.0) < MIN_LEAD * gate:
        return None
    i, j = np.array(pairs, np.intp).T
    labels = state.labels[recent[i]]
    enough = all((labels == label).sum() >= MIN_PAIRS // 3 for label in BOUNDARIES)
    fits = distance < chi2_quantile(CREATE, POINT * len(labels))
    return (recent[i], old[j]) if enough and len(labels) >= MIN_PAIRS and fits else None
