"""The batch's problem as GTSAM's nonlinear factors, for whoever wants to go on with them."""

from collections.abc import Callable, Iterator, MutableSequence
from dataclasses import replace
from typing import Any, Final

import gtsam
import numpy as np

from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.gtsam_factors import pose_array, spline_projection_factors, station_factors
from pathspace_graph.factors.se2 import rotation
from pathspace_graph.graph.rows import odometry_factor
from pathspace_graph.graph.variables import CALIBRATION_KEY, POINT, POSE, pose_key, pose_keys
from pathspace_graph.mapping.detection_rows import DetectionRows
from pathspace_graph.spline.boundary import Boundary

from .system import BatchSystem, CurveGauge, Evaluation

SEARCH_ROOM: Final = 4.0  # distance from its foot points in which a factor searches them (m along the curve)
SEARCH_HALVINGS: Final = 6  # most halvings of the room while another foot point in it is nearer, as in a bend
SAME_FOOT: Final = 1e-3  # distance below which two foot points are the same (m along the curve)


def nonlinear_graph(system: BatchSystem, at: Evaluation) -> gtsam.NonlinearFactorGraph:
    """Return every factor of the problem, on the keys of `graph.variables`.

    A graph of plain least squares, with the associations of `at` and the sigmas across the curve over the
    roots of their robust weights. Each control point is anchored where it is. At an optimum its linearization
    is that of the optimization; its error isn't the robust cost.
    """
    factors, graph = [*drive_factors(system, at)], gtsam.NonlinearFactorGraph()
    for label, gauge in system.gauges.items():
        factors += _gauge(gauge, at.state.control_points(label))
        factors += [*_across(system, at, label), *_along(system, at, label)]
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


def _across(system: BatchSystem, at: Evaluation, label: int) -> list[gtsam.CustomFactor]:
    """Return a factor for each cycle, of its used detections on a boundary."""
    boundary, variables = at.state.boundaries[label], at.state.variables
    chosen, measured = _measured(system, at, at.across, label)
    u, points = at.u[chosen], system.detections.points_map(at.across.rows[chosen], variables)
    room = _room(boundary, at.state.control_points(label), points, u)
    return spline_projection_factors(low=u - room, high=u + room, sigma_model=0.0, **measured)


def _along(system: BatchSystem, at: Evaluation, label: int) -> list[gtsam.CustomFactor]:
    """Return a factor for each cycle, of its used detections at stations of a boundary."""
    if system.matches is None:
        return []
    chosen, measured = _measured(system, at, at.along, label)
    station = system.matches.used(system.detections)[1][chosen]
    u, sigma_station = system.matches.stations.u[station], np.zeros(len(station))
    return station_factors(u=u, sigma_station=sigma_station, **measured)


def _measured(
    system: BatchSystem, at: Evaluation, seen: DetectionRows, label: int
) -> tuple[BoolArray, dict[str, Any]]:
    """Return which detections (m,) of a boundary have any weight, and what factors need of these."""
    detections, scale = system.detections, seen.scale(system.kernel.weights(seen.whitened))
    chosen = (detections.boundary[seen.rows] == label) & (scale > 0.0)
    rows = seen.rows[chosen]
    return chosen, {
        "pose_keys": pose_keys(detections.cycle[rows]),
        "control_keys": at.state.keys(label).tolist(),
        "tables": at.state.boundaries[label].tables,
        "points_vehicle": detections.measured[rows],
        "covariances": scale[chosen, None, None] ** -2.0 * np.eye(2),
        "twists": detections.twist[rows],
        "huber": np.inf,
        "sensor_key": at.state.variables.sensor_key,
    }


def _room(boundary: Boundary, control_points: Array, points: Array, u: Array) -> Array:
    """Return the room (m,) about u in which the nearest foot point of each point (m, 2) is that at u."""
    room = np.full(len(u), SEARCH_ROOM)
    for _ in range(SEARCH_HALVINGS):
        nearest = boundary.find(control_points, points, u - room, u + room).u
        room[np.abs(nearest - u) > SAME_FOOT] *= 0.5
    return room
