"""Registration of detections with a stretch of the curves, for loop closure and relocalization."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import hypot, sqrt
from typing import Final, Self

import numpy as np

from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.se2 import path_lengths, rotation, to_vehicle, wrap_angle
from pathspace_graph.settings.online import ClosingSettings

from .curve_map import CurveMap
from .path import DrivenPath
from .state import Curves, State

HEADING: Final = 0.8  # largest angle between the headings of two passes of one place (rad)
START_LATERAL: Final = 5.0  # largest distance from the start at which its line is crossed to close a loop (m)
START_HEADING: Final = 0.5  # largest angle between the heading at the start and that crossing (rad)
REGISTERED_AGE: Final = 2.0  # largest age of registered detections (s)
BEGINNING: Final = 60.0  # length of the curves that counts as their beginning (m)
BEGINNING_SHARE: Final = 0.6  # largest share of a short curve that counts as its beginning
REGISTERED_REACH: Final = 3.0  # largest distance from the curves in the first iteration (m)
REGISTERED_SHRINK: Final = 0.7  # factor for each further iteration, down to `closing.inlier_distance`
REGISTERED_ITERATIONS: Final = 7
START_STEP: Final = 2.0  # distance of the poses of the beginning at which a place is tried (m)
START_CHI2: Final = 16.3  # largest squared Mahalanobis distance of these: 99.9 % of chi-square, 3 degrees
RIVAL_APART: Final = 1.5  # least distance of two different places (m); gaps between cones are larger
REGISTERED_DETECTIONS: Final = 25  # least number of registered detections
MIN_INLIERS: Final = 5  # least number of inliers on each boundary


@dataclass(frozen=True, eq=False)
class Motion:
    """A rigid correction of the newest poses and their detections."""

    centre: Array  # (2,) centre of the rotation, the newest position, in m, map frame
    vector: Array  # (3,) translation (x, y) in m after the rotation by the third entry (rad)

    def apply(self, points: Array) -> Array:
        """Move points (m, 2)."""
        c, s = np.cos(self.vector[2]), np.sin(self.vector[2])
        turned = (points - self.centre) @ np.array([[c, s], [-s, c]])
        return np.asarray(turned + self.centre + self.vector[:2])

    def move(self, poses: Array) -> None:
        """Move poses (m, 3) in place."""
        poses[:, :2] = self.apply(poses[:, :2])
        poses[:, 2] += self.vector[2]


@dataclass(frozen=True, eq=False)
class Sightings:
    """Coloured detections at the present estimate of the poses."""

    rows: IntArray  # (m,) rows of the detections in their table
    labels: IntArray
    points: Array  # (m, 2) positions in m, map frame
    covariances: Array  # (m, 2, 2) covariances in m^2, map frame
    explained: BoolArray  # (m,) whether the newest curves explain it, so that it may contradict a place

    @classmethod
    def of_points(cls, rows: IntArray, labels: IntArray, points: Array) -> Self:
        """Build sightings of equal weight, with no covariance of their own."""
        return cls(rows, labels, points, np.zeros((len(rows), 2, 2)), np.ones(len(rows), bool))


@dataclass(frozen=True, eq=False)
class Matches:
    """Detections with foot points inside a stretch of their curve, for one motion."""

    rows: IntArray  # (m,) rows of the detections in their table
    labels: IntArray
    u: Array  # (m,) parameters of the foot points (m)
    inlier: BoolArray  # (m,) whether the detection is within `inlier_distance` of the curve
    explained: BoolArray  # (m,) whether the newest curves explain the detection
    hessian: Array  # (3, 3) information of the motion, from the detections within reach
    negative_gradient: Array  # (3,) negative gradient of the cost by the motion, from the same detections

    def inliers(self, label: int) -> tuple[IntArray, Array]:
        """Return the rows (k,) and the parameters (k,) of one boundary's inliers."""
        chosen = self.inlier & (self.labels == label)
        return self.rows[chosen], self.u[chosen]


@dataclass(frozen=True, eq=False)
class RefinedMotion:
    """Result of the registration."""

    motion: Motion  # of the detections onto their curves
    matches: Matches
    covariance: Array  # (3, 3) covariance of the motion (m, m, rad)


