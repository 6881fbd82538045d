"""Rigid motions of the plane, SE(2): a pose is `(x, y, theta)` in m, m and rad."""

from math import cos, sin
from typing import Final

import numpy as np

from . import _kernels as kernels
from .arrays import Array


def wrap_angle(angle: Array) -> Array:
    """Wrap angles (rad) to (-pi, pi]."""
    return -((np.pi - angle) % (2.0 * np.pi) - np.pi)


def difference(poses: Array, others: Array) -> Array:
    """Difference of poses (..., 3) as coordinates, with headings wrapped to (-pi, pi]."""
    off = poses - others
    off[..., 2] = wrap_angle(off[..., 2])
    return off


def rotation(theta: float) -> Array:
    """Rotation matrix R(theta) (2, 2) from the vehicle frame to the map frame."""
    c, s = cos(theta), sin(theta)
    return np.array([[c, -s], [s, c]])


def rotations(theta: Array) -> Array:
    """Rotation matrices R(theta) (m, 2, 2) of angles (m,)."""
    turn = np.empty((len(theta), 2, 2))
    turn[:, 0, 0] = turn[:, 1, 1] = np.cos(theta)
    turn[:, 1, 0] = np.sin(theta)
    turn[:, 0, 1] = -turn[:, 1, 0]
    return turn


def rotated(covariances: Array, theta: Array) -> Array:
    """Rotate covariances K (m, 2, 2) by angles (m,): `R K R'`."""
    turn = rotations(theta)
    return np.asarray(turn @ covariances @ turn.transpose(0, 2, 1))


def left_of(vectors: Array) -> Array:
    """Turn vectors (..., 2) by a quarter to the left: (x, y) becomes (-y, x)."""
    turned = np.empty_like(vectors)
    turned[..., 0] = -vectors[..., 1]
    turned[..., 1] = vectors[..., 0]
    return turned


def compose(pose: Array, delta: Array) -> Array:
    """Compose `pose * delta` on SE(2), for one pose (3,) or row by row (k, 3).

    Headings are not wrapped, so that whole turns accumulate.
    """
    if pose.ndim == delta.ndim == 1:
        (x, y, theta), (dx, dy, turn) = pose.tolist(), delta.tolist()
        c, s = cos(theta), sin(theta)
        return np.array([x + c * dx - s * dy, y + s * dx + c * dy, theta + turn])
    cosine, sine, along, left = np.cos(pose[..., 2]), np.sin(pose[..., 2]), delta[..., 0], delta[..., 1]
    x, y = pose[..., 0] + cosine * along - sine * left, pose[..., 1] + sine * along + cosine * left
    return np.array([x, y, pose[..., 2] + delta[..., 2]]).T


def inverse(pose: Array) -> Array:
    """Inverse (3,) of a pose on SE(2); its heading is not wrapped."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return np.array([-c * pose[0] - s * pose[1], s * pose[0] - c * pose[1], -pose[2]])


def relative(pose: Array, other: Array) -> Array:
    """Relative pose `pose^-1 * other` (3,) on SE(2); its heading is not wrapped."""
    return np.append(rotation(pose[2]).T @ (other[:2] - pose[:2]), other[2] - pose[2])


def move_points(motion: Array, points: Array) -> Array:
    """Move points p (m, 2) by a rigid motion (3,) of the map frame: `R p + t`."""
    return np.asarray(points @ rotation(motion[2]).T + motion[:2])


def path_lengths(path: Array) -> Array:
    """Length (n,) of a path from its first point (n, 2), or pose (n, 3), to each one (m)."""
    return np.append(0.0, np.cumsum(np.hypot(*np.diff(path[:, :2], axis=0).T)))


to_map: Final = kernels.to_map
"""Transform points z (m, 2) from the vehicle frames of poses (m, 3) to the map frame: `p = R z + t`."""


def in_vehicle(directions: Array, poses: Array) -> Array:
    """Rotate vectors (m, 2) from the map frame to the vehicle frames of poses (m, 3)."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    x, y = directions[:, 0], directions[:, 1]
    return np.array([c * x + s * y, -s * x + c * y]).T


def to_vehicle(points_map: Array, poses: Array) -> Array:
    """Transform points p (m, 2) from the map frame to vehicle frames of poses (m, 3): `z = R^T (p - t)`."""
    return in_vehicle(points_map - poses[:, :2], poses)


def se2_exp(tangents: Array) -> Array:
    """Exponential map of SE(2): relative poses (k, 3) of tangents (k, 3).

    A tangent is a twist `(vx, vy, wz)` times its duration, in m, m and rad.
    """
    x, y, theta = tangents.T
    half = np.where(theta == 0.0, np.finfo(float).tiny, 0.5 * theta)  # avoid 0 / 0: sin(half) / half is 1
    sine, cosine = np.sin(half), np.cos(half)
    sinc, cosc = sine * cosine / half, sine * sine / half
    return np.array([sinc * x - cosc * y, cosc * x + sinc * y, theta]).T
