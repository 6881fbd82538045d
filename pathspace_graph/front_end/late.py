"""Late cycles: detections that come after newer ones, while their time is still inside the window."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.odometry import odometry_residuals
from pathspace_graph.factors.se2 import left_of, move_points, rotation, se2_exp
from pathspace_graph.graph.smoother import FixedLagSmoother
from pathspace_graph.graph.window import MapRows
from pathspace_graph.io.log import Detections
from pathspace_graph.settings.front_end import MotionSettings

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LateDetections:
    """Holds the detections of a late cycle as they would be seen from a pose of the window."""

    detections: Detections
    """These are the detections, in the vehicle frame of that pose."""
    cycle: int
    """The pose is that of this perception cycle."""
    twist: Array
    """(3,) The vehicle moved with this mean twist then, in m/s, m/s and rad/s."""


def at_nearest_pose(
    smoother: FixedLagSmoother[MapRows], detections: Detections, settings: MotionSettings
) -> LateDetections:
    """Returns late detections as they would be seen from the pose of the window that is nearest in time.

    No pose is added. The vehicle is taken to move with a constant twist from the pose before the stamp to the
    pose after it. With T the motion from the nearest pose to the late one, a detection z with covariance K
    becomes `T z` with `R (K + G Q G') R'`, where `G = [I | J z]` and J is the quarter turn. Q is the
    covariance of the odometry for the share of the interval up to the nearest pose, and what a changing twist
    may add: half the acceleration times the times to both poses. This treats the errors of the detections as
    independent, though one motion has moved them all.
    """
    times, poses, t = smoother.times, smoother.variables.poses, detections.t
    after = int(np.searchsorted(times, t))
    before, duration = after - 1, times[after] - times[after - 1]
    (motion,), _, _ = odometry_residuals(poses[before, None], poses[after, None], np.zeros((1, 3)))
    share = (t - times[before]) / duration
    nearest, share = (before, share) if share < 0.5 else (after, share - 1.0)
    moved, whitener = se2_exp(share * motion[None])[0], smoother.window.odometry.whiteners[before]
    bend = 0.5 * (t - times[before]) * (times[after] - t) * np.array(settings.accelerations)
    spread = abs(share) * np.linalg.inv(whitener.T @ whitener) + np.diag(bend**2)
    z = detections.points_vehicle
    by_motion = np.zeros((len(z), 2, 3))
    by_motion[:, :, :2], by_motion[:, :, 2] = np.eye(2), left_of(z)
    turn = rotation(moved[2])
    covariances = turn @ (detections.covariances + by_motion @ spread @ by_motion.transpose(0, 2, 1)) @ turn.T
    seen = replace(detections, points_vehicle=move_points(moved, z), covariances=covariances)
    return LateDetections(seen, smoother.first_cycle + nearest, motion / duration)
