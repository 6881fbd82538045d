"""The batch of a drive so far, whose result replaces the online map where road is driven again.

Online, every measurement is linearized while the map is still open, and the curves are sparse. Both rotate
the map by several tenths of a degree. The batch solves the same measurements again, with the revisits. The
result is a marginal: the information of the poses that have left the window about the map, the calibration
and the oldest pose of the window.

A lap starts from odometry and the revisit that ended it, and is solved on curves that meet the cones. A
repair starts from a closed map. An open road keeps the curves of its map, which goes on to grow.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial import KDTree
from threadpoolctl import threadpool_limits

from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.se2 import path_lengths, to_map
from pathspace_graph.front_end.log_odometry import LogOdometry
from pathspace_graph.graph.elimination import marginal_before
from pathspace_graph.graph.gaussian import upper_root
from pathspace_graph.graph.rows import Revisit
from pathspace_graph.graph.variables import POINT, POSE
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.mapping.detection_rows import Stations
from pathspace_graph.mapping.detections import DetectionTable
from pathspace_graph.mapping.smoother import FAR_ROOM, reached
from pathspace_graph.mapping.state import SAMPLE, GivenFactor, State
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.boundary import (
    Boundary,
    boundaries_cross,
    crossed_boundaries,
    crossings_told,
    sampled,
)
from pathspace_graph.spline.bspline import BSpline

from .simplification import map_block, own_settings, simplified
from .start import StartMap, aligned_odometry, start_odometry
from .system import BatchSystem, Convergence, Effort, Evaluation, Optimizer, Stage, weak_priors

FROM_MAP: Final = Effort(rough_rounds=8, rounds=20, tolerance=10.0)  # limited, to finish in time
FROM_ODOMETRY: Final = Effort(rounds=24, tolerance=10.0)
AHEAD_SHARE: Final = 0.06  # way until the result is used, by that of the drive: twice `CYCLES_SHARE` of it


@dataclass(frozen=True, eq=False)
class OpenLap:
    """All measurements from the start to the newest cycle, and the start of the batch."""

    settings: MapperSettings  # settings of the online mapper
    chain: LogOdometry  # odometry between all cycles
    detections: DetectionTable  # detections of all cycles, to associate again
    first_kept: int  # first cycle whose pose stays a variable of the window
    start: StartMap | None  # None for a start from odometry, whose first revisit ended the lap
    revisits: tuple[Revisit, ...] = ()
    factors: tuple[GivenFactor, ...] = ()
    """The user's factors that began before `first_kept`, as linearized when they were given."""


@dataclass(frozen=True, eq=False)
class LapMarginal:
    """The batch's map, and the information of the poses before `first_kept` about it.

    It is a Gaussian of [calibration | control points, left first | pose of `first_kept`].
    """

    convergence: Convergence
    splines: dict[int, BSpline]  # closed curves on few knots, or open ones on those of the start, map frame
    ends: dict[int, float]  # parameter up to which each curve is confirmed (m)
    calibration: Array  # (2,) or (7,) calibration of odometry and sensor at the optimum
    calibration_prior: tuple[Array, Array]  # means and standard deviations of the calibrations' priors in it
    poses: Array  # (P, 3) poses of all cycles, map frame
    first_kept: int  # cycle that ends the marginal: it has all measurements of earlier poses, and no others
    mean: Array  # (n,) mean of the marginal
    root: Array  # (n, n) upper triangular square root R of its information `R' R`, by `far_first`
    near: dict[int, IntArray]
    """(k,) control points of closed curves that the window may reach, in driving order; all if missing."""
    scatter: dict[int, Array]
    """(m,) sigma of each closed boundary's control points by the scatter of its cones (m)."""
    cones: dict[int, Array]
    """(k, 2) cones of each closed curve: parameters, and sigmas along it, given the curve (m)."""
    seconds: float  # wall time (s)
    objection: str = ""  # evidence against the map; empty if there is none

    @property
    def closed(self) -> bool:
        return any(spline.periodic for spline in self.splines.values())


