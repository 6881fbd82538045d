"""Odometry between two perception cycles: twists integrated on SE(2), with covariance and calibration."""

from dataclasses import dataclass, field

import numpy as np

from . import _kernels as kernels
from .arrays import Array
from .se2 import se2_exp

MIN_SIGMA = 1e-6  # of integrated odometry (m, rad); keeps the factor of an empty interval finite
CALIBRATION = ("scale", "bias")  # scale error of the speeds (-), yaw-rate bias (rad/s)
CALIBRATION_SIZE = len(CALIBRATION)


@dataclass(frozen=True)
class IntegratedOdometry:
    """Relative pose over an interval, as the measurement of a factor between its two poses."""

    delta: Array  # (3,) end pose in the frame of the start (m, m, rad)
    covariance: Array  # (3, 3) of the end pose, in its own frame (GTSAM's tangent of Pose2)
    calibration_jacobian: Array  # (3, 2) derivative of the end pose, in its own frame
    whitener: Array  # (3, 3) W with `W' W = covariance^-1`
    twist: Array = field(default_factory=lambda: np.zeros(3))  # (3,) at the end (m/s, m/s, rad/s)


def integrate_poses(durations: Array, twists: Array) -> Array:
    """Integrate k constant twists to the poses (k, 3) after each of them, in the frame of the start.

    durations (k,) are in s, twists (k, 3) in m/s, m/s and rad/s.
    """
    return accumulated(se2_exp(twists * durations[:, None]))


def accumulated(steps: Array) -> Array:
    """Accumulate steps (k, 3) on SE(2) to the poses (k, 3) after each of them, in the frame of the start."""
    heading = np.cumsum(steps[:, 2])
    before = heading - steps[:, 2]
    c, s = np.cos(before), np.sin(before)
    x = np.cumsum(c * steps[:, 0] - s * steps[:, 1])
    y = np.cumsum(s * steps[:, 0] + c * steps[:, 1])
    return np.array([x, y, heading]).T


def integrate_twists(durations: Array, twists: Array, sigma: Array) -> IntegratedOdometry:
    """Compute `prod_k exp(dt_k xi_k)` with its first-order covariance and its calibration derivative.

    Body twists xi (k, 3) (m/s, m/s, rad/s) are constant over durations dt (k,) in s; sigma, (3,) or (k, 3),
    is the standard deviation of each independent sample. An error e of sample k, in its own frame, propagates
    to the end as `Ad(T_end^-1 T_k) e` with T_k the middle of its step. The odometry measures `(1 + scale) v`
    and `w + bias`, so the calibrated end pose is the end pose minus `calibration_jacobian @ (scale, bias)`.
    Without samples the result is the identity with zero covariance.
    """
    sigmas = np.empty(twists.shape)
    sigmas[:] = sigma  # ten times faster than `broadcast_to`
    return integrate_each(durations, twists, sigmas, [len(durations)])[0]


def integrate_each(
    durations: Array, twists: Array, sigmas: Array, counts: list[int]
) -> list[IntegratedOdometry]:
    """Integrate the twists of motions, `counts` of each; the arrays are as in `integrate_twists`, stacked."""
    ends = np.cumsum(counts, dtype=np.intp)
    motions = kernels.integrated(durations, twists, sigmas, ends, MIN_SIGMA)
    last = [twists[end - 1] if count else np.zeros(3) for end, count in zip(ends, counts, strict=True)]
    return [IntegratedOdometry(*motion, twist) for motion, twist in zip(motions, last, strict=True)]
