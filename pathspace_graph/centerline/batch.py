"""The batch of a centre line with a width: all poses and one ribbon, on GTSAM's own optimizer."""

from collections.abc import Callable
from dataclasses import replace
from typing import Final

import gtsam
import numpy as np
from threadpoolctl import threadpool_limits

from pathspace_graph.batch.mapper import BatchMapper, BatchResult
from pathspace_graph.batch.nonlinear_graph import drive_factors
from pathspace_graph.batch.start import CurveMapper
from pathspace_graph.errors import SettingsError, solving
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.gtsam_factors import pose_array
from pathspace_graph.factors.noise import KnownNoise
from pathspace_graph.graph.variables import pose_key
from pathspace_graph.io.log import Log
from pathspace_graph.io.results import BatchRun
from pathspace_graph.run import settings_dict
from pathspace_graph.scale.door import log_at_scale
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.centre_line import find_line
from pathspace_graph.spline.ribbon import SIDE, Ribbon

from .edges import map_of
from .graph import EdgeDetections, edge_factors, ribbon_covariance, ribbon_keys, shape_factors

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
