"""The spline-projection factor: a reading's signed distance across the curve, without any association."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .footpoint import FootPoints
from .noise import whiteners

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ProjectionRows:
    """One row a reading: residual, its standard deviation, and its Jacobian blocks, not whitened."""

    residual: Array
    """(m,) signed distance of the reading from the curve, left of travel positive, m."""
    sigma: Array
    """(m,) standard deviation of the reading across the curve, m."""
    by_pose: Array
    """(m, 3) derivative by the pose (x, y, theta) in the map frame."""
    by_control: Array
    """(m, degree + 1, 2) derivative by the control points of the foot point's span."""


def sigma_across(normals: Array, covariances: Array, poses: Array, sigma_model: float) -> Array:
    """`sqrt(n^T R K R^T n + sigma_model^2)` (m,): a reading's sigma along the map-frame normals (m, 2)."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    nx, ny = c * normals[:, 0] + s * normals[:, 1], -s * normals[:, 0] + c * normals[:, 1]
    variance = (
        nx * nx * covariances[:, 0, 0] + 2.0 * nx * ny * covariances[:, 0, 1] + ny * ny * covariances[:, 1, 1]
    )
    return np.sqrt(variance + sigma_model**2)


def project(
    points_map: Array, covariances: Array, poses: Array, foot: FootPoints, sigma_model: float
) -> ProjectionRows:
    """`r = n . (p - S(u))` with `u` the foot point of `p = R z + t` (paper: Update).

    points_map (m, 2), covariances (m, 2, 2) in the vehicle frame, poses (m, 3) of each row. At an interior
    foot point `p - S` is along `n` while `S'` and `dn/du` are along the tangent, so every term through `u`
    vanishes and

        dr/dt = n,   dr/dtheta = n . (J R z),   dr/dc_j = -beta_j(u) n      (J: the quarter turn)

    are exact at any distance from the curve. At an end of the curve, or of a stretch, they are not: leave
    such rows out (`foot.interior`).
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
    """Two rows a reading, whitened: how far it is from its foot point, and their Jacobian blocks."""

    residual: Array
    """(m, 2) whitened offset from the foot point."""
    by_pose: Array
    """(m, 2, 3) derivative by the pose (x, y, theta) in the map frame."""
    by_control: Array
    """(m, 2, degree + 1, 2) derivative by the control points of the foot point's span."""


def offset_from_foot_point(
    points_map: Array, covariances: Array, poses: Array, foot: FootPoints, sigma_model: float
) -> OffsetRows:
    """`r = W (p - S(u))`, `W^T W = (R K R^T + sigma_model^2 I)^-1`, with `u` held where the foot point is.

    For comparison with `project`, whose arguments it has: at the foot point both see the same distance, but
    this one also holds the curve and the pose along the curve, of which the reading says nothing:

        dr/dt = W,   dr/dtheta = W J R z,   dr/dc_j = -beta_j(u) W      (J: the quarter turn)
    """
    W = whiteners(_widened(covariances, poses, sigma_model))
    offset, arm = points_map - foot.position, points_map - poses[:, :2]
    turned = np.stack([-arm[:, 1], arm[:, 0]], axis=1)
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
