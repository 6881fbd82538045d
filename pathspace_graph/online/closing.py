"""Closing the loop: the newest readings meet the beginning of the curves.

`near_start` says where to look; `register` finds the rigid motion of the newest poses that lays their
readings on the beginning; `tie` holds those readings against the oldest control points; `bend` solves the
whole loop. What then makes each curve periodic is `simplification`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.mapping.curve_map import CurveSmoother
from pathspace_graph.mapping.registration import Registration

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


def tie(smoother: CurveSmoother, registration: Registration) -> None:
    """Move the window onto the beginning, and hold the agreeing readings against it."""
    smoother.reactivate(with_prior=smoother.submaps is None)
    poses = smoother.map.state.poses
    poses[:, :2] = registration.motion.apply(poses[:, :2])
    poses[:, 2] += registration.motion.vector[2]
    for label, (rows, u) in registration.matches.items():
        smoother.map.readings.take(rows, label, u)


def bend(smoother: CurveSmoother) -> None:
    """Solve the whole loop, each submap relinearized in its own frame."""
    settings = smoother.map.settings.closing
    smoother.solve_loop(settings.iterations, settings.sigma_step)
