"""The landmark factor: a reading against the one point that it saw, with its full covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LandmarkResiduals:
    """Two rows a reading, in the vehicle frame, not whitened."""

    residual: Array
    """(m, 2) where the landmark should be seen, minus where it was, m."""
    by_pose: Array
    """(m, 2, 3) derivative by the pose (x, y, theta) in the map frame."""
    by_landmark: Array
    """(m, 2, 2) derivative by the landmark in the map frame: the transposed rotation."""


def landmark_residuals(poses: Array, landmarks: Array, readings: Array) -> LandmarkResiduals:
    """`r = R^T (l - t) - z`: poses (m, 3), landmarks (m, 2) in the map frame, readings (m, 2).

    dr/dt = -R^T,   dr/dtheta = (a_y, -a_x) with a = R^T (l - t),   dr/dl = R^T.
    """
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    dx, dy = landmarks[:, 0] - poses[:, 0], landmarks[:, 1] - poses[:, 1]
    seen = np.column_stack([c * dx + s * dy, -s * dx + c * dy])
    by_landmark = np.stack([np.column_stack([c, s]), np.column_stack([-s, c])], axis=1)
    by_theta = np.column_stack([seen[:, 1], -seen[:, 0]])
    by_pose = np.concatenate([-by_landmark, by_theta[:, :, None]], axis=2)
    return LandmarkResiduals(seen - readings, by_pose, by_landmark)
