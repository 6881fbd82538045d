"""Scan matching: register the detections of a cycle to those of the previous cycles.

Cones need no identity: each detection is registered to the weighted mean of nearby earlier ones, and the
weights sharpen with each iteration (EM-ICP; Granger and Pennec 2002).

Matches also reveal yaw and latency of the sensor. A sensor turned by psi observes each motion turned by -psi.
Detections with a latency tau lie `tau v` too far ahead, which is observable when the velocity changes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
from scipy.spatial import KDTree

from pathspace_graph.copies import Copyable
from pathspace_graph.factors import _kernels as kernels
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.noise import huber_weights
from pathspace_graph.factors.odometry import IntegratedOdometry
from pathspace_graph.factors.se2 import left_of, rotation, to_map
from pathspace_graph.factors.sensor import SENSOR
from pathspace_graph.io.log import Detections
from pathspace_graph.settings.online import CalibrationSettings, MotionSettings

# --- points of lines -------------------------------------------------------------------------------------


MOST_DOUBLINGS: Final = 1 << 6  # of the side of a cell
MOST_CELLS: Final = 1 << 20  # in a row of cells, which is more than any sensor sees
MERGE_CELL: Final = 1.0  # side of the cells (m) in which points are merged: 5 mm beside an arc of 9 m
MERGE_RANGE: Final = 12.0
"""Range (m) beyond which the side doubles, and doubles again at each double of it.

