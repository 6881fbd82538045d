"""Detections, their residuals and Jacobians, and odometry in numpy."""

from __future__ import annotations

import numpy as np
from scipy.linalg import lapack

from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.odometry import integrate_poses
from pathspace_graph.factors.residuals import sigma_across
from pathspace_graph.factors.se2 import compose, in_vehicle, left_of, se2_exp, wrap_angle
from pathspace_graph.factors.sensor import RANGE, by_range, by_sensor


def to_map(points_vehicle: Array, poses: Array) -> Array:
    """Return `p = R z + t` (m, 2), map frame: points z (m, 2) in the vehicle frames of poses (m, 3)."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    x, y = points_vehicle[:, 0], points_vehicle[:, 1]
    return np.array([c * x - s * y + poses[:, 0], s * x + c * y + poses[:, 1]]).T


def shifted(measured: Array, twists: Array, sensor: Array) -> Array:
    """Return `z + C b` (m, 2) of detections z (m, 2), with C of `by_sensor` and a calibration b (5,)."""
    return np.asarray(measured + by_sensor(measured, twists) @ sensor)


def sensor_terms(
    directions: Array, residual: Array, poses: Array, measured: Array, twists: Array, sensor: Array
) -> tuple[Array, Array]:
    """Return factors `f = 1 / (1 - rates b)` (m,) and derivatives `f d' R C + f^2 r rates` (m, 5) by b."""
    if len(sensor) == 0:
        return np.ones(len(residual)), np.zeros((len(residual), 0))
    along = in_vehicle(directions, poses)
    rates = np.einsum("mi,mkij,mj->mk", along, by_range(measured), along)
    factor = 1.0 / (1.0 - rates @ sensor[RANGE])
    jacobian = np.einsum("mi,mik->mk", along, by_sensor(measured, twists)) * factor[:, None]
    jacobian[:, RANGE] += (residual * factor**2)[:, None] * rates
    return factor, jacobian


def detection_rows(
    points_map: Array,
    covariances: Array,
    poses: Array,
    normals: Array,
    distances: Array,
    basis: Array,
    measured: Array,
    twists: Array,
    sensor: Array,
    sigma_model: float,
) -> tuple[Array, Array, Array]:
    """Return residuals (m,) and sigmas (m,) of `project`, and derivatives by [pose | sensor | controls]."""
    arm = points_map - poses[:, :2]
    by_theta = normals[:, 1] * arm[:, 0] - normals[:, 0] * arm[:, 1]
    factors, by_calibration = sensor_terms(normals, distances, poses, measured, twists, sensor)
    by_pose = np.concatenate([normals, by_theta[:, None]], axis=1)
    by_control = (-basis[:, :, None] * normals[:, None, :]).reshape(len(basis), 2 * basis.shape[1])
    factor = factors[:, None]
    jacobian = np.concatenate([factor * by_pose, by_calibration, factor * by_control], axis=1)
    return factors * distances, sigma_across(normals, covariances, poses, sigma_model), jacobian


def station_rows(
    points_map: Array,
    covariances: Array,
    poses: Array,
    value: Array,
    slope: Array,
    control: Array,
    measured: Array,
    twists: Array,
    sensor: Array,
    sigma_station: Array,
) -> tuple[Array, Array, Array]:
    """Return `r = t . (p - S(u))` (m,) along the tangent t at stations u, sigmas (m,), and derivatives."""
    at, velocity = (np.einsum("mj,mjd->md", basis, control) for basis in (value, slope))
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    t = velocity / speed[:, None]
    n, arm = left_of(t), points_map - at
    along, turning = (arm * t).sum(axis=1), (arm * n).sum(axis=1) / speed
    seen = measured, twists, sensor
    residual, sigma, jacobian = detection_rows(points_map, covariances, poses, t, along, value, *seen, 0.0)
    factor = (jacobian[:, :2] * t).sum(axis=1)
    by_turn = (factor * turning)[:, None, None] * slope[:, :, None] * n[:, None, :]
    jacobian[:, -slope.shape[1] * 2 :] += by_turn.reshape(len(t), 2 * slope.shape[1])
    return residual, np.hypot(sigma, sigma_station), jacobian


def integrated(durations: Array, twists: Array, sigmas: Array) -> tuple[Array, Array, Array]:
    """Return end pose (3,), covariance (3, 3) and calibration derivative (3, 2) of `integrate_twists`."""
    poses = integrate_poses(durations, twists)
    end = poses[-1]
    # in the middle of each step the adjoint equals the exponential's right Jacobian to second order
    adjoints = _adjoints_to_end(compose(poses, se2_exp(-0.5 * twists * durations[:, None])), end)
    scaled = (adjoints * (durations[:, None] * sigmas)[:, None, :]).transpose(1, 0, 2).reshape(3, -1)
    by_speed, by_rate = adjoints[:, :, :2] @ twists[:, :2, None], adjoints[:, :, 2:]
    by_calibration = np.concatenate([by_speed, by_rate], axis=2).transpose(1, 2, 0) @ durations
    return end, scaled @ scaled.T, by_calibration


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


def whitener(covariance: Array, least: float) -> Array:
    """Return lower triangular W (3, 3) with `W' W` the inverse of a covariance (3, 3) plus `least^2`."""
    root, _ = lapack.dpotrf(covariance + np.eye(3) * least**2, lower=1)
    whitener, _ = lapack.dtrtri(root, lower=1)
    return np.ascontiguousarray(whitener)


def odometry_residuals(poses_start: Array, poses_end: Array, deltas: Array) -> tuple[Array, Array, Array]:
    """Return `r = Log(delta^-1 start^-1 end)` (m, 3), and its Jacobians (m, 3, 3) by start and end."""
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


def whitened_odometry(
    poses_start: Array,
    poses_end: Array,
    deltas: Array,
    whiteners: Array,
    by_calibration: Array,
    calibration: Array,
) -> tuple[Array, Array]:
    """Return `W (r + G b)` (m, 3) with r of `odometry_residuals`, and its derivatives (m, 3, 8)."""
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
