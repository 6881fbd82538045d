"""The landmarks on the engine: rows, prediction, marginalization, merging, against dense algebra."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.factors.landmark import landmark_residuals
from pathspace_graph.factors.odometry import integrate_twists
from pathspace_graph.graph.gaussian import graph_of, jacobian_factor, merge_variables, normal_equations
from pathspace_graph.graph.keys import landmark_keys, pose_key, sizes
from pathspace_graph.graph.smoother import FixedLagSmoother
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.landmark.closing import merge
from pathspace_graph.landmark.landmark_map import LandmarkMap, LandmarkSmoother
from pathspace_graph.landmark.prediction import predict
from pathspace_graph.landmark.state import LandmarkState
from pathspace_graph.mapping.prediction import smoother_settings
from pathspace_graph.settings.mapper import GateSettings, MapperSettings, RelinearizeSettings

from ..scenes.drives import ODOMETRY_SIGMA, see
from ..scenes.jacobians import assert_jacobians

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]

CONES = np.array([[6.0, 2.0], [6.0, -2.0], [10.0, 2.5], [10.0, -1.5], [6.1, 2.05]])
LABELS = np.array([LEFT, RIGHT, LEFT, RIGHT, LEFT], dtype=np.intp)
PERIOD = 0.1
SPEED = 1.0
QUADRATIC = replace(MapperSettings(), lag=100.0, gate=GateSettings(huber=np.inf))


def drive_on(smoother: LandmarkSmoother, cycle: int, twist: tuple[float, float, float]) -> None:
    """The pose of one more cycle, reached with a twist (m/s, m/s, rad/s)."""
    steps = 1 if cycle else 0
    odometry = integrate_twists(np.full(steps, PERIOD), np.tile(twist, (steps, 1)), ODOMETRY_SIGMA)
    smoother.predict(PERIOD * cycle, odometry, smoother.map.settings.odometry.sigmas_start)


def see_all(smoother: LandmarkSmoother, cycle: int, noise: float) -> None:
    """Every cone is seen from the newest pose, and its landmark known."""
    t, rng = PERIOD * cycle, np.random.default_rng(cycle)
    if cycle == 0:
        smoother.map.state.add(CONES + 0.1, LABELS)
    seen = see(t, np.array([SPEED * t, 0.0, 0.0]), CONES, LABELS)
    noisy = seen.points_vehicle + noise * rng.normal(0.0, 0.1, seen.points_vehicle.shape)
    rows = smoother.map.detections.append(replace(seen, points_vehicle=noisy), cycle)
    smoother.map.detections.take(np.arange(rows.start, rows.stop), np.arange(len(CONES)))


def driven(cycles: int, settings: MapperSettings = QUADRATIC, noise: float = 1.0) -> LandmarkSmoother:
    """A drive straight on, all cones seen in every cycle."""
    smoother = FixedLagSmoother(smoother_settings(settings), LandmarkMap(settings))
    for cycle in range(cycles):
        drive_on(smoother, cycle, (SPEED, 0.1, 0.05))
        see_all(smoother, cycle, noise)
        smoother.step()
        smoother.marginalize()
    return smoother


def test_rows_are_the_derivatives_of_their_residuals() -> None:
    smoother = driven(4)
    variables, track = smoother.variables, smoother.map
    track.loop_pairs = np.array([[4, 0], [3, 2]])

    def whitened(x: Array) -> tuple[Array, Array]:
        variables.values = x
        groups = [*track.rows(np.arange(1, 4)), *track.linear_gauge(False)]
        residual = np.concatenate([rows.residual for rows in groups])
        dense = [_dense(rows.columns(variables.layout), rows.jacobian, len(x)) for rows in groups]
        return residual, np.concatenate(dense)

    x = variables.values + np.random.default_rng(0).normal(0.0, 0.3, len(variables.values))
    assert len(whitened(x)[0]) == 2 * (3 * len(CONES) + 2)  # the first cycle was not asked for
    assert_jacobians(whitened, [x])


def test_a_tie_pulls_two_landmarks_together_as_far_as_it_is_sure() -> None:
    smoother = driven(3)
    apart = np.diff(smoother.map.state.landmarks[[0, 4]], axis=0)
    smoother.map.loop_pairs = np.array([[4, 0]])
    smoother.step()
    tied = np.diff(smoother.map.state.landmarks[[0, 4]], axis=0)
    smoother.map.loop_pairs = np.zeros((0, 2), np.intp)
    smoother.step()
    free = np.diff(smoother.map.state.landmarks[[0, 4]], axis=0)
    assert np.hypot(*tied.T) < 0.9 * np.hypot(*apart.T)
    np.testing.assert_allclose(free, apart, atol=1e-3)  # nothing of the tie is left


def test_what_it_predicts_is_what_a_step_with_the_new_pose_would_say() -> None:
    """`H Sigma H'` reached through the odometry equals that of the whole system, the new pose included."""
    smoother = driven(6, noise=0.0)
    drive_on(smoother, 6, (SPEED, 0.0, 0.3))
    landmarks, state = np.array([2, 0]), smoother.map.state
    found = predict(smoother, landmarks)
    pose, points = smoother.variables.poses[-1].copy(), state.landmarks[landmarks]
    rows = landmark_residuals(np.tile(pose, (2, 1)), points, np.zeros((2, 2)))
    np.testing.assert_allclose(found.points_vehicle, rows.residual)
    before = smoother.variables.values.copy()
    smoother.step()
    np.testing.assert_allclose(smoother.variables.values, before, atol=0.1)
    for k, landmark in enumerate(landmarks.tolist()):
        covariance = smoother.last_covariance(np.array([pose_key(6), state.keys[landmark]]))
        h = np.concatenate([rows.by_pose[k], rows.by_landmark[k]], axis=1)
        np.testing.assert_allclose(found.covariances[k], h @ covariance @ h.T, rtol=2e-3)


def test_the_last_steps_covariance_is_the_inverse_of_its_system() -> None:
    """That of the step, though the window has moved on since."""
    smoother = driven(4)
    layout, keys = smoother.layout, smoother.map.state.keys[[3, 1]]
    hessian, _ = normal_equations(smoother.linear_graph(), layout)
    smoother.step()  # nearly nothing moves
    drive_on(smoother, 4, (SPEED, 0.0, 0.0))
    entries = layout.entries(keys)
    expected = np.linalg.inv(hessian)[np.ix_(entries, entries)]
    np.testing.assert_allclose(smoother.last_covariance(keys), expected, rtol=1e-6)


def test_poses_that_leave_take_nothing_with_them() -> None:
    """With a short lag the map is that of the whole drive, up to what is linearized earlier."""
    whole, short = driven(25), driven(25, replace(QUADRATIC, lag=0.5))
    assert len(short.times) == 6
    np.testing.assert_allclose(short.map.state.landmarks, whole.map.state.landmarks, atol=3e-3)
    keys = whole.map.state.keys
    expected = whole.last_covariance(keys)
    np.testing.assert_allclose(short.last_covariance(keys), expected, atol=0.03 * expected.max())


@pytest.mark.parametrize("tolerance", [1e-12, 10.0])  # so that no factor goes stale by itself
def test_merging_is_the_constraint_that_both_are_one(tolerance: float) -> None:
    stale = RelinearizeSettings(tolerance, tolerance)
    smoother = driven(8, replace(QUADRATIC, lag=0.3, relinearize=stale))
    layout, variables, state = smoother.layout, smoother.variables, smoother.map.state
    hessian, vector = normal_equations(smoother.linear_graph(), layout)
    negative_gradient = vector - hessian @ (variables.values - variables.reference)
    constraint = np.zeros((2, layout.size))
    constraint[:, layout.entries(state.keys[[4]])] = np.eye(2)
    constraint[:, layout.entries(state.keys[[0]])] = -np.eye(2)
    kkt = np.block([[hessian, constraint.T], [constraint, np.zeros((2, 2))]])
    step = np.linalg.solve(kkt, np.append(negative_gradient, -constraint @ variables.values))[: layout.size]
    expected = (variables.values + step)[layout.entries(state.keys[:4])]
    before = state.landmarks[0].copy()
    merge(smoother, np.array([4]), np.array([0]))
    np.testing.assert_array_equal(state.numbers, np.arange(4))
    assert smoother.map.merged_into == {4: 0}
    assert set(smoother.map.detections.landmark.tolist()) == {0, 1, 2, 3}
    np.testing.assert_allclose(state.landmarks, expected.reshape(-1, 2), atol=1e-3)
    assert np.abs(expected[:2] - before).max() > 0.01


def test_a_merged_graph_has_the_error_of_the_old_one_where_both_are_one() -> None:
    rng, keys = np.random.default_rng(2), landmark_keys(np.arange(4))
    gone, kept, offset = keys[[3, 1]], keys[[0, 2]], rng.normal(0.0, 1.0, 4)
    factors = [_random(rng, of) for of in (keys[[0, 3]], keys[[1, 2, 3]], keys[[0, 1, 2]])]
    old, new = graph_of(*factors), merge_variables(graph_of(*factors), gone, kept, offset)
    raised = []
    for _ in range(5):
        known = {int(key): rng.normal(0.0, 3.0, 2) for key in kept}
        at_new = _vectors(known)
        for key, same, apart in zip(gone.tolist(), kept.tolist(), offset.reshape(-1, 2), strict=True):
            known[key] = known[same] + apart
        old_error = old.error(_vectors(known))
        raised.append(new.error(at_new) - old_error)
    np.testing.assert_allclose(raised, raised[0], atol=1e-9 * old_error)  # a constant is nobody's


def test_a_key_that_the_graph_does_not_hold_merges_into_nothing() -> None:
    keys = landmark_keys(np.arange(3))
    graph = graph_of(_random(np.random.default_rng(3), keys[:2]))
    hessian, vector = graph.hessian(gtsam.Ordering(keys[:2].tolist()))
    found = merge_variables(graph, keys[2:], keys[:1], np.ones(2)).hessian(gtsam.Ordering(keys[:2].tolist()))
    np.testing.assert_allclose(found[0], hessian, atol=1e-9)
    np.testing.assert_allclose(found[1], vector, atol=1e-9)


@pytest.mark.parametrize("observed", [2, 0])
def test_a_landmark_has_the_colour_of_most_of_its_readings(observed: int) -> None:
    state = LandmarkState()
    state.next_number = 10 * observed  # numbers, not positions
    n = state.add(CONES, LABELS)
    state.vote(np.array([RIGHT, RIGHT, RIGHT]), n[[0, 0, 1]])
    np.testing.assert_array_equal(state.labels, [RIGHT, RIGHT, LEFT, RIGHT, LEFT])
    state.vote(np.array([LEFT, LEFT]), n[[0, 0]])
    assert state.labels[0] == RIGHT  # a tie changes nothing
    state.vote(np.array([LEFT]), n[[0]])
    assert state.labels[0] == LEFT


def _dense(columns: IntArray, jacobian: Array, size: int) -> Array:
    out = np.zeros((len(jacobian), size))
    np.add.at(out, (np.arange(len(jacobian))[:, None], columns), jacobian)
    return out


def _random(rng: np.random.Generator, keys: IntArray) -> gtsam.GaussianConditional:
    return jacobian_factor(keys, rng.normal(0.0, 1.0, (3, int(sizes(keys).sum()))), rng.normal(0.0, 1.0, 3))


def _vectors(values: dict[int, Array]) -> gtsam.VectorValues:
    out = gtsam.VectorValues()
    for key, value in values.items():
        out.insert(key, value)
    return out
