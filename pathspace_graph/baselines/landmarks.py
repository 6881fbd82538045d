"""Landmarks: their variables, detections and rows, associations, and the least-squares problem of a drive.

`OnlineBaseline` is the base of all online baselines: the mapper's front end.
"""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Final, Self, TypeAlias

import numpy as np
import scipy  # imports its modules on first use

from pathspace_graph.batch.association import insert_drive
from pathspace_graph.copies import shallow
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.noise import KnownNoise, huber_loss, huber_weights, whiteners
from pathspace_graph.factors.odometry import CALIBRATION_SIZE
from pathspace_graph.factors.residuals import chi2_quantile, landmark_residuals
from pathspace_graph.factors.se2 import to_map
from pathspace_graph.factors.sensor import by_sensor, restored
from pathspace_graph.front_end.front_end import FrontEnd, Reading, is_orange, judge_log
from pathspace_graph.front_end.log_odometry import LogOdometry, half_square
from pathspace_graph.graph import elimination
from pathspace_graph.graph.rows import Rows
from pathspace_graph.graph.smoother import FixedLagSmoother, merge_points
from pathspace_graph.graph.variables import (
    LANDMARK_LETTER,
    POINT,
    POSE,
    SENSOR_KEY,
    Variables,
    indices,
    landmark_keys,
    pose_keys,
)
from pathspace_graph.io.log import Detections, Log, Odometry
from pathspace_graph.io.map import NO_COVARIANCE, Map, PointBoundary
from pathspace_graph.io.results import RunNoise
from pathspace_graph.labels import BOUNDARIES, LEFT, RIGHT, UNKNOWN
from pathspace_graph.mapping.detections import DetectionColumns
from pathspace_graph.mapping.motion import known_noise
from pathspace_graph.mapping.tracks import nearest_within
from pathspace_graph.run import CycleResult, Stopwatch
from pathspace_graph.settings.mapper import GrowthSettings, MapperSettings, known_settings

UNASSOCIATED: Final = -1  # landmark of a detection without one, which may create one
AMBIGUOUS: Final = -2  # landmark of a detection without one, which must not create one
SIGMA_MERGE: Final = 0.1  # standard deviation of the distance of two landmarks of one cone (m)


class LandmarkState:
    """Landmarks, oldest first. The number of a landmark is that of its key and never changes."""

    def __init__(self) -> None:
        self.variables = Variables()  # landmarks, calibration and poses by key
        self.numbers: IntArray = np.zeros(0, np.intp)  # (n,) numbers of the landmarks, ascending
        self.labels: IntArray = np.zeros(0, np.intp)  # (n,) labels of the landmarks
        self.votes: IntArray = np.zeros((0, len(BOUNDARIES)), np.intp)  # (n, 2) detections by label
        self.next_number = 0

    def copy(self) -> Self:
        other = shallow(self)
        other.variables = self.variables.copy()
        other.votes = self.votes.copy()
        return other

    def __len__(self) -> int:
        return len(self.numbers)

    @property
    def keys(self) -> IntArray:
        return landmark_keys(self.numbers)

    @property
    def landmarks(self) -> Array:
        """View of the landmarks (n, 2) in m, map frame."""
        return self.variables.block(LANDMARK_LETTER).reshape(-1, POINT)

    def positions(self, numbers: IntArray) -> IntArray:
        """Positions of landmarks by number, of any shape; all must exist."""
        return self.numbers.searchsorted(numbers)

    def add(self, points: Array, labels: IntArray, numbers: IntArray | None = None) -> IntArray:
        """Add landmarks (k, 2) with labels (k,), by default with the next numbers; return numbers (k,)."""
        new = self.next_number + np.arange(len(labels)) if numbers is None else numbers
        self.variables.insert(landmark_keys(new), points.ravel())
        self.numbers = np.concatenate([self.numbers, new])
        self.labels = np.concatenate([self.labels, labels])
        self.votes = np.concatenate([self.votes, np.zeros((len(labels), len(BOUNDARIES)), np.intp)])
        self.next_number = int(new[-1]) + 1 if len(new) else self.next_number
        return new

    def vote(self, labels: IntArray, numbers: IntArray) -> None:
        """Count detections with labels (k,) on landmarks (k,), which take the majority's label."""
        known, rows = np.isin(labels, BOUNDARIES), np.arange(len(self))
        np.add.at(self.votes, (self.positions(numbers[known]), labels[known]), 1)
        most = self.votes.argmax(axis=1)
        self.labels = np.where(self.votes[rows, most] > self.votes[rows, self.labels], most, self.labels)

    def keep(self, stays: BoolArray) -> None:
        """Remove the landmarks whose entry in `stays` (n,) is not set, but not their variables."""
        self.numbers, self.labels, self.votes = self.numbers[stays], self.labels[stays], self.votes[stays]


