"""The map of a road is replaced: by the marginal of a batch of the drive, or by a known map. Its gauge."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from scipy.linalg import block_diag

from pathspace_graph.batch.association import POSE_STEP, headings, locate_poses
from pathspace_graph.batch.known_map import KnownMap
from pathspace_graph.batch.lap import LapMarginal
from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.se2 import compose, inverse, left_of, move_points
from pathspace_graph.graph.gaussian import upper_root
from pathspace_graph.graph.smoother import exchange_calibration_priors, hold_motion, restart, set_prior
from pathspace_graph.graph.variables import NO_KEYS, pose_keys
from pathspace_graph.mapping.road import Road
from pathspace_graph.mapping.smoother import CurveSmoother
from pathspace_graph.mapping.state import GivenFactor, State
from pathspace_graph.spline.boundary import SAME_DIRECTION, Boundary, open_boundary

SIGMAS_CALIBRATIONS: Final = (0.05, 0.02, 0.03, 0.1, 0.05, 0.05, 0.2)
"""Prior standard deviations of the calibrations on a known map, where all are observable: odometry's scale
(-) and yaw-rate bias (rad/s), and the sensor's yaw (rad), offset (m), latency (s), range scale (-) and bias
(m)."""
FIRST_ROOM: Final = 2.0  # largest distance of the first place beside a pose over that of the nearest (m)
FIRST_REACH: Final = 20.0  # search range of foot points about that place (m along the curve)
SIGMA_STEP: Final = 10.0  # damping of control points while the loop is optimized (m)


# --- another map -----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class NewMap:
    """Curves, and the Gaussian of [calibration | control points, left first | pose] that is their prior."""

    curves: dict[int, tuple[Boundary, Array]]  # by label, with the control points (m, 2) in m, map frame
    calibration: Array  # (2,) or (7,) calibration of odometry and sensor
    known: dict[int, int]  # number of first control points of each curve that the prior holds
    mean: Array  # (n,) mean of the prior
    root: Array  # (n, n) square root of its information, as in `LapMarginal.root`
    near: dict[int, IntArray] = field(default_factory=dict)  # as in `LapMarginal.near`
    scatter: dict[int, Array] = field(default_factory=dict)  # as in `CurveMap.replaced_by`
    cones: dict[int, Array] = field(default_factory=dict)


def replace_map(
    road: Road, new: NewMap, poses: Array, cycle: int, given: Sequence[GivenFactor] = ()
) -> Array:
    """Replace curves, prior and window of a road; return the jump (3,) of the newest pose.

    The window keeps the poses (P, 3) of its last cycles and their measurements; the prior is on the pose of
    `cycle`. What is fixed to the vehicle moves with the newest pose: driven path, tentative and orange cones.
    Curves on new knots locate the poses again. Of the factors that the user has `given`, the prior includes
    those before the window, and the others on former control points become rows on the new ones.
    """
    smoother, state = road.smoother, road.smoother.map.state
    variables, before = state.variables, state.poses[-1].copy()
    restart(smoother, smoother.next_cycle - len(poses))
    smoother.user_factors.drop([one.factor for one in given if one.cycle < smoother.first_cycle])
    road.move(compose(poses[-1], inverse(before)))
    removed = state.map_keys
    state.replace_curves({label: boundary for label, (boundary, _) in new.curves.items()})
    are_new = len(np.setdiff1d(state.map_keys, removed)) > 0
    smoother.user_factors.remove(np.setdiff1d(removed, state.map_keys), variables)
    variables.remove(removed)
    for label, (_, points) in sorted(new.curves.items()):
        variables.insert(state.control_keys(label), points.ravel())
    variables.calibrations[:] = new.calibration
    state.poses[:] = poses
    smoother.map.replaced_by(new.scatter, new.cones)
    for label, count in new.known.items():
        smoother.map.place(label, count)
    if are_new:
        locate_poses(state)
        if not state.closed:
            _locate_first(state)
    held = [state.control_keys(label)[: new.known[label]] for label in state.boundaries]
    keys = np.concatenate([variables.calibration_keys, *held, pose_keys(np.array([cycle]))])
    far = [np.delete(state.control_keys(label), near) for label, near in new.near.items()]
    set_prior(smoother, keys, new.mean, new.root, np.concatenate([NO_KEYS, *far]))
    state.activate_only(dict(new.near))
    later = [one for one in given if one.cycle >= smoother.first_cycle and one.points]
    if are_new and later:
        smoother.reactivate()
        smoother.add_to_prior([rows for one in later for rows in one.on(state)])
    if state.closed:
        smoother.deactivate_distant()  # most of a long map: the window does not reach it
    if are_new:
        smoother.reassociate()
    for _ in range(road.settings.closing.iterations):
        smoother.step(SIGMA_STEP)
    return np.asarray(road.poses[-1] - before)


def take_marginal(road: Road, marginal: LapMarginal, given: Sequence[GivenFactor] = ()) -> Array:
    """Continue from the batch of a drive; return the jump (3,) of the newest pose.

    The window keeps its own factors of the poses from `first_kept` on, and the marginal has those of all
    earlier poses, so nothing is counted twice. Closed curves have few, new knots. Open ones keep their knots
    and go on to grow; their ends that have grown since move with the vehicle.
    """
    smoother, state, settings = road.smoother, road.smoother.map.state, road.settings
    window = road.poses[marginal.first_kept - smoother.first_cycle :]
    solved = marginal.poses[marginal.first_kept :]
    motion = compose(solved[-1], inverse(window[len(solved) - 1]))
    poses = np.concatenate([solved, compose(motion, window[len(solved) :])])
    curves = dict[int, tuple[Boundary, Array]]()
    for label, spline in marginal.splines.items():
        points = spline.distinct_control_points
        boundary = state.boundaries.get(label, open_boundary(settings.spline))
        if spline.periodic:  # a batch may have found a side that the road has not
            curves[label] = boundary.closed(spline.knots), points
            continue
        placed, end = spline.size, marginal.ends[label]
        if boundary.confirmed_end > end:  # growth has placed the last ones again
            placed = boundary.settled(spline.size, boundary.last_cone(end))
        grown = move_points(motion, state.control_points(label)[placed:])
        curves[label] = boundary, np.concatenate([points[:placed], grown])
    new = NewMap(
        curves,
        marginal.calibration,
        {label: spline.size for label, spline in marginal.splines.items()},
        marginal.mean,
        marginal.root,
        marginal.near,
        marginal.scatter,
        marginal.cones,
    )
    jump = replace_map(road, new, poses, marginal.first_kept, given)
    exchange_calibration_priors(smoother, marginal.calibration_prior)
    return jump


def take_known(road: Road, known: KnownMap, pose: Array, covariance: Array) -> Array:
    """Continue on a known map; return the jump (3,) of the newest pose, which was `pose` (3,) on that map.

    The covariance (3, 3) is of the newest pose, map frame.
    """
    settings, state, boundaries = road.settings, road.smoother.map.state, road.boundaries
    points = [spline.distinct_control_points for _, spline in sorted(known.splines.items())]
    sigmas = np.array(SIGMAS_CALIBRATIONS)[: len(state.variables.calibrations)]
    parts = np.diag(sigmas**2), known.covariance, covariance
    curves = {}
    for label, own in zip(sorted(known.splines), points, strict=True):
        before = boundaries.get(label)
        first = before.first + before.size if before else 0  # its control points have new keys
        curves[label] = known.boundary(label, settings, first), own
    new = NewMap(
        curves,
        state.variables.calibrations.copy(),
        {label: len(own) for label, (_, own) in curves.items()},
        np.concatenate([state.variables.calibrations, *(own.ravel() for own in points), pose]),
        block_diag(*(upper_root(np.asarray(np.linalg.inv(part), np.float64)) for part in parts)),
        cones=known.cones,
    )
    road.growth.wait_for({} if known.closed else known.ends)
    poses = compose(compose(pose, inverse(road.poses[-1])), road.poses)
    return replace_map(road, new, poses, road.next_cycle - 1)


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
