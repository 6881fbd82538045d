"""What replaces the map of an open road: the marginal of the lap's batch, or a known map; and its gauge."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from scipy.linalg import block_diag

from pathspace_graph.batch.association import POSE_STEP, headings, locate_poses
from pathspace_graph.batch.known_map import KnownMap
from pathspace_graph.batch.lap import LapMarginal
from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.se2 import compose, inverse, left_of, move_points, relative
from pathspace_graph.graph.smoother import exchange_calibration_priors, hold_motion, restart, set_prior
from pathspace_graph.graph.variables import control_keys, pose_keys
from pathspace_graph.mapping.road import Road
from pathspace_graph.mapping.smoother import CurveSmoother
from pathspace_graph.mapping.state import GivenFactor, State
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.boundary import SAME_DIRECTION, Boundary, open_boundary

SIGMAS_CALIBRATIONS: Final = (0.05, 0.02, 0.03, 0.1, 0.05, 0.05, 0.2)
"""Prior standard deviations of the calibrations on a known map, where all are observable: odometry's scale
(-) and yaw-rate bias (rad/s), and the sensor's yaw (rad), offset (m), latency (s), range scale (-) and bias
(m)."""
FIRST_ROOM: Final = 2.0  # largest distance of the first place beside a pose over that of the nearest (m)
FIRST_REACH: Final = 20.0  # search range of foot points about that place (m along the curve)
SIGMA_STEP: Final = 10.0  # damping of control points while the loop is optimized (m)


# --- the marginal of a batch -----------------------------------------------------------------------------


def swap_in(road: Road, marginal: LapMarginal, given: Sequence[GivenFactor] = ()) -> Array:
    """Replace curves and prior by the marginal of a lap; return the jump (3,) of the newest pose.

    The window keeps its own factors of the poses from `first_kept` on, and the marginal has those of all
    earlier poses, so nothing is counted twice. The marginal includes the priors of spacing and shape. Of the
    factors that the user has `given`, later ones on former control points go on as rows.
    """
    smoother, state = road.smoother, road.smoother.map.state
    restart(smoother, marginal.first_kept)
    smoother.user_factors.drop([one.factor for one in given if one.cycle < marginal.first_kept or one.points])
    before, removed = state.poses[-1].copy(), state.map_keys
    settings = road.settings.spline, road.settings.gauge
    for label, spline in marginal.splines.items():  # a batch may have found a side that the road has not
        boundary = state.boundaries.get(label, open_boundary(*settings))
        state.close(label, boundary.closed(spline.knots))
    added = np.concatenate([state.control_keys(label) for label in marginal.splines])
    points = np.concatenate([spline.distinct_control_points for spline in marginal.splines.values()])
    smoother.variables.remove(removed)
    smoother.variables.insert(added, points.ravel())
    smoother.map.replaced_by(marginal.scatter, marginal.cones, marginal.stations)
    _move_poses(state.poses, marginal.poses[marginal.first_kept :])
    locate_poses(state)
    _take_prior(smoother, marginal, added)
    later = [one for one in given if one.cycle >= marginal.first_kept and one.points]
    smoother.add_to_prior([rows for one in later for rows in one.on(state)])
    smoother.reassociate()
    return _jump(road, before)


def lay_on(road: Road, marginal: LapMarginal, given: Sequence[GivenFactor] = ()) -> Array:
    """Move an open map to the marginal of its batch, the new prior; return the jump (3,) of the newest pose.

    The curves keep their knots and go on to grow. What came after the batch's last pose moves rigidly with
    it: poses, tentative cones, and the newest ends of the curves.
    """
    smoother, state = road.smoother, road.smoother.map.state
    restart(smoother, marginal.first_kept)
    smoother.user_factors.drop([one.factor for one in given if one.cycle < marginal.first_kept])
    before = state.poses[-1].copy()
    _move_poses(state.poses, marginal.poses[marginal.first_kept :])
    motion = compose(state.poses[-1], inverse(before))
    road.move(motion)
    for label, spline in marginal.splines.items():
        control_points, boundary = state.control_points(label), state.boundaries[label]
        end, placed = marginal.ends[label], spline.size
        if boundary.confirmed_end > end:  # growth has placed the last ones again
            placed = boundary.settled(spline.size, boundary.last_cone(end))
        control_points[placed:] = move_points(motion, control_points[placed:])
        control_points[:placed] = spline.control_points[:placed]
    known = [state.control_keys(label)[: spline.size] for label, spline in marginal.splines.items()]
    _take_prior(smoother, marginal, np.concatenate(known))
    exchange_calibration_priors(smoother, marginal.calibration_prior)
    return _jump(road, before)


def _move_poses(poses: Array, solved: Array) -> None:
    """Set the first poses of the window (P, 3) to the solved ones (k, 3), and move the rest rigidly."""
    last = poses[len(solved) - 1].copy()
    for pose in poses[len(solved) :]:
        pose[:] = compose(solved[-1], relative(last, pose))
    poses[: len(solved)] = solved


def _take_prior(smoother: CurveSmoother, marginal: LapMarginal, known: IntArray) -> None:
    """Take the calibration and the prior of a marginal, whose control points have the keys `known` (k,)."""
    variables = smoother.variables
    variables.calibrations[:] = marginal.calibration
    oldest = pose_keys(np.array([marginal.first_kept]))
    keys = np.concatenate([variables.calibration_keys, known, oldest])
    set_prior(smoother, keys, marginal.mean, marginal.information)


def _jump(road: Road, before: Array) -> Array:
    """Take the steps after a replacement; return the jump (3,) of the newest pose from that before."""
    for _ in range(road.settings.closing.iterations):
        road.smoother.step(SIGMA_STEP)
    return np.asarray(road.poses[-1] - before)


# --- a known map ----------------------------------------------------------------------------------------


def lay_on_known(road: Road, known: KnownMap, motion: Array, covariance: Array) -> Array:
    """Replace curves and prior of an open road by a known map; return the jump (3,) of the newest pose.

    The motion (3,) moves the road onto the map; the covariance (3, 3) is of the newest pose, map frame.
    """
    smoother, state = road.smoother, road.smoother.map.state
    variables = state.variables
    sigmas = np.array(SIGMAS_CALIBRATIONS)[: len(variables.calibrations)]
    restart(smoother, smoother.first_cycle)
    before, removed = state.poses[-1].copy(), state.map_keys
    smoother.user_factors.remove(removed, variables)
    road.move(motion)
    road.growth.wait_for({} if known.closed else known.ends)
    curves = {label: _next(state.boundaries, known, label, road.settings) for label in known.splines}
    state.replace_curves(curves)
    added = np.concatenate([control_keys(label, b.numbers) for label, b in state.boundaries.items()])
    points = np.concatenate([spline.distinct_control_points for spline in known.splines.values()])
    variables.remove(removed)
    variables.insert(added, points.ravel())
    known.place_cones(smoother.map)
    state.poses[:] = compose(motion, state.poses)
    locate_poses(state)
    if not known.closed:
        _locate_first(state)
    keys = np.concatenate([variables.calibration_keys, added, pose_keys(smoother.cycles[-1:])])
    mean = np.concatenate([variables.calibrations, points.ravel(), state.poses[-1]])
    known_of = np.diag(sigmas**2), known.covariance, covariance
    information = block_diag(*map(np.linalg.inv, known_of))
    set_prior(smoother, keys, mean, information)
    smoother.reassociate()
    return _jump(road, before)


def _locate_first(state: State) -> None:
    """Set `pose_u` on open curves to the first place beside the poses, as a curve may pass there twice."""
    newest = state.poses[-1]
    for label, boundary in state.boundaries.items():
        points = state.control_points(label)
        u = np.arange(boundary.tables.low, boundary.tables.high, POSE_STEP)
        position, tangent = (boundary.evaluate(points, u, order) for order in (0, 1))
        along = tangent @ headings(newest[None])[0] > SAME_DIRECTION * np.hypot(*tangent.T)
        away = np.where(along, np.hypot(*(position - newest[:2]).T), np.inf)
        first = float(u[int((away < away.min() + FIRST_ROOM).argmax())])
        low = np.full(len(state.poses), max(first - FIRST_REACH, boundary.tables.low))
        found = boundary.find(points, state.poses[:, :2], low, low + 2.0 * FIRST_REACH)
        state.locate(label, np.maximum.accumulate(found.u))


def _next(boundaries: dict[int, Boundary], known: KnownMap, label: int, settings: MapperSettings) -> Boundary:
    """Return a known curve whose control points have new keys."""
    before = boundaries.get(label)
    return known.boundary(label, settings, before.first + before.size if before else 0)


# --- the gauge -------------------------------------------------------------------------------------------


def fix_gauge(smoother: CurveSmoother) -> None:
    """Fix the rigid motion of a closed map; its shape is still estimated.

    Only the beginning of the drive is known in the map frame. Over many laps the fitted curve becomes
    overconfident about centimetre offsets from the cones, which few control points cannot follow. Such an
    offset near the start rotates the whole map. So the uncertainty of the rigid motion is frozen.
    """
    state = smoother.map.state
    tangents = [state.spline(label).tangent_unit(b.abscissae) for label, b in state.boundaries.items()]
    keys, normals = state.map_keys, left_of(np.concatenate(tangents))
    order = np.argsort(keys)
    hold_motion(smoother, keys[order], motion_across(state.map_points[order], normals[order]))


def motion_across(points: Array, normals: Array) -> Array:
    """Return the rows C (3, 2k) such that `C dx` is the best-fitting rigid motion for small moves dx (2k,).

    Points (k, 2) may slide along their curve, so only moves along the normals (k, 2) count. With the rows N
    (k, 2k) of the normals and the rigid motions G (2k, 3), this is the least-squares solution `(N G)^+ N`.
    """
    count = len(points)
    across = np.zeros((count, count, 2))
    across[np.arange(count), np.arange(count)] = normals
    turn = (normals * left_of(points)).sum(axis=1)
    return np.asarray(np.linalg.pinv(np.column_stack([normals, turn])) @ across.reshape(count, -1))
