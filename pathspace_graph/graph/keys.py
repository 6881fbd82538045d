"""Keys: what a GTSAM key means, and the order of the keys.

    b_0   calibration of the odometry (scale error [-], yaw-rate bias [rad/s])
    c_0   calibration of the sensor (`factors.sensor:SENSOR`), where it is estimated
    l_j   control point j of the left boundary (m, m), map frame
    m_i   landmark i of the landmark graphs (m, m), map frame
    r_j   control point j of the right boundary (m, m), map frame
    x_k   pose of perception cycle k (m, m, rad), map frame
    y_0   the origin of the map frame, as a pose: the open map hangs on it, and it does not move

A control point keeps its key while its boundary grows; a curve on new knots has new keys. A pose is
`(x, y, theta)` with theta unwrapped, and it changes by addition: its unknowns are not the tangent of
`gtsam.Pose2`.
"""

from __future__ import annotations

from functools import cache
from typing import Final

import gtsam
import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.sensor import SENSOR_SIZE

IntArray = NDArray[np.intp]

CONTROL_LETTERS: Final = ("l", "r")
"""The keys of a boundary's control points have this letter, by the label of the boundary (left, right)."""
LANDMARK_LETTER: Final = "m"
"""The keys of landmarks have this letter."""
CALIBRATION_LETTER: Final = "b"
"""The key of the odometry's calibration has this letter."""
SENSOR_LETTER: Final = "c"
"""The key of the sensor's calibration has this letter."""
POSE_LETTER: Final = "x"
"""The keys of poses have this letter."""
POSE: Final = 3
"""A pose has this number of entries: x, y, theta."""
POINT: Final = 2
"""Every other variable but the sensor's calibration has this number of entries."""
CALIBRATION_KEY: Final = int(gtsam.symbol(CALIBRATION_LETTER, 0))
"""This is the key of the odometry's calibration."""
SENSOR_KEY: Final = int(gtsam.symbol(SENSOR_LETTER, 0))
"""This is the key of the sensor's calibration. The keys of all points and poses are greater."""

_INDEX_BITS: Final = 56
"""GTSAM keeps the index of a symbol in this number of low bits, and its letter in the highest byte."""
_NAMES_IN_MESSAGE: Final = 3
"""A message names at most this number of keys."""


@cache
def letter_keys(letter: str) -> tuple[int, int]:
    """Returns the first key of a letter, and the first key after its last one."""
    first = int(gtsam.symbol(letter, 0))
    return first, first + (1 << _INDEX_BITS)


FIRST_POSE: Final = letter_keys(POSE_LETTER)[0]
"""Poses have the last keys: every key from this one on belongs to a pose."""
ORIGIN_KEY: Final = int(gtsam.symbol("y", 0))
"""This is the key of the origin of the map frame, which is a pose at (0, 0, 0) by definition."""
_FIRST_LANDMARK: Final = letter_keys(LANDMARK_LETTER)[0]
_FIRST_CONTROL: Final = tuple(letter_keys(letter)[0] for letter in CONTROL_LETTERS)


def pose_key(cycle: int) -> int:
    """Returns the key `symbol('x', cycle)` of the pose at a perception cycle, counted from 0."""
    return FIRST_POSE + int(cycle)


def pose_keys(cycles: IntArray) -> IntArray:
    """Returns the keys of the poses at perception cycles, in any shape."""
    return FIRST_POSE + np.asarray(cycles, np.intp)


def control_keys(label: int, numbers: IntArray) -> IntArray:
    """Returns the keys of a boundary's control points by their numbers, in any shape."""
    return _FIRST_CONTROL[label] + np.asarray(numbers, np.intp)


def landmark_keys(numbers: IntArray) -> IntArray:
    """Returns the keys of landmarks by their numbers, in any shape."""
    return _FIRST_LANDMARK + np.asarray(numbers, np.intp)


def indices(keys: IntArray) -> IntArray:
    """Returns the index of each key: the cycle of a pose, or the number of a point."""
    return np.asarray(keys & ((1 << _INDEX_BITS) - 1))


def are_poses(keys: IntArray) -> NDArray[np.bool_]:
    """Returns which keys belong to poses."""
    return np.asarray(keys >= FIRST_POSE)


def sizes(keys: IntArray) -> IntArray:
    """Returns the number of entries of each key's variable, which its letter determines."""
    return np.where(are_poses(keys), POSE, np.where(keys == SENSOR_KEY, SENSOR_SIZE, POINT))


def name(key: int) -> str:
    """Returns a key as text, such as `x12`."""
    return str(gtsam.DefaultKeyFormatter(key))


def names(keys: IntArray) -> str:
    """Returns the first few keys as text, for a message."""
    return ", ".join(name(key) for key in keys[:_NAMES_IN_MESSAGE].tolist())
