"""The landmark batch that is told the truth, on answers known by hand."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.eval.metrics.accuracy import root_mean_square
from pathspace_graph.eval.metrics.reference import (
    landmark_rmse,
    solve_oracle_landmarks,
    truth_of,
    with_true_covariances,
    with_true_noise,
    without_sensor_errors,
)
from pathspace_graph.eval.metrics.trajectory import position_rms, trajectory_errors
from pathspace_graph.factors.se2 import to_map
from pathspace_graph.io.log import Detections, Log, Odometry, Truth
from pathspace_graph.labels import LEFT, UNKNOWN
from pathspace_graph.sim.faults import Faults, SensorFaults
from pathspace_graph.sim.sensor import OdometryNoise, SensorSettings
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.vehicle import VehicleSettings

from ...scenes.drives import bean_track

Array = NDArray[np.float64]

QUIET = SimulationSettings(
    laps=1,
    sensor=SensorSettings(range_sigma=1e-3, range_sigma_growth=0.0, bearing_sigma=1e-4, false_positives=0.0),
    odometry=OdometryNoise(white=(1e-3, 1e-3, 1e-4), scale=0.0, gyro_bias=0.0),
)


@cache
def quiet_log() -> Log:
    return simulate(bean_track(), QUIET, 0)


def test_with_noise_of_a_millimetre_the_batch_is_as_exact() -> None:
    log = quiet_log()
    system, solved = solve_oracle_landmarks(log)
    assert len(solved.landmarks) > 60
    assert landmark_rmse(solved, truth_of(log)) < 0.003
    assert position_rms(trajectory_errors(system.chain.stamps, solved.variables.poses, truth_of(log))) < 0.003


def test_unknown_cones_are_not_counted() -> None:
    truth = truth_of(quiet_log())
    _, solved = solve_oracle_landmarks(quiet_log())
    left = truth.cone_labels == LEFT
    some = replace(truth, cone_labels=np.where(left, LEFT, UNKNOWN))
    errors = np.linalg.norm(solved.landmarks - truth.cones[solved.numbers], axis=1)
    assert landmark_rmse(solved, some) == pytest.approx(root_mean_square(errors[left[solved.numbers]]))


def test_a_log_without_truth_or_associations_is_refused() -> None:
    log = quiet_log()
    with pytest.raises(ValueError, match="truth"):
        solve_oracle_landmarks(replace(log, truth=None))
    with pytest.raises(ValueError, match="associations"):
        solve_oracle_landmarks(replace(log, truth=replace(truth_of(log), associations=None)))


# --- what else the batch is told -------------------------------------------------------------------------


@pytest.mark.parametrize("bend", [0.0, 0.004, -0.004])
def test_detections_without_noise_are_exact_without_the_errors_of_the_sensor(bend: float) -> None:
    """Each told detection, from the true pose at its told stamp, lies on its cone."""
    faults = SensorFaults(latency=-0.12, yaw=-0.0175, lateral=0.1, range_scale=0.08, range_bias=-0.19)
    sensor = SensorSettings(range_sigma=1e-9, range_sigma_growth=0.0, bearing_sigma=1e-9, false_positives=0.0)
    sensor = replace(sensor, range_bend=bend, range_bend_from=6.0)
    vehicle = VehicleSettings(rate=100.0)
    settings = SimulationSettings(laps=1, sensor=sensor, vehicle=vehicle, faults=Faults(sensor=faults))
    log = simulate(bean_track(), settings, 0)
    assert log.truth is not None and log.truth.associations is not None
    told, associations = without_sensor_errors(log, log.truth.associations)
    cones = np.split(associations, np.cumsum([len(cycle.labels) for cycle in told.cycles])[:-1])
    assert len(told.cycles) == len(log.cycles)
    for cycle, seen in zip(told.cycles, cones, strict=True):
        k = int(np.argmin(np.abs(log.truth.pose_t - cycle.t)))
        assert log.truth.pose_t[k] == pytest.approx(cycle.t, abs=1e-9)
        points = to_map(cycle.points_vehicle, np.tile(log.truth.poses[k], (len(seen), 1)))
        np.testing.assert_allclose(points, log.truth.cones[seen], atol=1e-6)


def test_a_covariance_shrinks_by_the_slope_of_ranges_that_bend() -> None:
    """A range of 20 m reads 1.08 * 20 - 0.19 + 0.004 * 11^2 m, and grows by 1.08 + 0.008 * 11 a metre."""
    point, covariance = np.array([[21.894, 0.0]]), np.diag([0.25, 0.04])
    cycle = Detections(0.0, point, covariance[None], np.array([LEFT]))
    sensor, bend = np.array([0.0, 0.0, 0.0, 0.08, -0.19]), np.array([0.004, 9.0])
    truth = Truth(np.zeros(0), np.zeros((0, 3)), np.zeros((1, 2)), np.array([LEFT]), sensor=sensor, bend=bend)
    log = Log(Odometry(np.zeros(1), np.zeros((1, 3))), (cycle,), np.ones(3), truth=truth)
    told, _ = without_sensor_errors(log, np.zeros(1, dtype=int))
    np.testing.assert_allclose(told.cycles[0].points_vehicle, [[20.0, 0.0]], atol=1e-12)
    expected = np.diag([0.25 / 1.168**2, 0.04 * (20.0 / 21.894) ** 2])
    np.testing.assert_allclose(told.cycles[0].covariances[0], expected, atol=1e-12)


def test_told_the_noise_a_drawn_log_has_the_covariances_of_the_sensor() -> None:
    settings = SimulationSettings(laps=1, draw=True)
    log = with_true_covariances(simulate(bean_track(), settings, 1))
    assert log.truth is not None and log.truth.rays is not None
    begin, growth, bearing = log.truth.rays
    cycle = log.cycles[3]
    ranges = np.linalg.norm(cycle.points_vehicle, axis=1)
    expected = (begin + growth * ranges) ** 2 + (bearing * np.maximum(ranges, 1.0)) ** 2
    np.testing.assert_allclose(np.trace(cycle.covariances, axis1=1, axis2=2), expected)


def test_two_sightings_of_a_cone_are_worth_less_by_their_correlation() -> None:
    """Seen along x at 0 s and 2 s: variances are multiplied by 1 + share exp(-2 / time)."""
    cycles = tuple(
        Detections(t, np.array([[4.0, 0.0]]), np.diag([0.09, 0.04])[None], np.array([LEFT]))
        for t in (0.0, 2.0)
    )
    noise = np.array([0.5, 0.4, 0.3, 0.2, 0.8, 4.0])
    truth = Truth(np.zeros(0), np.zeros((0, 3)), np.array([[4.0, 0.0]]), np.array([LEFT]), noise=noise)
    log = Log(Odometry(np.array([0.0, 2.0]), np.zeros((2, 3))), cycles, np.ones(3), truth=truth)
    told = with_true_noise(log, np.zeros(2, dtype=int))
    np.testing.assert_array_equal(told.odometry_sigma, [0.5, 0.4, 0.3])
    expected = np.diag([0.09 * (1.0 + 0.2 * np.exp(-0.5)), 0.04 * (1.0 + 0.8 * np.exp(-0.5))])
    for cycle in told.cycles:
        np.testing.assert_allclose(cycle.covariances[0], expected)
