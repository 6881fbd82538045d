"""One centre line with a width: as the batch of a log, and from the posterior of the online mapper."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import chain
from typing import Final

import gtsam
import numpy as np

from pathspace_graph.batch import mapper as batch
from pathspace_graph.batch.association import headings
from pathspace_graph.batch.mapper import BatchMapper, BatchResult
from pathspace_graph.batch.start import CurveMapper
from pathspace_graph.batch.system import CurveGauge
from pathspace_graph.errors import SettingsError
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.gtsam_factors import pose_array, spline_projection_factors
from pathspace_graph.factors.noise import KnownNoise
from pathspace_graph.factors.residuals import RIBBON
from pathspace_graph.graph.gaussian import sparse_marginal
from pathspace_graph.graph.variables import POSE, pose_key, pose_keys
from pathspace_graph.io.log import Detections, Log, Odometry
from pathspace_graph.io.map import NO_COVARIANCE, Map, SplineBoundary
from pathspace_graph.io.results import BatchRun, LapBatches, RunNoise, VehicleState
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.run import CycleResult, settings_dict
from pathspace_graph.scale import at_scale, log_at_scale
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.centre_line import SIDE, CentreCurve, Ribbon, find_line

NAME: Final = "centerline"
ROOM: Final = 4.0  # distance along the line within which a foot point is searched for (m)
RIBBON_LETTER: Final = "a"  # of the keys of a ribbon's control points, which hold `Point3` (x, y, h)
ROUNDS: Final = 2  # optimizations; before each, the control points are held beside the poses anew
MAX_ITERATIONS: Final = 15  # most iterations of one of them
TOLERANCE: Final = 1e-5  # largest relative gain of its last iteration


def map_of(ribbon: Ribbon, covariance: Array | None, sigma_shape: float, until: dict[int, float]) -> Map:
    """Return the edges of a ribbon as a map, with the covariance (3m, 3m) of its control points, if known.

    `sigma_shape` (m) is added to each control point. Open edges are confirmed up to the parameters `until`.
    """
    edges, joint, at = {label: ribbon.edge_spline(label) for label in BOUNDARIES}, None, 0
    if covariance is not None:
        by_ribbon = np.concatenate([jacobian for _, jacobian in edges.values()])
        joint = by_ribbon @ covariance @ by_ribbon.T
        joint = 0.5 * (joint + joint.T) + sigma_shape**2 * np.eye(len(joint))
    boundaries = {}
    for label, (spline, jacobian) in edges.items():
        block = slice(at, at := at + len(jacobian))
        own = NO_COVARIANCE if joint is None else joint[block, block].copy()
        boundaries[label] = SplineBoundary(spline, own, until.get(label, spline.domain[1]))
    return Map(ribbon.periodic, boundaries, joint)


def ribbon_of(track: Map, settings: MapperSettings) -> tuple[Ribbon, Array | None, dict[int, float]]:
    """Return the ribbon between the boundaries of a map, or raise a SettingsError.

    With it come its covariance (3m, 3m), if known, and the parameter up to which each open edge is confirmed.
    """
    curves = {label: track.curve(label, "a centre line") for label in BOUNDARIES}
    P = track.covariance_of(*curves.values())
    left, right = (curve.spline for curve in curves.values())
    line, until = find_line(left, right, left.periodic, settings.centerline.spacing), {}
    for side, (label, curve) in enumerate(curves.items()):
        if not left.periodic:
            end = np.array([min(curve.confirmed_until, curve.spline.domain[1])])
            until[label] = float(line.ribbon_parameters(side, end)[0])
    return line.ribbon, None if P is None else line.by_boundaries @ P @ line.by_boundaries.T, until


@at_scale
class CenterlineMapper:
    """Maps a track online as a ribbon, from the joint Gaussian of the boundaries of `FixedLagMapper`.

    Where there is no line between the boundaries, the map is theirs.
    """

    def __init__(
        self, settings: MapperSettings | None = None, odometry_sigma: Array | KnownNoise | None = None
    ) -> None:
        self.settings = settings or MapperSettings()
        self.boundaries = FixedLagMapper(replace(self.settings, scale=1.0), odometry_sigma)

    def update(self, odometry: Odometry, detections: Detections) -> CycleResult:
        return self.boundaries.update(odometry, detections)

    def wait(self) -> None:
        self.boundaries.wait()

    def batches(self) -> LapBatches:
        return self.boundaries.batches()

    def noise_used(self) -> RunNoise:
        return self.boundaries.noise_used()

    def vehicle_state(self) -> VehicleState:
        return self.boundaries.vehicle_state()

    def map(self) -> Map:
        return self._edges(self.boundaries.map())

    def outline(self) -> Map:
        return self._edges(self.boundaries.outline())

    def _edges(self, track: Map) -> Map:
        try:
            ribbon, covariance, until = ribbon_of(track, self.settings)
        except SettingsError:
            return track
        edges = map_of(ribbon, covariance, self.settings.spline.sigma_shape, until)
        return replace(edges, points=track.points)


def ribbon_keys(ribbon: Ribbon) -> list[int]:
    return [int(gtsam.symbol(RIBBON_LETTER, j)) for j in range(ribbon.size)]


def edge_factors(start: BatchResult, line: CentreCurve, settings: MapperSettings) -> list[gtsam.CustomFactor]:
    """Return a factor for each cycle with detections that the batch of both boundaries uses."""
    table, variables, parts = start.system.detections, start.optimum.state.variables, []
    for side, (label, projected) in enumerate(start.optimum.projected.items()):
        used = start.system.scale(projected) > 0.0
        u = line.ribbon_parameters(side, projected.foot.u[used])
        parts.append((projected.rows[used], np.full(len(u), SIDE[label]), u))
    rows, sides, u = (np.concatenate(part) for part in zip(*parts, strict=True))
    order = np.argsort(rows)
    rows, u = rows[order], u[order]
    return spline_projection_factors(
        pose_keys(table.cycle[rows]),
        ribbon_keys(line.ribbon),
        line.ribbon.tables,
        points_vehicle=table.measured[rows],
        covariances=table.covariance[rows],
        low=u - ROOM,
        high=u + ROOM,
        sigma_model=settings.batch.sigma_model,
        huber=settings.gate.huber,
        sensor_key=variables.sensor_key,
        twists=table.twist[rows],
        sides=sides[order],
    )


def shape_factors(ribbon: Ribbon, poses: Array, settings: MapperSettings) -> Iterator[gtsam.CustomFactor]:
    """Yield the weak priors of the control points, each in the frame of the nearest of poses (n, 3).

    Those of a boundary (`CurveGauge`), and small second differences of the width.
    """
    points, keys = ribbon.distinct_control_points[:, :2], np.array(ribbon_keys(ribbon))
    cycle = ((points[:, None] - poses[:, :2]) ** 2).sum(axis=2).argmin(axis=1)
    beside = poses[cycle]
    smoothness = np.zeros((len(ribbon.bending), ribbon.size))
    columns = (np.arange(len(smoothness))[:, None] + np.arange(3)) % ribbon.size
    np.put_along_axis(smoothness, columns, ribbon.bending, axis=1)
    gauge = CurveGauge(
        label=0,
        keys=keys,
        cycle=cycle,
        ahead=(headings(beside) * (points - beside[:, :2])).sum(axis=1),
        sigma=settings.batch.sigma_slide,
        smoothness=smoothness,
        sigma_smoothness=settings.batch.sigma_smoothness * ribbon.spacing,
        sigma_anchor=np.inf,
    )
    for j in range(ribbon.size):
        terms = _of_ribbon(batch.beside_of(gauge, j), np.zeros((0, 1)))
        yield batch.factor_beside(keys[j : j + 1], int(cycle[j]), 1, terms, RIBBON)
    for row, weights in enumerate(ribbon.bending / settings.centerline.sigma_width):
        terms = _of_ribbon(batch.bending_of(gauge, row), weights[None])
        yield batch.factor_beside(keys[columns[row]], int(gauge.middle_cycle[row]), RIBBON, terms, RIBBON)


Terms = Callable[[Array, Array], tuple[Array, Array, Array]]


def _of_ribbon(terms: Terms, weights: Array) -> Terms:
    """Return the terms of a centre line and weights (r, k) of widths as those of a ribbon's points (k, 3)."""

    def of_ribbon(points: Array, pose: Array) -> tuple[Array, Array, Array]:
        residual, by_points, by_pose = terms(points[:, :2], pose)
        count = residual.size
        by_all, by_any_pose = np.zeros((count + len(weights), *points.shape)), np.zeros((len(weights), POSE))
        by_all[:count, :, :2], by_all[count:, :, 2] = by_points.reshape(count, -1, 2), weights
        by_poses = np.vstack([by_pose.reshape(count, POSE), by_any_pose])
        return np.append(residual, weights @ points[:, 2]), by_all, by_poses

    return of_ribbon


