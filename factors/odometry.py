"""Odometry between two perception cycles: twists integrated on SE(2), with covariance and calibration."""

from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import lapack

from .arrays import Array
from .kernels import compiled
from .se2 import compose, se2_exp, wrap_angle

MIN_SIGMA = 1e-6  # of integrated odometry (m, rad), which keeps the factor of an empty interval finite
CALIBRATION_SIZE = 2  # entries of the calibration: scale error of the speeds (-), yaw-rate bias (rad/s)


@dataclass(frozen=True)
class IntegratedOdometry:
    """Relative pose over an interval, as a factor between its two poses needs it."""

    delta: Array  # (3,) end pose in the frame of the start (m, m, rad)
    covariance: Array  # (3, 3) of the end pose, in its own frame (GTSAM's tangent of Pose2)
    calibration_jacobian: Array  # (3, 2) derivative of the end pose, in its own frame
    whitener: Array  # (3, 3) W with `W' W = covariance^-1`
    twist: Array = field(default_factory=lambda: np.zeros(3))  # (3,) at the end (m/s, m/s, rad/s)


def integrate_poses(durations: Array, twists: Array) -> Array:
    """Return the poses (k, 3), in the frame of the start, after each of k constant twists.

    durations (k,) are in s, twists (k, 3) in m/s, m/s and rad/s.
    """
    return accumulated(se2_exp(twists * durations[:, None]))


def accumulated(steps: Array) -> Array:
    """Return the poses (k, 3), in the frame of the start, after each of k steps (k, 3) on SE(2)."""
    heading = np.cumsum(steps[:, 2])
    before = heading - steps[:, 2]
    c, s = np.cos(before), np.sin(before)
    x = np.cumsum(c * steps[:, 0] - s * steps[:, 1])
    y = np.cumsum(s * steps[:, 0] + c * steps[:, 1])
    return np.array([x, y, heading]).T


def integrate_twists(durations: Array, twists: Array, sigma: Array) -> IntegratedOdometry:
    """Return `prod_k exp(dt_k xi_k)` with its first-order covariance and its calibration derivative.

    Body twists (k, 3) (m/s, m/s, rad/s) are held over durations (k,) in s; sigma, (3,) or (k, 3), is the
    standard deviation of each independent sample. An error e of sample k, in its own frame, reaches the end
    as `Ad(T_end^-1 T_k) e` with T_k the middle of its step. The odometry measures `(1 + scale) v` and
    `w + bias`, so the calibrated end pose is the end pose minus `calibration_jacobian @ (scale, bias)`.
    Without samples the result is the identity with zero covariance.
    """
    if len(durations) == 0:
        return integrated_odometry(np.zeros(3), np.zeros((3, 3)), np.zeros((3, CALIBRATION_SIZE)))
    sigmas = np.empty(twists.shape)
    sigmas[:] = sigma  # `broadcast_to` takes ten times as long
    motion = _integrated(durations, twists, sigmas)
    return IntegratedOdometry(*motion, _whitener(motion[1], MIN_SIGMA), twists[-1])


@compiled
def _integrated(durations: Array, twists: Array, sigmas: Array) -> tuple[Array, Array, Array]:
    """Return end pose (3,), covariance (3, 3) and calibration derivative (3, 2) of `integrate_twists`."""
    poses = integrate_poses(durations, twists)
    end = poses[-1]
    # in the middle of each step the adjoint equals the exponential's right Jacobian to second order
    adjoints = _adjoints_to_end(compose(poses, se2_exp(-0.5 * twists * durations[:, None])), end)
    scaled = (adjoints * (durations[:, None] * sigmas)[:, None, :]).transpose(1, 0, 2).reshape(3, -1)
    by_speed, by_rate = adjoints[:, :, :2] @ twists[:, :2, None], adjoints[:, :, 2:]
    by_calibration = np.concatenate([by_speed, by_rate], axis=2).transpose(1, 2, 0) @ durations
    return end, scaled @ scaled.T, by_calibration


def integrated_odometry(delta: Array, covariance: Array, calibration_jacobian: Array) -> IntegratedOdometry:
    """Return the odometry with its whitener; `MIN_SIGMA` lifts a covariance of zero."""
    whitener = _whitener(covariance, MIN_SIGMA)
    return IntegratedOdometry(delta, covariance, calibration_jacobian, whitener)


