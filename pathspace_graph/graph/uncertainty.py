"""The uncertainty of measurements that are not in the graph yet, which gates them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .gaussian import FactoredSystem, half_solve
from .keys import CALIBRATION_LETTER, POSE, pose_keys
from .odometry import OdometryChain, through_odometry
from .rows import Rows

Array = NDArray[np.float64]


def predicted_covariance(
    step: FactoredSystem, rows: Rows, poses: Array, odometry: OdometryChain, newest: int, together: int
) -> Array:
    """Returns the predicted covariances `J Sigma J'` (m / k, k, k) of every k = `together` rows.

    The pose is the first key of a row, and Sigma is the covariance of the last step. The pose of the cycle
    `newest` was not in that step, so it is replaced by its prediction from the pose before: the odometry's
    last interval leads from the first of `poses` (2, 3) to it. A map point that was not in the step
    contributes nothing.
    """
    gradient, row = np.zeros((step.layout.size, len(rows)), order="F"), np.arange(len(rows))
    columns = rows.columns(step.layout)
    known = columns >= 0
    gradient[columns[known], np.broadcast_to(row[:, None], columns.shape)[known]] = rows.jacobian[known]
    noise, on_newest = np.zeros((len(rows), POSE)), columns[:, 0] < 0
    if on_newest.any():
        by_previous, by_calibration, noise[on_newest] = through_odometry(
            rows.jacobian[on_newest, :POSE], poses, odometry
        )
        previous = pose_keys(np.array([newest - 1]))
        gradient[step.layout.entries(previous)[:, None], row[on_newest]] += by_previous.T
        gradient[step.layout.block(CALIBRATION_LETTER), row[on_newest]] += by_calibration.T
    half = half_solve(step.factor, gradient).T.reshape(-1, together, step.layout.size)
    own = noise.reshape(-1, together, POSE)
    return np.asarray(half @ half.transpose(0, 2, 1) + own @ own.transpose(0, 2, 1))
