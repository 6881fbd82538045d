"""The batch of a centre line with a width: all poses and one ribbon, on GTSAM's own optimizer.

Its factors are the detections of every cycle, and weak priors on what they leave free.
"""

from collections.abc import Callable, Iterator, MutableSequence
from dataclasses import dataclass, replace
from typing import Final

import gtsam
import numpy as np
from threadpoolctl import threadpool_limits

from pathspace_graph.batch.mapper import BatchMapper, BatchResult
from pathspace_graph.batch.nonlinear_graph import drive_factors
from pathspace_graph.batch.start import CurveMapper
from pathspace_graph.centerline.online import map_of
from pathspace_graph.errors import SettingsError, solving
from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.gtsam_factors import fill, pose_array, ribbon_factor
from pathspace_graph.factors.noise import KnownNoise
from pathspace_graph.factors.residuals import RIBBON
from pathspace_graph.factors.se2 import rotation
from pathspace_graph.graph.gaussian import sparse_marginal
from pathspace_graph.graph.variables import pose_key
from pathspace_graph.io.log import Log
from pathspace_graph.io.results import BatchRun
from pathspace_graph.run import settings_dict
from pathspace_graph.scale import log_at_scale
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.centre_line import SIDE, Ribbon, find_line

ROOM: Final = 4.0
"""Distance along the line within which a foot point is searched for (m)."""
RIBBON_LETTER = "a"
"""The keys of a ribbon's control points have this letter; they hold `Point3` (x, y, h)."""


@dataclass(frozen=True, eq=False)
class EdgeDetections:
    """Holds the detections (m,) that are used, in the order of their cycles."""

    cycle: IntArray
    """Each was made in this perception cycle."""
    side: Array
    """Each is of the left edge where this is 1, and of the right one where it is -1."""
    u: Array
    """Each has its foot point on the centre line near this parameter (m)."""
    points_vehicle: Array
    """These are the detections (m, 2) as measured, in the vehicle frame, in m."""
    covariances: Array
    """These are their covariances (m, 2, 2) in m^2."""
    twists: Array
    """The vehicle moved with these twists (m, 3), in m/s, m/s and rad/s."""


def ribbon_keys(ribbon: Ribbon) -> list[int]:
    """Returns the keys of the distinct control points of a ribbon."""
    return [int(gtsam.symbol(RIBBON_LETTER, j)) for j in range(ribbon.size)]


def edge_factors(
    ribbon: Ribbon, detections: EdgeDetections, settings: MapperSettings, sensor_key: int | None
) -> Iterator[gtsam.CustomFactor]:
    """Yields a factor for each cycle that has detections."""
    keys, room = ribbon_keys(ribbon), ROOM
    changes = np.flatnonzero(np.diff(detections.cycle)) + 1
    for own in np.split(np.arange(len(detections.cycle)), changes):
        if len(own):
            yield ribbon_factor(
                pose_key(detections.cycle[own[0]]),
                keys,
                ribbon.tables,
                points_vehicle=detections.points_vehicle[own],
                covariances=detections.covariances[own],
                sides=detections.side[own],
                low=detections.u[own] - room,
                high=detections.u[own] + room,
                sigma_model=settings.batch.sigma_model,
                huber=settings.gate.huber,
                sensor_key=sensor_key,
                twists=detections.twists[own],
            )


def shape_factors(ribbon: Ribbon, poses: Array, settings: MapperSettings) -> Iterator[gtsam.CustomFactor]:
    """Yields the weak priors of the control points, each in the frame of the nearest pose of poses (n, 3).

    A detection constrains nothing along the line, so each control point is held beside its pose, along the
    heading, where it is now. Second differences are small, of the line as the pose sees it and of the width.
    In the map frame they would turn with the map (`batch.gauge:CurveGauge`).
    """
    keys, batch = ribbon_keys(ribbon), settings.batch
    offset = ribbon.distinct_control_points[:, None, :2] - poses[:, :2]
    nearest = (offset**2).sum(axis=2).argmin(axis=1)
    sigma_bend = batch.sigma_smoothness * ribbon.spacing
    sigmas = np.array([sigma_bend, sigma_bend, settings.centerline.sigma_width])
    for j, key in enumerate(keys):
        yield _beside_factor(
            key, int(nearest[j]), ribbon.distinct_control_points[j], poses[nearest[j]], batch.sigma_slide
        )
    for j, row in enumerate(ribbon.bending):
        middle = (j + 1) % ribbon.size
        three = [keys[(j + k) % ribbon.size] for k in range(3)]
        yield _bending_factor(three, int(nearest[middle]), row, sigmas)


