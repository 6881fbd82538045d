"""The landmark factor: a detection against the landmark that it saw, with its full covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .se2 import to_vehicle

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LandmarkResiduals:
    """Holds two rows for each detection, in the vehicle frame, not whitened."""

    residual: Array
    """Each row (m, 2) is the expected minus the measured position of the landmark, in m."""
    by_pose: Array
    """These are the derivatives (m, 2, 3) by the pose (x, y, theta) in the map frame."""
    by_landmark: Array
    """These are the derivatives (m, 2, 2) by the landmark in the map frame, the transposed rotations."""


def landmark_residuals(poses: Array, landmarks: Array, points_vehicle: Array) -> LandmarkResiduals:
    """Returns `r = R^T (l - t) - z`, with poses (m, 3) and landmarks l (m, 2) in the map frame.

    The detections z are points_vehicle (m, 2) in the vehicle frame, in m. The derivatives are

        dr/dt = -R^T,   dr/dtheta = (a_y, -a_x) with a = R^T (l - t),   dr/dl = R^T
    """
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    expected = to_vehicle(landmarks, poses)
    by_landmark = np.stack([np.column_stack([c, s]), np.column_stack([-s, c])], axis=1)
    by_theta = np.column_stack([expected[:, 1], -expected[:, 0]])
    by_pose = np.concatenate([-by_landmark, by_theta[:, :, None]], axis=2)
    return LandmarkResiduals(expected - points_vehicle, by_pose, by_landmark)
