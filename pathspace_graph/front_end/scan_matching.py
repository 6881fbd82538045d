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

from pathspace_graph.copies import Copyable
from pathspace_graph.factors import _kernels as kernels
from pathspace_graph.factors.arrays import Array, BoolArray
from pathspace_graph.factors.odometry import IntegratedOdometry
from pathspace_graph.factors.se2 import rotation, to_map
from pathspace_graph.factors.sensor import SENSOR, by_sensor
from pathspace_graph.io.log import Detections
from pathspace_graph.settings.mapper import CalibrationSettings, MotionSettings

# --- points of lines -------------------------------------------------------------------------------------


LINE_REACH: Final = 1.5  # reach of a line by that of a cone: its points are spread over the gap of points
LEAST_POINTS: Final = 2.0  # least sum of weights of the points of a line
LEAST_SPREAD: Final = 0.3  # least standard deviation of these along the line, in reaches
LEAST_SHAPE: Final = 4.0  # least ratio of their variances along and across it
LEAST_INSIDE: Final = 0.5  # largest distance along the line from the mean of its points, in reaches
LINE_HELD: Final = np.array([0.1, 10.0, 1.0]) ** 2
"""Variances (m^2, m^2, rad^2) about the start, vehicle frame: the way along the lines is not searched for."""
LINES_ALIKE: Final = np.array([1.0, 0.03, 0.003]) ** 2
"""Variances (m^2, m^2, rad^2) of errors that all points of a match share, vehicle frame: nothing is known
along the lines, and they are taken for straight."""


def merged(line: Detections) -> Detections:
    """Return the means of the points of lines that share label and cell.

    The cells have a side of 1 m, 5 mm beside an arc of 9 m. It doubles at 12 m, and at each double of that:
    noise grows with the range, so a sensor that sees three times as far needs hardly more points.
    """
    doublings = np.maximum(np.frexp(np.hypot(*line.points_vehicle.T) / 12.0)[1], 0)
    column, row = np.floor(line.points_vehicle.T / np.ldexp(1.0, doublings)).astype(np.intp)
    # one number for label and cell, as no sensor sees 2^20 cells in a row; unique rows take six times as long
    keys = (((line.labels << 6) + doublings << 20) + column << 20) + row
    _, first, cell, counts = np.unique(keys, return_index=True, return_inverse=True, return_counts=True)
    columns = [*line.points_vehicle.T, *line.covariances.reshape(-1, 4).T]
    sums = np.column_stack([np.bincount(cell, values, len(counts)) for values in columns])
    means = sums / counts[:, None]
    covariances = means[:, 2:].reshape(-1, 2, 2) / counts[:, None, None]
    return Detections(line.t, means[:, :2], covariances, line.labels[first])


class Seen(NamedTuple):
    """Detections of a cycle as they are matched."""

    points: Array  # (m, 2) corrected, vehicle frame (m)
    variances: Array  # (m,) of one coordinate (m^2)


# --- cones -----------------------------------------------------------------------------------------------

LEARNED_ERRORS: Final = [SENSOR.index("yaw"), SENSOR.index("latency")]  # errors that are learned
SIGMAS_ERRORS: Final = (0.02, 0.05)  # rad and s, first: those of a hasty mounting
SIGMAS_CHANGES: Final = (0.001, 0.005)  # their change in a minute, rad and s
SCAN_MEMORY: Final = 0.65  # age of remembered detections, s, over which odometry hardly drifts
REACH_FIRST: Final = 1.0
REACH_LAST: Final = 0.4
"""Reach of the first and the last iteration, m: the weight at distance d is `exp(-d^2 / 2 reach^2)`."""
REACHES: Final = [REACH_FIRST * ((REACH_LAST / REACH_FIRST) ** 0.2) ** k for k in range(6)]
REACHES_CHECK: Final = (REACH_FIRST, REACH_LAST)  # of the check, which begins near the solution
FARTHEST: Final = 3.0  # distance in reaches from which on a remembered detection has no weight
MIN_WEIGHT: Final = 0.7  # least sum of weights of a matched detection
MIN_MATCHED: Final = 3  # least number of matched detections that tell a motion
SCAN_HUBER: Final = 2.5  # whitened distance beyond which Huber's loss reduces a detection's weight
SIGMA_CONE: Final = 0.05  # added to a detection's, m, since one side of a cone is seen
LEAST_SHARE: Final = 1e-6  # least det of a pose's information by the product of its diagonal
MOST_MISFIT: Final = 9.0  # largest whitened square in a misfit that is compared with another
MIN_DOUBTING: Final = 4  # least number of matched detections of a contradiction
MISFIT_GAIN: Final = 0.02  # smoothing gain of the mean-square misfit
LARGE_MISFIT: Final = 1.5  # mean-square misfit beyond which its excess scales the detections' covariances


