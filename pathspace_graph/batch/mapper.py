"""The offline batch: every pose, every detection and both curves of a log in one least-squares problem."""

from collections.abc import Callable, Iterator, MutableSequence, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import ClassVar, Final

import gtsam
import numpy as np
from scipy.spatial import KDTree
from threadpoolctl import threadpool_limits

from pathspace_graph.errors import SettingsError, SolveError
from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.gtsam_factors import pose_array, spline_projection_factors, station_factors
from pathspace_graph.factors.noise import KnownNoise
from pathspace_graph.factors.se2 import path_lengths, rotation, to_map
from pathspace_graph.front_end.front_end import JudgedLog, judge_log
from pathspace_graph.front_end.log_odometry import LogOdometry
from pathspace_graph.graph.elimination import eliminated_system
from pathspace_graph.graph.gaussian import FactoredSystem, cholesky
from pathspace_graph.graph.relative import Revisit
from pathspace_graph.graph.rows import odometry_factor
from pathspace_graph.graph.variables import (
    CALIBRATION_KEY,
    POINT,
    POSE,
    Layout,
    are_poses,
    pose_key,
    pose_keys,
)
from pathspace_graph.io.log import Log
from pathspace_graph.io.map import Map, PointBoundary, SplineBoundary, joint_covariance
from pathspace_graph.io.results import BatchRun, CycleRecord, RunResult, VehicleState
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.laps import LapCounter
from pathspace_graph.lengths import POSE as POSE_LENGTHS
from pathspace_graph.lengths import Length, Text, joined
from pathspace_graph.mapping.detections import DetectionColumns, DetectionTable
from pathspace_graph.mapping.motion import known_noise, size_of_vehicle, with_inflated_priors, with_size
from pathspace_graph.mapping.orange import OrangeCones, Sighting
from pathspace_graph.mapping.state import State
from pathspace_graph.run import Stopwatch, settings_dict
from pathspace_graph.scale import solved
from pathspace_graph.settings.mapper import MapperSettings, Start, known_settings
from pathspace_graph.spline.boundary import Boundary

from .lap import disagreement, objection, share_used
from .optimizer import LOOSE_GATE, Convergence, Optimizer
from .simplification import Scatter, map_block, own_settings, scatter_of_cones, simplified
from .start import CurveMapper, find_revisits, start_odometry, start_online
from .system import BatchSystem, Biweight, CurveGauge, Evaluation

ROOM: Final = 4.0  # distance from its foot points in which a factor searches them (m along the curve)
HALVINGS: Final = 6  # most halvings of the room while another foot point in it is nearer, as in a bend
SAME: Final = 1e-3  # distance below which two foot points are the same (m along the curve)
STRETCH: Final = 25.0  # length of the stretches of the drive by which a miss is located (m)
FEW: Final = 20  # number of detections below which a stretch says nothing
NEAR: Final = 2.5  # farthest from the drive that detections are near it, by the usual distance of used ones
MISSES: Final = 1.0 / 3.0  # least share of the detections near the drive on no boundary that is a miss
SHOWN: Final = 3  # most stretches that are told


def nonlinear_graph(system: BatchSystem, at: Evaluation) -> gtsam.NonlinearFactorGraph:
    """Return every factor of the problem, on the keys of `graph.variables`.

    A graph of plain least squares, with the associations of `at` and the sigmas across the curve over the
    roots of their robust weights. Each control point is anchored where it is. At an optimum its linearization
    is that of the optimization; its error isn't the robust cost.
    """
    factors, graph = [*drive_factors(system, at)], gtsam.NonlinearFactorGraph()
    for label, gauge in system.gauges.items():
        factors += _gauge(gauge, at.state.control_points(label))
        factors += [*_projections(system, at, label), *_along(system, at, label)]
    for factor in factors:
        graph.add(factor)
    return graph