@log_at_scale
class CenterlineBatch:
    """Maps a whole log as a ribbon by GTSAM's optimizer, from the batch of two boundaries.

    The map is theirs where there is no line between them.
    """

    def __init__(
        self,
        settings: MapperSettings | None = None,
        odometry_sigma: Array | KnownNoise | None = None,
        online: Callable[[MapperSettings, KnownNoise], CurveMapper] | None = None,
    ) -> None:
        self.settings = settings or MapperSettings()
        self._boundaries = BatchMapper(self.settings, odometry_sigma, online)

    def solve(self, log: Log) -> BatchRun:
        start = self._boundaries.solve(log)
        names = ("map", "trajectory_t", "trajectory", "cycles", "laps", "converged", "cost", "noise")
        shared = {name: getattr(start, name) for name in names}
        run = BatchRun(estimator=NAME, settings=settings_dict(self.settings), **shared)
        try:
            return self._optimized(start, run)
        except SettingsError:
            return run

    def _optimized(self, start: BatchResult, run: BatchRun) -> BatchRun:
        settings, splines, count = self.settings, start.optimum.state.splines, len(start.trajectory)
        if len(splines) < len(SIDE):
            return run
        left, right = splines.values()
        line = find_line(left, right, start.optimum.state.closed, settings.centerline.spacing)
        ribbon, variables, drive = line.ribbon, start.optimum.state.variables, gtsam.NonlinearFactorGraph()
        drawn = batch.drive_factors(start.system, start.optimum), edge_factors(start, line, settings)
        for factor in chain(*drawn):
            drive.add(factor)
        values = variables.gtsam_values(variables.calibration_keys)
        for k, pose in enumerate(variables.poses):
            values.insert(pose_key(k), gtsam.Pose2(*pose))
        keys = ribbon_keys(ribbon)
        for key, point in zip(keys, ribbon.distinct_control_points, strict=True):
            values.insert(key, point)
        parameters = gtsam.LevenbergMarquardtParams()
        parameters.setRelativeErrorTol(TOLERANCE)
        parameters.setMaxIterations(MAX_ITERATIONS)
        for _ in range(ROUNDS):
            graph = gtsam.NonlinearFactorGraph(drive)
            for factor in shape_factors(ribbon, _poses(values, count), settings):
                graph.add(factor)
            optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)
            values = optimizer.optimize()
            ribbon = ribbon.with_points(np.array([values.atPoint3(key) for key in keys]))
        marginal = sparse_marginal(graph.linearize(values), np.array(keys))
        covariance = np.asarray(np.linalg.inv(marginal.hessian(gtsam.Ordering(keys))[0]), np.float64)
        return replace(
            run,
            map=replace(map_of(ribbon, covariance, settings.spline.sigma_shape, {}), points=start.map.points),
            trajectory=_poses(values, count),
            converged=bool(optimizer.iterations() < MAX_ITERATIONS),
            cost=float(optimizer.error()),
        )


def _poses(values: gtsam.Values, count: int) -> Array:
    poses = np.array([pose_array(values.atPose2(pose_key(k))) for k in range(count)])
    poses[:, 2] = np.unwrap(poses[:, 2])
    return poses
