"""The motion of the vehicle by its odometry, for different meanings of the odometry's columns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.se2 import se2_exp
from pathspace_graph.io.log import Odometry

Array = NDArray[np.float64]

Content = Literal["twist", "twist in the map frame", "pose", "nothing"]
"""The columns of the odometry hold this; with `nothing` the vehicle does not move at all."""

DEGREE: Final = float(np.pi / 180.0)
"""This is a degree in radians."""


@dataclass(frozen=True)
class Meaning:
    """Says what the columns of the odometry mean."""

    speed: float = 1.0
    """The unit of the speeds is this in m/s."""
    rate: float = 1.0
    """The unit of the yaw rate is this in rad/s."""
    content: Content = "twist"
    """The columns hold a twist of the vehicle, one in the axes of the map, or a pose."""

    def poses(self, odometry: Odometry) -> Array:
        """Returns the poses (N, 3) at the stamps, in a frame of their own; theta is not wrapped."""
        measured = odometry.twist * [self.speed, self.speed, self.rate]
        if self.content == "pose":
            return np.column_stack([measured[:, :2], np.unwrap(measured[:, 2])])
        if self.content == "nothing":
            return np.zeros_like(measured)
        dt = np.diff(odometry.t)[:, None]
        heading = np.append(0.0, np.cumsum(measured[:-1, 2:] * dt))
        if self.content == "twist":
            steps = _turned(se2_exp(measured[:-1] * dt)[:, :2], heading[:-1])
        else:
            steps = measured[:-1, :2] * dt
        return np.column_stack([np.cumsum(np.vstack([np.zeros(2), steps]), axis=0), heading])


def motions(odometry_t: Array, poses: Array, begin: Array, end: Array) -> Array:
    """Returns the motions (P, 3) between stamps (P,), each in the frame of its beginning.

    Between the stamps (N,) of the poses (N, 3) the motion is even.
    """
    first, last = _at(odometry_t, poses, begin), _at(odometry_t, poses, end)
    moved = _turned(last[:, :2] - first[:, :2], -first[:, 2])
    return np.column_stack([moved, last[:, 2] - first[:, 2]])


def _at(odometry_t: Array, poses: Array, stamps: Array) -> Array:
    """Returns the poses (P, 3) at stamps (P,) by linear interpolation; beyond the ends they are held."""
    return np.column_stack([np.interp(stamps, odometry_t, column) for column in poses.T])


def _turned(vectors: Array, angles: Array) -> Array:
    """Returns vectors (n, 2), each turned by its angle (n,)."""
    c, s = np.cos(angles), np.sin(angles)
    return np.column_stack([c * vectors[:, 0] - s * vectors[:, 1], s * vectors[:, 0] + c * vectors[:, 1]])
