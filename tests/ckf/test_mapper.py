"""The paper's spline filter: expansion, update, closing, and whole drives."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.ckf.closing import update_by_correspondences
from pathspace_graph.ckf.expansion import proximity_chain
from pathspace_graph.ckf.mapper import CkfMapper
from pathspace_graph.ckf.state import CurveState
from pathspace_graph.ckf.update import classify, update
from pathspace_graph.estimators import make_online
from pathspace_graph.eval.metrics.table1 import cone_distances, lap_metrics
from pathspace_graph.io.log import Detections
from pathspace_graph.io.map import SplineBoundary
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.mapping.belief import Belief
from pathspace_graph.mapping.registration import Motion
from pathspace_graph.run import run_online
from pathspace_graph.settings.comparison import CkfSettings
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track_generator import TrackGeneratorSettings, generate_track
from pathspace_graph.spline.bspline import BSpline

from ..scenes.drives import ahead, bean_track, corridor, exact_log, lap_log

Array = NDArray[np.float64]

READING = 0.01 * np.eye(2)
UNBENT = CkfSettings(sigma_bend=1e9)
"""Expansion as written: nothing is said of the bending."""


def state_with_curve(ckf: CkfSettings | None = None) -> CurveState:
    """The left row of a bend, mapped as far as 12 m."""
    state = CurveState(Belief(np.zeros(3), 1e-4 * np.eye(3)), MapperSettings(ckf=ckf or CkfSettings()))
    readings = np.array([[4.0, 2.0], [8.0, 2.4], [12.0, 3.4]])
    state.begin(LEFT, readings, np.tile(READING, (3, 1, 1)))
    return state


def detections(points: Array) -> Detections:
    return Detections(0.0, points, np.tile(READING, (len(points), 1, 1)), np.full(len(points), LEFT))


def test_an_expansion_leaves_the_old_curve_as_it_was_and_ends_on_the_reading() -> None:
    state = state_with_curve(UNBENT)
    before = state.spline(LEFT)
    u = np.linspace(*before.domain, 200)
    state.extend(LEFT, np.array([17.0, 5.5]), READING)
    after = state.spline(LEFT)
    np.testing.assert_allclose(after.evaluate(u), before.evaluate(u), atol=1e-12)
    assert after.size == before.size + 1
    np.testing.assert_allclose(after.evaluate(np.array([after.domain[1]]))[0], [17.0, 5.5], atol=1e-3)
    np.testing.assert_array_equal(after.knots[-4:], after.domain[1])


def test_an_expansion_keeps_the_old_curves_uncertainty_and_brings_the_readings() -> None:
    state = state_with_curve(UNBENT)
    before, u = state.spline(LEFT), np.linspace(0.0, 8.0, 20)
    covariance = before.covariance_at(u, state.covariance(LEFT))
    state.extend(LEFT, np.array([17.0, 5.5]), READING)
    after = state.spline(LEFT)
    np.testing.assert_allclose(after.covariance_at(u, state.covariance(LEFT)), covariance, atol=1e-9)
    end = after.covariance_at(np.array([after.domain[1]]), state.covariance(LEFT))[0]
    pose_part = 1e-4 * (np.eye(2) + np.outer([-5.5, 17.0], [-5.5, 17.0]))
    np.testing.assert_allclose(end, READING + pose_part, atol=1e-4)


def test_expansions_without_readings_between_stay_bounded_by_the_prior_of_little_bending() -> None:
    """As written, what is open of the end's bending multiplies by 2 + sqrt 3 at each one."""

    def largest(ckf: CkfSettings) -> float:
        state = state_with_curve(ckf)
        for k in range(8):
            state.extend(LEFT, np.array([17.0 + 5.0 * k, 3.4]), READING)
        return float(np.sqrt(np.linalg.eigvalsh(state.belief.covariance)[-1]))

    assert largest(CkfSettings()) < 10.0
    assert largest(UNBENT) > 100.0


def test_the_second_curve_doesnt_disturb_the_first() -> None:
    state = CurveState(Belief(np.zeros(3), 1e-4 * np.eye(3)), MapperSettings())
    rows = {RIGHT: np.array([[4.0, -2.0], [8.0, -2.0]]), LEFT: np.array([[4.0, 2.0], [8.0, 2.0]])}
    for label, readings in rows.items():
        state.begin(label, readings, np.tile(READING, (2, 1, 1)))
    right = state.spline(RIGHT)
    state.extend(LEFT, np.array([14.0, 2.0]), READING)
    np.testing.assert_allclose(state.spline(RIGHT).control_points, right.control_points, atol=1e-6)
    assert (state.spline(LEFT).control_points[:, 1] > 1.0).all()


def test_the_chain_goes_from_the_end_always_to_the_nearest() -> None:
    points = np.array([[9.0, 0.0], [3.0, 0.0], [6.0, 0.0]])
    np.testing.assert_array_equal(proximity_chain(points, np.zeros(2)), [1, 2, 0])


@pytest.mark.parametrize("prediction", ["fitted", "direct"])
def test_an_update_moves_the_curve_to_the_readings_and_makes_it_surer(prediction: str) -> None:
    settings = CkfSettings()
    settings = replace(settings, prediction="direct") if prediction == "direct" else settings
    state = state_with_curve(settings)
    readings = detections(np.array([[6.0, 2.5], [7.0, 2.6], [9.5, 3.0]]))
    found = classify(state, readings)
    assert len(found[LEFT].rows) == 3
    u = found[LEFT].basis @ np.linspace(0.0, 8.0, 4)
    before = state.foot_points(LEFT, readings.points_vehicle, 0.0 * u, 0.0 * u + 12.0).distance
    spread = np.trace(state.belief.covariance)
    update(state, readings, found)
    after = state.foot_points(LEFT, readings.points_vehicle, 0.0 * u, 0.0 * u + 12.0).distance
    assert np.linalg.norm(after) < np.linalg.norm(before)
    assert np.trace(state.belief.covariance) < spread
    assert np.linalg.eigvalsh(state.belief.covariance)[0] > -1e-12