Noise grows with the range, so a sensor that sees three times as far needs hardly more points."""
LINE_REACH: Final = 1.5  # reach of a line by that of a cone: its points are spread over the gap of points
LEAST_POINTS: Final = 2.0  # least sum of weights of the points that tell a line
LEAST_SPREAD: Final = 0.3  # least standard deviation of these along the line, by the reach
LEAST_SHAPE: Final = 4.0  # least ratio of their variances along and across it: others are no line
LEAST_INSIDE: Final = 0.5  # most distance along the line from the mean of its points, by the reach
LINE_HELD: Final = np.array([0.1, 10.0, 1.0]) ** 2
"""Variances (m^2, m^2, rad^2) about the start, vehicle frame: the way along the lines is not searched for."""
LINES_ALIKE: Final = np.array([1.0, 0.03, 0.003]) ** 2
"""Variances (m^2, m^2, rad^2) of errors that all points of a match share, vehicle frame: nothing is known
along the lines, and they are taken for straight."""
HEADING_TOLD: Final = 0.05  # standard deviation of the heading (rad) up to which lines hold the pose


def merged(line: Detections) -> Detections:
    """Return the means of the points of lines that share label and cell."""
    doublings = np.maximum(np.frexp(np.hypot(*line.points_vehicle.T) / MERGE_RANGE)[1], 0)
    side = np.ldexp(MERGE_CELL, doublings)
    column, row = np.floor(line.points_vehicle.T / side).astype(np.intp)
    keys = ((line.labels * MOST_DOUBLINGS + doublings) * MOST_CELLS + column) * MOST_CELLS + row
    _, first, cell, counts = np.unique(keys, return_index=True, return_inverse=True, return_counts=True)
    points = _means(line.points_vehicle, cell, counts)
    covariances = _means(line.covariances.reshape(-1, 4), cell, counts) / counts[:, None]
    return Detections(line.t, points, covariances.reshape(-1, 2, 2), line.labels[first])


def _means(values: Array, cell: IntArray, counts: IntArray) -> Array:
    return np.column_stack([np.bincount(cell.ravel(), column) for column in values.T]) / counts[:, None]


class Seen(NamedTuple):
    """Detections of a cycle as they are matched."""

    points: Array  # (m, 2) corrected, vehicle frame (m)
    variances: Array  # (m,) of one coordinate (m^2)

    def where(self, chosen: BoolArray) -> "Seen":
        return Seen(self.points[chosen], self.variances[chosen])


class MatchLimits(NamedTuple):
    """Limits of a match, as `scan_matching` has them for cones."""

    farthest: float  # distance in reaches from which on a remembered detection has no weight
    huber: float  # whitened distance beyond which a weight is reduced
    sigma: float  # added to a detection's (m)
    fewest: int  # least number of matched detections that tell a motion


class Targets(NamedTuple):
    """Lines beside placed detections."""

    off: Array  # (m, 2) from the mean of the recent points to each detection (m)
    weights: Array  # (m,) sums of the weights of these points
    normals: Array  # (m, 2) unit vectors across the line
    matched: BoolArray  # (m,) whether there is a line


def targets_on_lines(placed: Array, recent: Array, reach: float, farthest: float) -> Targets:
    """Return the lines beside placed points (m, 2), by recent points (n, 2) within a reach (m)."""
    centre = placed.mean(axis=0)  # about which the moments are summed, or their differences would vanish
    near, points = placed - centre, recent - centre
    x, y = points.T
    square = (near**2).sum(axis=1)[:, None] + (points**2).sum(axis=1) - 2.0 * near @ points.T
    beside, weight = square < (farthest * reach) ** 2, np.zeros(square.shape)
    weight[beside] = np.exp(-0.5 * square[beside] / reach**2)
    total = np.maximum(weight.sum(axis=1), np.finfo(float).tiny)
    means = weight @ np.column_stack([x, y, x * x, x * y, y * y]) / total[:, None]
    mean, (xx, xy, yy) = means[:, :2], means[:, 2:].T
    xx, xy, yy = xx - mean[:, 0] ** 2, xy - mean[:, 0] * mean[:, 1], yy - mean[:, 1] ** 2
    off = near - mean
    middle, half = 0.5 * (xx + yy), np.hypot(0.5 * (xx - yy), xy)
    direction = 0.5 * np.arctan2(2.0 * xy, xx - yy)
    tangents = np.column_stack([np.cos(direction), np.sin(direction)])
    along, across = middle + half, np.maximum(middle - half, 0.0)
    matched = (total > LEAST_POINTS) & (along > (LEAST_SPREAD * reach) ** 2) & (along > LEAST_SHAPE * across)
    matched &= np.abs((off * tangents).sum(axis=1)) < LEAST_INSIDE * reach
    return Targets(off, total, left_of(tangents), matched)


@dataclass(frozen=True, eq=False)
class LineMatch:
    """Points of a cycle beside recent ones."""

    recent: Array  # (k, 2) recent points (m)
    seen: Seen
    limits: MatchLimits

    def found(self, start: Array, reaches: Sequence[float]) -> tuple[Array, Array, BoolArray, float]:
        """Lay the detections on the recent points by Gauss-Newton steps from a pose (3,), one for each reach.

        The result is the pose (3,), its information (3, 3), which detections were matched, and the sum of
        their whitened squares.
        """
        pose, turn = start.copy(), np.eye(3)  # from the vehicle's frame at the start
        turn[:2, :2] = rotation(start[2])
        held = turn @ np.diag(1.0 / LINE_HELD) @ turn.T
        for reach in reaches:
            hessian, gradient, *_ = self._system(pose, reach)
            pose = pose - np.linalg.solve(hessian + held, gradient + held @ (pose - start))
        hessian, _, matched, square = self._system(pose, reaches[-1])
        if matched.sum() < self.limits.fewest:
            return pose, np.zeros((3, 3)), matched, square
        covariance = np.linalg.inv(hessian + held) + turn @ np.diag(LINES_ALIKE) @ turn.T
        return pose, np.asarray(np.linalg.inv(covariance)), matched, square

    def squares(self, pose: Array, reach: float) -> tuple[Array, BoolArray]:
        """Whitened squares (m,) of the detections at a pose (3,), and which of them are matched."""
        targets, _, squares = self._misfit(pose, reach)
        return squares, targets.matched

    def _misfit(self, pose: Array, reach: float) -> tuple[Targets, Array, Array]:
        """Targets at a pose (3,), and variances and whitened squares (m,) of the detections."""
        placed = to_map(self.seen.points, pose[None])
        targets = targets_on_lines(placed, self.recent, LINE_REACH * reach, self.limits.farthest)
        weights = np.where(targets.matched, targets.weights, 1.0)
        variances = self.seen.variances * (1.0 + 1.0 / weights) + self.limits.sigma**2
        squares = (targets.off * targets.normals).sum(axis=1) ** 2 / variances
        return targets, np.asarray(variances), np.asarray(squares)

    def _system(self, pose: Array, reach: float) -> tuple[Array, Array, BoolArray, float]:
        """Hessian (3, 3) and gradient (3,) of half the sum of squares, which are matched, and the sum."""
        targets, variances, square = self._misfit(pose, reach)
        weights = huber_weights(np.sqrt(square), self.limits.huber) * targets.matched / variances
        n = targets.normals
        information = n[:, :, None] * n[:, None, :] * weights[:, None, None]
        arm = left_of(to_map(self.seen.points, pose[None]) - pose[:2])
        jacobian = np.concatenate([np.tile(np.eye(2), (len(arm), 1, 1)), arm[:, :, None]], axis=2)
        weighted = information @ jacobian
        hessian = np.einsum("mij,mik->jk", jacobian, weighted)
        gradient = np.einsum("mij,mi->j", weighted, targets.off)
        return hessian, gradient, targets.matched, float(np.where(targets.matched, square, 0.0).sum())


# --- cones -----------------------------------------------------------------------------------------------

LEARNED_ERRORS: Final = [SENSOR.index("yaw"), SENSOR.index("latency")]  # errors that are learned
SIGMAS_ERRORS: Final = (0.02, 0.05)  # rad and s, first: those of a hasty mounting
SIGMAS_CHANGES: Final = (0.001, 0.005)  # their change in a minute, rad and s
MINUTE: Final = 60.0

SCAN_MEMORY: Final = 0.65  # age of remembered detections, s, over which odometry hardly drifts
MOST_REMEMBERED: Final = 2000  # largest number of remembered detections, which bounds the time of a match
LINE_REMEMBERED: Final = 40  # largest number of points of lines in a remembered cycle
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


class RecentDetections(Copyable):
    """Detections of the newest cycles, in the frame of dead reckoning."""

    def __init__(self) -> None:
        self.points: Array = np.zeros((0, 2))  # (n, 2) place of each detection, m
        # a row is [stamp | point as measured | place of the vehicle | derivatives of x | derivatives of y]
        self._table: Array = np.zeros((0, 5 + 2 * len(LEARNED_ERRORS)))

    def add(self, t: float, measured: Array, columns: Array, pose: Array) -> None:
        """Add detections (m, 2) at t (s) from a pose (3,), and their derivatives (m, 2, e) by the errors."""
        new = np.empty((len(measured), self._table.shape[1]))
        new[:, 0], new[:, 1:3], new[:, 3:5] = t, to_map(measured, pose[None]), pose[:2]
        new[:, 5:] = (rotation(pose[2]) @ columns).reshape(len(measured), new.shape[1] - 5)
        self._table = np.concatenate([self._table, new])[-MOST_REMEMBERED:]
        self.points = self._table[:, 1:3]

    def correct(self, errors: Array) -> None:
        """Correct the detections for sensor errors (e,)."""
        columns = self._table[:, 5:].reshape(len(self._table), 2, len(errors))
        self.points = self._table[:, 1:3] + columns @ errors

    def forget(self, t: float) -> None:
        first = int(self._table[:, 0].searchsorted(t - SCAN_MEMORY, side="right"))
        self._table = self._table[first:]
        self.points = self._table[:, 1:3]

    @property
    def seen_from(self) -> Array:
        """Mean position (2,) from which the detections were seen."""
        return np.asarray(self._table[:, 3:5].sum(axis=0) / len(self._table))

    def has(self, points: Array) -> BoolArray:
        """Whether each point (m, 2) coincides with earlier detections."""
        return np.asarray(kernels.weighted_means(points, self.points, REACH_LAST, FARTHEST)[1] > MIN_WEIGHT)


@dataclass(frozen=True, eq=False)
class Match:
    """Registration of detections to earlier ones."""

    pose: Array  # (3,) in the frame of the earlier detections, m, m and rad
    information: Array  # (3, 3) information about the pose from the matched detections, same frame
    is_matched: BoolArray  # (m,) whether each detection coincides with earlier ones
    misfit: float  # mean square of the matched detections' whitened distances
    by_lines: bool = False  # whether they are points of lines

    @property
    def matched(self) -> int:
        return int(self.is_matched.sum())

    @property
    def is_certain(self) -> bool:
        """Whether the detections constrain the pose in every direction."""
        if self.by_lines:
            return bool(np.linalg.inv(self.information)[2, 2] < HEADING_TOLD**2)
        (w, _, a), (_, _, b), (_, _, turning) = self.information.tolist()  # of x and y: w times the identity
        return bool(w * (w * turning - a * a - b * b) / max(w * w * turning, _TINY) > LEAST_SHARE)


def match(
    recent: RecentDetections, points_vehicle: Array, variances: Array, start: Array, reaches: Sequence[float]
) -> Match:
    """Register detections (m, 2), vehicle frame, to the recent ones by Gauss-Newton steps from a pose (3,).

    Each step, one for each of the reaches (m), minimizes `sum_i |R z_i + t - m_i|^2 / sigma_i^2`. m_i is the
    weighted mean of the recent detections near the point, n_i the sum of the weights, and `sigma_i^2 =
    variance_i (1 + 1/n_i) + SIGMA_CONE^2`. The variances (m,) are per coordinate (m^2).
    """
    limits = (FARTHEST, MIN_WEIGHT, SCAN_HUBER, SIGMA_CONE, MIN_MATCHED, LEAST_SHARE)
    pose, information, matched, cost = kernels.matched(
        recent.points, points_vehicle, variances, start, reaches, limits
    )
    return Match(pose, information, matched, cost / max(int(matched.sum()), 1))


def misfit_at(recent: RecentDetections, points_vehicle: Array, variances: Array, pose: Array) -> float:
    """Return the mean square of the whitened distances of `match` at a given pose (3,)."""
    points = to_map(points_vehicle, pose[None])
    means, weights = kernels.weighted_means(points, recent.points, REACH_LAST, FARTHEST)
    matched = weights > MIN_WEIGHT
    variance = variances * (1.0 + 1.0 / np.where(matched, weights, 1.0)) + SIGMA_CONE**2
    square = np.where(matched, ((points - means) ** 2).sum(axis=1) / variance, MOST_MISFIT)
    return float(np.minimum(square, MOST_MISFIT).mean()) if len(square) else 0.0


MATCH_LIMITS: Final = MatchLimits(FARTHEST, SCAN_HUBER, SIGMA_CONE, MIN_MATCHED)


# --- errors of the sensor --------------------------------------------------------------------------------


def by_errors(points_vehicle: Array, twist: Array) -> Array:
    """Return the derivatives (m, 2, 2) of detections (m, 2), vehicle frame, by yaw and latency."""
    columns = np.empty((len(points_vehicle), 2, len(LEARNED_ERRORS)))
    columns[:, :, 0] = left_of(points_vehicle)
    columns[:, :, 1] = -twist[:2] - twist[2] * columns[:, :, 0]
    return columns


@dataclass(frozen=True, eq=False)
class Difference:
    """Difference of a match from the odometry, in the vehicle frame."""

    off: Array  # (3,) m, m and rad
    covariance: Array  # (3, 3) its covariance, for a sensor without errors
    shifts: Array  # (3, 2) its derivatives by the sensor errors


class SensorErrors(Copyable):
    """Kalman filter of the sensor errors e = (yaw, latency), in rad and s.

    Detections are corrected by the mean. A remaining yaw shifts a match, in the vehicle frame, by
    `(d_y, -d_x, 0)`, and a latency by `mean(v) - v`. d is the displacement from the mean position of the
    poses of the remembered detections, v the velocity, and mean(v) its mean over these poses.
    """

    def __init__(self, settings: MotionSettings) -> None:
        self.mean: Array = np.zeros(len(LEARNED_ERRORS))  # (2,) yaw (rad, to the left) and latency (s)
        self.covariance: Array = np.diag(np.square(SIGMAS_ERRORS))  # (2, 2) their covariance
        self._drift: Array = np.diag(np.square(SIGMAS_CHANGES)) / MINUTE
        self._velocity: Array = np.zeros(3)
        self._possible: Array = 0.5 * SCAN_MEMORY * np.array(settings.accelerations)

    def contradict(self, settings: CalibrationSettings) -> bool:
        """Whether the errors contradict the sensor's prior by more than `settings.doubt` sigmas."""
        if not settings.sensor:
            return False
        limit, prior = settings.doubt**2, (settings.sigma_yaw, settings.sigma_latency)
        known = zip(self.mean.tolist(), self.covariance.diagonal().tolist(), prior, strict=True)
        return any(mean**2 > limit * (variance + sigma**2) for mean, variance, sigma in known)

    def found(self, settings: CalibrationSettings) -> CalibrationSettings:
        """Return wide priors of the sensor with the learned yaw and latency as means.

        With zero means, the bias of the yaw rate absorbs most of a yaw of some degrees and bends the map. The
        first matches find about half of a large yaw (`SIGMAS_ERRORS`), so its sigma is as large.
        """
        (yaw, latency), wide = self.mean.tolist(), settings.widened()
        return replace(wide, yaw=yaw, latency=latency, sigma_yaw=max(wide.sigma_yaw, abs(yaw)))

    def follow(self, velocity: Array, dt: float) -> None:
        """Update the mean velocity with that of a cycle (3,) of duration dt (s)."""
        share = min(dt / (0.5 * SCAN_MEMORY), 1.0)
        self._velocity = self._velocity + share * (velocity - self._velocity)

    def covariance_of(self, difference: Difference) -> Array:
        shifts = difference.shifts
        return np.asarray(difference.covariance + shifts @ self.covariance @ shifts.T)

    def square_of(self, difference: Difference) -> float:
        return kernels.squared(difference.off, difference.covariance, difference.shifts, self.covariance)

    def shifts(self, way: Array, velocity: Array) -> Array:
        """Return the derivatives (3, 2) of the difference between match and odometry by the errors.

        The displacement `way` (2,) and the velocity (3,) are in the vehicle frame. Changes of the velocity
        are clipped to what a vehicle can do; the rest is slip.
        """
        off = np.minimum(np.maximum(self._velocity - velocity, -self._possible), self._possible)
        (ahead, left), (x, y, turn) = way.tolist(), off.tolist()
        return np.array([[left, x], [-ahead, y], [0.0, turn]])

    def update(self, difference: Difference, dt: float) -> None:
        """Update with an agreeing match, dt (s) after the previous one, weighted by `dt / SCAN_MEMORY`."""
        measured = difference.off, difference.covariance, difference.shifts, min(dt / SCAN_MEMORY, 1.0)
        self.mean, self.covariance = kernels.learned(self.mean, self.covariance, dt * self._drift, *measured)


