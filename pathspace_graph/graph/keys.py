"""The convention of keys, and their order: the one place that says what a GTSAM key means.

    b_0   calibration of the odometry (scale error [-], yaw-rate bias [rad/s])
    l_j   control point j of the left boundary (m, m), map frame
    m_i   landmark i of the landmark graphs (m, m), map frame
    r_j   control point j of the right boundary (m, m), map frame
    x_k   pose of perception cycle k (m, m, rad), map frame

A control point keeps its key while its boundary grows; new knots make new keys. A pose is `(x, y, theta)`
with theta unwrapped, and it changes by addition: its unknowns are not the tangent of `gtsam.Pose2`.
"""

from __future__ import annotations

from functools import cache
from typing import Final

import gtsam
import numpy as np
from numpy.typing import NDArray

IntArray = NDArray[np.intp]

CONTROL_LETTERS: Final = ("l", "r")
"""Letter of a boundary's control points, by its label (left, right)."""
LANDMARK_LETTER: Final = "m"
"""Letter of landmarks."""
CALIBRATION_LETTER: Final = "b"
"""Letter of the odometry's calibration."""
POSE_LETTER: Final = "x"
"""Letter of poses."""
POSE: Final = 3
"""Entries of a pose: x, y, theta."""
POINT: Final = 2
"""Entries of every other variable: a control point, a landmark, the calibration."""
CALIBRATION_KEY: Final = int(gtsam.symbol(CALIBRATION_LETTER, 0))
"""Key of the odometry's calibration."""

_INDEX_BITS = 56  # GTSAM packs a symbol as its letter in the highest byte and its index below


@cache
def letter_keys(letter: str) -> tuple[int, int]:
    """The first key of a letter, and the first one past them."""
    first = int(gtsam.symbol(letter, 0))
    return first, first + (1 << _INDEX_BITS)


FIRST_POSE: Final = letter_keys(POSE_LETTER)[0]
"""Poses have the last keys: every key from here on is one."""
_FIRST_LANDMARK: Final = letter_keys(LANDMARK_LETTER)[0]
_FIRST_CONTROL: Final = tuple(letter_keys(letter)[0] for letter in CONTROL_LETTERS)


def pose_key(cycle: int) -> int:
    """Key of the pose at a perception cycle, counted from 0: `symbol('x', cycle)`."""
    return FIRST_POSE + int(cycle)


def pose_keys(cycles: IntArray) -> IntArray:
    """Keys of the poses at perception cycles, of any shape."""
    return FIRST_POSE + np.asarray(cycles, np.intp)


def control_keys(label: int, numbers: IntArray) -> IntArray:
    """Keys of a boundary's control points by their numbers, of any shape."""
    return _FIRST_CONTROL[label] + np.asarray(numbers, np.intp)


def landmark_keys(numbers: IntArray) -> IntArray:
    """Keys of landmarks by their numbers, of any shape."""
    return _FIRST_LANDMARK + np.asarray(numbers, np.intp)


def indices(keys: IntArray) -> IntArray:
    """Index of each key behind its letter: the cycle of a pose, the number of a point."""
    return np.asarray(keys & ((1 << _INDEX_BITS) - 1))


def are_poses(keys: IntArray) -> NDArray[np.bool_]:
    """Which keys are poses."""
    return np.asarray(keys >= FIRST_POSE)


def sizes(keys: IntArray) -> IntArray:
    """Entries of each key's variable: a key has one size, by its letter."""
    return np.where(are_poses(keys), POSE, POINT)


def name(key: int) -> str:
    """A key as a person reads it, such as `x12`."""
    return str(gtsam.DefaultKeyFormatter(key))