@compiled
def _whitener(covariance: Array, least: float) -> Array:
    """Return lower triangular W (3, 3) with `W' W` the inverse of a covariance (3, 3) plus `least^2`."""
    root, _ = lapack.dpotrf(covariance + np.eye(3) * least**2, lower=1)
    whitener, _ = lapack.dtrtri(root, lower=1)
    return np.ascontiguousarray(whitener)


def _adjoints_to_end(poses: Array, end: Array) -> Array:
    """Return the adjoint maps (k, 3, 3) that carry a tangent at each pose to one at the end pose."""
    theta = poses[:, 2] - end[2]
    c, s = np.cos(theta), np.sin(theta)
    ce, se = np.cos(end[2]), np.sin(end[2])
    dx, dy = poses[:, 0] - end[0], poses[:, 1] - end[1]
    out = np.zeros((len(poses), 3, 3))
    out[:, 0, 0], out[:, 0, 1], out[:, 0, 2] = c, -s, -se * dx + ce * dy
    out[:, 1, 0], out[:, 1, 1], out[:, 1, 2] = s, c, -(ce * dx + se * dy)
    out[:, 2, 2] = 1.0
    return out


@compiled
def odometry_residuals(poses_start: Array, poses_end: Array, deltas: Array) -> tuple[Array, Array, Array]:
    """Return `r = Log(delta^-1 start^-1 end)` (m, 3), and its Jacobians (m, 3, 3) by start and end.

    It is the residual of GTSAM's BetweenFactorPose2, a tangent in the frame of the end (m, m, rad). Poses
    (m, 3) are in the map frame, deltas (m, 3) in the frame of the start. The Jacobians are by (x, y, theta)
    in the map frame.
    """
    angle = poses_start[:, 2] + deltas[:, 2]
    c, s = np.cos(angle), np.sin(angle)
    offset = poses_end[:, :2] - poses_start[:, :2]
    along, across = c * offset[:, 0] + s * offset[:, 1], -s * offset[:, 0] + c * offset[:, 1]
    cd, sd = np.cos(deltas[:, 2]), np.sin(deltas[:, 2])
    dx, dy = along - (cd * deltas[:, 0] + sd * deltas[:, 1]), across - (cd * deltas[:, 1] - sd * deltas[:, 0])
    phi = wrap_angle(poses_end[:, 2] - angle)
    a, slope = _inverse_left_terms(phi)
    h = 0.5 * phi
    residuals = np.array([a * dx + h * dy, a * dy - h * dx, phi]).T
    by_phi_x, by_phi_y = slope * dx + 0.5 * dy, slope * dy - 0.5 * dx
    by_end = np.zeros((len(deltas), 3, 3))
    by_end[:, 0, 0], by_end[:, 0, 1], by_end[:, 0, 2] = a * c - h * s, a * s + h * c, by_phi_x
    by_end[:, 1, 0], by_end[:, 1, 1], by_end[:, 1, 2] = -a * s - h * c, a * c - h * s, by_phi_y
    by_end[:, 2, 2] = 1.0
    by_start = -by_end
    by_start[:, 0, 2] += a * across - h * along
    by_start[:, 1, 2] += -a * along - h * across
    return residuals, by_start, by_end


@compiled
def whitened_odometry(
    poses_start: Array,
    poses_end: Array,
    deltas: Array,
    whiteners: Array,
    by_calibration: Array,
    calibration: Array,
) -> tuple[Array, Array]:
    """Return `W (r + G b)` (m, 3) with r of `odometry_residuals`, and its derivatives (m, 3, 8).

    W (m, 3, 3) are whiteners, and G (m, 3, 2) derivatives by the calibration b (2,). The result's
    derivatives are by [b | start | end].
    """
    residual, *by_poses = odometry_residuals(poses_start, poses_end, deltas)
    residual = residual + by_calibration @ calibration
    jacobian = whiteners @ np.concatenate([by_calibration, *by_poses], axis=2)
    return (whiteners @ residual[:, :, None])[:, :, 0], jacobian


def _inverse_left_terms(phi: Array) -> tuple[Array, Array]:
    """Return `a = (phi/2) cot(phi/2)` of SE(2)'s inverse left Jacobian, and da/dphi."""
    small = np.abs(phi) < 1e-3  # the next terms of the series are below 1e-15 there
    half = np.where(small, 0.5, 0.5 * phi)
    cot = 1.0 / np.tan(half)
    a = np.where(small, 1.0 - phi**2 / 12.0, half * cot)
    slope = np.where(small, -phi / 6.0, 0.5 * cot - 0.5 * half * (1.0 + cot**2))
    return a, slope