@dataclass
class LandmarkDetections(DetectionColumns):
    """Detections with their associations to landmarks."""

    landmark: IntArray = field(default_factory=lambda: np.zeros(0, np.intp))  # or UNASSOCIATED or AMBIGUOUS

    def copy(self) -> Self:
        return replace(self, landmark=self.landmark.copy(), changed=self.changed.copy())

    @property
    def used(self) -> BoolArray:
        return self.landmark >= 0

    def _clear_associations(self) -> None:
        self.landmark = np.full(len(self), UNASSOCIATED, np.intp)

    def merge(self, gone: IntArray, kept: IntArray) -> None:
        for number, became in zip(gone.tolist(), kept.tolist(), strict=True):
            self.landmark[self.landmark == number] = became

    def take(self, rows: IntArray, numbers: IntArray) -> None:
        self.landmark[rows], self.changed[rows] = numbers, True


class LandmarkMap:
    """The landmarks and the detections of the window, for the engine (`graph.window:MapRows`)."""

    reached_inactive = False  # no landmark is ever inactive

    def __init__(self, settings: MapperSettings) -> None:
        self.settings = settings
        self.state = LandmarkState()
        self.variables = self.state.variables
        self.detections = LandmarkDetections()  # detections from the poses in the window
        self.twist: Array = np.zeros(POSE)  # (3,) at the newest detections (m/s, m/s, rad/s)
        self.merged_into: dict[int, int] = {}  # number of the remaining landmark, by that of the merged one

    def copy(self) -> Self:
        other = shallow(self)
        other.state = self.state.copy()
        other.variables = other.state.variables
        other.detections = self.detections.copy()
        other.merged_into = self.merged_into.copy()
        return other

    def add(self, detections: Detections, cycle: int, twist: Array) -> slice:
        """Add the corrected detections of the newest cycle, made at a twist (3,); return their rows."""
        self.twist = twist
        rows = self.detections.append(detections, cycle, twist)
        self.correct()
        return rows

    def changed(self) -> IntArray:
        return self.detections.cycle[self.detections.changed]

    def rows(self, cycles: IntArray) -> list[Rows]:
        chosen = self.detections.used & self.detections.in_cycles(cycles)
        return [landmark_rows(self.state, self.detections, np.flatnonzero(chosen), self.settings.gate.huber)]

    def correct(self) -> None:
        self.detections.correct(self.variables.sensor)

    def linearized(self, cycles: IntArray) -> None:
        self.detections.mark_linearized()

    def activate(self, keys: IntArray) -> None: ...  # every landmark is always active

    def activate_all(self) -> None: ...

    def drop_cycle(self, cycle: int) -> None:
        self.detections.keep_from(cycle + 1)

    def merge(self, gone: IntArray, kept: IntArray) -> None:
        """Move the detections and votes of landmarks `gone` (k,) to `kept` (k,), both given by position."""
        state = self.state
        gone_numbers, kept_numbers = state.numbers[gone], state.numbers[kept]
        self.detections.merge(gone_numbers, kept_numbers)
        np.add.at(state.votes, kept, state.votes[gone])
        stays = np.ones(len(state), bool)
        stays[gone] = False
        state.keep(stays)
        self.merged_into.update(zip(gone_numbers.tolist(), kept_numbers.tolist(), strict=True))


LandmarkSmoother: TypeAlias = FixedLagSmoother[LandmarkMap]