@dataclass(frozen=True, eq=False)
class Match:
    """Registration of detections to earlier ones."""

    pose: Array  # (3,) in the frame of the earlier detections, m, m and rad
    information: Array  # (3, 3) information about the pose from the matched detections, same frame
    is_matched: BoolArray  # (m,) whether each detection coincides with earlier ones
    matched: int  # number of these
    misfit: float  # mean square of the matched detections' whitened distances

    @property
    def information_vehicle(self) -> Array:
        """Information (3, 3) about the pose in the vehicle frame."""
        turn = np.eye(3)
        turn[:2, :2] = rotation(self.pose[2]).T
        return np.asarray(turn @ self.information @ turn.T)


@dataclass(frozen=True, eq=False)
class Difference:
    """Difference of a match from the odometry, in the vehicle frame."""

    off: Array  # (3,) m, m and rad
    covariance: Array  # (3, 3) its covariance, for a sensor without errors
    shifts: Array  # (3, 2) its derivatives by the sensor errors
    spread: Array  # (3, 3) its covariance, with that of the sensor errors
    square: float  # squared Mahalanobis distance; 0 for a match of too few detections to contradict anything


# --- errors of the sensor --------------------------------------------------------------------------------


class SensorErrors(Copyable):
    """Kalman filter of the sensor errors e = (yaw, latency), in rad and s.

    Detections are corrected by the mean. A remaining yaw shifts a match, in the vehicle frame, by
    `(d_y, -d_x, 0)`, and a latency by `mean(v) - v`. d is the displacement from the mean position of the
    poses of the remembered detections, v the velocity, and mean(v) its mean over these poses.
    """

    def __init__(self, settings: MotionSettings) -> None:
        self.mean: Array = np.zeros(len(LEARNED_ERRORS))  # (2,) yaw (rad, to the left) and latency (s)
        self.covariance: Array = np.diag(np.square(SIGMAS_ERRORS))  # (2, 2) their covariance
        self._drift: Array = np.diag(np.square(SIGMAS_CHANGES)) / 60.0
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

    def shifts(self, way: Array, velocity: Array) -> Array:
        """Return the derivatives (3, 2) of the difference between match and odometry by the errors.

        The displacement `way` (2,) and the velocity (3,) are in the vehicle frame. Changes of the velocity
        are clipped to what a vehicle can do; the rest is slip.
        """
        off = np.minimum(np.maximum(self._velocity - velocity, -self._possible), self._possible)
        (ahead, left), (x, y, turn) = way.tolist(), off.tolist()
        return np.array([[left, x], [-ahead, y], [0.0, turn]])

    def update(self, off: Array, covariance: Array, shifts: Array, dt: float) -> None:
        """Update with a match `off` (3,) the odometry, dt (s) after the previous one.

        It is weighted by `dt / SCAN_MEMORY`. Covariance (3, 3) and shifts (3, 2) are those of `Difference`.
        """
        drift, share = dt * self._drift, min(dt / SCAN_MEMORY, 1.0)
        self.mean, self.covariance = kernels.learned(
            self.mean, self.covariance, drift, off, covariance, shifts, share
        )


# --- matches of each cycle -------------------------------------------------------------------------------


