"""The landmark window: rows, prediction, marginalization and merging, against dense linear algebra."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.eval.landmark_association import PLANE
from pathspace_graph.eval.landmark_closing import merge
from pathspace_graph.eval.landmark_gating import predict
from pathspace_graph.eval.landmark_window import LandmarkSmoother
from pathspace_graph.factors.landmark import landmark_residuals
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.log import Odometry
from pathspace_graph.settings import GateSettings, MapperSettings

from .jacobians import assert_jacobians
from .scenes import ODOMETRY_SIGMA, see

Array = NDArray[np.float64]

CONES = np.array([[6.0, 2.0], [6.0, -2.0], [10.0, 2.5], [10.0, -1.5], [6.1, 2.05]])
LABELS = np.array([LEFT, RIGHT, LEFT, RIGHT, LEFT], dtype=np.intp)
PERIOD = 0.1
SPEED = 1.0
QUADRATIC = replace(MapperSettings(), lag=100.0, gate=GateSettings(huber=np.inf))


def drive_on(smoother: LandmarkSmoother, cycle: int, noise: float = 0.0) -> None:
    """One more cycle of a drive straight on, every cone seen and its landmark known."""
    rng = np.random.default_rng(cycle)
    t = PERIOD * cycle
    stamps = np.array([t - PERIOD]) if cycle else np.zeros(0)
    smoother.drive(Odometry(stamps, np.tile([SPEED, 0.1, 0.05], (len(stamps), 1))), t, ODOMETRY_SIGMA)
    if cycle == 0:
        smoother.add_landmarks(CONES + 0.1, LABELS)
    seen = see(t, np.array([SPEED * t, 0.0, 0.0]), CONES, LABELS)
    noisy = seen.points_vehicle + noise * rng.normal(0.0, 0.1, seen.points_vehicle.shape)
    rows = smoother.add_readings(replace(seen, points_vehicle=noisy))
    smoother.readings.take(np.arange(rows.start, rows.stop), np.arange(len(CONES)))


def driven(cycles: int, settings: MapperSettings = QUADRATIC, noise: float = 1.0) -> LandmarkSmoother:
    smoother = LandmarkSmoother(settings)
    for cycle in range(cycles):
        drive_on(smoother, cycle, noise)
        smoother.step()
        smoother.marginalize()
    return smoother


def test_rows_are_the_derivatives_of_their_residuals() -> None:
    smoother = driven(4)

    def whitened(x: Array) -> tuple[Array, Array]:
        smoother.state.vector = x
        rows = smoother.linearize()
        residual = np.concatenate([r.residual for r in rows])
        jacobian = np.zeros((len(residual), len(x)))
        start = 0
        for r in rows:
            i = start + np.arange(len(r.residual))[:, None]
            np.add.at(jacobian, (i, r.columns), r.jacobian)
            start += len(r.residual)
        return residual, jacobian

    x = smoother.state.vector + np.random.default_rng(0).normal(0.0, 0.3, len(smoother.state.vector))
    assert_jacobians(whitened, [x])


def test_what_it_predicts_is_what_a_step_with_the_new_pose_would_say() -> None:
    """`H Sigma H'` reached through the odometry equals that of the whole system, the new pose included."""
    smoother = driven(6, noise=0.0)
    t = PERIOD * 6
    smoother.drive(Odometry(np.array([t - PERIOD]), np.array([[SPEED, 0.0, 0.3]])), t, ODOMETRY_SIGMA)
    landmarks, size = np.array([2, 0]), smoother.state.map_size
    found = predict(smoother, landmarks)
    before = smoother.state.vector
    smoother.step()
    np.testing.assert_allclose(smoother.state.vector, before, atol=0.1)
    assert smoother.last_step is not None
    lower = np.tril(smoother.last_step.factor)
    covariance = np.linalg.inv(lower @ lower.T)
    poses = np.tile(before[-3:], (2, 1))
    rows = landmark_residuals(poses, before[:size].reshape(-1, 2)[landmarks], np.zeros((2, 2)))
    for k, landmark in enumerate(landmarks):
        own = PLANE * landmark + np.arange(PLANE)
        columns = np.concatenate([np.arange(len(lower) - 3, len(lower)), own])
        h = np.concatenate([rows.by_pose[k], rows.by_landmark[k]], axis=1)
        expected = h @ covariance[np.ix_(columns, columns)] @ h.T
        np.testing.assert_allclose(found.covariances[k], expected, rtol=2e-3)
    np.testing.assert_allclose(found.points, rows.residual)


def test_poses_that_leave_take_nothing_with_them() -> None:
    """With a short lag the map is that of the whole drive, up to what is linearized earlier."""
    whole, short = driven(25), driven(25, replace(QUADRATIC, lag=0.5))
    assert len(short.times) == 6
    np.testing.assert_allclose(short.state.landmarks, whole.state.landmarks, atol=3e-3)
    everything = np.arange(len(CONES))
    expected = whole.covariance(everything)
    np.testing.assert_allclose(short.covariance(everything), expected, atol=0.03 * expected.max())


def test_merging_is_the_constraint_that_both_are_one() -> None:
    smoother = driven(8, replace(QUADRATIC, lag=0.3))
    rows, prior = smoother.linearize(), smoother.prior
    size, n = len(smoother.state.vector), len(smoother.state.labels)
    jacobian = np.concatenate([_dense(r.columns, r.jacobian, size) for r in rows])
    residual = np.concatenate([r.residual for r in rows])
    hessian, descent = jacobian.T @ jacobian, -jacobian.T @ residual
    q = len(prior.point)
    hessian[:q, :q] += prior.information
    descent[:q] += prior.descent_at(smoother.state.vector)
    constraint = np.zeros((2, size))
    constraint[[0, 1], [8, 9]], constraint[[0, 1], [0, 1]] = 1.0, -1.0
    x = smoother.state.vector.copy()
    kkt = np.block([[hessian, constraint.T], [constraint, np.zeros((2, 2))]])
    expected = x + np.linalg.solve(kkt, np.append(descent, -constraint @ x))[:size]
    merge(smoother, np.array([4]), np.array([0]))
    assert len(smoother.state.labels) == n - 1
    assert smoother.merged == {4: 0}
    assert set(smoother.readings.landmark[smoother.readings.used].tolist()) == {0, 1, 2, 3}
    np.testing.assert_allclose(smoother.state.landmarks, expected[:8].reshape(-1, 2), atol=1e-3)
    assert np.abs(expected[:2] - x[:2]).max() > 0.01


def _dense(columns: NDArray[np.intp], jacobian: Array, size: int) -> Array:
    out = np.zeros((len(jacobian), size))
    np.add.at(out, (np.arange(len(jacobian))[:, None], columns), jacobian)
    return out


def test_a_landmark_has_the_colour_of_most_of_its_readings() -> None:
    state = LandmarkSmoother(QUADRATIC).state
    state.add_landmarks(CONES, LABELS)
    state.vote(np.array([RIGHT, RIGHT, RIGHT]), np.array([0, 0, 1]))
    np.testing.assert_array_equal(state.labels, [RIGHT, RIGHT, LEFT, RIGHT, LEFT])
    state.vote(np.array([LEFT, LEFT]), np.array([0, 0]))
    assert state.labels[0] == RIGHT  # a tie changes nothing
    state.vote(np.array([LEFT]), np.array([0]))
    assert state.labels[0] == LEFT
