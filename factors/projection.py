"""The spline-projection factor: a detection's signed distance across the curve, without any association.

The place factor is its distance along the curve from the place of the cone that it saw.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .footpoint import FootPoints
from .noise import whiteners
from .se2 import left_of

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


@dataclass(frozen=True)
class OffsetRows:
    """Holds two whitened rows for each detection: its offset from the foot point, and Jacobian blocks."""

    residual: Array
    """These are the whitened offsets (m, 2) from the foot points."""
    by_pose: Array
    """These are the derivatives (m, 2, 3) by the pose (x, y, theta) in the map frame."""
    by_control: Array
    """These are the derivatives (m, 2, degree + 1, 2) by the control points of the foot point's span."""


def offset_from_foot_point(
    points_map: Array, covariances: Array, poses: Array, foot: FootPoints, sigma_model: float
) -> OffsetRows:
    """Returns `r = W (p - S(u))` with u held, and `W^T W = (R K R^T + sigma_model^2 I)^-1`.

    This is the point-to-point variant of `project`, for an ablation, with the same arguments. Both see the
    same distance at the foot point, but this one also constrains the pose and the curve along the curve,
    where a detection has no information. With J the quarter turn

        dr/dt = W,   dr/dtheta = W J R z,   dr/dc_j = -beta_j(u) W
    """
    W = whiteners(_widened(covariances, poses, sigma_model))
    offset, arm = points_map - foot.position, points_map - poses[:, :2]
    turned = left_of(arm)
    return OffsetRows(
        residual=np.einsum("mij,mj->mi", W, offset),
        by_pose=np.concatenate([W, np.einsum("mij,mj->mi", W, turned)[:, :, None]], axis=2),
        by_control=-foot.basis[:, None, :, None] * W[:, :, None, :],
    )


def _widened(covariances: Array, poses: Array, sigma_model: float) -> Array:
    """Returns `R K R^T + sigma_model^2 I` (m, 2, 2) in the map frame, K (m, 2, 2) in the vehicle frame."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    turns = np.moveaxis(np.array([[c, -s], [s, c]]), -1, 0)
    return np.asarray(turns @ covariances @ turns.transpose(0, 2, 1) + sigma_model**2 * np.eye(2))


# --- the place of a cone along the curve -----------------------------------------------------------------


@dataclass(frozen=True)
class PlaceRows:
    """Holds one row for each detection: residual, tangent and Jacobian blocks, not whitened."""

    residual: Array
    """This is the distance (m,) of the detection past its cone's place, in m, along the tangent there."""
    tangent_unit: Array
    """These are the unit tangents (m, 2) at the places, map frame."""
    by_pose: Array
    """These are the derivatives (m, 3) by the pose (x, y, theta) in the map frame."""
    by_control: Array
    """These are the derivatives (m, degree + 1, 2) by the control points of the place's span."""

    @property
    def flat_by_control(self) -> Array:
        """Returns the derivatives (m, 2 (degree + 1)) by the coordinates of the control points."""
        return self.by_control.reshape(-1, 2 * self.by_control.shape[1])


def along_from_place(
    points_map: Array, poses: Array, control_points: Array, basis: Array, basis_slope: Array
) -> PlaceRows:
    """Returns `r = t . (p - S(u_k))`, where t is the unit tangent at the place u_k of a cone on the curve.

    The parameter u_k is a constant. So `S(u_k)` and its slope `S'(u_k)` are fixed combinations of the control
    points c_j (m, degree + 1, 2) of the place's span, with the coefficients `basis` and `basis_slope`
    (m, degree + 1). points_map `p = R z + t_pose` (m, 2) are in m, poses (m, 3) in the map frame. With J the
    quarter turn, n the unit normal and `d = n . (p - S)`, the derivatives are exact at any distance:

        dr/dt_pose = t,   dr/dtheta = t . (J R z),   dr/dc_j = -beta_j t + d / |S'| beta'_j n
    """
    position = np.einsum("mj,mjd->md", basis, control_points)
    slope = np.einsum("mj,mjd->md", basis_slope, control_points)
    speed = np.hypot(slope[:, 0], slope[:, 1])
    t = slope / speed[:, None]
    n = left_of(t)
    offset, arm = points_map - position, points_map - poses[:, :2]
    turning = (n * offset).sum(axis=1) / speed
    by_theta = t[:, 1] * arm[:, 0] - t[:, 0] * arm[:, 1]
    return PlaceRows(
        residual=(t * offset).sum(axis=1),
        tangent_unit=t,
        by_pose=np.concatenate([t, by_theta[:, None]], axis=1),
        by_control=(turning[:, None] * basis_slope)[:, :, None] * n[:, None, :]
        - basis[:, :, None] * t[:, None, :],
    )
