"""The swap: the map and the prior of the closed loop are replaced by the marginal of the open lap's batch."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.batch.association import locate_poses
from pathspace_graph.batch.lap import LapMarginal
from pathspace_graph.factors.se2 import compose, relative
from pathspace_graph.graph.keys import control_keys, pose_keys
from pathspace_graph.mapping.curve_map import CurveSmoother

from .association import reassociate

Array = NDArray[np.float64]


def go_on_from(smoother: CurveSmoother, marginal: LapMarginal) -> Array:
    """Replaces curves and prior by the marginal of a lap, and returns the jump (3,) of the newest pose.

    The window keeps its own factors of the poses from `first_kept` on, the marginal has those of all poses
    before, so nothing is counted twice. The marginal holds the curves' spacing and shape as well. Poses after
    the last one of the lap are moved with it.
    """
    state, settings, first = smoother.map.state, smoother.map.settings, marginal.first_kept
    smoother.reactivate(with_prior=False)
    before = state.poses[-1].copy()
    removed, added, points = state.map_keys, [], []
    for label, spline in marginal.splines.items():
        boundary = state.boundaries[label] = state.boundaries[label].closed(spline.knots)
        added.append(control_keys(label, boundary.numbers))
        points.append(spline.distinct_control_points)
    smoother.restart(first, removed, np.concatenate(added), np.concatenate(points))
    smoother.map.held_by_prior = True
    smoother.map.scatter, smoother.map.cones = marginal.scatter, marginal.cones
    _move_poses(state.poses, marginal.poses[first:])
    state.variables.calibrations[:] = marginal.calibration
    smoother.map.correct()
    locate_poses(state, settings.batch.association)
    keys = np.concatenate([state.variables.calibration_keys, *added, pose_keys(np.array([first]))])
    smoother.set_prior(keys, marginal.mean, marginal.information)
    reassociate(smoother)
    for _ in range(settings.closing.iterations):
        smoother.step(settings.closing.sigma_step)
    return np.asarray(state.poses[-1] - before)


def _move_poses(poses: Array, solved: Array) -> None:
    """Sets the first poses of the window (P, 3) to the solved ones (k, 3), and moves the others rigidly."""
    last = len(solved) - 1
    later = [relative(poses[last], pose) for pose in poses[last + 1 :]]
    poses[: last + 1] = solved
    for slot, delta in enumerate(later, start=last + 1):
        poses[slot] = compose(poses[last], delta)
