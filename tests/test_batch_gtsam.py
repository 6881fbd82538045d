"""The batch's optimum against GTSAM's own Levenberg-Marquardt on the same problem, factor by factor."""

from __future__ import annotations

from collections.abc import MutableSequence

import gtsam
import numpy as np
from numpy.typing import NDArray

from pathspace_graph.batch_equations import calibration_information
from pathspace_graph.batch_gauge import CurveGauge, curve_gauge
from pathspace_graph.batch_system import BatchSystem
from pathspace_graph.factors.gauge import smoothness_matrix
from pathspace_graph.factors.gtsam_factors import (
    calibrated_odometry_factor,
    pose_array,
    smoothness_factors,
    spline_projection_factor,
)
from pathspace_graph.factors.linear_graph import rotation
from pathspace_graph.factors.odometry import IntegratedOdometry
from pathspace_graph.settings import MapperSettings
from pathspace_graph.state import State
from tests.batch_scenes import drawn, settled, straight

Array = NDArray[np.float64]

CALIBRATION = gtsam.symbol("b", 0)
ROOM = 4.0
"""Stretch (m) on either side of a foot point that a factor searches."""


def control_keys(state: State, label: int) -> list[int]:
    return [gtsam.symbol("lr"[label], j) for j in range(state.boundaries[label].size)]


def pose_key(slot: int) -> int:
    return int(gtsam.symbol("x", slot))


def values_of(state: State) -> gtsam.Values:
    values = gtsam.Values()
    for label in state.boundaries:
        for key, point in zip(control_keys(state, label), state.control_points(label), strict=True):
            values.insert(key, point)
    values.insert(CALIBRATION, state.calibration)
    for slot, pose in enumerate(state.poses):
        values.insert(pose_key(slot), gtsam.Pose2(*pose))
    return values


def vector_of(values: gtsam.Values, state: State) -> Array:
    points = [values.atPoint2(key) for label in state.boundaries for key in control_keys(state, label)]
    poses = [pose_array(values.atPose2(pose_key(slot))) for slot in range(len(state.poses))]
    return np.concatenate([np.ravel(points), values.atPoint2(CALIBRATION), np.ravel(poses)])


def beside_factor(gauge: CurveGauge, j: int, control_key: int) -> gtsam.CustomFactor:
    """A control point held beside its pose."""
    keys = [pose_key(int(gauge.slot[j])), control_key]
    slot = np.zeros(1, np.intp)
    one = CurveGauge(slot, gauge.ahead[j : j + 1], gauge.sigma, np.zeros((2, 2)), 0.0)

    def error(_: gtsam.CustomFactor, values: gtsam.Values, H: MutableSequence[Array] | None) -> Array:
        pose = values.atPose2(keys[0])
        rows = one.beside(values.atPoint2(keys[1])[None], pose_array(pose)[None], 0)
        if H is not None:
            by_pose = rows.by_pose.copy()
            by_pose[:, :2] = by_pose[:, :2] @ rotation(pose.theta())
            H[0], H[1] = by_pose, rows.by_border
        return rows.residual

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(1), keys, error)


def graph_of(system: BatchSystem, begun: State, state: State) -> gtsam.NonlinearFactorGraph:
    """Every factor; gauges are those of the state that the curves began with."""
    graph, chain = gtsam.NonlinearFactorGraph(), system.chain
    prior = gtsam.noiseModel.Gaussian.Information(chain.first_information)
    graph.add(gtsam.PriorFactorPose2(pose_key(0), gtsam.Pose2(*chain.first), prior))
    sigmas = calibration_information(system.settings.odometry) ** -0.5
    graph.add(gtsam.PriorFactorPoint2(CALIBRATION, np.zeros(2), gtsam.noiseModel.Diagonal.Sigmas(sigmas)))
    for k, (delta, whitener, by) in enumerate(
        zip(chain.deltas, chain.whiteners, chain.by_calibration, strict=True)
    ):
        odometry = IntegratedOdometry(delta, np.linalg.inv(whitener.T @ whitener), by, whitener)
        graph.add(calibrated_odometry_factor(pose_key(k), pose_key(k + 1), CALIBRATION, odometry))
    for label in state.boundaries:
        add_curve(graph, system, begun, label)
    return graph


def add_curve(graph: gtsam.NonlinearFactorGraph, system: BatchSystem, begun: State, label: int) -> None:
    boundary, keys = begun.boundaries[label], control_keys(begun, label)
    points = begun.control_points(label)
    gauge = curve_gauge(boundary, points, begun.poses, system.settings.batch.sigma_slide)
    for j, key in enumerate(keys):
        graph.add(beside_factor(gauge, j, key))
    mean = boundary.length / (len(boundary.knots) - 2 * boundary.degree - 1)
    matrix = smoothness_matrix(boundary.abscissae, None)
    for factor in smoothness_factors(keys, matrix, boundary.gauge.sigma_smoothness * mean):
        graph.add(factor)
    readings = system.readings
    for slot in range(len(begun.poses)):
        rows = np.flatnonzero(readings.used & (readings.boundary == label) & (readings.slot == slot))
        if len(rows):
            factor = spline_projection_factor(
                pose_key(slot),
                keys,
                boundary.tables,
                points_vehicle=readings.point[rows],
                covariances=readings.covariance[rows],
                low=readings.u[rows] - ROOM,
                high=readings.u[rows] + ROOM,
                sigma_model=system.settings.spline.sigma_model,
                huber=np.inf,
            )
            graph.add(factor)


def test_levenberg_marquardt_finds_the_same_optimum() -> None:
    exact, begun = straight(4.0, MapperSettings().batch.sigma_smoothness)
    system, _ = drawn(exact, np.random.default_rng(3))
    system.begin(begun)
    system.hold_sigmas(begun)
    ours = settled(system, begun, 8)
    graph = graph_of(system, begun, ours)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(0.0)
    parameters.setAbsoluteErrorTol(1e-12)
    theirs = gtsam.LevenbergMarquardtOptimizer(graph, values_of(begun), parameters).optimize()
    assert np.abs(vector_of(theirs, begun) - begun.vector).max() > 0.05
    np.testing.assert_allclose(vector_of(theirs, begun), ours.vector, atol=1e-3)
    np.testing.assert_allclose(graph.error(theirs), graph.error(values_of(ours)), rtol=1e-6)