def drive_factors(system: BatchSystem, at: Evaluation) -> Iterator[gtsam.NonlinearFactor]:
    """Yield all factors that hold no control point: odometry, first pose and the priors of calibrations."""
    for k, interval in enumerate(system.chain.odometry.intervals):
        yield odometry_factor(k, interval)
    for one in system.revisits:
        root = one.root.copy()  # GTSAM's tangents are in the frame of the later pose
        root[:, :2] = root[:, :2] @ rotation(one.local[2])
        noise = gtsam.noiseModel.Gaussian.Information(root.T @ root)
        ends = pose_key(one.earlier), pose_key(one.later)
        yield gtsam.BetweenFactorPose2(*ends, gtsam.Pose2(*one.local), noise)
    chain, calibration, noises = system.chain, system.settings.calibration, gtsam.noiseModel
    map_from_pose = np.eye(POSE)  # GTSAM's tangents of a pose are in its own frame
    map_from_pose[:2, :2] = rotation(at.state.poses[0, 2])
    noise = noises.Gaussian.Information(map_from_pose.T @ chain.first_information @ map_from_pose)
    yield gtsam.PriorFactorPose2(pose_key(0), gtsam.Pose2(*chain.first), noise)
    sigmas = noises.Diagonal.Sigmas(chain.calibration_sigma)
    yield gtsam.PriorFactorPoint2(CALIBRATION_KEY, chain.calibration_mean, sigmas)
    if chain.bias is not None:
        noise = noises.Diagonal.Precisions(np.array([0.0, chain.bias.sigma**-2]))
        yield gtsam.PriorFactorPoint2(CALIBRATION_KEY, np.array([0.0, chain.bias.value]), noise)
    sensor_key = at.state.variables.sensor_key
    if sensor_key is not None:
        sigmas = noises.Diagonal.Sigmas(np.array(calibration.sigmas))
        yield gtsam.PriorFactorVector(sensor_key, np.array(calibration.means), sigmas)


def _gauge(gauge: CurveGauge, control_points: Array) -> Iterator[gtsam.NonlinearFactor]:
    anchor = gtsam.noiseModel.Isotropic.Sigma(2, gauge.sigma_anchor)
    for j, (key, point) in enumerate(zip(gauge.keys.tolist(), control_points, strict=True)):
        yield factor_beside(gauge.keys[j : j + 1], int(gauge.cycle[j]), 1, beside_of(gauge, j))
        yield gtsam.PriorFactorPoint2(key, point, anchor)
    for row in range(len(gauge.smoothness)):
        keys, cycle = gauge.keys[gauge.neighbours[row]], int(gauge.middle_cycle[row])
        yield factor_beside(keys, cycle, POINT, bending_of(gauge, row))


Terms = Callable[[Array, Array], tuple[Array, Array, Array]]
"""Whitened residuals of control points as a pose (1, 3) sees them, with derivatives by both."""


def beside_of(gauge: CurveGauge, j: int) -> Terms:
    """Return the terms that hold control point j of a curve beside its pose."""
    only = slice(j, j + 1)
    return replace(gauge, keys=gauge.keys[only], cycle=gauge.cycle[only], ahead=gauge.ahead[only]).terms


def bending_of(gauge: CurveGauge, row: int) -> Terms:
    """Return the terms of a second difference of a curve, as the pose beside it sees it."""
    chosen = gauge.neighbours[row]
    smoothness = gauge.smoothness[row, chosen][None]
    return replace(gauge, keys=gauge.keys[chosen], cycle=np.zeros(3, np.intp), smoothness=smoothness).bending


def factor_beside(points: IntArray, cycle: int, size: int, terms: Terms) -> gtsam.CustomFactor:
    """Return the factor of `size` whitened residuals of control points (k,) as the pose of a cycle sees them.

    GTSAM's tangents of a pose are in its own frame.
    """
    keys = [*points.tolist(), pose_key(cycle)]

    def error(_: gtsam.CustomFactor, values: gtsam.Values, H: MutableSequence[Array] | None) -> Array:
        pose = values.atPose2(keys[-1])
        at = np.array([values.atPoint2(key) for key in keys[:-1]])
        residual, by_points, by_pose = terms(at, pose_array(pose)[None])
        if H is not None:
            by_pose[..., :2] = by_pose[..., :2] @ rotation(pose.theta())
            for k, block in enumerate(np.split(by_points.reshape(size, -1), len(points), axis=1)):
                H[k] = block
            H[len(points)] = by_pose.reshape(size, POSE)
        return residual.ravel()

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(size), keys, error)


