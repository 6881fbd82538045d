"""The landmark batch: told, it is GTSAM's optimum; not told, it finds what it would have been told."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import C, L, X
from numpy.typing import NDArray
from scipy.spatial import KDTree

from pathspace_graph.batch_data import integrate_log
from pathspace_graph.eval.landmark_batch import LandmarkBatch
from pathspace_graph.eval.landmark_reassociation import drop_rare, merge_duplicates
from pathspace_graph.eval.landmark_start import as_landmark_readings, start_told
from pathspace_graph.eval.landmark_state import LandmarkState
from pathspace_graph.eval.landmark_system import LandmarkSystem
from pathspace_graph.eval.landmark_told import solve_landmarks
from pathspace_graph.eval.limit import solve_told_landmarks
from pathspace_graph.factors.gtsam_factors import calibrated_odometry_factor
from pathspace_graph.factors.landmark import landmark_residuals
from pathspace_graph.factors.odometry import integrate_twists
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.log import Log
from pathspace_graph.map import PointBoundary
from pathspace_graph.run import split_odometry
from pathspace_graph.settings import MapperSettings
from pathspace_graph.sim.simulate import SimulationSettings, simulate

from .scenes import ahead, bean_track, exact_log, true_poses

Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def log() -> Log:
    return simulate(bean_track(), SimulationSettings(laps=2), seed=3)


def part_of(log: Log, cycles: int) -> tuple[Log, NDArray[np.int_]]:
    """The beginning of a log, and its true associations."""
    assert log.truth is not None and log.truth.associations is not None
    kept = log.cycles[:cycles]
    readings = sum(len(cycle.labels) for cycle in kept)
    return Log(log.odometry, kept, log.odometry_sigma), log.truth.associations[:readings]


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
    result, told = batch.solve(log), solve_told_landmarks(log)
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
    readings = as_landmark_readings(short)
    chain = integrate_log(short, log.odometry_sigma, settings.odometry)
    state = start_told(readings, chain, associations)
    return LandmarkSystem(readings, chain, settings), state


def test_blocks_of_the_joint_covariance_are_those_of_the_whole_inverse(log: Log) -> None:
    system, state = told_system(log, 25)
    state = system.settle(state)
    found = system.covariance(state)
    matrix, _ = system.normal_equations(system.evaluate(state)).dense()
    whole = np.linalg.inv(matrix)
    slot, landmark = np.array([3, 20, 24]), np.array([0, 5, 2])
    r = landmark_residuals(state.poses[slot], state.landmarks[landmark], np.zeros((3, 2)))
    predicted = found.predicted(slot, landmark, r.by_pose, r.by_landmark)
    n = state.map_size + 2
    for k in range(3):
        pose, point = n + 3 * slot[k] + np.arange(3), 2 * landmark[k] + np.arange(2)
        columns = np.concatenate([pose, point])
        h = np.concatenate([r.by_pose[k], r.by_landmark[k]], axis=1)
        np.testing.assert_allclose(predicted[k], h @ whole[np.ix_(columns, columns)] @ h.T, rtol=1e-6)


def test_the_optimum_has_no_gradient(log: Log) -> None:
    system, state = told_system(log, 60)
    before = system.evaluate(state).cost
    state = system.settle(state)
    at = system.evaluate(state)
    equations = system.normal_equations(at)
    scaled = equations.descent_border / np.sqrt(equations.scale_border)
    assert at.cost < before
    assert np.abs(scaled).max() < 0.05


def test_two_of_one_cone_are_merged_and_two_cones_are_not(log: Log) -> None:
    system, state = told_system(log, 60)
    readings, settings = system.readings, system.settings
    twin = len(state.labels)
    often = int(np.bincount(readings.landmark[readings.used]).argmax())
    state.add_landmarks(state.landmarks[often : often + 1] + 0.05, state.labels[often : often + 1])
    mine = np.flatnonzero(readings.used & (readings.landmark == often))
    readings.take(mine[::2], np.full(len(mine[::2]), twin))
    state = system.settle(state)
    merge_duplicates(state, readings, system.covariance(state), settings)
    drop_rare(state, readings, 1)
    assert len(state.labels) == twin
    assert (readings.landmark[mine] == often).all()


def test_rare_ones_are_dropped_and_the_others_keep_their_readings(log: Log) -> None:
    system, state = told_system(log, 60)
    readings = system.readings
    counts = np.bincount(readings.landmark[readings.used], minlength=len(state.labels))
    fewest = int(np.sort(counts)[len(counts) // 3]) + 1
    ids = state.ids.copy()
    before = readings.numbers(ids)
    drop_rare(state, readings, fewest)
    np.testing.assert_array_equal(state.ids, ids[counts >= fewest])
    after = readings.numbers(state.ids)
    kept = np.isin(before, state.ids)
    np.testing.assert_array_equal(after[kept], before[kept])
    assert (after[~kept] == -1).all()


def test_a_log_in_which_nothing_is_seen_is_an_empty_map() -> None:
    log = exact_log(ahead(5.0, 2.0), np.zeros((0, 2)), np.zeros(0, np.intp))
    result = LandmarkBatch(odometry_sigma=log.odometry_sigma).solve(log)
    assert result.map.size == 0 and not result.map.closed
    np.testing.assert_allclose(result.trajectory, true_poses(log), atol=1e-6)
