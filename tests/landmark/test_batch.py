"""The landmark batch: told, it is GTSAM's optimum; not told, it finds what it would have been told."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import C, L, X
from numpy.typing import NDArray
from scipy.spatial import KDTree

from pathspace_graph.eval.metrics.limit import solve_oracle_landmarks
from pathspace_graph.factors.gtsam_factors import calibrated_odometry_factor
from pathspace_graph.factors.landmark import landmark_residuals
from pathspace_graph.factors.odometry import integrate_twists
from pathspace_graph.graph.elimination import linear_graph
from pathspace_graph.graph.keys import pose_key
from pathspace_graph.io.log import Log
from pathspace_graph.io.map import PointBoundary
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.landmark.batch import LandmarkBatch
from pathspace_graph.landmark.oracle import solve_landmarks, start_oracle
from pathspace_graph.landmark.reassociation import remove_rare
from pathspace_graph.landmark.state import LandmarkState
from pathspace_graph.landmark.system import LandmarkSystem
from pathspace_graph.run import split_odometry
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.sim.simulate import SimulationSettings, simulate

from ..scenes.drives import ahead, bean_track, exact_log, true_poses

Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def log() -> Log:
    return simulate(bean_track(), SimulationSettings(laps=2), seed=3)


def part_of(log: Log, cycles: int) -> tuple[Log, NDArray[np.int_]]:
    """The beginning of a log, and its true associations."""
    assert log.truth is not None and log.truth.associations is not None
    kept = log.cycles[:cycles]
    detections = sum(len(cycle.labels) for cycle in kept)
    return Log(log.odometry, kept, log.odometry_sigma), log.truth.associations[:detections]


def gtsam_optimum(log: Log, associations: NDArray[np.int_]) -> gtsam.Values:
    """The same problem, of GTSAM's own factors as far as it has them."""
    graph, values, settings = gtsam.NonlinearFactorGraph(), gtsam.Values(), MapperSettings().odometry
    start = np.array([settings.sigma_start, settings.sigma_start, settings.sigma_start_heading])
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


def test_told_it_is_gtsams_optimum(log: Log) -> None:
    """GTSAM's readings are polar, so the two differ by how Gaussian a reading is in each."""
    short, associations = part_of(log, 60)
    ours, theirs = solve_landmarks(short, associations), gtsam_optimum(short, associations)
    expected = np.array([theirs.atPoint2(L(int(j))) for j in ours.landmark_ids])
    np.testing.assert_allclose(ours.landmarks, expected, atol=0.03)
    last = theirs.atPose2(X(len(short.cycles)))
    np.testing.assert_allclose(ours.trajectory[-1, :2], [last.x(), last.y()], atol=0.02)


def test_what_it_is_not_told_it_finds(log: Log) -> None:
    assert log.truth is not None and log.truth.associations is not None
    batch = LandmarkBatch(odometry_sigma=log.odometry_sigma)
    result, told = batch.solve(log), solve_oracle_landmarks(log)
    assert result.converged
    assert result.map.closed and result.laps == 2
    assert len(result.trajectory) == len(log.cycles)
    colour = log.truth.cone_labels[told.landmark_ids]
    for label in BOUNDARIES:
        boundary, expected = result.map.boundaries[label], told.landmarks[colour == label]
        assert isinstance(boundary, PointBoundary)
        assert boundary.size == len(expected)
        assert KDTree(boundary.points).query(expected)[0].max() < 0.2


def told_system(log: Log, cycles: int) -> tuple[LandmarkSystem, LandmarkState]:
    short, associations = part_of(log, cycles)
    settings = MapperSettings()
    system = LandmarkSystem.of_log(short, settings, log.odometry_sigma)
    return system, start_oracle(system, associations)


def whole_system(system: LandmarkSystem, state: LandmarkState) -> tuple[Array, Array]:
    """Normal equations of all variables, in the order of their keys."""
    graph = linear_graph(system.rows(state), state.variables)
    hessian, vector = graph.hessian(state.variables.layout.ordering)
    return hessian, vector


