"""The whole log's problem as GTSAM's own nonlinear factors."""

from __future__ import annotations

from collections.abc import Iterator, MutableSequence
from dataclasses import replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.gtsam_factors import (
    pose_array,
    rotation,
    smoothness_factors,
    spline_projection_factors,
)
from pathspace_graph.factors.projection import to_map
from pathspace_graph.graph.keys import CALIBRATION_KEY, POSE, pose_key, pose_keys
from pathspace_graph.graph.odometry import odometry_factor
from pathspace_graph.mapping.measurements import Chain
from pathspace_graph.spline.boundary import Boundary

from .gauge import CurveGauge
from .system import BatchSystem, Evaluation

Array = NDArray[np.float64]

ROOM = 4.0
"""Stretch (m) of a curve on either side of a foot point where its factor looks for it."""
HALVINGS = 6
"""Most times that the stretch is halved while another foot point in it is nearer: a bend may turn about a
reading."""
SAME = 1e-3
"""Foot points as near along the curve (m) are one."""


def nonlinear_graph(system: BatchSystem, at: Evaluation) -> gtsam.NonlinearFactorGraph:
    """Every factor of the problem, on the keys that `graph.keys` has.

    What a round of the optimization holds is held here as it is at `at`: which readings are in use, and their
    sigmas across the curve, divided by the root of their robust weights, so that the graph is one of plain
    least squares; and what anchors each control point anchors it where it is. So at an optimum the gradient
    is zero and the linearization is the optimization's own, but the error is not its robust cost, and beyond
    some decimetres from there the weights would be others.
    """
    graph = gtsam.NonlinearFactorGraph()
    for factor in _odometry(system.chain):
        graph.add(factor)
    for factor in _priors(system.chain, at.state.poses[0, 2]):
        graph.add(factor)
    for label, gauge in system.gauges.items():
        for factor in (*_gauge(gauge, at.state.control_points(label)), *_projections(system, at, label)):
            graph.add(factor)
    return graph


def _odometry(chain: Chain) -> Iterator[gtsam.NonlinearFactor]:
    """Between every two cycles."""
    for k, interval in enumerate(chain.odometry.intervals):
        yield odometry_factor(k, interval)


def _priors(chain: Chain, heading: float) -> Iterator[gtsam.NonlinearFactor]:
    """Of the first pose and of the calibration; GTSAM has the former in the frame of that pose."""
    turn = np.eye(POSE)
    turn[:2, :2] = rotation(heading)
    noise = gtsam.noiseModel.Gaussian.Information(turn.T @ chain.first_information @ turn)
    yield gtsam.PriorFactorPose2(pose_key(0), gtsam.Pose2(*chain.first), noise)
    sigmas = gtsam.noiseModel.Diagonal.Sigmas(chain.calibration_sigma)
    yield gtsam.PriorFactorPoint2(CALIBRATION_KEY, np.zeros(2), sigmas)


def _gauge(gauge: CurveGauge, control_points: Array) -> Iterator[gtsam.NonlinearFactor]:
    """What holds the control points (m, 2) of a curve."""
    keys = gauge.keys.tolist()
    anchor = gtsam.noiseModel.Isotropic.Sigma(2, gauge.sigma_anchor)
    for j, (key, point) in enumerate(zip(keys, control_points, strict=True)):
        yield beside_factor(gauge, j)
        yield gtsam.PriorFactorPoint2(key, point, anchor)
    yield from smoothness_factors(keys, gauge.smoothness, gauge.sigma_smoothness)


def beside_factor(gauge: CurveGauge, j: int) -> gtsam.CustomFactor:
    """Control point j of a curve held beside its pose."""
    only = slice(j, j + 1)
    one = replace(gauge, keys=gauge.keys[only], cycle=gauge.cycle[only], ahead=gauge.ahead[only])
    keys = [int(gauge.keys[j]), pose_key(gauge.cycle[j])]

    def error(_: gtsam.CustomFactor, values: gtsam.Values, H: MutableSequence[Array] | None) -> Array:
        pose = values.atPose2(keys[1])
        residual, by_point, by_pose = one.terms(values.atPoint2(keys[0])[None], pose_array(pose)[None])
        if H is not None:
            by_pose[:, :2] = by_pose[:, :2] @ rotation(pose.theta())
            H[0], H[1] = by_point, by_pose
        return residual

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(1), keys, error)


def _projections(system: BatchSystem, at: Evaluation, label: int) -> list[gtsam.CustomFactor]:
    """A factor for each cycle of the readings in use on a boundary that have any weight.

    A reading that is as sure in every direction keeps its sigma however the curve turns.
    """
    projected, boundary = at.projected[label], at.state.boundaries[label]
    scale, detections = system.scale(projected), system.detections
    weighted = scale > 0.0
    scale, u, rows = scale[weighted], projected.foot.u[weighted], projected.rows[weighted]
    cycles, points_vehicle = detections.cycle[rows], detections.point[rows]
    points = to_map(points_vehicle, at.state.variables.poses_at(cycles))
    room = _room(boundary, at.state.control_points(label), points, u)
    return spline_projection_factors(
        pose_keys(cycles),
        at.state.keys(label).tolist(),
        boundary.tables,
        points_vehicle=points_vehicle,
        covariances=scale[:, None, None] ** -2.0 * np.eye(2),
        low=u - room,
        high=u + room,
        sigma_model=0.0,
        huber=np.inf,
    )


def _room(boundary: Boundary, control_points: Array, points: Array, u: Array) -> Array:
    """(m,) how far (m) to either side of u the foot point of each point (m, 2) is still the one at u."""
    room = np.full(len(u), ROOM)
    for _ in range(HALVINGS):
        nearest = boundary.find(control_points, points, u - room, u + room).u
        room[np.abs(nearest - u) > SAME] *= 0.5
    return room