def landmark_rows(
    state: LandmarkState, detections: LandmarkDetections, chosen: IntArray, huber: float
) -> Rows:
    """Linearize `w W (R^T (l - t) - z)` for associated detections (m,), with `W' W = K^-1`.

    w is the root of each row's Huber weight. The detections z are corrected by the sensor's calibration; the
    residuals are converted to those of measured detections (`factors.sensor:restored`).
    """
    cycles, numbers, sensor = detections.cycle[chosen], detections.landmark[chosen], state.variables.sensor
    poses, points = state.variables.poses_at(cycles), state.landmarks[state.positions(numbers)]
    predicted = landmark_residuals(poses, points, detections.corrected(chosen, sensor))
    measured = detections.measured[chosen], detections.twist[chosen]
    inverse, by_calibration = restored(predicted.residual, *measured, sensor)
    white = whiteners(detections.covariance[chosen])
    residual = np.einsum("mij,mj->mi", white @ inverse, predicted.residual)
    weight = np.sqrt(huber_weights(residual, huber))
    blocks = inverse @ predicted.by_pose, by_calibration, inverse @ predicted.by_landmark
    jacobian = white @ np.concatenate(blocks, axis=2)
    return two_rows(cycles, numbers, jacobian * weight[:, :, None], residual * weight)


def two_rows(cycles: IntArray, numbers: IntArray, jacobian: Array, residual: Array) -> Rows:
    """Convert Jacobians (m, 2, n) and residuals (m, 2) to rows on [pose | landmark], owned by the cycles."""
    sensor = [np.full(len(cycles), SENSOR_KEY)] if jacobian.shape[2] > POSE + POINT else []
    keys = np.stack([pose_keys(cycles), *sensor, landmark_keys(numbers)], axis=1)
    flat = jacobian.reshape(-1, jacobian.shape[2])
    return Rows(np.repeat(keys, POINT, axis=0), flat, residual.ravel(), np.repeat(cycles, POINT))


def landmark_counts(labels: IntArray) -> tuple[int, int]:
    return int((labels == LEFT).sum()), int((labels == RIGHT).sum())


def point_map(points: Array, labels: IntArray, joint: Array | None, closed: bool) -> Map:
    """Build a map of landmarks (n, 2) by label, with the blocks of the joint covariance (2 n, 2 n)."""
    boundaries, order = {}, [np.zeros(0, np.intp)]
    for label in BOUNDARIES:
        chosen = np.flatnonzero(labels == label)
        if len(chosen):
            order.append((POINT * chosen[:, None] + np.arange(POINT)).ravel())
            covariance = NO_COVARIANCE if joint is None else joint[np.ix_(order[-1], order[-1])]
            boundaries[label] = PointBoundary(points[chosen].copy(), covariance)
    columns = np.concatenate(order)
    return Map(closed, boundaries, None if joint is None else joint[np.ix_(columns, columns)])


# --- the least-squares problem of a whole drive ----------------------------------------------------------


@dataclass(frozen=True, eq=False)
class LandmarkSystem:
    """Minimizes `1/2 |odometry|^2 + sum rho(associated detections) + 1/2 |calibration, first pose|^2`."""

    detections: LandmarkDetections
    chain: LogOdometry
    settings: MapperSettings
    noise: RunNoise

    @classmethod
    def of_log(cls, log: Log, settings: MapperSettings, noise: KnownNoise) -> "LandmarkSystem":
        """Set up the problem of a log without associations; `noise` is known before the drive."""
        judged = judge_log(log, noise, settings)
        detections = LandmarkDetections.of(judged.cycles, twists=judged.chain.twists)
        return cls(detections, judged.chain, judged.settings, judged.noise)

    def cost(self, state: LandmarkState) -> float:
        """Half the sum of squares at a state, with Huber's loss of the detections."""
        *drive, detections = self.rows(state, np.inf)
        return half_square(drive) + float(huber_loss(detections.residual, self.settings.gate.huber).sum())

    def rows(self, state: LandmarkState, huber: float) -> list[Rows]:
        """All rows, those of the detections last, weighted by a Huber threshold (sigmas)."""
        rows = landmark_rows(state, self.detections, np.flatnonzero(self.detections.used), huber)
        labels = state.labels[state.positions(indices(rows.keys[:, -1]))]
        seen = replace(rows, owner=elimination.owners(rows.owner, labels == RIGHT))
        return [*self.chain.rows_at(state.variables, self.settings.calibration), seen]

    def eliminated(self, state: LandmarkState) -> elimination.Elimination:
        graph = elimination.linear_graph(self.rows(state, self.settings.gate.huber), state.variables)
        return elimination.Elimination(graph, state.variables.layout)

    def optimize(self, state: LandmarkState) -> None:
        """Optimize a state by Levenberg-Marquardt with fixed associations; landmarks are damped (1/m^2)."""
        variables, cost, damping = state.variables, self.cost(state), 1e-2
        keys = np.repeat(state.keys, POINT)[:, None]
        still = Rows(
            keys,
            np.tile(np.eye(POINT), (len(state), 1)),
            np.zeros(len(keys)),
            -1 - np.arange(len(keys)) // POINT,
        )
        for _ in range(80):
            damped = replace(still, jacobian=np.sqrt(damping) * still.jacobian)
            rows, before = self.rows(state, self.settings.gate.huber), variables.values
            graph = elimination.linear_graph([*rows, damped], variables)
            variables.values = before + elimination.solution(graph, variables.layout)
            gain = cost - self.cost(state)
            if gain < 0.0:
                variables.values = before
                damping *= 5.0
            else:
                cost -= gain
                damping = max(0.1 * damping, 1e-6)
            if damping > 1e6 or 0.0 <= gain <= 1e-6 * cost:
                break
        self.detections.correct(variables.sensor)

    def marginal(self, state: LandmarkState, first: int) -> tuple[IntArray, Array, Array]:
        """Return the Gaussian of poses before a cycle on calibrations, landmarks and its pose.

        It is given by keys, mean (n,) and information (n, n).
        """
        rows = self.rows(state, self.settings.gate.huber)
        layout, information, vector = elimination.marginal_before(rows, state.variables, first)
        here = state.variables.values[state.variables.layout.entries(layout.keys)]
        return layout.keys, here + np.linalg.solve(information, vector), information


