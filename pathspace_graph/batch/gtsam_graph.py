"""Export of the batch's problem as GTSAM's nonlinear factors."""

from collections.abc import Iterator, MutableSequence
from dataclasses import replace
from typing import Any, Final

import gtsam
import numpy as np

from pathspace_graph.errors import SettingsError
from pathspace_graph.factors.arrays import Array, BoolArray
from pathspace_graph.factors.gtsam_factors import (
    fill,
    pose_array,
    spline_projection_factors,
    station_factors,
)
from pathspace_graph.factors.se2 import rotation
from pathspace_graph.graph.rows import odometry_factor
from pathspace_graph.graph.variables import CALIBRATION_KEY, POSE, pose_key
from pathspace_graph.mapping.detection_rows import DetectionRows
from pathspace_graph.mapping.gtsam_graph import seen_on, weak_priors
from pathspace_graph.spline.boundary import Boundary

from .system import BatchSystem, CurveGauge, Evaluation

SEARCH_ROOM: Final = 4.0  # room around foot points in which a factor searches them (m along the curve)
SEARCH_HALVINGS: Final = (
    6  # largest number of halvings of the room to exclude nearer foot points, as in bends
)
SAME_FOOT: Final = 1e-3  # largest distance of equal foot points (m along the curve)


def nonlinear_graph(system: BatchSystem, at: Evaluation) -> gtsam.NonlinearFactorGraph:
    """Build every factor of the problem, on the keys of `graph.variables`.

    It is a graph of plain least squares, with the associations of `at`. Sigmas across the curve are divided
    by the roots of their robust weights, and each control point is anchored at its position. At an optimum
    the graph has the linearization of the optimization, but its error is not the robust cost. SettingsError
    for several drives.
    """
    factors, graph = [*drive_factors(system, at)], gtsam.NonlinearFactorGraph()
    for label, gauge in system.gauges.items():
        factors += [factor_beside(gauge, j) for j in range(len(gauge.keys))]
        factors += weak_priors(at.state, label, at.state.boundaries[label].everything)
        factors += [*_across(system, at, label), *_along(system, at, label)]
    for factor in factors:
        graph.add(factor)
    return graph


def drive_factors(system: BatchSystem, at: Evaluation) -> Iterator[gtsam.NonlinearFactor]:
    """Yield factors of poses and calibrations, and the user's; SettingsError for several drives."""
    if len(at.state.drives) > 1:
        raise SettingsError(f"graph: expected the batch of one drive, found {len(at.state.drives)} drives")
    for k, interval in enumerate(system.chains[0].odometry.intervals):
        yield odometry_factor(k, interval)
    for one in system.revisits:
        root = one.root.copy()  # GTSAM's tangents are in the frame of the later pose
        root[:, :2] = root[:, :2] @ rotation(one.local[2])
        noise = gtsam.noiseModel.Gaussian.Information(root.T @ root)
        ends = pose_key(one.earlier), pose_key(one.later)
        yield gtsam.BetweenFactorPose2(*ends, gtsam.Pose2(*one.local), noise)
    chain, calibration, noises = system.chains[0], system.settings.calibration, gtsam.noiseModel
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
    yield from system.own


def factor_beside(gauge: CurveGauge, j: int) -> gtsam.CustomFactor:
    """Build the factor that keeps control point j of a curve beside its pose."""
    point_key, cycle = int(gauge.keys[j]), int(gauge.cycle[j])
    alone = replace(gauge, ahead=gauge.ahead[j : j + 1])

    def error(_: gtsam.CustomFactor, values: gtsam.Values, H: MutableSequence[Array] | None) -> Array:
        pose = values.atPose2(pose_key(cycle))
        point = np.array(values.atPoint2(point_key))
        residual, by_point, by_pose = alone.terms(point[None], pose_array(pose)[None])
        if H is not None:  # GTSAM's tangents of a pose are in its own frame
            by_pose[:, :2] = by_pose[:, :2] @ rotation(pose.theta())
            fill(H, [by_point, by_pose])
        return residual

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(1), [point_key, pose_key(cycle)], error)


def _across(system: BatchSystem, at: Evaluation, label: int) -> list[gtsam.CustomFactor]:
    """Build a factor for each cycle, with its used detections on a boundary."""
    boundary, variables = at.state.boundaries[label], at.state.variables
    chosen, measured = _measured(system, at, at.across, label)
    u, points = at.u[chosen], system.detections.points_map(at.across.rows[chosen], variables)
    room = _room(boundary, at.state.control_points(label), points, u)
    return spline_projection_factors(low=u - room, high=u + room, sigma_model=0.0, **measured)


def _along(system: BatchSystem, at: Evaluation, label: int) -> list[gtsam.CustomFactor]:
    """Build a factor for each cycle, with its used detections at stations of a boundary."""
    if system.stations is None:
        return []
    chosen, measured = _measured(system, at, at.along, label)
    station = system.detections.station[at.along.rows[chosen]]
    u, sigma_station = system.stations.u[station], np.zeros(len(station))
    return station_factors(u=u, sigma_station=sigma_station, **measured)


def _measured(
    system: BatchSystem, at: Evaluation, seen: DetectionRows, label: int
) -> tuple[BoolArray, dict[str, Any]]:
    """Return whether detections (m,) of a boundary have a weight, and the arguments of their factors."""
    detections, scale = system.detections, seen.scale(system.kernel.weights(seen.whitened))
    chosen = (detections.boundary[seen.rows] == label) & (scale > 0.0)
    covariances = scale[chosen, None, None] ** -2.0 * np.eye(2)
    return chosen, seen_on(at.state, detections, label, seen.rows[chosen], covariances, np.inf)


def _room(boundary: Boundary, control_points: Array, points: Array, u: Array) -> Array:
    """Room (m,) around u in which the foot point at u is the nearest one to each point (m, 2)."""
    room = np.full(len(u), SEARCH_ROOM)
    for _ in range(SEARCH_HALVINGS):
        nearest = boundary.find(control_points, points, u - room, u + room).u
        room[np.abs(nearest - u) > SAME_FOOT] *= 0.5
    return room