def test_what_no_reading_reaches_stays_uncertain() -> None:
    """Held against the control points as they are and without a floor, it would be known exactly."""
    state = state_with_curve()
    for k in range(4):
        state.extend(LEFT, np.array([17.0 + 5.0 * k, 3.4]), READING)
    far = state.covariance(LEFT)[-4:, -4:]
    update(state, detections(np.array([[6.0, 2.5]])), classify(state, detections(np.array([[6.0, 2.5]]))))
    np.testing.assert_allclose(state.covariance(LEFT)[-4:, -4:], far, rtol=0.05)


def test_a_straight_drive_is_mapped_straight() -> None:
    cones, labels = corridor(80.0)
    log = exact_log(ahead(6.0, 10.0), cones, labels)
    result = run_online(log, CkfMapper(odometry_sigma=log.odometry_sigma), name="ckf")
    assert np.abs(result.trajectory[:, 1]).max() < 0.05
    for label, y in ((LEFT, 2.0), (RIGHT, -2.0)):
        boundary = result.map.boundaries[label]
        assert isinstance(boundary, SplineBoundary)
        points = boundary.spline.evaluate(np.linspace(*boundary.spline.domain, 200))
        assert points[-1, 0] > 55.0
        assert np.abs(points[:, 1] - y).max() < 0.1


def test_an_exact_lap_closes_both_curves() -> None:
    log = lap_log(bean_track(), overrun=60.0)
    mapper = CkfMapper(odometry_sigma=log.odometry_sigma)
    result = run_online(log, mapper, name="ckf")
    assert result.map.closed
    assert log.truth is not None
    assert cone_distances(result.map, log.truth).max() < 0.6
    sizes = [boundary.size for boundary in result.map.boundaries.values()]
    assert sum(sizes) < 0.6 * len(log.truth.cones)


def test_a_noisy_lap_is_mapped_with_few_control_points() -> None:
    log = simulate(
        generate_track(np.random.default_rng(2), TrackGeneratorSettings()), SimulationSettings(laps=2), 0
    )
    result = run_online(log, make_online("ckf", MapperSettings(), log), name="ckf")
    assert log.truth is not None
    metrics = lap_metrics(result.map, log.truth, 2)
    assert result.map.closed
    assert metrics.rmse < 0.8
    assert metrics.missed < 0.05
    assert metrics.size < 0.5 * len(log.truth.cones)


def test_no_detections_are_no_reason_to_fail() -> None:
    cones, labels = corridor(80.0)
    log = exact_log(ahead(6.0, 4.0), cones, labels)
    blind = replace(
        log,
        cycles=tuple(
            Detections(c.t, c.points_vehicle[:0], c.covariances[:0], c.labels[:0]) for c in log.cycles
        ),
    )
    result = run_online(blind, CkfMapper(), name="ckf")
    assert result.map.size == 0
    driven = 6.0 * result.trajectory_t[-1]
    assert result.trajectory[-1] == pytest.approx([driven, 0.0, 0.0], abs=1e-2)
    assert result.trajectory[-1, 0] < driven  # the mean over headings: a turned metre leads less far


@pytest.mark.parametrize("change", [{"ridge": 2.0}, {"penalty": "cost"}])
def test_a_fitted_prediction_takes_from_the_readings_what_a_filter_on_them_would(
    change: dict[str, Any],
) -> None:
    """Both sides of the innovation go through one full-rank gain, which cancels, lambda with it."""
    results = []
    for settings in (CkfSettings(), replace(CkfSettings(), **change)):
        state = state_with_curve(settings)
        readings = detections(np.array([[6.0, 2.5], [7.0, 2.6], [9.5, 3.0]]))
        update(state, readings, classify(state, readings))
        results.append((state.belief.mean, state.belief.covariance))
    np.testing.assert_allclose(results[0][0], results[1][0], atol=1e-6)
    np.testing.assert_allclose(results[0][1], results[1][1], atol=1e-6)


def test_closing_waits_for_the_end_to_reach_its_beginning() -> None:
    state = state_with_curve()
    before = state.belief.mean.copy()
    assert not update_by_correspondences(state, Motion(np.zeros(2), np.array([0.0, 50.0, 0.0])))
    np.testing.assert_array_equal(state.belief.mean, before)


def test_a_lost_vehicle_is_found_again_on_a_closed_curve() -> None:
    phi = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
    points = 10.0 * np.column_stack([np.cos(phi), np.sin(phi)])
    state = CurveState(Belief(np.array([8.0, 0.0, np.pi / 2]), np.eye(3)), MapperSettings())
    state.belief.mean = np.concatenate([state.belief.mean, points.ravel()])
    state.belief.covariance = np.eye(len(state.belief.mean))
    state.curves[LEFT] = BSpline.periodic_from(np.linspace(0.0, 60.0, 13), points)
    right = float(state.spline(LEFT).foot_points(np.array([[8.0, 0.0]])).u[0])
    state.pose_u[LEFT] = right + 30.0
    state.locate_vehicle()
    assert state.pose_u[LEFT] % 60.0 == pytest.approx(right % 60.0, abs=1e-3)