def solve_landmarks(
    log: Log, associations: IntArray, settings: MapperSettings | None = None
) -> tuple[LandmarkSystem, LandmarkState]:
    """Minimize all squared Mahalanobis distances over poses, calibration and landmarks, without robust loss.

    associations (R,) are the landmark numbers of all detections in file order. Negative ones and orange cones
    are left out.
    """
    associations = associations[~np.concatenate([is_orange(cycle) for cycle in log.cycles])]
    settings = settings or MapperSettings()
    settings = replace(settings, gate=replace(settings.gate, huber=np.inf))
    drift = np.zeros(3) if log.odometry_drift is None else log.odometry_drift
    system = LandmarkSystem.of_log(log, settings, KnownNoise(log.odometry_sigma, drift=drift))
    state = start_oracle(system, associations)
    system.optimize(state)
    return system, state


def start_oracle(system: LandmarkSystem, associations: IntArray) -> LandmarkState:
    """Associate the system's detections with landmarks (R,); return the state by dead reckoning."""
    detections, rows = system.detections, np.flatnonzero(associations >= 0)
    numbers, first, landmark = np.unique(associations[rows], return_index=True, return_inverse=True)
    detections.take(rows, numbers[landmark])
    calibration = np.array(system.settings.calibrations)
    poses = system.chain.dead_reckoned(calibration[:CALIBRATION_SIZE])
    points = to_map(detections.point[rows[first]], poses[detections.cycle[rows[first]]])
    votes = np.zeros((len(numbers), 3), np.intp)  # left, right, unknown
    np.add.at(votes, (landmark, detections.label[rows]), 1)
    state = LandmarkState()
    state.add(points, votes.argmax(axis=1), numbers.astype(np.intp))
    state.votes = votes[:, : len(BOUNDARIES)]
    insert_drive(state.variables, calibration, poses)
    return state


# --- association of detections with landmarks by Hungarian assignment, and of landmarks of one cone -----

ROUGH_GATE: Final = 5.0  # largest distance of a tested landmark from a detection of the cycle (m)
CREATE: Final = 0.99  # probability of the gates outside of which a detection may be new
MATCH_GATE: Final = chi2_quantile(0.95, POINT)  # gate of a match (squared Mahalanobis distance)
CREATE_GATE: Final = chi2_quantile(CREATE, POINT)  # gate outside of which a detection may be new


def assign(cost: Array) -> tuple[IntArray, BoolArray]:
    """Minimize `sum_ij cost_ij` over one-to-one assignments; an unassigned detection costs the match gate.

    cost (m, n) are squared Mahalanobis distances of detections to landmarks, infinite for other labels.
    Return the column (m,) of each landmark, or UNASSOCIATED, and whether detections (m,) may create one.
    """
    landmark = np.full(len(cost), UNASSOCIATED, np.intp)
    rows, columns = scipy.optimize.linear_sum_assignment(np.minimum(cost, MATCH_GATE))
    chosen = cost[rows, columns] < MATCH_GATE
    landmark[rows[chosen]] = columns[chosen]
    return landmark, np.asarray((cost > CREATE_GATE).all(axis=1))