# --- matches of each cycle -------------------------------------------------------------------------------


class ScanMatcher(Copyable):
    """Matching of each cycle with the previous ones, and sensor errors and noise learned from it."""

    def __init__(self, settings: MotionSettings, *, of_lines: bool = False) -> None:
        self._settings, self._of_lines = settings, of_lines
        self._misfit = 1.0  # mean of those of the matches that agreed, the newest counting most
        self.forget()

    def forget(self) -> None:
        """Forget the remembered cycles and the learned sensor errors."""
        self.recent, self.errors = RecentDetections(), SensorErrors(self._settings)

    @property
    def excess(self) -> float:
        """Ratio of the actual variance of detections to the claimed one; at least 1."""
        return max(self._misfit / LARGE_MISFIT, 1.0)

    def corrected(self, detections: Detections, twist: Array) -> Seen:
        """Correct a cycle's detections, and the remembered ones, for the sensor errors."""
        measured, covariances = detections.points_vehicle, detections.covariances
        if len(self.recent.points):
            self.recent.forget(detections.t)
            self.recent.correct(self.errors.mean)
        points = measured + by_errors(measured, twist) @ self.errors.mean
        return Seen(points, 0.5 * (covariances[:, 0, 0] + covariances[:, 1, 1]))

    def remember(self, detections: Detections, twist: Array, pose: Array) -> None:
        """Remember the detections of a cycle with a pose (3,) and a twist (3,)."""
        measured = detections.points_vehicle
        columns, every = by_errors(measured, twist), 1
        if self._of_lines:
            every = max(-(-len(measured) // LINE_REMEMBERED), 1)
        if len(measured):
            self.recent.add(detections.t, measured[::every], columns[::every], pose)

    def has(self, seen: Seen, pose: Array) -> BoolArray:
        """Whether each detection (m,), seen from a pose (3,), coincides with earlier ones."""
        placed = to_map(seen.points, pose[None])
        if self._of_lines and len(self.recent.points):
            return np.asarray(KDTree(self.recent.points).query(placed)[0] < REACH_FIRST)
        return self.recent.has(placed)

    def match(self, seen: Seen, start: Array, reaches: Sequence[float]) -> Match | None:
        """Return the match of detections from an initial pose (3,); None if the pose is not observable."""
        if not (len(self.recent.points) and len(seen.points)):
            return None
        if self._of_lines:
            pose, information, chosen, square = self._beside(seen).found(start, reaches)
            misfit = square / max(int(chosen.sum()), 1)
            matched = Match(pose, information, chosen, misfit, by_lines=True)
        else:
            matched = match(self.recent, seen.points, seen.variances, start, reaches)
        return matched if matched.matched >= MIN_MATCHED and matched.is_certain else None

    def difference(self, matched: Match, odometry: IntegratedOdometry, predicted: Array) -> Difference:
        """Return the difference of a match from the pose (3,) predicted by odometry, in the vehicle frame."""
        known = matched.pose, matched.information, self.excess, predicted, odometry.covariance
        way = rotation(predicted[2]).T @ (predicted[:2] - self.recent.seen_from)
        return Difference(*kernels.off_prediction(*known), self.errors.shifts(way, odometry.twist))

    def denies(self, matched: Match, difference: Difference, limit: float) -> bool:
        """Whether a match contradicts the odometry by more than `limit` sigmas."""
        return matched.matched >= MIN_DOUBTING and self.errors.square_of(difference) > limit**2

    def agree(self, matched: Match, difference: Difference, dt: float) -> None:
        """Learn from a match that agrees with the odometry, dt (s) after the previous cycle."""
        self._misfit += MISFIT_GAIN * (matched.misfit - self._misfit)
        self.errors.update(difference, dt)

    def fits(self, matched: Match) -> bool:
        """Whether the misfit of a match is small enough for a motion."""
        return matched.misfit < MAX_MISFIT * self.excess

    def fits_better(self, matched: Match, predicted: Array, seen: Seen) -> bool:
        """Whether detections fit badly at the predicted pose (3,), and clearly better at the match."""
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
        return LineMatch(self.recent.points, seen, MATCH_LIMITS)