def solve_lap(lap: OpenLap) -> LapMarginal:
    """Compute the marginal of a drive at the optimum of its batch, in one thread."""
    begin = time.perf_counter()
    with threadpool_limits(limits=1):
        system, at, convergence = lap_optimum(lap)
        prior = np.array(lap.settings.calibrations), np.array(lap.settings.sigmas_calibrations)
        scatter, cones = dict[int, Array](), dict[int, Array]()
        if at.state.closed:
            simple = simplified(at.state, system.detections, system.settings)
            few, change = simple.state, simple.change
            curves = few.boundaries.items()
            scatter = {label: simple.scatter.of_control_points(label, boundary) for label, boundary in curves}
            objection = evidence_against(system, at, few.splines, simple.detections)
        else:
            few, change = at.state, np.eye(at.state.map_points.size)
            calibration, earlier = at.state.variables.calibration, lap.revisits[1:]
            objection = disagreement(system, at.state.poses, calibration, earlier)
        information, mean, dense = marginal_of(system, at, few, change, lap.first_kept)
        near = reached_next(few, lap) if few.closed else {}
        sizes = {label: boundary.size for label, boundary in few.boundaries.items()}
        order = far_first(sizes, near, len(at.state.variables.calibrations))
        if system.stations is not None:
            cones = stations_on(few, system.stations, at.state, change, dense)
        elif at.state.closed:
            sigma = lap.settings.spline.sigma_shape
            places = simple.scatter.places.items()
            cones = {label: np.column_stack([u, np.full(len(u), sigma)]) for label, u in places}
        return LapMarginal(
            convergence=convergence,
            splines=few.splines,
            ends={label: boundary.confirmed_end for label, boundary in few.boundaries.items()},
            calibration=at.state.variables.calibrations.copy(),
            calibration_prior=prior,
            poses=at.state.poses.copy(),
            first_kept=lap.first_kept,
            mean=mean,
            root=upper_root(information[np.ix_(order, order)]),
            near=near,
            scatter=scatter,
            cones=cones,
            seconds=time.perf_counter() - begin,
            objection=objection,
        )


def lap_optimum(lap: OpenLap, effort: Effort | None = None) -> tuple[BatchSystem, Evaluation, Convergence]:
    """Return the problem of a drive, its optimum, and the convergence.

    A lap is solved on closed curves that meet the cones, an open road on the curves of its map.
    """
    start = lap.start
    settings = lap.settings if start is not None and start.is_open else own_settings(lap.settings)
    system = BatchSystem(lap.detections.copy(), [lap.chain], [settings], lap.revisits, lap.factors)
    if start is None:
        return system, *Optimizer(system, effort or FROM_ODOMETRY).find(start_odometry(system))
    optimizer = Optimizer(system, effort or FROM_MAP)
    if start.is_open:
        alone = Stage(settings.batch.gate, optimizer.effort.rounds, optimizer.effort.tolerance)
        return system, *optimizer.run(start.state(settings), alone)
    return system, *optimizer.find(start.state(settings))


def marginal_of(
    system: BatchSystem, at: Evaluation, few: State, change: Array, first_kept: int
) -> tuple[Array, Array, Array]:
    """Return information (n, n) and mean (n,) of [calibration | few control points | oldest kept pose].

    The third result is the covariance (d, d) of the dense control points. The marginal has the factors of
    poses before `first_kept`, linearized at the optimum; the window has the others. `change` F maps the dense
    control points to the few. So the covariance is `T Sigma T'` with `T = diag(I, F, I)`, where Sigma is the
    covariance of the dense marginal.
    """
    state, variables = at.state, at.state.variables
    gauge = system.gauge if state.closed else system.settings.gauge
    weak = weak_priors(state, gauge, first_kept)
    _, information, vector = marginal_before(system.rows(at, weak), variables, first_kept)
    covariance = np.linalg.inv(information)
    T = block_diag(np.eye(len(variables.calibrations)), change, np.eye(POSE))
    here = np.concatenate([variables.calibrations, few.map_points.ravel(), state.poses[first_kept]])
    mean = here + T @ (covariance @ vector)
    first, last = len(variables.calibrations), len(covariance) - POSE
    dense = np.asarray(covariance[first:last, first:last], np.float64)
    covariance = T @ covariance @ T.T
    return np.asarray(np.linalg.inv(0.5 * (covariance + covariance.T)), np.float64), mean, dense


def reached_next(few: State, lap: OpenLap) -> dict[int, IntArray]:
    """Control points (k,) of closed curves, by label, that the window may reach once it has the map.

    The vehicle drives on while the batch runs, for a share of the drive so far.
    """
    room = FAR_ROOM + AHEAD_SHARE * path_lengths(few.poses)[-1]
    return {
        label: reached(boundary, few.pose_u[label][lap.first_kept :], lap.settings, room)
        for label, boundary in few.boundaries.items()
    }