def _projections(system: BatchSystem, at: Evaluation, label: int) -> list[gtsam.CustomFactor]:
    """Return a factor for each cycle, of its used detections on a boundary that have any weight."""
    projected, boundary = at.projected[label], at.state.boundaries[label]
    scale, detections = system.scale(projected), system.detections
    weighted = scale > 0.0
    scale, u, rows = scale[weighted], projected.foot.u[weighted], projected.rows[weighted]
    cycles, variables = detections.cycle[rows], at.state.variables
    points = to_map(detections.corrected(rows, variables.sensor), variables.poses_at(cycles))
    room = _room(boundary, at.state.control_points(label), points, u)
    return spline_projection_factors(
        pose_keys(cycles),
        at.state.keys(label).tolist(),
        boundary.tables,
        points_vehicle=detections.measured[rows],
        covariances=scale[:, None, None] ** -2.0 * np.eye(2),
        low=u - room,
        high=u + room,
        sigma_model=0.0,
        huber=np.inf,
        sensor_key=variables.sensor_key,
        twists=detections.twist[rows],
    )


def _along(system: BatchSystem, at: Evaluation, label: int) -> list[gtsam.CustomFactor]:
    """Return a factor for each cycle, of its detections at stations of a boundary that have any weight."""
    if at.along is None:
        return []
    stations, detections = at.along.stations, system.detections
    scale = at.along.scale(system.kernel)
    chosen = (stations.label[at.along.station] == label) & (scale > 0.0)
    rows, station = at.along.detection[chosen], at.along.station[chosen]
    return station_factors(
        pose_keys(detections.cycle[rows]),
        at.state.keys(label).tolist(),
        at.state.boundaries[label].tables,
        u=stations.u[station],
        sigma_station=np.zeros(len(rows)),
        points_vehicle=detections.measured[rows],
        covariances=scale[chosen, None, None] ** -2.0 * np.eye(2),
        twists=detections.twist[rows],
        huber=np.inf,
        sensor_key=at.state.variables.sensor_key,
    )


def _room(boundary: Boundary, control_points: Array, points: Array, u: Array) -> Array:
    """Return the room (m,) about u in which the nearest foot point of each point (m, 2) is that at u."""
    room = np.full(len(u), ROOM)
    for _ in range(HALVINGS):
        nearest = boundary.find(control_points, points, u - room, u + room).u
        room[np.abs(nearest - u) > SAME] *= 0.5
    return room


Found = tuple[Evaluation, Convergence]
"""An optimum, and how its search ended."""

NAME: Final = "spline"  # name of the estimator on the command line


