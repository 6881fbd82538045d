"""The landmark system: cost and rows belong to one problem, and its optimum is that of GTSAM's factors."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import C, L, X
from numpy.typing import NDArray

from pathspace_graph.baselines.landmarks import LandmarkSystem, solve_landmarks, start_oracle
from pathspace_graph.factors.gtsam_factors import calibrated_odometry_factor
from pathspace_graph.factors.odometry import integrate_twists
from pathspace_graph.io.log import Log
from pathspace_graph.labels import LEFT, UNKNOWN
from pathspace_graph.run import split_odometry
from pathspace_graph.settings.mapper import MapperSettings

from ...scenes.drives import ahead, exact_log
from .scenes import KNOWN, beginning_of, normal_equations_of, oracle_system


def test_the_cost_falls_along_the_gradient_of_the_rows(bean: Log) -> None:
    """`d cost = -g . dx`"""
    system, state = oracle_system(bean, 25)
    variables, rng = state.variables, np.random.default_rng(0)
    hessian, vector = normal_equations_of(system, state)
    at, step = variables.values, 1e-6 * rng.normal(size=len(vector)) / np.sqrt(np.diagonal(hessian))
    costs = []
    for sign in (1.0, -1.0):
        variables.values = at + sign * step
        costs.append(system.cost(state))
    assert costs[0] - costs[1] == pytest.approx(-2.0 * vector @ step, rel=1e-4)


def test_the_oracle_starts_each_landmark_at_its_first_detection_with_its_most_frequent_label() -> None:
    log = exact_log(ahead(5.0, 1.0), np.array([[8.0, 2.0]]), np.array([LEFT]))
    system = LandmarkSystem.of_log(log, MapperSettings(), log.noise)
    system.detections.label[0] = UNKNOWN
    associations = np.full(len(system.detections), 7)
    associations[-1] = -1
    state = start_oracle(system, associations)
    np.testing.assert_array_equal(state.numbers, [7])
    np.testing.assert_array_equal(state.labels, [LEFT])
    np.testing.assert_array_equal(state.votes, [[len(associations) - 2, 0]])
    np.testing.assert_array_equal(system.detections.used, associations >= 0)
    np.testing.assert_allclose(state.landmarks, [[8.0, 2.0]], atol=1e-9)


def gtsam_optimum(log: Log, associations: NDArray[np.int_]) -> gtsam.Values:
    """Returns the optimum of the same problem, with GTSAM's own factors as far as it has them."""
    graph, values, settings = gtsam.NonlinearFactorGraph(), gtsam.Values(), MapperSettings().odometry
    start = np.array(settings.sigmas_start)
    graph.add(gtsam.PriorFactorPose2(X(0), gtsam.Pose2(), gtsam.noiseModel.Diagonal.Sigmas(start)))
    sigmas = gtsam.noiseModel.Diagonal.Sigmas(np.array([settings.sigma_scale, settings.sigma_bias]))
    graph.add(gtsam.PriorFactorPoint2(C(0), np.zeros(2), sigmas))
    values.insert(X(0), gtsam.Pose2())
    values.insert(C(0), np.zeros(2))
    row = 0
    for k, (held, cycle) in enumerate(split_odometry(log)):
        step = integrate_twists(np.diff(np.append(held.t, cycle.t)), held.twist, log.odometry_sigma)
        graph.add(calibrated_odometry_factor(X(k), X(k + 1), C(0), step))
        pose = values.atPose2(X(k)).compose(gtsam.Pose2(*step.delta))
        values.insert(X(k + 1), pose)
        for z, covariance in zip(cycle.points_vehicle, cycle.covariances, strict=True):
            j, row = int(associations[row]), row + 1
            if j < 0:
                continue
            distance, bearing = float(np.hypot(*z)), float(np.arctan2(z[1], z[0]))
            polar = np.array([[-z[1], z[0]], [z[0] * distance, z[1] * distance]]) / distance**2
            noise = gtsam.noiseModel.Gaussian.Covariance(polar @ covariance @ polar.T)
            graph.add(gtsam.BearingRangeFactor2D(X(k + 1), L(j), gtsam.Rot2(bearing), distance, noise))
            if not values.exists(L(j)):
                values.insert(L(j), pose.transformFrom(z))
    return gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()


def test_with_oracle_associations_it_is_gtsams_optimum(bean: Log) -> None:
    """GTSAM's detections are polar, so the two differ by how Gaussian a detection is in each."""
    beginning, associations = beginning_of(bean, 60)
    settings = MapperSettings(calibration=KNOWN)
    _, ours = solve_landmarks(beginning, associations, settings)
    theirs = gtsam_optimum(beginning, associations)
    expected = np.array([theirs.atPoint2(L(int(j))) for j in ours.numbers])
    np.testing.assert_allclose(ours.landmarks, expected, atol=0.03)
    last = theirs.atPose2(X(len(beginning.cycles)))
    np.testing.assert_allclose(ours.variables.poses[-1, :2], [last.x(), last.y()], atol=0.02)