@dataclass(frozen=True, eq=False)
class Registration:
    """Detections, and the stretch (low, high) of each curve, by label, to register them with."""

    state: State
    seen: Sightings
    stretches: Mapping[int, tuple[float, float]]
    settings: ClosingSettings

    @cached_property
    def curves(self) -> Curves:
        return self.state.whole_curves

    def refine(self, start: Motion, mean: Array, information: Array) -> RefinedMotion:
        """Refine a motion by iterated closest points; its prior has a mean (3,) and information (3, 3)."""
        vector = start.vector
        for iteration in range(REGISTERED_ITERATIONS):
            reach = max(self.settings.inlier_distance, REGISTERED_REACH * REGISTERED_SHRINK**iteration)
            matches = self.match(Motion(start.centre, vector), reach)
            negative_gradient = matches.negative_gradient - information @ (vector - mean)
            vector = vector + np.linalg.solve(matches.hessian + information, negative_gradient)
        covariance = np.asarray(np.linalg.inv(matches.hessian + information), np.float64)
        return RefinedMotion(Motion(start.centre, vector), matches, covariance)

    def match(self, motion: Motion, reach: float) -> Matches:
        """Match moved detections with their stretches, and linearize those within `reach` (m)."""
        seen, curves = self.seen, self.curves
        moved, curve = motion.apply(seen.points), curves.labels.searchsorted(seen.labels)
        low, high = np.array([self.stretches[label] for label in curves.labels.tolist()])[curve].T
        foot = curves.find(self.state.map_points, moved, curve, low, high)
        inside, used = foot.interior, foot.interior & (np.abs(foot.distance) < reach)
        n, arm = foot.normal_unit[used], moved[used] - motion.centre - motion.vector[:2]
        variance = np.einsum("mi,mij,mj->m", n, seen.covariances[used], n) + self.settings.sigma_reading**2
        jacobian = by_motion(n, arm) / np.sqrt(variance)[:, None]
        return Matches(
            seen.rows[inside],
            seen.labels[inside],
            foot.u[inside],
            np.abs(foot.distance[inside]) < self.settings.inlier_distance,
            seen.explained[inside],
            jacobian.T @ jacobian,
            -jacobian.T @ (foot.distance[used] / np.sqrt(variance)),
        )


def near_start(path: DrivenPath, pose: Array, settings: ClosingSettings) -> bool:
    """Whether a pose (3,) may be on the beginning again: after a long path, near it, and in its direction."""
    if path.length < settings.min_path:
        return False
    away = np.hypot(*(path.beginning[:, :2] - pose[:2]).T)
    same_direction = np.cos(path.beginning[:, 2] - pose[2]) > np.cos(HEADING)
    return bool((same_direction & (away < settings.radius_after(path.length))).any())


def passes_start(state: State, path: DrivenPath, motion: Motion) -> bool:
    """Whether the newest path, moved, crosses the start line on its road.

    In each round of a skidpad the vehicle is on its beginning again, but has not closed a lap.
    """
    start, turn = path.beginning[0, :2], rotation(path.beginning[0, 2])
    newest = motion.apply(path.points[path.stations > path.length - BEGINNING])
    crosses, left = start_crossings(newest, path.beginning[0])
    for label, boundary in state.boundaries.items():
        u = np.arange(0.0, min(BEGINNING, boundary.confirmed_end), boundary.settings.search_step)
        curve = boundary.evaluate(state.control_points(label), u) - start
        _, beside = curve[np.hypot(*curve.T).argmin()] @ turn
        crosses &= (left - beside) * beside < 0.0  # on the start's side of the boundary
    return bool(crosses.any())


def start_crossings(path: Array, start: Array) -> tuple[BoolArray, Array]:
    """Return whether steps (n - 1,) of a path (n, 2) cross the line of a start (3,), and the ends' offsets.

    A crossing is in the direction of the start. Offsets (n - 1,) are in m, positive to its left.
    """
    ahead, left = to_vehicle(path, start[None]).T
    steps, forward = np.hypot(np.diff(ahead), np.diff(left)), np.diff(ahead)
    crosses = (ahead[:-1] <= 0.0) & (ahead[1:] > 0.0) & (np.abs(left[1:]) < START_LATERAL)
    return crosses & (forward > np.cos(START_HEADING) * steps), left[1:]