class ScanMatcher(Copyable):
    """Likelihood of a motion by the detections of the newest cycles, in the frame of dead reckoning.

    Errors and noise of the sensor are learned from the matches that agree with the odometry.
    """

    def __init__(self, settings: MotionSettings, *, of_lines: bool = False) -> None:
        self._settings, self._of_lines = settings, of_lines
        line = (LINE_REACH, LEAST_POINTS, LEAST_SPREAD, LEAST_SHAPE, LEAST_INSIDE) if of_lines else ()
        least_share = 0.0 if of_lines else LEAST_SHARE
        self._limits = (FARTHEST, MIN_WEIGHT, SCAN_HUBER, SIGMA_CONE, MIN_MATCHED, least_share), line
        self._misfit = 1.0  # mean of those of the matches that agreed, the newest counting most
        self.forget()

    def forget(self) -> None:
        """Forget the remembered cycles and the learned sensor errors."""
        self.errors = SensorErrors(self._settings)
        self.points: Array = np.zeros((0, 2))  # (n, 2) place of each remembered detection, m
        # a row is [stamp | place of the vehicle | place of the point | its derivatives of x | those of y]
        self._table: Array = np.zeros((0, 9))

    @property
    def excess(self) -> float:
        """Ratio of the actual variance of detections to the claimed one; at least 1."""
        return max(self._misfit / LARGE_MISFIT, 1.0)

    def corrected(self, detections: Detections, twist: Array) -> Seen:
        """Correct a cycle's detections, and the remembered ones, for the sensor errors; forget old ones."""
        first = int(self._table[:, 0].searchsorted(detections.t - SCAN_MEMORY, side="right"))
        table = self._table = self._table[first:]
        self.points = table[:, 3:5] + table[:, 5:].reshape(len(table), 2, 2) @ self.errors.mean
        sensor, covariances = np.zeros(len(SENSOR)), detections.covariances
        sensor[LEARNED_ERRORS] = self.errors.mean
        points = kernels.shifted(detections.points_vehicle, twist, sensor)
        return Seen(points, 0.5 * (covariances[:, 0, 0] + covariances[:, 1, 1]))

    def remember(self, detections: Detections, twist: Array, pose: Array) -> None:
        """Remember the detections of a cycle with a pose (3,) and a twist (3,).

        The time of a match is bounded by 40 points of lines in a cycle, and 2000 detections.
        """
        measured = detections.points_vehicle
        if self._of_lines:
            measured = measured[:: max(-(-len(measured) // 40), 1)]
        columns = np.ascontiguousarray(by_sensor(measured, twist[None])[:, :, LEARNED_ERRORS])
        new = np.empty((len(measured), self._table.shape[1]))
        new[:, 0], new[:, 1:3], new[:, 3:5] = detections.t, pose[:2], to_map(measured, pose[None])
        new[:, 5:] = (rotation(pose[2]) @ columns).reshape(len(measured), 4)
        self._table = np.concatenate([self._table, new])[-2000:]
        self.points = self._table[:, 3:5]

    def has(self, seen: Seen, pose: Array) -> BoolArray:
        """Whether each detection (m,), seen from a pose (3,), coincides with earlier ones."""
        reach, farthest, least = REACH_LAST, FARTHEST, MIN_WEIGHT
        if self._of_lines:
            reach, farthest, least = REACH_FIRST, 1.0, 0.0  # any point within the reach
        points = to_map(seen.points, pose[None])
        return np.asarray(kernels.weighted_means(points, self.points, reach, farthest)[1] > least)

    def match(self, seen: Seen, start: Array, reaches: Sequence[float]) -> Match | None:
        """Register detections to the remembered ones by Gauss-Newton steps from a pose (3,).

        Each step, one for each of the reaches (m), minimizes `sum_i |R z_i + t - m_i|^2 / sigma_i^2`. m_i is
        the weighted mean of the remembered detections near the point, n_i the sum of the weights, and
        `sigma_i^2 = variance_i (1 + 1/n_i) + SIGMA_CONE^2`. Of a point of a line, only the distance across
        the line counts. None if the pose is not observable in every direction; along lines it need not be.
        """
        if not (len(self.points) and len(seen.points)):
            return None
        turn = np.eye(3)  # from the vehicle's frame at the start
        turn[:2, :2] = rotation(start[2])
        held = turn @ np.diag(1.0 / LINE_HELD) @ turn.T if self._of_lines else np.zeros(0)
        pose, information, matched, cost = kernels.matched(
            self.points, *seen, start, reaches, *self._limits, held
        )
        count = int(matched.sum())
        if count < MIN_MATCHED:
            return None
        if self._of_lines:
            covariance = np.linalg.inv(information + held) + turn @ np.diag(LINES_ALIKE) @ turn.T
            information = np.asarray(np.linalg.inv(covariance), np.float64)
            is_certain = covariance[2, 2] < 0.05**2  # rad^2 of the heading: then lines hold the pose
        else:
            (w, _, a), (_, _, b), (_, _, turning) = information.tolist()  # of x and y: w times the identity
            determinant, product = w * (w * turning - a * a - b * b), w * w * turning
            is_certain = determinant / max(product, np.finfo(float).tiny) > LEAST_SHARE
        return Match(pose, information, matched, count, cost / count) if is_certain else None

    def misfit(self, seen: Seen, pose: Array) -> float:
        """Return the mean square of the whitened distances of `match` at a given pose (3,).

        Each counts up to `MOST_MISFIT`, and so do detections that match nothing.
        """
        return kernels.misfit(self.points, *seen, pose, REACH_LAST, *self._limits, MOST_MISFIT)

    def difference(self, matched: Match, odometry: IntegratedOdometry, predicted: Array) -> Difference:
        """Return the difference of a match from the pose (3,) predicted by odometry, in the vehicle frame."""
        seen_from = self._table[:, 1:3].sum(axis=0) / len(self._table)
        shifts = self.errors.shifts(rotation(predicted[2]).T @ (predicted[:2] - seen_from), odometry.twist)
        known = matched.pose, matched.information, self.excess, predicted, odometry.covariance
        off, covariance, spread, square = kernels.off_prediction(*known, shifts, self.errors.covariance)
        return Difference(off, covariance, shifts, spread, square if matched.matched >= MIN_DOUBTING else 0.0)

    def agree(self, matched: Match, difference: Difference, dt: float) -> None:
        """Learn from a match that agrees with the odometry, dt (s) after the previous cycle."""
        self._misfit += MISFIT_GAIN * (matched.misfit - self._misfit)
        self.errors.update(difference.off, difference.covariance, difference.shifts, dt)
