"""The motion between two cycles: standing still, the odometry, or what the detections show instead.

Scan matching registers the detections of a cycle to those of the previous cycles. Cones need no identity:
each detection is registered to the weighted mean of nearby earlier ones, and the weights sharpen with each
iteration (EM-ICP; Granger and Pennec 2002).

Matches also reveal yaw and latency of the sensor. A sensor turned by psi observes each motion turned by -psi.
Detections with a latency tau lie `tau v` too far ahead, which is observable when the velocity changes.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from pathspace_graph.copies import Copyable
from pathspace_graph.factors import _kernels as kernels
from pathspace_graph.factors.arrays import Array, BoolArray
from pathspace_graph.factors.noise import TwistNoise
from pathspace_graph.factors.odometry import IntegratedOdometry
from pathspace_graph.io.log import Detections, Odometry
from pathspace_graph.mapping.motion import BiasMeasurement, MeasuredMotion
from pathspace_graph.settings.mapper import CalibrationSettings, MotionSettings


@dataclass(frozen=True)
class Matching:
    """Constants of scan matching, which the kernels read by name.

    Earlier detections at distances d from a detection have the weights `exp(-d^2 / 2 reach^2)`.
    """

    of_lines: bool = False
    """Whether detections are points of lines: of their offsets only the part across the line counts."""

    farthest: float = 3.0
    """Distance from which on an earlier detection has no weight, in reaches."""
    min_weight: float = 0.7
    """Least sum of weights of a matched cone."""
    huber: float = 2.5
    """Whitened distance beyond which Huber's loss reduces the weight of a detection."""
    sigma_cone: float = 0.05
    """Standard deviation added to a detection's, m, since one side of a cone is seen."""
    min_matched: int = 3
    """Least number of matched detections that tell a motion."""
    min_doubting: int = 4
    """Least number of matched detections of a contradiction."""
    least_share: float = 1e-6
    """Least determinant of a pose's information, relative to the product of its diagonal; for cones."""
    most_misfit: float = 9.0
    """Largest whitened square in a misfit that is compared with another."""
    misfit_gain: float = 0.02
    """Smoothing gain of the mean-square misfit."""
    large_misfit: float = 1.5
    """Mean-square misfit beyond which its excess scales the covariances of detections."""

    line_reach: float = 1.5
    """Reach of a line relative to that of a cone: its points are spread over the gaps of points."""
    least_points: float = 2.0
    """Least sum of weights of the points of a line."""
    least_spread: float = 0.3
    """Least standard deviation of these along the line, in reaches."""
    least_shape: float = 4.0
    """Least ratio of their variances along and across the line."""
    least_inside: float = 0.5
    """Largest distance along the line from the mean of its points, in reaches."""
    line_held: tuple[float, float, float] = (0.1, 10.0, 1.0)
    """Standard deviations (m, m, rad) about the start, vehicle frame: along lines nothing is searched for."""
    lines_alike: tuple[float, float, float] = (1.0, 0.03, 0.003)
    """Standard deviations (m, m, rad) of errors that all points of a match share, vehicle frame: nothing is
    known along the lines, and they are taken for straight."""


MATCHING: Final = Matching()
SIGMAS_PULL_OFF: Final = (0.3, 0.05, 0.0)  # motion that odometry misses when a rest ends (m, m, rad)


@dataclass(frozen=True, eq=False)
class SensorErrors:
    """Errors of the sensor, learned from the matches that agree with the odometry."""

    mean: Array  # (2,) yaw (rad, to the left) and latency (s)
    covariance: Array  # (2, 2) their covariance

    def contradict(self, settings: CalibrationSettings) -> bool:
        """Whether the errors contradict the sensor's prior by more than `settings.doubt` sigmas."""
        if not settings.sensor:
            return False
        limit, (yaw, latency) = settings.doubt**2, self.mean.tolist()
        (of_yaw, _), (_, of_latency) = self.covariance.tolist()
        is_turned = yaw**2 > limit * (of_yaw + settings.sigma_yaw**2)
        return bool(is_turned or latency**2 > limit * (of_latency + settings.sigma_latency**2))

    def found(self, settings: CalibrationSettings) -> CalibrationSettings:
        """Return wide priors of the sensor with the learned yaw and latency as means.

        With zero means, the bias of the yaw rate absorbs most of a yaw of some degrees and bends the map. The
        first matches find about half of a large yaw, so its sigma is as large.
        """
        (yaw, latency), wide = self.mean.tolist(), settings.widened()
        return replace(wide, yaw=yaw, latency=latency, sigma_yaw=max(wide.sigma_yaw, abs(yaw)))


class MotionCheck(Copyable):
    """Check of each cycle's odometry against the detections of the newest cycles.

    Poses are in the frame of dead reckoning, which drifts; only the newest ones are used. The hypotheses and
    their likelihoods are compiled (`factors/kernels/motion_check.cpp`).
    """

    def __init__(self, noise: TwistNoise, settings: MotionSettings, matching: Matching = MATCHING) -> None:
        self.noise = noise
        self.t: float | None = None  # stamp of the newest cycle (s)
        self.twist: Array | None = None  # (3,) newest measured twist (m/s, m/s, rad/s)
        self.pose: Array = np.zeros(3)  # (3,) newest pose by dead reckoning; the first one is 0
        self.seen_again: BoolArray = np.zeros(0, bool)  # (m,) `Reading.seen_again` of the newest cycle
        self._check = kernels.MotionCheck(noise, settings, matching)

    @property
    def errors(self) -> SensorErrors:
        """Yaw and latency of the sensor, learned so far."""
        return SensorErrors(*self._check.errors)

    def set_noise(self, noise: TwistNoise) -> None:
        """Set the noise of a twist, and forget the detections and the learned errors of the sensor."""
        self.noise = noise
        self._check.set_noise(noise)

    def update(
        self, odometry: Odometry, detections: Detections, *, may_contradict: bool = True
    ) -> MeasuredMotion:
        """Return the motion since the previous cycle.

        `may_contradict` says whether the noise of the detections is known well enough to contradict the
        odometry; otherwise they only agree with it, or replace it where it is missing. Points of lines cannot
        show a standstill.
        """
        check, read = self._check, odometry.twist
        measured, twists, doubted, missing, stuck, bias, durations, excess, leaves = check.update(
            odometry.t, read, detections.t, detections.points_vehicle, detections.covariances, may_contradict
        )
        self.t, self.twist = detections.t, read[-1] if len(read) else self.twist
        self.pose, self.seen_again = check.pose, check.seen_again
        motion = MeasuredMotion(
            odometry=IntegratedOdometry(*measured),
            twists=twists,
            doubted=doubted,
            missing=missing,
            stuck=stuck,
            bias=None if bias is None else BiasMeasurement(*bias),
            durations=durations,
            excess=excess,
        )
        return motion.with_missed(np.array(SIGMAS_PULL_OFF), self.noise) if leaves else motion