def squared_mahalanobis(innovations: Array, covariances: Array) -> Array:
    """Compute `r' S^-1 r` (...,) for innovations (..., 2) with covariances (..., 2, 2), in closed form."""
    x, y = innovations[..., 0], innovations[..., 1]
    xx, xy, yy = covariances[..., 0, 0], covariances[..., 0, 1], covariances[..., 1, 1]
    return np.asarray((yy * x * x - 2.0 * xy * x * y + xx * y * y) / (xx * yy - xy * xy))


def pair_costs(points: Array, covariances: Array, predicted: Array, predicted_covariances: Array) -> Array:
    """Squared Mahalanobis distances (m, n) of detections (m, 2) and predicted ones (n, 2).

    Their covariances are (m, 2, 2) and (n, 2, 2).
    """
    innovations = predicted[None] - points[:, None]
    return squared_mahalanobis(innovations, predicted_covariances[None] + covariances[:, None])


def hysteresis_costs(cost: Array, held: BoolArray) -> Array:
    """Keep previous (`held`) pairs in the match gate up to the create gate, so that they do not flip."""
    inside = (1.0 - 1e-9) * MATCH_GATE  # against round-off
    return np.where(held & (cost < CREATE_GATE), np.minimum(cost, inside), cost)


def compatible(labels: IntArray, landmark_labels: IntArray) -> BoolArray:
    """Whether the detection of each pair (m, n) has the landmark's label or an unknown one."""
    return np.asarray((labels[:, None] == landmark_labels[None]) | (labels == UNKNOWN)[:, None])


def associate_newest(smoother: LandmarkSmoother, new: slice, eligible: BoolArray) -> None:
    """Associate the rows `new` of the newest pose with eligible (n,) landmarks.

    A detection between the gates becomes AMBIGUOUS. So does a detection in the match gate of a landmark with
    another label, and votes for its own label.
    """
    detections, state = smoother.map.detections, smoother.map.state
    rows = np.arange(new.start, new.stop)
    points = detections.points_map(rows, smoother.variables)
    near = nearest_within(state.landmarks, points, ROUGH_GATE)[1]
    landmarks = np.flatnonzero(near & eligible)
    numbers = state.numbers[landmarks]
    predicted = predicted_points(smoother, landmarks)
    any_label = pair_costs(detections.point[rows], detections.covariance[rows], *predicted)
    same_label = compatible(detections.label[rows], state.labels[landmarks])
    landmark, is_new = assign(np.where(same_label, any_label, np.inf))
    matched = landmark != UNASSOCIATED
    detections.take(rows[matched], numbers[landmark[matched]])
    explained = (any_label < MATCH_GATE).any(axis=1)
    detections.landmark[rows[~matched & (~is_new | explained)]] = AMBIGUOUS
    if explained.any():
        state.vote(detections.label[rows[explained]], numbers[any_label[explained].argmin(axis=1)])


def predicted_points(smoother: LandmarkSmoother, landmarks: IntArray) -> tuple[Array, Array]:
    """Predict detections of landmarks (k,), by position, from the newest pose.

    They (k, 2) are in m, vehicle frame, with covariances `H_j Sigma H_j'` (k, 2, 2). Sigma is the covariance
    of pose and landmark in the last step, and zero before the first one.
    """
    state, k = smoother.map.state, len(landmarks)
    cycles = np.full(k, smoother.next_cycle - 1)
    poses, zero = smoother.variables.poses_at(cycles), np.zeros((k, POINT))
    expected = landmark_residuals(poses, state.landmarks[landmarks], zero)
    if smoother.last_step is None or k == 0:
        return expected.residual, np.zeros((k, POINT, POINT))
    columns = len(smoother.variables.sensor)
    sensor = by_sensor(expected.residual, np.tile(smoother.map.twist, (k, 1)))[:, :, :columns]
    jacobian = np.concatenate([expected.by_pose, -sensor, expected.by_landmark], axis=2)
    rows = two_rows(cycles, state.numbers[landmarks], jacobian, zero)
    return expected.residual, smoother.predicted_covariance(rows, together=POINT)