def _beside_factor(key: int, cycle: int, point: Array, pose: Array, sigma: float) -> gtsam.CustomFactor:
    """Returns the factor `(h . (c - p) - ahead) / sigma`, h the heading and p the position of a pose."""
    ahead = float(np.array([np.cos(pose[2]), np.sin(pose[2])]) @ (point[:2] - pose[:2]))
    keys = [key, pose_key(cycle)]

    def error(_: gtsam.CustomFactor, values: gtsam.Values, H: MutableSequence[Array] | None) -> Array:
        at, now = values.atPoint3(keys[0])[:2], pose_array(values.atPose2(keys[1]))
        heading = np.array([np.cos(now[2]), np.sin(now[2])])
        arm = at - now[:2]
        if H is not None:
            turned = heading[0] * arm[1] - heading[1] * arm[0]
            by_position = -heading @ rotation(now[2])
            fill(H, [np.array([[*heading, 0.0]]) / sigma, np.array([[*by_position, turned]]) / sigma])
        return np.array([(heading @ arm - ahead) / sigma])

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(1), keys, error)


def _bending_factor(three: list[int], cycle: int, row: Array, sigmas: Array) -> gtsam.CustomFactor:
    """Returns the factor of a second difference (x, y in the frame of a pose, h) with sigmas (3,)."""
    keys = [*three, pose_key(cycle)]

    def error(_: gtsam.CustomFactor, values: gtsam.Values, H: MutableSequence[Array] | None) -> Array:
        bend = row @ np.array([values.atPoint3(key) for key in three])
        turn = np.eye(RIBBON)
        turn[:2, :2] = rotation(values.atPose2(keys[3]).theta()).T
        seen = turn @ bend
        if H is not None:
            by_pose = np.zeros((RIBBON, 3))
            by_pose[0, 2], by_pose[1, 2] = seen[1], -seen[0]
            blocks = [weight * turn for weight in row] + [by_pose]
            fill(H, [block / sigmas[:, None] for block in blocks])
        return np.asarray(seen / sigmas)

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(RIBBON), keys, error)


def ribbon_covariance(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, ribbon: Ribbon) -> Array:
    """Returns the joint covariance (3m, 3m) of the control points, all other variables marginalized out."""
    keys = np.array(ribbon_keys(ribbon))
    marginal = sparse_marginal(graph.linearize(values), keys)
    information, _ = marginal.hessian(gtsam.Ordering(keys.tolist()))
    return np.asarray(np.linalg.inv(information), np.float64)


# --- the optimization ------------------------------------------------------------------------------------


NAME: Final = "centerline"
"""Name of the estimator on the command line."""
ROUNDS: Final = 2
"""Number of optimizations; before each, the control points are held beside the poses anew."""
MAX_ITERATIONS: Final = 15
"""Largest number of iterations of one of them."""
TOLERANCE: Final = 1e-5
"""Share by which an iteration lowers the error at least, or it is the last one."""


