"""Twists from poses, for records that have no twists."""

from __future__ import annotations

from itertools import pairwise

import gtsam
import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.se2 import relative

Array = NDArray[np.float64]


def twists_of(moves: Array) -> Array:
    """Returns the logarithm (n, 3) of relative poses (n, 3): the twists that lead there in 1 s."""
    return np.array([gtsam.Pose2.Logmap(gtsam.Pose2(*move)) for move in moves]).reshape(-1, 3)


def twists_between(t: Array, poses: Array) -> Array:
    """Returns the constant twists (n - 1, 3) that lead from each pose (n, 3) at t (n,) in s to the next."""
    moves = np.array([relative(one, other) for one, other in pairwise(poses)])
    return twists_of(moves) / np.diff(t)[:, None]