def associate_created(
    points: Array, cycles: IntArray, landmarks: Array, settings: GrowthSettings
) -> tuple[IntArray, IntArray]:
    """Return the rows of detections (m, 2) that belong to new landmarks (k, 2), and the landmark of each.

    A detection belongs to the nearest landmark within the merge radius, if it is the nearest of its cycle.
    """
    if len(points) == 0 or len(landmarks) == 0:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    nearest, near = nearest_within(points, landmarks, settings.merge_radius)
    rows = np.argsort(np.hypot(*(points - landmarks[nearest]).T), kind="stable")
    rows = rows[near[rows]]
    _, first = np.unique(np.column_stack([cycles[rows], nearest[rows]]), axis=0, return_index=True)
    chosen = rows[first]
    return chosen, nearest[chosen]


def find_duplicates(
    state: LandmarkState, known: int, covariance: Callable[[IntArray], Array], settings: MapperSettings
) -> tuple[IntArray, IntArray]:
    """Find duplicates: the positions (k,) of landmarks, and of older landmarks of the same cone.

    Of the pairs of one label in the merge radius and the match gate, the nearest ones are taken, each
    landmark once.
    """
    points, labels = state.landmarks[:known], state.labels[:known]
    distance = np.hypot(*np.moveaxis(points[:, None] - points[None], 2, 0))
    near = (distance < settings.growth.merge_radius) & (labels[:, None] == labels[None])
    newer, older = np.nonzero(np.tril(near, -1))
    involved, index = np.unique(np.concatenate([newer, older]), return_inverse=True)
    if len(involved) == 0:
        return newer, older
    spread = difference_covariances(covariance(state.keys[involved]), *index.reshape(2, -1))
    squared = squared_mahalanobis(points[newer] - points[older], spread)
    taken, chosen = set[int](), list[int]()
    for row in np.argsort(squared)[: int((squared < MATCH_GATE).sum())].tolist():
        pair = {int(newer[row]), int(older[row])}
        if taken.isdisjoint(pair):
            taken |= pair
            chosen.append(row)
    return newer[chosen], older[chosen]


def difference_covariances(joint: Array, i: IntArray, j: IntArray) -> Array:
    """Covariances (..., 2, 2) of the differences of points i and j (...,), plus that of `SIGMA_MERGE`."""
    blocks = joint.reshape(len(joint) // POINT, POINT, -1, POINT)
    spread = blocks[i, :, i] + blocks[j, :, j] - blocks[i, :, j] - blocks[j, :, i]
    return np.asarray(spread + SIGMA_MERGE**2 * np.eye(POINT))


def merge(smoother: LandmarkSmoother, gone: IntArray, kept: IntArray) -> None:
    """Merge the landmarks at positions `gone` (k,) into those at `kept` (k,), and take one step."""
    keys = smoother.map.state.keys
    merge_points(smoother, keys[gone], keys[kept])
    smoother.map.merge(gone, kept)
    smoother.step()


# --- base of the online baselines: the mapper's front end -----------------------------------------------

FRONT_END: Final = ("closing", "gate", "growth", "motion", "noise", "sides", "spline")
"""Settings of the front end and of the growth of landmarks."""


class OnlineBaseline:
    """Online estimator; a subclass maps the readings of the front end.

    `odometry_sigma` (3,) is the standard deviation of a twist reading (m/s, m/s, rad/s).
    """

    def __init__(
        self, settings: MapperSettings | None = None, odometry_sigma: Array | KnownNoise | None = None
    ) -> None:
        self.settings = known_settings(settings)
        self.front_end = FrontEnd(self.settings, known_noise(odometry_sigma))
        self._begin()

    @abstractmethod
    def _begin(self) -> None:
        """Initialize the subclass."""

    def update(self, odometry: Odometry, detections: Detections) -> CycleResult:
        watch = Stopwatch()
        cycle = self.front_end.admit(odometry, detections)
        reading = self.front_end.update(cycle.odometry, cycle.detections)
        return cycle.counted(self._process(reading, watch))

    @abstractmethod
    def _process(self, reading: Reading, watch: Stopwatch) -> CycleResult:
        """Map a cycle."""

    @abstractmethod
    def map(self, with_covariance: bool = True) -> Map:
        """Return a copy of the map."""

    def outline(self) -> Map:
        return self.map(with_covariance=False)

    def noise_used(self) -> RunNoise:
        return self.front_end.noise_used
