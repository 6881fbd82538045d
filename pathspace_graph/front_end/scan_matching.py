"""Scan matching: the detections of a cycle are laid on those of the cycles just before.

No cone needs an identity: each detection is drawn to the weighted mean of the earlier ones beside it, and the
weights sharpen from iteration to iteration (EM-ICP; Granger and Pennec 2002).

Matches also tell how much the sensor is turned, and how late it is. One turned by psi sees each motion turned
by -psi. Detections that are late by tau lie too far ahead by `tau v`, which changes of the velocity show.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Self

import numpy as np
from scipy.spatial import KDTree

from pathspace_graph.copies import shallow
from pathspace_graph.factors import _kernels as kernels
from pathspace_graph.factors.arrays import Array, BoolArray
from pathspace_graph.factors.odometry import IntegratedOdometry
from pathspace_graph.factors.se2 import left_of, rotation, to_map
from pathspace_graph.factors.sensor import SENSOR
from pathspace_graph.io.log import Detections
from pathspace_graph.settings.online import CalibrationSettings, MotionSettings

from .line_matching import HEADING_TOLD, Limits, LineMatch, Seen

LEARNED_ERRORS: Final = [SENSOR.index("yaw"), SENSOR.index("latency")]  # errors that are learned
SIGMAS_ERRORS: Final = (0.02, 0.05)  # rad and s, first: those of a hasty mounting
SIGMAS_CHANGES: Final = (0.001, 0.005)  # their change in a minute, rad and s
MINUTE: Final = 60.0

SCAN_MEMORY: Final = 0.65  # age of remembered detections, s, over which odometry hardly drifts
MOST_REMEMBERED: Final = 2000  # largest number of remembered detections, which bounds the time of a match
LINE_REMEMBERED: Final = (
    40  # largest number of points of lines of a cycle that are: some cycles fill the gaps
)
REACH_FIRST: Final = 1.0
REACH_LAST: Final = 0.4
"""Reach of the first and the last iteration, m: the weight at distance d is `exp(-d^2 / 2 reach^2)`."""
MATCH_STEPS: Final = 6
REACHES: Final = [
    REACH_FIRST * ((REACH_LAST / REACH_FIRST) ** (1.0 / (MATCH_STEPS - 1))) ** k for k in range(MATCH_STEPS)
]
REACHES_CHECK: Final = (REACH_FIRST, REACH_LAST)  # of the check, which begins near the solution
FARTHEST: Final = 3.0  # distance in reaches from which on a remembered detection has no weight
MIN_WEIGHT: Final = 0.7  # least sum of weights of a matched detection
MIN_MATCHED: Final = 3  # least number of matched detections that tell a motion
SCAN_HUBER: Final = 2.5  # whitened distance beyond which Huber's loss reduces a detection's weight
SIGMA_CONE: Final = 0.05  # added to a detection's, m, since one side of a cone is seen
LEAST_SHARE: Final = 1e-6  # least det of a pose's information by the product of its diagonal
MOST_MISFIT: Final = 9.0  # largest whitened square in a misfit that is compared with another
MIN_DOUBTING: Final = 4  # least number of matched detections of a contradiction
LARGE_MISFIT: Final = 1.5  # mean-square misfit beyond which its excess scales the detections' covariances
MISFIT_GAIN: Final = 0.02  # smoothing gain of the mean-square misfit
MAX_MISFIT: Final = 3.0  # largest misfit of a motion: 1 where the vehicle moved, 4 where it was put down
MISFIT_ODOMETRY: Final = 2.0  # least misfit at the odometry's own pose in a contradiction
MISFIT_RATIO: Final = 1.3  # least ratio of that misfit to the one of the match


_TINY: Final = float(np.finfo(float).tiny)


class RecentDetections:
    """Detections of the newest cycles in one frame."""

    def __init__(self) -> None:
        self.points: Array = np.zeros((0, 2))  # (n, 2) place of each detection, m
        # a row is [stamp | point as measured | place of the vehicle | derivatives of x | derivatives of y]
        self._table: Array = np.zeros((0, 5 + 2 * len(LEARNED_ERRORS)))

    def copy(self) -> Self:
        """Return a copy that goes on independently: no attribute is changed in place."""
        return shallow(self)

    def add(self, t: float, measured: Array, columns: Array, pose: Array) -> None:
        """Add detections (m, 2) at t (s) from a pose (3,), and their derivatives (m, 2, e) by errors."""
        new = np.empty((len(measured), self._table.shape[1]))
        new[:, 0], new[:, 1:3], new[:, 3:5] = t, to_map(measured, pose[None]), pose[:2]
        new[:, 5:] = (rotation(pose[2]) @ columns).reshape(len(measured), new.shape[1] - 5)
        self._table = np.concatenate([self._table, new])[-MOST_REMEMBERED:]
        self.points = self._table[:, 1:3]

    def correct(self, errors: Array) -> None:
        """Put the detections where they are if the sensor has these errors (e,)."""
        columns = self._table[:, 5:].reshape(len(self._table), 2, len(errors))
        self.points = self._table[:, 1:3] + columns @ errors

    def forget(self, t: float) -> None:
        first = int(self._table[:, 0].searchsorted(t - SCAN_MEMORY, side="right"))
        self._table = self._table[first:]
        self.points = self._table[:, 1:3]

    @property
    def seen_from(self) -> Array:
        """Mean place (2,) from which the detections were seen."""
        return np.asarray(self._table[:, 3:5].sum(axis=0) / len(self._table))

    def has(self, points: Array) -> BoolArray:
        """Return whether each point (m, 2) lies where an earlier detection does."""
        return np.asarray(kernels.weighted_means(points, self.points, REACH_LAST, FARTHEST)[1] > MIN_WEIGHT)


@dataclass(frozen=True, eq=False)
class Match:
    """Pose that lays detections on earlier ones."""

    pose: Array  # (3,) in the frame of the earlier detections, m, m and rad
    information: Array  # (3, 3) information about the pose from the matched detections, same frame
    is_matched: BoolArray  # (m,) whether each detection lies on earlier ones
    misfit: float  # mean square of the matched detections' whitened distances
    by_lines: bool = False  # whether lines are among them, which tell nothing along themselves

    @property
    def matched(self) -> int:
        return int(self.is_matched.sum())

    @property
    def is_certain(self) -> bool:
        """Whether the detections hold the pose in every direction."""
        if self.by_lines:
            return bool(np.linalg.inv(self.information)[2, 2] < HEADING_TOLD**2)
        (w, _, a), (_, _, b), (_, _, turning) = self.information.tolist()  # of x and y: w times the identity
        return bool(w * (w * turning - a * a - b * b) / max(w * w * turning, _TINY) > LEAST_SHARE)


def match(
    recent: RecentDetections, points_vehicle: Array, variances: Array, start: Array, reaches: Sequence[float]
) -> Match:
    """Lay detections (m, 2), vehicle frame, on the recent ones by Gauss-Newton steps from a pose (3,).

    Each step, one for each of the reaches (m), minimizes `sum_i |R z_i + t - m_i|^2 / sigma_i^2`, m_i being
    the weighted mean of the recent detections beside the point, and `sigma_i^2 = variance_i (1 + 1/n_i) +
    SIGMA_CONE^2` with n_i the sum of the weights. The variances (m,) are those of one coordinate (m^2).
    """
    limits = (FARTHEST, MIN_WEIGHT, SCAN_HUBER, SIGMA_CONE, MIN_MATCHED, LEAST_SHARE)
    pose, information, matched, cost = kernels.matched(
        recent.points, points_vehicle, variances, start, reaches, limits
    )
    return Match(pose, information, matched, cost / max(int(matched.sum()), 1))


def misfit_at(recent: RecentDetections, points_vehicle: Array, variances: Array, pose: Array) -> float:
    """Return the mean square of the whitened distances as `match` has them, at a pose (3,) that is given."""
    points = to_map(points_vehicle, pose[None])
    means, weights = kernels.weighted_means(points, recent.points, REACH_LAST, FARTHEST)
    matched = weights > MIN_WEIGHT
    variance = variances * (1.0 + 1.0 / np.where(matched, weights, 1.0)) + SIGMA_CONE**2
    square = np.where(matched, ((points - means) ** 2).sum(axis=1) / variance, MOST_MISFIT)
    return float(np.minimum(square, MOST_MISFIT).mean()) if len(square) else 0.0


MATCH_LIMITS: Final = Limits(FARTHEST, MIN_WEIGHT, SCAN_HUBER, SIGMA_CONE, MIN_MATCHED)


# --- errors of the sensor --------------------------------------------------------------------------------


def by_errors(points_vehicle: Array, twist: Array) -> Array:
    """Return the derivatives (m, 2, 2) of detections (m, 2), vehicle frame, by the yaw and by the latency."""
    columns = np.empty((len(points_vehicle), 2, len(LEARNED_ERRORS)))
    columns[:, :, 0] = left_of(points_vehicle)
    columns[:, :, 1] = -twist[:2] - twist[2] * columns[:, :, 0]
    return columns


@dataclass(frozen=True, eq=False)
class Difference:
    """Distance of a match of detections from the odometry, in the vehicle frame."""

    off: Array  # (3,) m, m and rad
    covariance: Array  # (3, 3) its covariance, for a sensor without errors
    shifts: Array  # (3, 2) its derivatives by the errors of the sensor


class SensorErrors:
    """Kalman filter of the errors e = (yaw, latency) of the sensor, in rad and s.

    Detections are corrected by the mean. What is left shifts a match, in the vehicle frame, by `(d_y, -d_x,
    0)` (yaw) and `mean v - v` (latency). d is the way from the mean place from which the remembered
    detections were seen, v the velocity, and mean v that while they were seen.
    """

    def __init__(self, settings: MotionSettings) -> None:
        self.mean: Array = np.zeros(len(LEARNED_ERRORS))  # (2,) yaw (rad, to the left) and latency (s)
        self.covariance: Array = np.diag(np.square(SIGMAS_ERRORS))  # (2, 2) their covariance
        self._drift: Array = np.diag(np.square(SIGMAS_CHANGES)) / MINUTE
        self._velocity: Array = np.zeros(3)
        self._possible: Array = 0.5 * SCAN_MEMORY * np.array(settings.accelerations)

    def copy(self) -> Self:
        """Return a copy that goes on independently: no attribute is changed in place."""
        return shallow(self)

    def contradict(self, settings: CalibrationSettings) -> bool:
        """Return whether the errors contradict the sensor's prior, by `settings.doubt` sigmas."""
        if not settings.sensor:
            return False
        limit, prior = settings.doubt**2, (settings.sigma_yaw, settings.sigma_latency)
        known = zip(self.mean.tolist(), self.covariance.diagonal().tolist(), prior, strict=True)
        return any(mean**2 > limit * (variance + sigma**2) for mean, variance, sigma in known)

    def found(self, settings: CalibrationSettings) -> CalibrationSettings:
        """Return wide priors of the sensor about the yaw and the latency that matches show.

        About zero they leave most of a yaw of some degrees to the bias of the yaw rate, which bends the map.
        The first matches find about half of a large yaw (`SIGMAS_ERRORS`), so its sigma is as large.
        """
        (yaw, latency), wide = self.mean.tolist(), settings.widened()
        return replace(wide, yaw=yaw, latency=latency, sigma_yaw=max(wide.sigma_yaw, abs(yaw)))

    def follow(self, velocity: Array, dt: float) -> None:
        """Take the velocity (3,) of a cycle, which lasted for dt (s), over into the mean velocity."""
        share = min(dt / (0.5 * SCAN_MEMORY), 1.0)
        self._velocity = self._velocity + share * (velocity - self._velocity)

    def covariance_of(self, difference: Difference) -> Array:
        shifts = difference.shifts
        return np.asarray(difference.covariance + shifts @ self.covariance @ shifts.T)

    def square_of(self, difference: Difference) -> float:
        return kernels.squared(difference.off, difference.covariance, difference.shifts, self.covariance)

    def shifts(self, way: Array, velocity: Array) -> Array:
        """Return the derivatives (3, 2) of how far a match is off the odometry, by the errors.

        Way (2,) and velocity (3,) are in the vehicle frame; changes that no vehicle makes are slip.
        """
        off = np.minimum(np.maximum(self._velocity - velocity, -self._possible), self._possible)
        (ahead, left), (x, y, turn) = way.tolist(), off.tolist()
        return np.array([[left, x], [-ahead, y], [0.0, turn]])

    def update(self, difference: Difference, dt: float) -> None:
        """Learn from a match that agrees, dt (s) after the last; it counts by its share of memory."""
        measured = difference.off, difference.covariance, difference.shifts, min(dt / SCAN_MEMORY, 1.0)
        self.mean, self.covariance = kernels.learned(self.mean, self.covariance, dt * self._drift, *measured)


