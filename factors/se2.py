"""Rigid motions of the plane, SE(2): a pose is `(x, y, theta)` in m, m and rad."""

from math import cos, sin
from typing import Final

import numpy as np

from . import _kernels as kernels
from .arrays import Array


def wrap_angle(angle: Array) -> Array:
    """Return each angle (rad) wrapped to (-pi, pi]."""
    return -((np.pi - angle) % (2.0 * np.pi) - np.pi)


def rotation(theta: float) -> Array:
    """Return R(theta) (2, 2), which turns a vector from the vehicle frame to the map frame."""
    c, s = cos(theta), sin(theta)
    return np.array([[c, -s], [s, c]])


def rotations(theta: Array) -> Array:
    """Return R(theta) (m, 2, 2) of each angle (m,)."""
    c, s = np.cos(theta), np.sin(theta)
    return np.stack([np.stack([c, -s], axis=1), np.stack([s, c], axis=1)], axis=1)


def rotated(covariances: Array, theta: Array) -> Array:
    """Return `R K R'` (m, 2, 2) of covariances K (m, 2, 2), with R(theta) of each angle (m,)."""
    turn = rotations(theta)
    return np.asarray(turn @ covariances @ turn.transpose(0, 2, 1))


def left_of(vectors: Array) -> Array:
    """Return vectors (n, 2) turned by a quarter to the left: (x, y) becomes (-y, x)."""
    turned = np.empty_like(vectors)
    turned[:, 0], turned[:, 1] = -vectors[:, 1], vectors[:, 0]
    return turned


def compose(pose: Array, delta: Array) -> Array:
    """Return `pose * delta` on SE(2), for one pose (3,) or row by row (k, 3).

    Headings are added and not wrapped, so that whole turns accumulate.
    """
    if pose.ndim == delta.ndim == 1:
        (x, y, theta), (dx, dy, turn) = pose.tolist(), delta.tolist()
        c, s = cos(theta), sin(theta)
        return np.array([x + c * dx - s * dy, y + s * dx + c * dy, theta + turn])
    cosine, sine, along, left = np.cos(pose[..., 2]), np.sin(pose[..., 2]), delta[..., 0], delta[..., 1]
    x, y = pose[..., 0] + cosine * along - sine * left, pose[..., 1] + sine * along + cosine * left
    return np.array([x, y, pose[..., 2] + delta[..., 2]]).T


def inverse(pose: Array) -> Array:
    """Return the pose (3,) with `pose * inverse = 0`; its heading is not wrapped."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return np.array([-c * pose[0] - s * pose[1], s * pose[0] - c * pose[1], -pose[2]])


def relative(pose: Array, other: Array) -> Array:
    """Return `pose^-1 * other` (3,) on SE(2); its heading is not wrapped."""
    return np.append(rotation(pose[2]).T @ (other[:2] - pose[:2]), other[2] - pose[2])


def move_points(motion: Array, points: Array) -> Array:
    """Return `R p + t` (m, 2): points (m, 2) after the rigid motion (3,) of the map frame."""
    return np.asarray(points @ rotation(motion[2]).T + motion[:2])


def path_lengths(path: Array) -> Array:
    """Return the length (n,) of a path from its first point (n, 2), or pose (n, 3), to each of them (m)."""
    return np.append(0.0, np.cumsum(np.hypot(*np.diff(path[:, :2], axis=0).T)))


to_map: Final = kernels.to_map
"""`p = R z + t` (m, 2), map frame: points z (m, 2) in the vehicle frames of poses (m, 3)."""


def in_vehicle(directions: Array, poses: Array) -> Array:
    """Return vectors (m, 2), map frame, in the vehicle frames of poses (m, 3)."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    x, y = directions[:, 0], directions[:, 1]
    return np.array([c * x + s * y, -s * x + c * y]).T


def to_vehicle(points_map: Array, poses: Array) -> Array:
    """Return `z = R^T (p - t)` (m, 2): points p (m, 2), map frame, in the vehicle frames of poses (m, 3)."""
    return in_vehicle(points_map - poses[:, :2], poses)


def se2_exp(tangents: Array) -> Array:
    """Return the exponential of SE(2), row by row: relative poses (k, 3).

    Each row of tangents (k, 3) is a twist `(vx, vy, wz)` times its duration, in m, m and rad.
    """
    x, y, theta = tangents.T
    half = np.where(theta == 0.0, np.finfo(float).tiny, 0.5 * theta)  # so that sin(half) / half is 1
    sine, cosine = np.sin(half), np.cos(half)
    sinc, cosc = sine * cosine / half, sine * sine / half
    return np.array([sinc * x - cosc * y, cosc * x + sinc * y, theta]).T