@dataclass(frozen=True, eq=False, kw_only=True)
class BatchResult(BatchRun):
    """The result of a batch optimization, how it ended, and its uncertainty."""

    LENGTHS: ClassVar = RunResult.LENGTHS | {
        **dict.fromkeys(("scatter", "online", "objection"), 0),
        "map_covariance": 2,
    }

    convergence: Convergence
    map_covariance: Array
    """Joint covariance (2m, 2m) of the control points of both boundaries, left first, in m^2. It comes from
    the measurements alone: the scatter of the cones isn't added."""
    scatter: Scatter
    """Distance of the cones from the map's curves, which have too few control points to follow them."""
    calibration: Array
    """Calibration (2,): scale error of the speeds [-], bias of the yaw rate [rad/s]."""
    online: RunResult | None
    """Online run that the batch began with, if it did."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Wall time of each stage (s)."""
    system: BatchSystem
    """Problem that was solved, on curves with about one knot for each cone."""
    optimum: Evaluation
    objection: str = ""
    """What speaks against the map as a whole; empty where nothing does."""

    @cached_property
    def pose_covariances(self) -> Array:
        """Return the marginal covariance (n, 3, 3) of each pose (x, y, theta), map frame, computed once."""
        with threadpool_limits(limits=1):
            weights = self.scale ** np.array(POSE_LENGTHS, float)
            marginals = self.system.eliminated(self.optimum).pose_marginals
            lengths = self.optimum.state.poses * [1.0, 1.0, 0.0]
            size = self.system.settings.odometry.sigma_size
            marginals = marginals + size**2 * lengths[:, :, None] * lengths[:, None, :]
            return np.outer(weights, weights) * marginals

    def graph(self) -> gtsam.NonlinearFactorGraph:
        """Return the whole problem at the optimum by `nonlinear_graph`; its lengths are over the scale."""
        return nonlinear_graph(self.system, self.optimum)

    def values(self) -> gtsam.Values:
        """Return the optimum over the scale: control points l_j and r_j, calibration b_0, poses x_k."""
        variables = self.optimum.state.variables
        return variables.gtsam_values(variables.keys)


class BatchMapper:
    """Mapper of a whole log at once."""

    def __init__(
        self,
        settings: MapperSettings | None = None,
        odometry_sigma: Array | KnownNoise | None = None,
        online: Callable[[MapperSettings, KnownNoise], CurveMapper] | None = None,
    ) -> None:
        """Keep the settings, and the standard deviation (3,) of a measured twist (m/s, m/s, rad/s).

        `online` makes the online mapper whose map the optimization begins with, if not at odometry.
        """
        self.settings = known_settings(settings)
        self.online = online
        self.odometry_sigma = odometry_sigma
        known_noise(odometry_sigma)  # a wrong one is refused here

    def solve(
        self, log: Log, start: Start | None = None, on_round: Callable[[], None] | None = None
    ) -> BatchResult:
        """Return the optimum, which is searched from odometry alone or from an online map.

        `start` is by default `batch.start` of the settings. `on_round` is called after each round.
        SettingsError if there is no online mapper to begin with, and SolveError where the log leaves no way
        to an optimum.
        """
        return solved(partial(self._solve, start, on_round), log, self.settings)

    def _solve(
        self, start: Start | None, on_round: Callable[[], None] | None, log: Log, scale: float
    ) -> BatchResult:
        watch, noise = Stopwatch(), known_noise(self.odometry_sigma, scale)
        judged = judge_log(log, noise, own_settings(self.settings))
        settings, chain = judged.settings, judged.chain
        watch.lap("integrate")
        start = start or self.settings.batch.start
        optimizer, found, online = self._search(log, judged, noise, start, on_round, watch)
        system = optimizer.system
        at, convergence, known = _with_wider_priors(optimizer, *found)
        watch.lap("optimum")
        size = system.settings.odometry.sigma_size
        joint = with_size(known.covariance(at.state.map_keys), at.state.map_points.ravel(), size)
        vehicle = _vehicle(at.state, known, size)
        watch.lap("covariance")
        detections = deepcopy(system.detections)  # the result's problem keeps its own associations
        state, change = simplified(at.state, detections, settings)
        joint = change @ joint @ change.T
        scatter = scatter_of_cones(state, detections, settings)
        watch.lap("simplify")
        records, laps = _records(state, detections, chain, sum(watch.laps.values()))
        return BatchResult(
            estimator=NAME,
            settings=settings_dict(replace(self.settings, scale=scale)),
            map=replace(_map(state, joint, scatter), points=_orange(judged, at.state, settings)),
            scatter=scatter,
            trajectory_t=chain.stamps,
            trajectory=at.state.poses.copy(),
            cycles=records,
            laps=laps,
            converged=convergence.converged,
            cost=convergence.cost,
            convergence=convergence,
            map_covariance=joint,
            calibration=at.state.variables.calibration.copy(),
            noise=judged.noise,
            vehicle=vehicle,
            online=online,
            seconds=watch.laps,
            system=system,
            optimum=at,
            objection=unmapped(detections, state.poses),
        )

    def _search(
        self,
        log: Log,
        judged: JudgedLog,
        noise: KnownNoise,
        start: Start,
        on_round: Callable[[], None] | None,
        watch: Stopwatch,
    ) -> tuple[Optimizer, Found, RunResult | None]:
        """Return the optimum with its optimizer, and the online run that the search began with, if it did."""
        revisits: Sequence[Revisit] = ()
        if start != "online":
            optimizer = _optimizer(judged, on_round)
            revisits = find_revisits(judged.chain, all_cones(judged), judged.settings)
            found = find_closed_optimum(optimizer, revisits)
            if found is None and start == "odometry":
                optimizer = _optimizer(judged, on_round)
                found = find_open_optimum(optimizer)
            if found is not None:
                return optimizer, found, None
        if self.online is None:
            raise SettingsError("start online: expected an online mapper to begin with, found none")
        watch.lap("optimum")
        mapper = self.online(replace(self.settings, scale=1.0), noise)
        state, online = start_online(log, mapper)
        watch.lap("start")
        optimizer, found = _optimizer(judged, on_round), None
        if start == "auto" and not revisits:
            found = find_closed_optimum(optimizer, mapper.closed_by)
        if found is None:
            optimizer = _optimizer(judged, on_round)
            optimizer.system.revisits = mapper.revisits
            found = optimizer.find(state)
        return optimizer, found, online