# --- matches of each cycle -------------------------------------------------------------------------------


class ScanMatcher:
    """Matches of each cycle with the newest ones, and what they show of the sensor and its noise."""

    def __init__(self, settings: MotionSettings) -> None:
        self._settings = settings
        self._misfit = 1.0  # mean of those of the matches that agreed, the newest counting most
        self.forget()

    def copy(self) -> Self:
        """Return a copy that goes on independently."""
        other = shallow(self)
        other.recent, other.recent_lines = self.recent.copy(), self.recent_lines.copy()
        other.errors = self.errors.copy()
        return other

    def forget(self) -> None:
        """Forget the newest cycles, and what was learned of the sensor."""
        self.recent, self.errors = RecentDetections(), SensorErrors(self._settings)
        self.recent_lines = RecentDetections()

    @property
    def excess(self) -> float:
        """Factor by which the variance of detections is larger than they claim; at least 1."""
        return max(self._misfit / LARGE_MISFIT, 1.0)

    def corrected(self, detections: Detections, twist: Array, is_line: BoolArray) -> Seen:
        """Return a cycle's detections by the errors of the sensor, and correct the remembered ones."""
        measured, covariances = detections.points_vehicle, detections.covariances
        for recent in (self.recent, self.recent_lines):
            if len(recent.points):
                recent.forget(detections.t)
                recent.correct(self.errors.mean)
        points = measured + by_errors(measured, twist) @ self.errors.mean
        return Seen(points, 0.5 * (covariances[:, 0, 0] + covariances[:, 1, 1]), is_line)

    def remember(self, detections: Detections, twist: Array, pose: Array, is_line: BoolArray) -> None:
        """Remember a cycle that was seen from a pose (3,), in motion by a twist (3,)."""
        measured = detections.points_vehicle
        columns, lines = by_errors(measured, twist), np.flatnonzero(is_line)
        lines = lines[:: max(-(-len(lines) // LINE_REMEMBERED), 1)]
        for recent, rows in ((self.recent, np.flatnonzero(~is_line)), (self.recent_lines, lines)):
            if len(rows):
                recent.add(detections.t, measured[rows], columns[rows], pose)

    def has(self, seen: Seen, pose: Array) -> BoolArray:
        """Return whether each detection (m,), from a pose (3,), lies where an earlier one does."""
        placed, again = to_map(seen.points, pose[None]), np.zeros(len(seen.points), bool)
        again[~seen.is_line] = self.recent.has(placed[~seen.is_line])
        lines = self.recent_lines.points
        if len(lines) and seen.is_line.any():
            again[seen.is_line] = KDTree(lines).query(placed[seen.is_line])[0] < REACH_FIRST
        return again

    def match(self, seen: Seen, start: Array, reaches: Sequence[float]) -> Match | None:
        """Return the match of detections from a pose (3,), unless it leaves the pose open."""
        if seen.is_line.any():
            pose, information, chosen, square = self._beside(seen).found(start, reaches)
            misfit = square / max(int(chosen.sum()), 1)
            matched = Match(pose, information, chosen, misfit, by_lines=True)
        else:
            matched = match(self.recent, seen.points, seen.variances, start, reaches)
        return matched if matched.matched >= MIN_MATCHED and matched.is_certain else None

    def difference(self, matched: Match, odometry: IntegratedOdometry, predicted: Array) -> Difference:
        """Return how far a match is from the pose (3,) that odometry predicts, in the vehicle's frame."""
        known = matched.pose, matched.information, self.excess, predicted, odometry.covariance
        recent = self.recent_lines if matched.by_lines else self.recent
        way = rotation(predicted[2]).T @ (predicted[:2] - recent.seen_from)
        return Difference(*kernels.off_prediction(*known), self.errors.shifts(way, odometry.twist))

    def denies(self, matched: Match, difference: Difference, limit: float) -> bool:
        """Return whether a match is more than `limit` sigmas off the odometry."""
        return matched.matched >= MIN_DOUBTING and self.errors.square_of(difference) > limit**2

    def agree(self, matched: Match, difference: Difference, dt: float) -> None:
        """Learn from a match that agrees with the odometry, dt (s) after the cycle before."""
        self._misfit += MISFIT_GAIN * (matched.misfit - self._misfit)
        self.errors.update(difference, dt)

    def fits(self, matched: Match) -> bool:
        """Return whether the misfit of a match is that of a motion."""
        return matched.misfit < MAX_MISFIT * self.excess

    def fits_better(self, matched: Match, predicted: Array, seen: Seen) -> bool:
        """Return whether detections fit badly at the predicted pose (3,), and clearly better at the match."""
        chosen = seen.where(matched.is_matched)
        poses = predicted, matched.pose
        at_odometry, at_match = (
            [self._misfit_with_lines(chosen, pose) for pose in poses]
            if matched.by_lines
            else [misfit_at(self.recent, chosen.points, chosen.variances, pose) for pose in poses]
        )
        return at_odometry > max(MISFIT_ODOMETRY, MISFIT_RATIO * at_match)

    def _misfit_with_lines(self, seen: Seen, pose: Array) -> float:
        """Mean square of the whitened distances at a pose (3,), as `misfit_at` has it for cones."""
        square, matched = self._beside(seen).squares(pose, REACH_LAST)
        square = np.where(matched, square, MOST_MISFIT)
        return float(np.minimum(square, MOST_MISFIT).mean()) if len(square) else 0.0

    def _beside(self, seen: Seen) -> LineMatch:
        return LineMatch(self.recent.points, self.recent_lines.points, seen, MATCH_LIMITS)
