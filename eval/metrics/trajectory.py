"""The error of a trajectory, by the truth or by another run's trajectory, and of the vehicle at its end."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.batch.association import path_lengths
from pathspace_graph.factors.se2 import wrap_angle
from pathspace_graph.io.log import Truth
from pathspace_graph.io.results import VehicleState

from .table1 import root_mean_square

Array = NDArray[np.float64]

LOST: Final = 5.0
"""A vehicle is lost where its position is wrong by more than this (m)."""
ASTRAY: Final = 1.0
"""A vehicle is astray where its position is wrong by more than this (m)."""
END: Final = 1.0
"""The end of a log is this long (s)."""


def interpolate_poses(pose_t: Array, poses: Array, t: Array) -> Array:
    """Returns poses (n, 3) [x, y, theta] at the stamps t (n,), linear between poses (N, 3) at pose_t (N,).

    Headings turn the shorter way.
    """
    columns = (poses[:, 0], poses[:, 1], np.unwrap(poses[:, 2]))
    x, y, theta = (np.interp(t, pose_t, column) for column in columns)
    return np.stack([x, y, wrap_angle(theta)], axis=1)


def pose_errors(t: Array, poses: Array, reference_t: Array, reference: Array) -> Array:
    """Returns [along, across, heading] (k, 3) in m, m, rad: the error of each pose in its reference's frame.

    t is (n,), poses is (n, 3). Nothing is aligned. Stamps outside those of the reference are left out, so
    k <= n.
    """
    inside = (t >= reference_t[0]) & (t <= reference_t[-1])
    expected = interpolate_poses(reference_t, reference, t[inside])
    dx, dy, turn = (poses[inside] - expected).T
    c, s = np.cos(expected[:, 2]), np.sin(expected[:, 2])
    return np.stack([c * dx + s * dy, c * dy - s * dx, wrap_angle(turn)], axis=1)


def trajectory_errors(t: Array, poses: Array, truth: Truth) -> Array:
    """Returns `pose_errors` by the true path."""
    return pose_errors(t, poses, truth.pose_t, truth.poses)


def ate(t: Array, poses: Array, truth: Truth) -> float:
    """Returns the absolute trajectory error sqrt(mean |p - p_true|^2) in m, without alignment."""
    return position_rms(trajectory_errors(t, poses, truth))


def end_of_trajectory(t: Array, poses: Array, truth: Truth) -> dict[str, float]:
    """Returns the largest position error (m), its rms in the last second (m), and whether that is a vehicle
    that is lost."""
    errors = trajectory_errors(t, poses, truth)
    if len(errors) == 0:
        return {}
    known = t[(t >= truth.pose_t[0]) & (t <= truth.pose_t[-1])]
    error_end = position_rms(errors[known >= known[-1] - END])
    return {
        "error_max": float(np.linalg.norm(errors[:, :2], axis=1).max()),
        "error_end": error_end,
        "lost_at_end": bool(error_end > LOST),
    }


def longest_astray(t: Array, poses: Array, truth: Truth, since: float) -> dict[str, float]:
    """Returns the longest time (s) and way (m) for which a vehicle was astray, from a stamp (s) on.

    It is counted from the first cycle that is wrong by more than a metre up to the next one that is right, or
    to the end.
    """
    after = (t >= max(since, truth.pose_t[0])) & (t <= truth.pose_t[-1])
    if not after.any():
        return {}
    stamps, errors = t[after], np.linalg.norm(trajectory_errors(t[after], poses[after], truth)[:, :2], axis=1)
    driven = np.interp(stamps, truth.pose_t, path_lengths(truth.poses))
    astray = np.append(errors > ASTRAY, False).astype(int)
    begins = np.flatnonzero(np.diff(astray, prepend=0) == 1)
    ends = np.minimum(np.flatnonzero(np.diff(astray, prepend=0) == -1), len(stamps) - 1)
    return {
        "astray_time": float((stamps[ends] - stamps[begins]).max(initial=0.0)),
        "astray_way": float((driven[ends] - driven[begins]).max(initial=0.0)),
    }


def vehicle_errors(state: VehicleState, t: float, truth: Truth) -> dict[str, float]:
    """Returns the calibration and the heading at a stamp (s): estimate, truth, claimed sigma and error.

    `KEY_by_sigma` is the error by its claimed standard deviation. What the truth doesn't know is absent.
    """
    _, _, sigma_heading, sigma_scale, sigma_bias = state.sigmas.tolist()
    scale, bias = state.calibration.tolist()
    values = {"scale": scale, "bias": bias, "scale_sigma": sigma_scale, "bias_sigma": sigma_bias}
    values["heading_sigma"] = sigma_heading
    if truth.calibration is not None:
        values["scale_true"], values["bias_true"] = truth.calibration.tolist()
        values |= _error("scale", scale - values["scale_true"], sigma_scale)
        values |= _error("bias", bias - values["bias_true"], sigma_bias)
    if len(truth.poses) and truth.pose_t[0] <= t <= truth.pose_t[-1]:
        ((_, _, heading),) = trajectory_errors(np.array([t]), state.pose[None], truth)
        values |= _error("heading", float(heading), sigma_heading)
    return values


def _error(key: str, error: float, sigma: float) -> dict[str, float]:
    return {f"{key}_error": error, f"{key}_by_sigma": error / sigma}


def position_rms(errors: Array) -> float:
    """Returns the root mean square distance (m) of pose errors (k, 3)."""
    return root_mean_square(np.linalg.norm(errors[:, :2], axis=1))
