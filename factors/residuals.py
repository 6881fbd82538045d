"""Residuals of detections and weak priors, with their Jacobians, as functions of arrays."""

from dataclasses import dataclass

import numpy as np
import scipy  # imports its modules on first use

from .arrays import Array
from .bspline import scatter
from .footpoint import FootPoints
from .se2 import in_vehicle, to_vehicle


@dataclass(frozen=True)
class ProjectionRows:
    """One row for each detection, not whitened: residual, standard deviation and Jacobian blocks."""

    residual: Array  # (m,) signed distance of the detection from the curve, in m, positive left of travel
    sigma: Array  # (m,) standard deviation of the detection across the curve, in m
    by_pose: Array  # (m, 3) derivatives by the pose (x, y, theta) in the map frame
    by_control: Array  # (m, degree + 1, 2) derivatives by the control points of the foot point's span


def chi2_quantile(probability: float, degrees: int) -> float:
    """Chi-square quantile; importing `scipy.stats` for it would dominate the start-up time."""
    return 2.0 * float(scipy.special.gammaincinv(0.5 * degrees, probability))


def sigma_across(normals: Array, covariances: Array, poses: Array, sigma_model: float) -> Array:
    """Standard deviations `sqrt(n^T R K R^T n + sigma_model^2)` (m,) of detections across the curve, in m.

    normals n (m, 2) are in the map frame, covariances K (m, 2, 2) in the vehicle frame of each row's pose
    (m, 3).
    """
    nx, ny = in_vehicle(normals, poses).T
    variance = (
        nx * nx * covariances[:, 0, 0] + 2.0 * nx * ny * covariances[:, 0, 1] + ny * ny * covariances[:, 1, 1]
    )
    return np.asarray(np.sqrt(variance + sigma_model**2))


def project(
    points_map: Array, covariances: Array, poses: Array, foot: FootPoints, sigma_model: float
) -> ProjectionRows:
    """Linearize `r = n . (p - S(u))` with u the foot point of `p = R z + t` (paper: Update).

    points_map p (m, 2) are in m, covariances (m, 2, 2) in the vehicle frame of each row's pose (m, 3). At an
    interior foot point `p - S` is along n, and `S'` and `dn/du` are along the tangent. So every term through
    u vanishes, and with J the quarter turn

        dr/dt = n,   dr/dtheta = n . (J R z),   dr/dc_j = -beta_j(u) n

    are exact at any distance from the curve. They do not hold elsewhere: drop rows that are not
    `foot.interior`.
    """
    n = foot.normal_unit
    arm = points_map - poses[:, :2]
    by_theta = n[:, 1] * arm[:, 0] - n[:, 0] * arm[:, 1]
    return ProjectionRows(
        residual=foot.distance,
        sigma=sigma_across(n, covariances, poses, sigma_model),
        by_pose=np.concatenate([n, by_theta[:, None]], axis=1),
        by_control=-foot.basis[:, :, None] * n[:, None, :],
    )


@dataclass(frozen=True)
class LandmarkResiduals:
    """Two rows for each detection, in the vehicle frame, not whitened."""

    residual: Array  # (m, 2) expected minus measured position of the landmark, in m
    by_pose: Array  # (m, 2, 3) derivatives by the pose (x, y, theta) in the map frame
    by_landmark: Array  # (m, 2, 2) derivatives by the landmark in the map frame


def landmark_residuals(poses: Array, landmarks: Array, points_vehicle: Array) -> LandmarkResiduals:
    """Linearize `r = R^T (l - t) - z` for poses (m, 3), landmarks l (m, 2) and detections z (m, 2).

    Poses and landmarks are in the map frame, detections in the vehicle frame, all in m. The derivatives are

        dr/dt = -R^T,   dr/dtheta = (a_y, -a_x) with a = R^T (l - t),   dr/dl = R^T
    """
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    expected = to_vehicle(landmarks, poses)
    by_landmark = np.stack([np.column_stack([c, s]), np.column_stack([-s, c])], axis=1)
    by_theta = np.column_stack([expected[:, 1], -expected[:, 0]])
    by_pose = np.concatenate([-by_landmark, by_theta[:, :, None]], axis=2)
    return LandmarkResiduals(expected - points_vehicle, by_pose, by_landmark)


def smoothness_coefficients(abscissae: Array, period: float | None, spacing: float | None = None) -> Array:
    """Coefficients (m - 2, 3) of second divided differences over abscissae (m,), times the squared spacing.

    Row j has the coefficients of the points j, j + 1 and j + 2. They give zero for points on a straight line,
    whatever their spacing. A curve that is closed after `period` has m rows. The default spacing is the mean
    gap of the abscissae.
    """
    m = len(abscissae)
    extended = abscissae if period is None else np.concatenate([abscissae, abscissae[:2] + period])
    gaps = np.diff(extended)
    mean = gaps[:m].mean() if spacing is None else spacing  # count the gap that the period repeats once
    before, after = gaps[:-1], gaps[1:]
    scale = 2.0 * mean**2 / (before + after)
    return np.column_stack([scale / before, -scale / before - scale / after, scale / after])


def smoothness_matrix(abscissae: Array, period: float | None) -> Array:
    """Matrix D (m - 2, m), or (m, m) for a closed curve, of `smoothness_coefficients`."""
    coefficients = smoothness_coefficients(abscissae, period)
    return scatter(coefficients, np.arange(len(coefficients)), len(abscissae), periodic=True)


def greville(knots: Array, degree: int) -> Array:
    """Greville abscissae `(t_{j+1} + ... + t_{j+p}) / p` (n,), where control points act most."""
    n = len(knots) - degree - 1
    windows = np.lib.stride_tricks.sliding_window_view(knots[1:-1], degree)
    return np.asarray(windows[:n].mean(axis=1))
