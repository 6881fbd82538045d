"""Loop closing and simplification (paper: Simplification), and the marginal and gauge of the closed map.

The loop closes by a batch of the lap (`swap_in`). A known map replaces an open road in a similar way
(`lay_on_known`).

Without a batch, `mapping.registration.register` finds correspondences between the newest detections and the
beginning of the curves. `apply_correspondences` moves the window there and associates the detections with the
oldest control points, `graph.changes:solve_loop` optimizes the whole loop, and `simplify` makes the curves
periodic.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.linalg import block_diag

from pathspace_graph.batch.association import LINE_STEP, POSE_STEP, headings, locate_poses
from pathspace_graph.batch.known_map import KnownMap
from pathspace_graph.batch.lap import LapMarginal
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.se2 import compose, left_of, relative, rotation
from pathspace_graph.graph.changes import hold_motion, replace_points, restart, set_prior
from pathspace_graph.graph.variables import control_keys, pose_keys
from pathspace_graph.mapping.registration import BEGINNING, Motion, RefinedMotion
from pathspace_graph.mapping.road import Road
from pathspace_graph.mapping.smoother import CurveSmoother
from pathspace_graph.mapping.state import State
from pathspace_graph.settings.mapper import Knots, MapperSettings
from pathspace_graph.spline.boundary import SAME_DIRECTION, Boundary
from pathspace_graph.spline.bspline import BSpline
from pathspace_graph.spline.knots import curvature_weighted_breaks, refit, thin

EXTRAPOLATED: Final = 2  # knot intervals past the confirmed end that map to the closed curve
JOIN_MARGIN: Final = 10.0  # with `BEGINNING`, largest distance of the seam from the end of a curve (m)
JOIN_SHARE: Final = 0.5  # least parameter of the seam on a short curve, as a share of its length
OVERLAP_STEP: Final = 1.0  # step of the points of the overlap (m)
OVERLAP_ROOM: Final = 4.0  # search range of their foot points on the beginning, about the expected ones (m)
SEAM_MARGIN: Final = 0.5  # distance before the seam within which a cone belongs to the beginning (m)
SIGMAS_CALIBRATIONS: Final = (0.05, 0.02, 0.03, 0.1, 0.05, 0.05, 0.2)
"""Prior standard deviations of the calibrations on a known map, where all are observable: odometry's scale
(-) and yaw-rate bias (rad/s), and the sensor's yaw (rad), offset (m), latency (s), range scale (-) and bias
(m)."""
FIRST_ROOM: Final = 2.0  # largest distance of the first place beside a pose over that of the nearest (m)
FIRST_REACH: Final = 20.0  # search range of foot points about that place (m along the curve)
SIGMA_STEP: Final = 10.0  # damping of control points while the loop is optimized (m)


def apply_correspondences(smoother: CurveSmoother, registration: RefinedMotion) -> None:
    """Move the window to the beginning of the curves, and associate the inliers with it."""
    smoother.reactivate(with_prior=smoother.submaps is None)
    state = smoother.map.state
    registration.motion.move(state.poses)
    for label in state.boundaries:
        rows, u = registration.matches.inliers(label)
        smoother.map.detections.take(rows, label, u)


# --- from an open curve, whose end overlaps its beginning, to a periodic one ------------------------------


@dataclass(frozen=True, eq=False)
class Overlap:
    """The correspondence between a curve's end and its beginning."""

    period: float  # length of the closed curve in the open curve's parameter (m)
    u: Array  # (k,) increasing parameters of the open curve's end, from the seam on
    w: Array  # (k,) parameters of the corresponding points on the beginning, from 0 on

    def new_parameter(self, u: Array) -> Array:
        """Map parameters of the open curve to those of the closed one, without wrapping."""
        return np.where(u < self.u[0], u, self.period + np.interp(u, self.u, self.w))


