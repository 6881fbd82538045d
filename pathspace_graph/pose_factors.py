"""A user's own GTSAM factors on the poses of the window: GNSS, IMU, anything that is a function of Pose2."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from .errors import SettingsError
from .window import POSE, Rows

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]

POSE_CHARACTER = "x"
"""Character of every pose's key."""


def pose_key(cycle: int) -> int:
    """GTSAM's key of the pose at a perception cycle, counted from 0: `symbol('x', cycle)`."""
    return int(gtsam.symbol(POSE_CHARACTER, cycle))


@dataclass(frozen=True)
class _PoseFactor:
    """A factor, and whose poses it is a function of."""

    factor: gtsam.NonlinearFactor
    """The factor."""
    cycles: tuple[int, ...]
    """Perception cycle of each of its keys."""


class PoseFactors:
    """The user's factors, each kept until the first of its poses leaves the window."""

    def __init__(self) -> None:
        self._held: list[_PoseFactor] = []

    def __len__(self) -> int:
        return len(self._held)

    def add(self, factors: Sequence[gtsam.NonlinearFactor], first: int, last: int) -> None:
        """Hold factors on poses of the cycles first..last; SettingsError, and none held, on any other key."""
        self._held += [_PoseFactor(factor, _cycles(factor, first, last)) for factor in factors]

    def drop(self, cycle: int) -> None:
        """The pose of a cycle has left, and with it every factor that it is in."""
        self._held = [held for held in self._held if cycle not in held.cycles]

    def rows(self, poses: Array, first: int, column: int) -> list[Rows]:
        """`A dx - b`, every factor linearized at poses (P, 3), of which the first is that of cycle `first`.

        `column` is the first pose's first entry in the state. A tangent of Pose2 is in the frame of the pose,
        the state's is the map's: `A_xy` becomes `A_xy R^T`.
        """
        values = gtsam.Values()
        for cycle in sorted({cycle for held in self._held for cycle in held.cycles}):
            values.insert(pose_key(cycle), gtsam.Pose2(*poses[cycle - first]))
        linear = [(held, held.factor.linearize(values)) for held in self._held]
        return [_rows(g, poses, first, column) for _, g in linear if g is not None]  # None: not active


def _cycles(factor: gtsam.NonlinearFactor, first: int, last: int) -> tuple[int, ...]:
    """Cycles of a factor's keys; SettingsError where one is not in the window."""
    known = {pose_key(cycle): cycle for cycle in range(first, last + 1)}
    keys = list(factor.keys())
    for key in keys:
        if key not in known:
            raise SettingsError(
                f"factor on {gtsam.DefaultKeyFormatter(key)}: expected keys of poses in the window, "
                f"{POSE_CHARACTER}{first} to {POSE_CHARACTER}{last}"
            )
    return tuple(known[key] for key in keys)


def _rows(linear: gtsam.GaussianFactor, poses: Array, first: int, column: int) -> Rows:
    """A linearized factor's whitened rows, on the state's columns."""
    matrix, right = linear.jacobian()
    slots = np.array(list(map(gtsam.symbolIndex, linear.keys())), np.intp) - first
    jacobian = np.array(matrix, float).reshape(len(right), len(slots), POSE)
    c, s = np.cos(poses[slots, 2]), np.sin(poses[slots, 2])
    x, y = jacobian[:, :, 0].copy(), jacobian[:, :, 1].copy()
    jacobian[:, :, 0], jacobian[:, :, 1] = c * x - s * y, s * x + c * y
    columns = (column + POSE * slots[:, None] + np.arange(POSE)).ravel()
    return Rows(np.tile(columns, (len(right), 1)), jacobian.reshape(len(right), -1), -np.asarray(right))