def far_first(sizes: Mapping[int, int], near: Mapping[int, IntArray], before: int) -> IntArray:
    """Order the entries of [calibration (before,) | control points by label | pose], far points first.

    `sizes` are the numbers of control points, of which those that are not `near` are far.
    """
    is_far = [np.zeros(before, bool)]
    for label, size in sorted(sizes.items()):
        points = np.full(size, label in near)
        points[near.get(label, [])] = False
        is_far.append(np.repeat(points, POINT))
    goes_first = np.concatenate([*is_far, np.zeros(POSE, bool)])
    return np.argsort(~goes_first, kind="stable")


def stations_on(
    few: State, stations: Stations, dense: State, change: Array, covariance: Array
) -> dict[int, Array]:
    """Transfer stations of dense curves to curves with few knots: parameters and sigmas along, (k, 2).

    A cone is `S_dense(u)`. Given the few control points `F c` it moves by `(B_dense(u) - B_few(u') F) dc`,
    where u' is its foot point on the curve with few knots, B the basis, and dc has the given covariance.
    """
    found = {}
    for curve in stations.curves:
        label, u = curve.label, curve.u
        old, new, new_points = dense.boundaries[label], few.boundaries[label], few.control_points(label)
        foot = new.find_anywhere(new_points, old.evaluate(dense.control_points(label), u))
        block = map_block(dense, label)
        F = change[map_block(few, label), block]
        along = along_of(old, u, foot.tangent_unit) - along_of(new, foot.u, foot.tangent_unit) @ F
        variance = np.einsum("kn,kn->k", along @ covariance[block, block], along)
        found[label] = np.column_stack([foot.u, np.sqrt(variance)])
    return found


def along_of(boundary: Boundary, u: Array, directions: Array) -> Array:
    """Derivatives (k, 2 m) of `d . S(u)` by the control points, for unit vectors d (k, 2)."""
    (basis,), span = boundary.tables.evaluate(u)
    by_control = np.zeros((len(u), boundary.size, 2))
    terms = basis[:, :, None] * directions[:, None, :]
    np.add.at(by_control, (np.arange(len(u))[:, None], boundary.columns(span)), terms)
    return by_control.reshape(len(u), -1)


# --- evidence against an optimum -------------------------------------------------------------------------


LEAST_USED: Final = 2.0 / 3.0  # least share of coloured detections on the curves of a closed result
DRIVE_RATIO: Final = 2.5  # largest distance of a boundary from the drive, relative to the drive's from it
DRIVE_PERCENTILE: Final = 95.0  # percentile of the poses' distances: the drive may begin or end off the track
BENT_SIGMAS: Final = 4.0  # largest distance of an optimum's poses from odometry and revisits (sigmas)
MISS_STRETCH: Final = 25.0  # length of the stretches of the drive by which a miss is located (m)
MISS_DETECTIONS: Final = 20  # least number of detections of such a stretch
MISS_NEAR: Final = (
    2.5  # largest distance of near detections from the drive, relative to the used ones' median
)
SAME_CONE: Final = 0.5  # distance of two detections of one cone, as the optimum places them (m)
SEEN_AGAIN: Final = 0.25  # least number of detections of a cone, relative to the median of the used ones
MISS_SHARE: Final = 1.0 / 3.0  # least share of near detections on no boundary that is a miss


def are_of_cones(detections: DetectionTable, points: Array) -> BoolArray:
    """Whether each detection at points (m, 2), map frame, has others beside it about as used ones have.

    False detections are scattered. They are evidence neither for a map nor against it.
    """
    if not detections.used.any():
        return np.ones(len(points), bool)
    count = np.asarray(KDTree(points).query_ball_point(points, SAME_CONE, return_length=True))
    return np.asarray(count >= SEEN_AGAIN * np.median(count[detections.used]))


def share_used(at: Evaluation, detections: DetectionTable) -> float:
    """Share of the coloured detections of cones of the first lap that lie on the curves of an optimum."""
    state = at.state
    coloured = np.isin(detections.label, list(state.boundaries))
    coloured &= are_of_cones(detections, detections.points_map(slice(None), state.variables))
    again = np.ones(len(state.poses), bool)  # beside a previously driven stretch of every boundary
    for label, boundary in state.boundaries.items():
        again &= state.pose_u[label] - state.pose_u[label][0] >= boundary.length
    first = coloured & ~again[detections.cycle]
    return float(detections.used[first].mean()) if first.any() else 0.0