@dataclass(frozen=True, eq=False)
class PeriodicCurve:
    """The periodic curve that replaces an open one."""

    overlap: Overlap
    knots: Array  # (m + 2 p + 1,) periodic knots
    points: Array  # (m, 2) control points in m, map frame
    old_from_new: Array  # (n, m) matrix E of the change of variables: `C_old = E C_new`


def make_periodic(
    boundary: Boundary,
    control_points: Array,
    settings: MapperSettings,
    knots: Knots,
) -> PeriodicCurve:
    """Fit a periodic curve to an open one with control points (n, 2).

    The number of its control points is a share of the number of cones, or of equivalent places on a line.
    """
    spline, overlap = boundary.spline(control_points), find_overlap(boundary, control_points)
    period, u = overlap.period, boundary.cone_parameters
    u = np.arange(0.0, period, LINE_STEP) if settings.of_lines else u
    u = _apart(u[u < period - SEAM_MARGIN], settings.growth.merge_radius)
    size = max(settings.spline.min_size, int(settings.spline.size_share * len(u)))
    if knots == "curvature" or size >= len(u):
        breaks = curvature_weighted_breaks(spline, size, settings.spline.linear_baseline, 0.0, period)
    else:
        cones = boundary.evaluate(control_points, u)
        *_, thinned = thin(cones, u, period, True, boundary.degree, size)
        breaks = thinned.breaks
    frame = BSpline.periodic_from(breaks, np.zeros((len(breaks) - 1, 2)), boundary.degree)
    change = refit(spline, frame, overlap.new_parameter)
    return PeriodicCurve(overlap, frame.knots, change.new_from_old @ control_points, change.old_from_new)


def _apart(values: Array, distance: float) -> Array:
    """Thin sorted values (k,) so that successive ones differ by more than `distance`."""
    kept: list[float] = []
    for value in values.tolist():
        if not kept or value - kept[-1] > distance:
            kept.append(value)
    return np.array(kept)


def find_overlap(boundary: Boundary, control_points: Array) -> Overlap:
    """Find the overlap of a curve's end with its beginning; the seam is the foot point of the beginning.

    A gap between end and beginning is bridged by a straight line.
    """
    confirmed_end = boundary.confirmed_end
    late = max(confirmed_end - BEGINNING - JOIN_MARGIN, JOIN_SHARE * confirmed_end)
    ends = boundary.evaluate(control_points, np.array([0.0, confirmed_end]))
    foot = boundary.find(control_points, ends[:1], np.array([late]), np.array([confirmed_end]))
    if not foot.interior[0]:
        period = confirmed_end + float(np.hypot(*(ends[0] - ends[1])))
        return Overlap(period, np.array([period, period + 1.0]), np.array([0.0, 1.0]))
    seam = float(foot.u[0])
    u = np.linspace(seam, confirmed_end, max(int((confirmed_end - seam) / OVERLAP_STEP), 1) + 1)
    low, high = np.maximum(u - seam - OVERLAP_ROOM, 0.0), u - seam + OVERLAP_ROOM
    w = boundary.find(control_points, boundary.evaluate(control_points, u), low, high).u
    w = np.maximum.accumulate(w)
    w[0], beyond = 0.0, EXTRAPOLATED * boundary.nominal[0]
    return Overlap(seam, np.append(u, u[-1] + beyond), np.append(w, w[-1] + beyond))


def simplify(smoother: CurveSmoother) -> None:
    """Replace every open curve by a periodic one of its final size, and step to the new optimum."""
    state, settings = smoother.map.state, smoother.map.settings
    knots = settings.spline.knots
    periodic = {
        label: make_periodic(boundary, state.control_points(label), settings, knots)
        for label, boundary in state.boundaries.items()
    }
    substitute(smoother, periodic)
    for _ in range(settings.closing.iterations):
        smoother.step(SIGMA_STEP)


