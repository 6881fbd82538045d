"""Closing: the whole loop is solved with the newest detections on the beginning of the curves.

`registration.register` finds where the newest poses are on the beginning. `apply_correspondences` moves them
there and holds their detections against the oldest control points. `optimize_loop` solves the whole loop.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.mapping.curve_map import CurveSmoother
from pathspace_graph.mapping.registration import Registration

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


def apply_correspondences(smoother: CurveSmoother, registration: Registration) -> None:
    """Move the window onto the beginning, and hold the agreeing readings against it."""
    smoother.reactivate(with_prior=smoother.submaps is None)
    poses = smoother.map.state.poses
    poses[:, :2] = registration.motion.apply(poses[:, :2])
    poses[:, 2] += registration.motion.vector[2]
    for label, (rows, u) in registration.matches.items():
        smoother.map.detections.take(rows, label, u)


def optimize_loop(smoother: CurveSmoother) -> None:
    """Solve the whole loop, each submap relinearized in its own frame."""
    settings = smoother.map.settings.closing
    smoother.solve_loop(settings.iterations, settings.sigma_step)