def objection(splines: Mapping[int, BSpline], poses: Array, used: float) -> str:
    """Describe the evidence against a map of closed curves around the poses (P, 3) of a lap; empty if none.

    Both boundaries must be closed, and cross only at level crossings. The vehicle must cross neither, and
    drive beside all of both. A large share of the detections must be `used`. Beside a gap between two cycles
    the boundaries are not tested if a point beside its middle would be too far from both poses.
    """
    if set(splines) != set(BOUNDARIES) or not all(spline.periodic for spline in splines.values()):
        return "not both of its boundaries are closed"
    driven, by_drive = poses[:, :2], KDTree(poses[:, :2])
    if boundaries_cross(splines, SAMPLE, driven):
        return "its boundaries cross"
    if crossed := crossed_boundaries(splines, driven):
        return crossings_told(crossed)
    for curve in (sampled(spline, SAMPLE) for spline in splines.values()):
        distance, beside = map(np.asarray, KDTree(curve).query(driven))
        aside = float(np.percentile(distance, DRIVE_PERCENTILE))
        missing = np.flatnonzero(np.hypot(*np.diff(driven, axis=0).T) > 2.0 * DRIVE_RATIO * aside)
        known = np.ones(len(curve), bool)
        for first, last in zip(beside[missing], beside[missing + 1], strict=True):
            known[np.arange(first, last if last >= first else last + len(curve)) % len(curve)] = False
        wider = float(np.max(by_drive.query(curve[known])[0])) / aside
        if wider > DRIVE_RATIO:
            return f"a boundary has a stretch {wider:.1f} times as far from the drive as one driven along"
    if used < LEAST_USED:
        return f"only {used:.0%} of the detections lie on its boundaries".replace("%", " %")
    return ""


def evidence_against(
    system: BatchSystem, at: Evaluation, splines: Mapping[int, BSpline], detections: DetectionTable
) -> str:
    """Describe the evidence against closed curves at an optimum, with their detections; empty if none."""
    poses, calibration = at.state.poses, at.state.variables.calibration
    used = share_used(at, detections)
    return disagreement(system, poses, calibration) or objection(splines, poses, used)


def disagreement(
    system: BatchSystem, poses: Array, calibration: Array, revisits: Sequence[Revisit] | None = None
) -> str:
    """Describe how the poses (P, 3) of an optimum contradict odometry and revisits; empty if they agree.

    Both are estimates of one drive, so they differ by some standard deviations of the less certain one. A
    wrong optimum bends the drive by much more, to fit the map. The odometry is corrected by the calibration
    (2,) of the optimum: what contradicts its prior widens that, and does not bend the drive. By default all
    `revisits` count; where no closed curve speaks against a wrong one, it must agree with the others.
    """
    if not system.revisits:
        return ""
    revisits = system.revisits if revisits is None else revisits
    calibrated = replace(system.chains[0], calibration_mean=calibration)
    sigmas = aligned_odometry(calibrated, revisits).disagreement(poses)
    return f"the poses are {sigmas:.1f} sigmas from the odometry" if sigmas > BENT_SIGMAS else ""


def unmapped(detections: DetectionTable, poses: Array) -> str:
    """Describe where a third of the detections near a drive lie on no boundary; empty if they do not.

    Detections far from the drive may be of another road, or false.
    """
    if len(detections.cycle) == 0:
        return ""
    driven, used = path_lengths(poses), detections.used
    points = to_map(detections.measured, poses[detections.cycle])
    distance = np.asarray(KDTree(poses[:, :2]).query(points)[0])
    near = distance < MISS_NEAR * np.median(distance[used] if used.any() else distance)
    near &= are_of_cones(detections, points)
    missed = near & ~used
    if missed.sum() < MISS_SHARE * near.sum():
        return ""
    stretch = (driven[detections.cycle] // MISS_STRETCH).astype(np.intp)
    count = np.bincount(stretch, near)
    poor = (count >= MISS_DETECTIONS) & (np.bincount(stretch, missed, len(count)) >= MISS_SHARE * count)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], poor, [False]])))
    ends = np.minimum(MISS_STRETCH * edges.reshape(-1, 2), driven[-1]).tolist()[:3]
    told = ", ".join(f"{a:.3g} to {b:.3g} m" for a, b in ends)
    where = f" ({told} of the drive)" if told else ""
    share = 100.0 * missed.sum() / near.sum()
    return f"{share:.0f} % of the detections near the drive lie on no boundary{where}"