def _optimizer(judged: JudgedLog, on_round: Callable[[], None] | None) -> Optimizer:
    """Return an optimizer with a system and detections of its own, so no search begins with another's."""
    detections = DetectionTable.of(judged.cycles, twists=judged.chain.twists)
    system = BatchSystem(detections, judged.chain, judged.settings, Biweight(LOOSE_GATE))
    return Optimizer(system, on_round=on_round)


def unmapped(detections: DetectionTable, poses: Array) -> str:
    """Return that a third of what was detected near a drive lies on no boundary, and where; or nothing.

    What is far from the drive may be of another road, or no cone.
    """
    if len(detections.cycle) == 0:
        return ""
    driven, used = path_lengths(poses), detections.used
    points = to_map(detections.measured, poses[detections.cycle])
    distance = np.asarray(KDTree(poses[:, :2]).query(points)[0])
    near = distance < NEAR * np.median(distance[used] if used.any() else distance)
    missed = near & ~used
    if missed.sum() < MISSES * near.sum():
        return ""
    stretch = (driven[detections.cycle] // STRETCH).astype(np.intp)
    count = np.bincount(stretch, near)
    poor = (count >= FEW) & (np.bincount(stretch, missed, len(count)) >= MISSES * count)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], poor, [False]])))
    ends = np.minimum(STRETCH * edges.reshape(-1, 2), driven[-1]).tolist()[:SHOWN]
    told = [Text("{a:.3g} to {b:.3g} m", a=Length(a), b=Length(b)) for a, b in ends]
    where = Text(" ({stretches} of the drive)", stretches=joined(told, ", ")) if told else ""
    said = "{share:.0f} % of what was detected near the drive lies on no boundary{where}"
    return Text(said, share=100.0 * missed.sum() / near.sum(), where=where)


def _known(system: BatchSystem, at: Evaluation) -> FactoredSystem:
    """Return the system of the map, the calibrations and the last pose, with all other poses eliminated."""
    keys = at.state.variables.layout.keys
    kept = Layout(keys[~are_poses(keys) | (keys == pose_key(len(at.state.poses) - 1))])
    return FactoredSystem(kept, cholesky(eliminated_system(system.linear_graph(at), kept)[0]))


def _vehicle(state: State, known: FactoredSystem, sigma_size: float) -> VehicleState:
    """Return the last pose and the calibration, with their joint covariance."""
    variables, last = state.variables, pose_key(len(state.poses) - 1)
    covariance = known.covariance(np.append(last, variables.calibration_keys))
    values = size_of_vehicle(state.poses[-1], len(variables.calibrations))
    covariance = with_size(covariance, values, sigma_size)
    return VehicleState.split(state.poses[-1], variables.calibrations, covariance)


