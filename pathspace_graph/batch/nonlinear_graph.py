"""The problem of a whole log as GTSAM's own nonlinear factors."""

from collections.abc import Callable, Iterator, MutableSequence
from dataclasses import replace
from typing import Final

import gtsam
import numpy as np

from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.gtsam_factors import pose_array, spline_projection_factors
from pathspace_graph.factors.se2 import rotation, to_map
from pathspace_graph.front_end.log_odometry import LogOdometry
from pathspace_graph.graph.rows import odometry_factor
from pathspace_graph.graph.variables import CALIBRATION_KEY, POINT, POSE, pose_key, pose_keys
from pathspace_graph.spline.boundary import Boundary

from .gauge import CurveGauge
from .system import BatchSystem, Evaluation

ROOM: Final = 4.0
"""Distance from its foot points in which a factor searches them (m along the curve)."""
HALVINGS: Final = 6
"""Most halvings of the room while another foot point in it is nearer, as in a bend about a detection."""
SAME: Final = 1e-3
"""Distance below which two foot points are the same (m along the curve)."""


def nonlinear_graph(system: BatchSystem, at: Evaluation) -> gtsam.NonlinearFactorGraph:
    """Return every factor of the problem, on the keys of `graph.variables`.

    It is a graph of plain least squares, and holds the associations as they are at `at`, and the sigmas
    across the curve divided by the root of their robust weights. Each control point is anchored where it is.
    At an optimum its linearization is that of the optimization; its error isn't the robust cost.
    """
    graph = gtsam.NonlinearFactorGraph()
    for factor in drive_factors(system, at):
        graph.add(factor)
    for label, gauge in system.gauges.items():
        for factor in (*_gauge(gauge, at.state.control_points(label)), *_projections(system, at, label)):
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
        between = gtsam.Pose2(*one.local)
        yield gtsam.BetweenFactorPose2(pose_key(one.earlier), pose_key(one.later), between, noise)
    yield from _priors(system.chain, at.state.poses[0, 2])
    sensor_key = at.state.variables.sensor_key
    if sensor_key is not None:
        sigmas = gtsam.noiseModel.Diagonal.Sigmas(np.array(system.settings.calibration.sigmas))
        yield gtsam.PriorFactorVector(sensor_key, np.array(system.settings.calibration.means), sigmas)


def _priors(chain: LogOdometry, heading: float) -> Iterator[gtsam.NonlinearFactor]:
    map_from_pose = np.eye(POSE)  # GTSAM's tangents of a pose are in its own frame
    map_from_pose[:2, :2] = rotation(heading)
    information = map_from_pose.T @ chain.first_information @ map_from_pose
    noise = gtsam.noiseModel.Gaussian.Information(information)
    yield gtsam.PriorFactorPose2(pose_key(0), gtsam.Pose2(*chain.first), noise)
    sigmas = gtsam.noiseModel.Diagonal.Sigmas(chain.calibration_sigma)
    yield gtsam.PriorFactorPoint2(CALIBRATION_KEY, chain.calibration_mean, sigmas)
    if chain.bias is not None:
        noise = gtsam.noiseModel.Diagonal.Precisions(np.array([0.0, chain.bias.sigma**-2]))
        yield gtsam.PriorFactorPoint2(CALIBRATION_KEY, np.array([0.0, chain.bias.value]), noise)


def _gauge(gauge: CurveGauge, control_points: Array) -> Iterator[gtsam.NonlinearFactor]:
    keys = gauge.keys.tolist()
    anchor = gtsam.noiseModel.Isotropic.Sigma(2, gauge.sigma_anchor)
    for j, (key, point) in enumerate(zip(keys, control_points, strict=True)):
        yield beside_factor(gauge, j)
        yield gtsam.PriorFactorPoint2(key, point, anchor)
    for row in range(len(gauge.smoothness)):
        yield bending_factor(gauge, row)


def beside_factor(gauge: CurveGauge, j: int) -> gtsam.CustomFactor:
    """Return the factor that holds control point j of a curve beside its pose."""
    only = slice(j, j + 1)
    one = replace(gauge, keys=gauge.keys[only], cycle=gauge.cycle[only], ahead=gauge.ahead[only])
    return _factor_beside(one.keys, int(gauge.cycle[j]), 1, one.terms)


def bending_factor(gauge: CurveGauge, row: int) -> gtsam.CustomFactor:
    """Return the factor of a second difference of a curve, as the pose beside it sees it."""
    chosen, cycle = gauge.neighbours[row], int(gauge.middle_cycle[row])
    keys, smoothness = gauge.keys[chosen], gauge.smoothness[row, chosen][None]
    only = replace(gauge, keys=keys, cycle=np.zeros(3, np.intp), smoothness=smoothness)
    return _factor_beside(keys, cycle, POINT, only.bending)


def _factor_beside(
    points: IntArray, cycle: int, size: int, terms: Callable[[Array, Array], tuple[Array, Array, Array]]
) -> gtsam.CustomFactor:
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
    """Return a factor for each cycle, of its used detections on a boundary that have any weight.

    The covariances are isotropic, so that a detection keeps its sigma when the curve's direction changes.
    """
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


def _room(boundary: Boundary, control_points: Array, points: Array, u: Array) -> Array:
    """Return the room (m,) about u in which the nearest foot point of each point (m, 2) is that at u."""
    room = np.full(len(u), ROOM)
    for _ in range(HALVINGS):
        nearest = boundary.find(control_points, points, u - room, u + room).u
        room[np.abs(nearest - u) > SAME] *= 0.5
    return room
