"""The start of the batch: from an online run of the same log, or from odometry alone.

From odometry, revisits determine the length of a lap and align the laps, and the first curves go through the
cones beside lap 1.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final, Protocol

import gtsam
import numpy as np

from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.odometry import CALIBRATION_SIZE
from pathspace_graph.factors.se2 import (
    compose,
    difference,
    path_lengths,
    relative,
    rotated,
    to_map,
)
from pathspace_graph.front_end.front_end import JudgedLog
from pathspace_graph.front_end.log_odometry import LogOdometry
from pathspace_graph.graph.elimination import Elimination, linear_graph, solution
from pathspace_graph.graph.rows import Revisit, revisit_rows
from pathspace_graph.graph.variables import CALIBRATION_KEY, POSE, Layout, Variables, pose_keys
from pathspace_graph.io.log import Log
from pathspace_graph.io.results import RunResult, VehicleState
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.mapping.detections import DetectionColumns, DetectionTable
from pathspace_graph.mapping.growth import GROWTH_REACH
from pathspace_graph.mapping.path import MIN_LATERAL, SIDES, along_and_across
from pathspace_graph.mapping.state import State
from pathspace_graph.places.find import NEARBY, find_return, return_to_beginning, revisit_of, seen_in
from pathspace_graph.run import OnlineEstimator, run_online
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.boundary import Boundary
from pathspace_graph.spline.bspline import BSpline

from .association import ROW_CONES, add_drive, cluster
from .simplification import boundary_of, exact_settings, fit_through
from .system import BatchSystem

NODE_STEP: Final = 5.0  # distance of the nodes, whose poses are aligned (m along the path)
ALIGN_TOLERANCE: Final = 1.0  # largest change in the last Gauss-Newton step (m), a sigma of `NEARBY`
OFF: Final = 0.3  # largest misfit of a revisit (sigmas of `NEARBY`) without a new alignment
REVISIT_INTERVAL: Final = 15.0  # least distance from one revisit to the next (m along the path)
LAP_SHARE: Final = 0.7  # least share of a lap between two passes
START_MAX_LATERAL: Final = 15.0  # largest distance of a boundary's detections from the driven path (m)


class CurveMapper(OnlineEstimator, Protocol):
    """An online estimator with curves, whose map can be the start of the batch."""

    @property
    def boundaries(self) -> dict[int, Boundary]: ...
    @property
    def corrected_poses(self) -> Array: ...
    @property
    def revisits(self) -> tuple[Revisit, ...]: ...
    @property
    def closed_by(self) -> tuple[Revisit, ...]: ...
    def control_points(self, label: int) -> Array: ...
    def vehicle_state(self) -> VehicleState: ...


@dataclass(frozen=True, eq=False)
class StartMap:
    """A map from which a batch starts, and the poses beside it."""

    splines: dict[int, BSpline]  # curves by label, map frame
    poses: Array  # (P, 3) poses of all cycles, map frame
    calibration: Array  # (2,) or (7,) calibration of the odometry, and of the sensor if estimated
    ends: dict[int, float] = field(default_factory=dict)  # confirmed ends of open curves (m)

    @property
    def is_open(self) -> bool:
        return not any(spline.periodic for spline in self.splines.values())

    def state(self, settings: MapperSettings) -> State:
        """Build the initial state from the map and the poses."""
        state = State()
        for label, spline in self.splines.items():
            own = replace(exact_settings(settings.spline), degree=spline.degree)
            boundary = Boundary(spline.knots, spline.periodic, own)
            boundary.confirmed_end = self.ends.get(label, boundary.tables.high)
            state.add_boundary(label, boundary, spline.distinct_control_points)
        add_drive(state, self.poses, self.calibration)
        return state


def start_online(log: Log, mapper: CurveMapper, settings: MapperSettings) -> tuple[State, RunResult]:
    """Run an online estimator; return its final map with all of its poses, and the run."""
    run, curves = run_online(log, mapper, outlines=True), mapper.boundaries.items()
    splines = {label: boundary.spline(mapper.control_points(label).copy()) for label, boundary in curves}
    ends = {label: boundary.confirmed_end for label, boundary in curves}
    corrected = mapper.corrected_poses
    poses = unwrap(np.concatenate([corrected, run.trajectory[len(corrected) :]]))
    vehicle = mapper.vehicle_state()
    calibration = np.concatenate([vehicle.calibration, vehicle.sensor])
    return StartMap(splines, poses, calibration, ends).state(settings), run


def unwrap(poses: Array) -> Array:
    """Remove the jumps of the headings of poses (n, 3)."""
    return np.column_stack([poses[:, :2], np.unwrap(poses[:, 2])]) if len(poses) else poses


# --- from odometry ---------------------------------------------------------------------------------------


def start_odometry(system: BatchSystem) -> State:
    """Start from poses by odometry and revisits, and curves through the cones detected in the first lap.

    The curves are closed if there is a revisit: the first one ends a lap.
    """
    detections, settings, revisits = system.detections, system.settings, system.revisits
    aligned, state = aligned_odometry(system.chains[0], revisits), State()
    calibration = np.array(settings.calibrations)
    calibration[:CALIBRATION_SIZE] = aligned.calibration
    detections.correct(calibration[CALIBRATION_SIZE:])
    lap = length_of_lap(aligned.poses, revisits[0]) if revisits else np.inf
    for label in BOUNDARIES:
        _begin_boundary(state, label, aligned.poses, lap, detections, settings)
    add_drive(state, aligned.poses, calibration)
    return state


def length_of_lap(poses: Array, revisit: Revisit) -> float:
    """Length (m) of the path of poses (P, 3) from a pose to the place beside it at its revisit."""
    driven = path_lengths(poses)
    return float(driven[revisit.later] - driven[revisit.earlier] - revisit.local[0])


@dataclass(frozen=True, eq=False)
class AlignedOdometry:
    """The optimum of odometry and revisits, without curves. Poses at nodes are variables."""

    poses: Array  # (P, 3) poses of all cycles, dead reckoned from the last node
    calibration: Array  # (2,) calibration of the odometry
    nodes: IntArray  # (k,) cycles of the nodes, the first and the last cycle among them
    graph: gtsam.GaussianFactorGraph  # as linearized in the last step; pose j is the one of node j
    layout: Layout

    @cached_property
    def covariances(self) -> Array:
        """Marginal covariance (k, 3, 3) of each node."""
        return Elimination(self.graph, self.layout).pose_marginals

    def disagreement(self, poses: Array) -> float:
        """Root mean square distance of poses (P, 3) from the nodes, in standard deviations."""
        off = (poses - self.poses)[self.nodes]
        square = np.einsum("ki,ki->k", off, np.linalg.solve(self.covariances, off[:, :, None])[:, :, 0])
        return float(np.sqrt(square.mean() / POSE))


def aligned_odometry(
    chain: LogOdometry, revisits: Sequence[Revisit], begin: AlignedOdometry | None = None
) -> AlignedOdometry:
    """Find the optimum of odometry and revisits by Gauss-Newton, from another one or dead reckoning.

    The ends of revisits are nodes. The odometry between nodes is one factor.
    """
    calibration = chain.calibration_mean if begin is None else begin.calibration
    poses = chain.dead_reckoned(calibration) if begin is None else begin.poses
    ends = np.array([(one.earlier, one.later) for one in revisits], np.intp).reshape(-1, 2)
    _, regular = np.unique(path_lengths(poses) // NODE_STEP, return_index=True)
    nodes = np.unique(np.concatenate([regular, ends.ravel(), [len(poses) - 1]]))
    odometry = copy(chain.odometry)
    odometry.compose_between(nodes)
    between = replace(chain, stamps=chain.stamps[nodes], odometry=odometry, twists=chain.twists[nodes])
    met = [
        replace(one, earlier=earlier, later=later)
        for one, (earlier, later) in zip(revisits, nodes.searchsorted(ends).tolist(), strict=True)
    ]
    variables = Variables()
    variables.insert(np.array([CALIBRATION_KEY]), calibration)
    variables.insert(pose_keys(np.arange(len(nodes))), poses[nodes].ravel())
    for _ in range(8):
        rows = between.rows(variables.poses, variables.calibration) + revisit_rows(met, variables.poses)
        graph = linear_graph(rows, variables)
        step = solution(graph, variables.layout)
        variables.values = variables.values + step
        if np.abs(step).max() < ALIGN_TOLERANCE:
            break
    reckoned = chain.dead_reckoned(variables.calibration)
    last = nodes.searchsorted(np.arange(len(poses)), side="right") - 1
    poses = compose(variables.poses[last], relative(reckoned[nodes[last]], reckoned))
    return AlignedOdometry(poses, variables.calibration, nodes, graph, variables.layout)


def all_detections(judged: JudgedLog) -> DetectionColumns:
    """Detections of a whole log, of orange cones too, corrected by the known calibration of the sensor."""
    pairs = zip(judged.cycles, judged.orange, strict=True)
    table = DetectionColumns.of([one.with_others(other) for one, other in pairs], twists=judged.chain.twists)
    calibration = judged.settings.calibration
    table.correct(np.array(calibration.means) if calibration.sensor else np.zeros(0))
    return table


def find_revisits(judged: JudgedLog) -> tuple[Revisit, ...]:
    """Find the revisits of a whole drive by its cones: the first return to its beginning, and later ones.

    Before the first return the poses are dead reckoned. A revisit that contradicts the poses aligns them. The
    next one is searched `REVISIT_INTERVAL` metres later, nearby.
    """
    chain, settings = judged.chain, judged.settings
    seen = seen_in(all_detections(judged).cones(settings.of_lines))
    closing, reckoned = settings.closing, aligned_odometry(chain, ())
    aligned, poses = reckoned, reckoned.poses
    driven, revisits, due, lap = path_lengths(poses), list[Revisit](), closing.min_path, np.inf
    for newest in range(len(poses)):
        is_last = newest == len(poses) - 1 and driven[newest] > closing.min_path
        if driven[newest] < due and not is_last:
            continue
        so_far = poses[: newest + 1]
        if revisits:
            due = driven[newest] + REVISIT_INTERVAL / 3.0
            last = float(path_lengths(so_far)[-1]) - LAP_SHARE * lap
            found = find_return(seen, so_far, last, settings)
            revisit = None if found is None else revisit_of(found[0], so_far, found[1], newest)
        else:
            due = driven[newest] + closing.check_interval
            covariance = reckoned.covariances[reckoned.nodes.searchsorted(newest)]
            revisit = return_to_beginning(seen, so_far, covariance, settings)
        if revisit is None:
            continue
        if not revisits:
            lap = length_of_lap(reckoned.poses, revisit)
        revisits.append(revisit)
        off = difference(relative(poses[revisit.earlier], poses[revisit.later]), revisit.local)
        if float(np.square(off / NEARBY[0]).sum()) > OFF**2:
            aligned = aligned_odometry(chain, revisits, aligned)
            poses = aligned.poses
        due = driven[newest] + REVISIT_INTERVAL
    return tuple(revisits)


def _begin_boundary(
    state: State,
    label: int,
    poses: Array,
    lap: float,
    detections: DetectionTable,
    settings: MapperSettings,
) -> None:
    """Add a curve through the cones of a boundary that were detected in the first lap (m), if they suffice.

    A detection far from the station of its cycle belongs to a stretch that is driven later.
    """
    driven, gate, closes = path_lengths(poses), settings.gate, bool(np.isfinite(lap))
    first_lap = driven < lap
    rows = np.flatnonzero((detections.label == label) & first_lap[detections.cycle])
    if len(rows) == 0 or first_lap.sum() < 2:
        return
    cycles, path, stations = detections.cycle[rows], poses[first_lap, :2], driven[first_lap]
    length = float(stations[-1]) + GROWTH_REACH
    if closes:
        length, path = lap, np.concatenate([path, path[:1]])
        stations = np.append(stations, length)
    points = to_map(detections.point[rows], poses[cycles])
    station, lateral = along_and_across(points, path, stations)
    side, ahead = SIDES[label] * lateral, station - driven[cycles]
    kept = (side > MIN_LATERAL) & (side < START_MAX_LATERAL)
    kept &= (ahead > -gate.view_behind) & (ahead < gate.view_ahead) & (station >= 0.0) & (station < length)
    covariances = rotated(detections.covariance[rows[kept]], poses[cycles[kept], 2])
    cones = cluster(points[kept], station[kept], covariances, length, closes, settings)
    if len(cones.u) >= ROW_CONES:
        spline, _ = fit_through(cones.points, closes, settings, settings.batch.size_share)
        state.add_boundary(label, *boundary_of(spline, settings))