def find_closed_optimum(optimizer: Optimizer, revisits: Sequence[Revisit]) -> Found | None:
    """Return the optimum whose search begins with odometry and the places that were met again.

    None where there are none, the search fails, or something speaks against the map.
    """
    system, settings = optimizer.system, optimizer.system.settings
    system.revisits = tuple(revisits)
    if not revisits:
        return None
    try:
        start = start_odometry(system.chain, system.detections, settings, revisits)
        at, convergence = optimizer.find(start)
    except SolveError:
        return None
    poses, used = at.state.poses, share_used(at, system.detections)
    why = disagreement(system, poses) or objection(at.state.splines, poses, used, settings)
    return None if why else (at, convergence)


def all_cones(judged: JudgedLog) -> DetectionColumns:
    """Return the detections of all cones of a log, corrected by the sensor's calibration as it is known."""
    pairs = zip(judged.cycles, judged.orange, strict=True)
    table = DetectionColumns.of([one.with_others(other) for one, other in pairs], twists=judged.chain.twists)
    calibration = judged.settings.calibration
    table.correct(np.array(calibration.means) if calibration.sensor else np.zeros(0))
    return table


def find_open_optimum(optimizer: Optimizer) -> Found:
    """Return the optimum whose search begins with an open map along the odometry."""
    system = optimizer.system
    return optimizer.find(start_odometry(system.chain, system.detections, system.settings))


def _with_wider_priors(
    optimizer: Optimizer, at: Evaluation, convergence: Convergence
) -> tuple[Evaluation, Convergence, FactoredSystem]:
    """Return the optimum, searched again while it contradicts the prior of a calibration, and `_known`."""
    system, variables = optimizer.system, at.state.variables
    known = _known(system, at)
    variance = np.diag(known.covariance(variables.calibration_keys))
    inflated = with_inflated_priors(variables.calibrations, variance, system.settings)
    if inflated == system.settings:
        return at, convergence, known
    system.settings = inflated
    system.chain = replace(system.chain, calibration_sigma=np.array(inflated.odometry.sigmas))
    return _with_wider_priors(optimizer, *optimizer.find(at.state))


def _map(state: State, joint: Array, scatter: Scatter) -> Map:
    """Return the curves with their covariance, to which the scatter of the cones is added."""
    boundaries = {}
    for label, boundary in state.boundaries.items():
        block = map_block(state, label)
        sigma = np.repeat(scatter.of_control_points(label, boundary), 2)
        covariance = joint[block, block] + np.diag(sigma**2)
        boundaries[label] = SplineBoundary(state.spline(label), covariance)
    return Map(state.closed, boundaries, joint_covariance(joint, boundaries))


def _orange(judged: JudgedLog, state: State, settings: MapperSettings) -> dict[int, PointBoundary]:
    cones, twists = OrangeCones(settings.growth, settings.spline.sigma_shape), judged.chain.twists
    for k, detections in enumerate(judged.orange):
        cones.add(Sighting(k, state.poses[k], twists[k], detections), state.variables.sensor)
    return cones.points()


def _records(
    state: State, detections: DetectionTable, chain: LogOdometry, seconds: float
) -> tuple[tuple[CycleRecord, ...], int]:
    """Return a record of each cycle, with its share of the seconds, and the number of complete laps."""
    left, right = (state.boundaries[b].size if b in state.boundaries else 0 for b in (LEFT, RIGHT))
    used = np.bincount(detections.cycle[detections.used], minlength=len(chain)).tolist()
    offered = np.bincount(detections.cycle, minlength=len(chain)).tolist()
    counter, share = LapCounter(), seconds / len(chain)
    records = tuple(
        CycleRecord(k, t, share, left, right, used[k], counter.update(state.poses[k]), offered=offered[k])
        for k, t in enumerate(chain.stamps.tolist())
    )
    return records, counter.completed