def register(
    track: CurveMap, times: Sequence[float], covariance: Array, beginning: Array, settings: ClosingSettings
) -> RefinedMotion | None:
    """Register the newest detections with the beginning of the curves; None if they disagree or fit twice.

    Iterated closest points on the curves minimize `sum (n . (M p - S(u)))^2 / sigma^2 + m' P^-1 m`. The
    `covariance` P (3, 3) of the newest pose is the prior, since detections along a straight or an arc do not
    determine the motion. If P exceeds the range of convergence, the iteration starts at the best pose of the
    `beginning` (k, 3) of the drive. `times` are the stamps of the poses (s).
    """
    registration, state = _with_beginning(track, times, settings), track.state
    prior = np.asarray(np.linalg.inv(covariance * settings.prior_scale**2), np.float64)
    centre, vector, lost = state.poses[-1, :2].copy(), np.zeros(3), is_lost(covariance, settings)
    _, first = np.unique(path_lengths(beginning) // START_STEP, return_index=True)
    starts = beginning[first] - state.poses[-1]
    starts[:, 2] = wrap_angle(starts[:, 2])
    if lost:
        likely = [vector, *starts[are_possible(starts, prior)]]
        inliers = [registration.match(Motion(centre, v), REGISTERED_REACH).inlier.sum() for v in likely]
        vector = likely[int(np.argmax(inliers))]
    found = registration.refine(Motion(centre, vector), np.zeros(3), prior)
    if not agrees(found.matches, list(state.boundaries), settings):
        return None
    if not is_certain(found.matches, found.covariance, settings, lost):
        return None
    return None if _has_rival(registration, found, starts, prior) else found


def _has_rival(registration: Registration, found: RefinedMotion, starts: Array, prior: Array) -> bool:
    """Whether detections also agree with another place, refined from starts (k, 3) near the found one.

    Cones at regular distances along a straight lie as well on the curves if they are moved by a gap. The
    covariance of one optimum does not know of others.
    """
    motion, labels = found.motion, list(registration.state.boundaries)
    for start in starts[are_possible(starts - motion.vector, prior)]:
        other = registration.refine(Motion(motion.centre, start), np.zeros(3), prior)
        apart = np.hypot(*(other.motion.vector - motion.vector)[:2])
        if apart > RIVAL_APART and agrees(other.matches, labels, registration.settings):
            return True
    return False


def are_possible(motions: Array, information: Array) -> BoolArray:
    """Whether a prior with mean zero and information (3, 3) allows the motions (k, 3)."""
    return np.asarray(np.einsum("ki,ij,kj->k", motions, information, motions) < START_CHI2)


def is_within_reach(track: CurveMap, times: Sequence[float], settings: ClosingSettings) -> bool:
    """Whether the newest detections reach the beginning; otherwise only a lost vehicle can register."""
    unmoved = Motion(track.state.poses[-1, :2], np.zeros(3))
    return bool(_with_beginning(track, times, settings).match(unmoved, REGISTERED_REACH).hessian.any())


def is_lost(covariance: Array, settings: ClosingSettings) -> bool:
    """Whether a pose with this covariance (3, 3) exceeds the registration's range of convergence."""
    prior = np.linalg.inv(covariance * settings.prior_scale**2)
    return bool(np.linalg.eigvalsh(prior[:2, :2])[0] < REGISTERED_REACH**-2)


def _with_beginning(track: CurveMap, times: Sequence[float], settings: ClosingSettings) -> Registration:
    """Set up the registration of the newest coloured detections with the beginning of the curves."""
    detections, variables, stamps = track.detections, track.variables, np.asarray(times)
    rows = np.flatnonzero(stamps[detections.cycle - variables.first_cycle] > stamps[-1] - REGISTERED_AGE)
    rows = rows[np.isin(detections.label[rows], list(track.state.boundaries))]
    points, covariances = detections.points_map(rows, variables), detections.covariances_map(rows, variables)
    recent = Sightings(rows, detections.label[rows], points, covariances, detections.used[rows])
    stretches = {
        label: (0.0, min(BEGINNING, BEGINNING_SHARE * boundary.confirmed_end))
        for label, boundary in track.state.boundaries.items()
    }
    return Registration(track.state, recent, stretches, settings)


def by_motion(normals: Array, arms: Array) -> Array:
    """Derivatives (m, 3) of distances across curves by a motion about the arms' origin.

    The normals (m, 2) are unit vectors, and the arms (m, 2) lead to the points (m), both in the map frame.
    """
    turning = normals[:, 1] * arms[:, 0] - normals[:, 0] * arms[:, 1]
    return np.column_stack([normals, turning])


def worst_sigma(covariance: Array) -> float:
    """Standard deviation (m) of a position in its worst direction, by covariance (3, 3)."""
    (a, b), (_, d) = covariance[:2, :2].tolist()
    return sqrt(0.5 * (a + d) + hypot(0.5 * (a - d), b))


def agrees(matches: Matches, labels: list[int], settings: ClosingSettings) -> bool:
    """Whether nearly all of enough detections are inliers, on a long stretch of every boundary.

    Outliers count only if the newest curves explain them: others are clutter, or of unmapped road.
    """
    asked = matches.explained
    count, inliers = int(asked.sum()), int(matches.inlier[asked].sum())
    if count < REGISTERED_DETECTIONS or inliers < settings.inlier_share * count:
        return False
    on_each = [matches.inliers(label)[1] for label in labels]
    return all(len(u) >= MIN_INLIERS and np.ptp(u) >= settings.overlap for u in on_each)


def is_certain(matches: Matches, posterior: Array, settings: ClosingSettings, lost: bool = False) -> bool:
    """Whether the motion is certain in every direction.

    The limit is wider after a long stretch of the beginning was driven again, since more detections would add
    little. It stays for a `lost` vehicle, because any place along a straight agrees equally well.
    """
    sigma = worst_sigma(posterior)
    driven_again = float(np.median(matches.u[matches.inlier]))
    patient = driven_again >= settings.patience and not lost
    return sigma <= (settings.sigma_patience if patient else settings.sigma_max)