def substitute(smoother: CurveSmoother, periodic: dict[int, PeriodicCurve]) -> None:
    """Change variables by `C_old = E C_new` in graph, detections and parameters of the poses."""
    state, detections = smoother.map.state, smoother.map.detections
    closed = {label: state.boundaries[label].closed(new.knots) for label, new in periodic.items()}
    replace_points(
        smoother,
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


def swap_in(smoother: CurveSmoother, marginal: LapMarginal) -> Array:
    """Replace curves and prior by the marginal of a lap; return the jump (3,) of the newest pose.

    The window keeps its own factors of the poses from `first_kept` on, and the marginal has those of all
    earlier poses, so nothing is counted twice. The marginal includes the priors of spacing and shape. Poses
    after the last one of the lap move rigidly with it.
    """
    state, settings, first = smoother.map.state, smoother.map.settings, marginal.first_kept
    smoother.reactivate(with_prior=False)
    before, removed = state.poses[-1].copy(), state.map_keys
    for label, spline in marginal.splines.items():
        state.close(label, state.boundaries[label].closed(spline.knots))
    added = np.concatenate([state.keys(label) for label in marginal.splines])
    points = np.concatenate([spline.distinct_control_points for spline in marginal.splines.values()])
    restart(smoother, first, removed, added, points)
    smoother.map.replaced_by(marginal.scatter, marginal.cones, marginal.stations)
    _move_poses(state.poses, marginal.poses[first:])
    state.variables.calibrations[:] = marginal.calibration
    locate_poses(state)
    keys = np.concatenate([state.variables.calibration_keys, added, pose_keys(np.array([first]))])
    set_prior(smoother, keys, marginal.mean, marginal.information)
    smoother.reassociate()
    for _ in range(settings.closing.iterations):
        smoother.step(SIGMA_STEP)
    return np.asarray(state.poses[-1] - before)


def _move_poses(poses: Array, solved: Array) -> None:
    """Set the first poses of the window (P, 3) to the solved ones (k, 3), and move the rest rigidly."""
    last = poses[len(solved) - 1].copy()
    for pose in poses[len(solved) :]:
        pose[:] = compose(solved[-1], relative(last, pose))
    poses[: len(solved)] = solved


# --- a known map ----------------------------------------------------------------------------------------


def lay_on_known(road: Road, known: KnownMap, motion: Motion, covariance: Array) -> Array:
    """Replace curves and prior of an open road by a known map; return the jump (3,) of the newest pose.

    The motion registers the road to the map; the covariance (3, 3) is of the newest pose, map frame.
    """
    smoother, state = road.smoother, road.smoother.map.state
    variables = state.variables
    sigmas = np.array(SIGMAS_CALIBRATIONS)[: len(variables.calibrations)]
    smoother.reactivate(with_prior=False)
    before, removed = state.poses[-1].copy(), state.map_keys
    road.move(as_pose(motion))
    road.growth.wait_for({} if known.closed else known.ends)
    curves = {label: _next(state.boundaries, known, label, road.settings) for label in known.splines}
    state.replace_curves(curves)
    added = np.concatenate([control_keys(label, b.numbers) for label, b in state.boundaries.items()])
    points = np.concatenate([spline.distinct_control_points for spline in known.splines.values()])
    restart(smoother, smoother.first_cycle, removed, added, points)
    known.place_cones(smoother.map)
    motion.move(state.poses)
    locate_poses(state)
    if not known.closed:
        _locate_first(state)
    keys = np.concatenate([variables.calibration_keys, added, pose_keys(smoother.cycles[-1:])])
    mean = np.concatenate([variables.calibrations, points.ravel(), state.poses[-1]])
    known_of = np.diag(sigmas**2), known.covariance, covariance
    information = block_diag(*map(np.linalg.inv, known_of))
    set_prior(smoother, keys, mean, information)
    smoother.reassociate()
    for _ in range(road.settings.closing.iterations):
        smoother.step(SIGMA_STEP)
    return np.asarray(state.poses[-1] - before)


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


def as_pose(motion: Motion) -> Array:
    """Return a motion as the pose (3,) of the moved origin."""
    turn = motion.vector[2]
    return np.append(motion.centre + motion.vector[:2] - rotation(turn) @ motion.centre, turn)


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
