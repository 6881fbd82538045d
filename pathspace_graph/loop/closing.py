"""Loop closing and simplification (paper: Simplification), and the marginal and gauge of the closed map.

`mapping.registration.register` finds the correspondences between the newest detections and the beginning of
the curves. `apply_correspondences` moves the window there and associates the detections with the oldest
control points, `optimize_loop` solves the whole loop, and `simplify` makes the curves periodic.
"""

from typing import Final

import numpy as np
from scipy.linalg import block_diag

from pathspace_graph.batch.association import locate_poses
from pathspace_graph.batch.lap import LapMarginal
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.se2 import compose, left_of, relative
from pathspace_graph.graph.variables import control_keys, pose_keys
from pathspace_graph.mapping.registration import RefinedMotion
from pathspace_graph.mapping.seam import PeriodicCurve, make_periodic
from pathspace_graph.mapping.smoother import CurveSmoother

SIGMA_STEP: Final = 10.0  # free motion of a control point in a step while the loop is optimized (m)


def apply_correspondences(smoother: CurveSmoother, registration: RefinedMotion) -> None:
    """Move the window onto the beginning, and associate the inliers with it."""
    smoother.reactivate(with_prior=smoother.submaps is None)
    state = smoother.map.state
    registration.motion.move(state.poses)
    for label in state.boundaries:
        rows, u = registration.matches.inliers(label)
        smoother.map.detections.take(rows, label, u)


def optimize_loop(smoother: CurveSmoother) -> dict[int, Array]:
    """Solve the whole loop, each submap relinearized in its own frame; return its keyframes (3,) by cycle."""
    return smoother.solve_loop(smoother.map.settings.closing.iterations, SIGMA_STEP)


def simplify(smoother: CurveSmoother) -> None:
    """Replace every open curve by a periodic one of its final size, and step to the new optimum."""
    state, settings = smoother.map.state, smoother.map.settings
    periodic = {
        label: make_periodic(boundary, state.control_points(label), settings, settings.spline.knots)
        for label, boundary in state.boundaries.items()
    }
    substitute(smoother, periodic)
    for _ in range(settings.closing.iterations):
        smoother.step(SIGMA_STEP)


def substitute(smoother: CurveSmoother, periodic: dict[int, PeriodicCurve]) -> None:
    """Change the variables, `C_old = E C_new`, in the graph, the detections and the poses' parameters."""
    state, detections = smoother.map.state, smoother.map.detections
    closed = {label: state.boundaries[label].closed(new.knots) for label, new in periodic.items()}
    smoother.substitute(
        np.concatenate([state.keys(label) for label in periodic]),
        np.concatenate([control_keys(label, boundary.numbers) for label, boundary in closed.items()]),
        np.concatenate([new.points for new in periodic.values()]),
        block_diag(*(new.old_from_new for new in periodic.values())),
        smoother.map.settings.spline.sigma_simplify,
    )
    for label, new in periodic.items():
        rows = detections.used_on(label)
        state.close(label, closed[label])
        detections.take(rows, label, new.overlap.new_parameter(detections.u[rows]))
        state.locate(label, new.overlap.new_parameter(state.pose_u[label]))


# --- the marginal of the open lap's batch ----------------------------------------------------------------


def go_on_from(smoother: CurveSmoother, marginal: LapMarginal) -> Array:
    """Replace curves and prior by the marginal of a lap, and return the jump (3,) of the newest pose.

    The window keeps its own factors of the poses from `first_kept` on, the marginal has those of all poses
    before, so nothing is counted twice. The marginal holds the curves' spacing and shape as well. Poses after
    the last one of the lap are moved with it.
    """
    state, settings, first = smoother.map.state, smoother.map.settings, marginal.first_kept
    smoother.reactivate(with_prior=False)
    before, removed = state.poses[-1].copy(), state.map_keys
    for label, spline in marginal.splines.items():
        state.close(label, state.boundaries[label].closed(spline.knots))
    added = np.concatenate([state.keys(label) for label in marginal.splines])
    points = np.concatenate([spline.distinct_control_points for spline in marginal.splines.values()])
    smoother.restart(first, removed, added, points)
    smoother.map.replaced_by(marginal.scatter, marginal.cones)
    _move_poses(state.poses, marginal.poses[first:])
    state.variables.calibrations[:] = marginal.calibration
    locate_poses(state, settings.batch.association)
    keys = np.concatenate([state.variables.calibration_keys, added, pose_keys(np.array([first]))])
    smoother.set_prior(keys, marginal.mean, marginal.information)
    smoother.reassociate()
    for _ in range(settings.closing.iterations):
        smoother.step(SIGMA_STEP)
    return np.asarray(state.poses[-1] - before)


def _move_poses(poses: Array, solved: Array) -> None:
    """Set the first poses of the window (P, 3) to the solved ones (k, 3), and move the others rigidly."""
    last = poses[len(solved) - 1].copy()
    for pose in poses[len(solved) :]:
        pose[:] = compose(solved[-1], relative(last, pose))
    poses[: len(solved)] = solved


def hold_gauge(smoother: CurveSmoother) -> None:
    """Hold where the closed map as a whole is, across its curves, while its shape goes on to be estimated.

    Only the beginning of the drive is known in the map frame: later laps tell of the gauge through the shape
    of the curves beside the start alone. They average out the noise of detections, but cones lie off a curve
    with few control points by the same distance in each lap. Many laps bend the curve to it, and a bend of
    centimetres beside the start turns the whole map. So its uncertainty is frozen after a few laps.
    """
    state = smoother.map.state
    tangents = [state.spline(label).tangent_unit(b.abscissae) for label, b in state.boundaries.items()]
    keys, normals = state.map_keys, left_of(np.concatenate(tangents))
    order = np.argsort(keys)
    smoother.hold_gauge(keys[order], motion_across(state.map_points[order], normals[order]))


def motion_across(points: Array, normals: Array) -> Array:
    """Return the rows C (3, 2k) by which `C dx` is the rigid motion that fits small moves dx (2k,) best.

    Points (k, 2) of a curve may slide along it, so their moves count along the normals (k, 2) only. With the
    rows N (k, 2k) of the normals and the rigid motions G it is the least squares solution `(N G)^+ N`.
    """
    count = len(points)
    across = np.zeros((count, count, 2))
    across[np.arange(count), np.arange(count)] = normals
    turn = (normals * left_of(points)).sum(axis=1)
    return np.asarray(np.linalg.pinv(np.column_stack([normals, turn])) @ across.reshape(count, -1))