@log_at_scale
class CenterlineBatch:
    """Maps a whole log as a ribbon.

    The start, with the sides of the detections, is the batch of two boundaries. Where there is no line
    between them, since one was never seen or they cross, their map is the result.
    """

    def __init__(
        self,
        settings: MapperSettings | None = None,
        odometry_sigma: Array | KnownNoise | None = None,
        online: Callable[[MapperSettings, KnownNoise], CurveMapper] | None = None,
    ) -> None:
        """Keeps the settings and what `BatchMapper` takes."""
        self.settings = settings or MapperSettings()
        self._boundaries = BatchMapper(self.settings, odometry_sigma, online)

    def solve(self, log: Log) -> BatchRun:
        """Returns the optimum over a whole log."""
        start = self._boundaries.solve(log)
        with threadpool_limits(limits=1), solving("the batch"):
            try:
                return self._solve(start)
            except SettingsError:
                return self._run(start)

    def _solve(self, start: BatchResult) -> BatchRun:
        settings, state = self.settings, start.optimum.state
        ribbon, detections = begin(start, settings.centerline.spacing)
        values = _values(start, ribbon)
        drive = gtsam.NonlinearFactorGraph()
        for factor in drive_factors(start.system, start.optimum):
            drive.add(factor)
        for factor in edge_factors(ribbon, detections, settings, state.variables.sensor_key):
            drive.add(factor)
        for _ in range(ROUNDS):
            graph = gtsam.NonlinearFactorGraph(drive)
            poses = _poses(values, len(start.trajectory))
            for factor in shape_factors(ribbon, poses, settings):
                graph.add(factor)
            optimizer = self._optimizer(graph, values)
            values = optimizer.optimize()
            points = np.array([values.atPoint3(key) for key in ribbon_keys(ribbon)])
            ribbon = ribbon.with_points(points)
        covariance = ribbon_covariance(graph, values, ribbon)
        return replace(
            self._run(start),
            map=replace(map_of(ribbon, covariance, settings.spline.sigma_shape, {}), points=start.map.points),
            trajectory=_poses(values, len(start.trajectory)),
            converged=bool(optimizer.iterations() < MAX_ITERATIONS),
            cost=float(optimizer.error()),
        )

    def _run(self, start: BatchResult) -> BatchRun:
        """Returns a run with what the start has found."""
        return BatchRun(
            estimator=NAME,
            settings=settings_dict(self.settings),
            map=start.map,
            trajectory_t=start.trajectory_t,
            trajectory=start.trajectory,
            cycles=start.cycles,
            laps=start.laps,
            converged=start.converged,
            cost=start.cost,
            noise=start.noise,
        )

    def _optimizer(
        self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values
    ) -> gtsam.LevenbergMarquardtOptimizer:
        parameters = gtsam.LevenbergMarquardtParams()
        parameters.setRelativeErrorTol(TOLERANCE)
        parameters.setMaxIterations(MAX_ITERATIONS)
        return gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)


def begin(start: BatchResult, spacing: float) -> tuple[Ribbon, EdgeDetections]:
    """Returns the ribbon between two boundaries, and their detections beside it, in the order of cycles."""
    state, table = start.optimum.state, start.system.detections
    splines = state.splines
    if len(splines) < len(SIDE):
        raise SettingsError(f"a centre line: expected both boundaries, found {len(splines)}")
    left, right = splines.values()
    line = find_line(left, right, state.closed, spacing)
    rows, sides, u = [], [], []
    for side, label in enumerate(splines):
        projected = start.optimum.projected[label]
        used = start.system.scale(projected) > 0.0
        rows.append(projected.rows[used])
        sides.append(np.full(int(used.sum()), SIDE[label]))
        u.append(line.ribbon_parameters(side, projected.foot.u[used]))
    row, edge, at = (np.concatenate(parts) for parts in (rows, sides, u))
    order = np.lexsort((row, table.cycle[row]))
    row, edge, at = row[order], edge[order], at[order]
    return line.ribbon, EdgeDetections(
        table.cycle[row], edge, at, table.measured[row], table.covariance[row], table.twist[row]
    )


def _values(start: BatchResult, ribbon: Ribbon) -> gtsam.Values:
    """Returns poses and calibrations of the start, and the control points of a ribbon."""
    variables, values = start.optimum.state.variables, gtsam.Values()
    poses = [pose_key(k) for k in range(len(start.trajectory))]
    for key, pose in zip(poses, variables.poses, strict=True):
        values.insert(key, gtsam.Pose2(*pose))
    calibrations = variables.gtsam_values(variables.calibration_keys)
    values.insert(calibrations)
    for key, point in zip(ribbon_keys(ribbon), ribbon.distinct_control_points, strict=True):
        values.insert(key, point)
    return values


def _poses(values: gtsam.Values, count: int) -> Array:
    """Returns the poses (n, 3), with headings that do not jump."""
    poses = np.array([pose_array(values.atPose2(pose_key(k))) for k in range(count)])
    poses[:, 2] = np.unwrap(poses[:, 2])
    return poses
