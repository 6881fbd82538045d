"""The spline-projection factor: a detection's signed distance across the curve, without any association."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .footpoint import FootPoints

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ProjectionRows:
    """Holds one row for each detection: residual, standard deviation and Jacobian blocks, not whitened."""

    residual: Array
    """This is the signed distance (m,) of the detection from the curve, in m, positive left of travel."""
    sigma: Array
    """This is the standard deviation (m,) of the detection across the curve, in m."""
    by_pose: Array
    """These are the derivatives (m, 3) by the pose (x, y, theta) in the map frame."""
    by_control: Array
    """These are the derivatives (m, degree + 1, 2) by the control points of the foot point's span."""


def sigma_across(normals: Array, covariances: Array, poses: Array, sigma_model: float) -> Array:
    """Returns `sqrt(n^T R K R^T n + sigma_model^2)` (m,), the sigma of each detection across the curve, in m.

    normals n (m, 2) are in the map frame, covariances K (m, 2, 2) in the vehicle frame of each row's pose
    (m, 3).
    """
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    nx, ny = c * normals[:, 0] + s * normals[:, 1], -s * normals[:, 0] + c * normals[:, 1]
    variance = (
        nx * nx * covariances[:, 0, 0] + 2.0 * nx * ny * covariances[:, 0, 1] + ny * ny * covariances[:, 1, 1]
    )
    return np.sqrt(variance + sigma_model**2)


def project(
    points_map: Array, covariances: Array, poses: Array, foot: FootPoints, sigma_model: float
) -> ProjectionRows:
    """Returns `r = n . (p - S(u))` with u the foot point of `p = R z + t` (paper: Update).

    points_map p (m, 2) are in m, covariances (m, 2, 2) in the vehicle frame of each row's pose (m, 3). At an
    interior foot point `p - S` is along n while `S'` and `dn/du` are along the tangent. So every term through
    u vanishes, and with J the quarter turn

        dr/dt = n,   dr/dtheta = n . (J R z),   dr/dc_j = -beta_j(u) n

    are exact at any distance from the curve. They are not exact at an end of the curve or of a stretch: such
    rows are to be left out (`foot.interior`).
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