def test_what_it_predicts_is_of_the_whole_inverse(log: Log) -> None:
    system, state = told_system(log, 25)
    system.optimize(state)
    whole = np.linalg.inv(whole_system(system, state)[0])
    cycles, landmarks = np.array([3, 20, 24]), np.array([0, 5, 2])
    r = landmark_residuals(state.variables.poses[cycles], state.landmarks[landmarks], np.zeros((3, 2)))
    jacobian, keys = np.concatenate([r.by_pose, r.by_landmark], axis=2), state.keys[landmarks]
    found = predicted_covariances(system.eliminated(state), cycles, keys, jacobian)
    for k, h in enumerate(jacobian):
        entries = state.variables.layout.entries(np.array([pose_key(cycles[k]), keys[k]]))
        np.testing.assert_allclose(found[k], h @ whole[np.ix_(entries, entries)] @ h.T, rtol=1e-6)


def test_the_optimum_has_no_gradient(log: Log) -> None:
    system, state = told_system(log, 60)
    before = system.cost(state)
    system.optimize(state)
    hessian, vector = whole_system(system, state)
    assert system.cost(state) < before
    assert np.abs(vector / np.sqrt(np.diagonal(hessian))).max() < 0.05


def test_the_cost_falls_along_the_gradient_of_the_rows(log: Log) -> None:
    """`d cost = -g . dx`: the cost and the linear system are of the same problem."""
    system, state = told_system(log, 25)
    variables, rng = state.variables, np.random.default_rng(0)
    hessian, vector = whole_system(system, state)
    at, step = variables.values, 1e-6 * rng.normal(size=len(vector)) / np.sqrt(np.diagonal(hessian))
    costs = []
    for sign in (1.0, -1.0):
        variables.values = at + sign * step
        costs.append(system.cost(state))
    assert costs[0] - costs[1] == pytest.approx(-2.0 * vector @ step, rel=1e-4)


def test_two_of_one_cone_are_merged_and_two_cones_are_not(log: Log) -> None:
    system, state = told_system(log, 60)
    detections, settings, count = system.detections, system.settings, len(state)
    numbers, counts = np.unique(detections.landmark[detections.used], return_counts=True)
    often = numbers[counts.argmax()]
    own = state.positions(np.array([often]))
    twin = state.add(state.landmarks[own] + 0.05, state.labels[own])
    mine = np.flatnonzero(detections.landmark == often)
    detections.take(mine[::2], np.repeat(twin, len(mine[::2])))
    system.optimize(state)
    first, second = find_duplicates(state, len(state), system.eliminated(state).joint, settings)
    detections.merge(state.numbers[first], state.numbers[second])
    remove_rare(state, detections, 1)
    assert len(state) == len(state.landmarks) == count
    assert (detections.landmark[mine] == often).all()


def test_rare_ones_are_dropped_and_the_others_keep_their_readings(log: Log) -> None:
    system, state = told_system(log, 60)
    detections = system.detections
    numbers, counts = np.unique(detections.landmark[detections.used], return_counts=True)
    fewest = int(np.sort(counts)[len(counts) // 3]) + 1
    before, points = detections.landmark.copy(), state.landmarks.copy()
    remove_rare(state, detections, fewest)
    np.testing.assert_array_equal(state.numbers, numbers[counts >= fewest])
    np.testing.assert_array_equal(state.landmarks, points[counts >= fewest])
    kept = np.isin(before, state.numbers)
    np.testing.assert_array_equal(detections.landmark[kept], before[kept])
    assert (detections.landmark[~kept] == -1).all()


def test_a_log_in_which_nothing_is_seen_is_an_empty_map() -> None:
    log = exact_log(ahead(5.0, 2.0), np.zeros((0, 2)), np.zeros(0, np.intp))
    result = LandmarkBatch(odometry_sigma=log.odometry_sigma).solve(log)
    assert result.map.size == 0 and not result.map.closed
    np.testing.assert_allclose(result.trajectory, true_poses(log), atol=1e-6)
