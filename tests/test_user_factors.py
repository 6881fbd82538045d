"""A user's own GTSAM factors on the window's poses: the same as in a batch, and what a GNSS is worth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.errors import SettingsError
from pathspace_graph.factors.odometry import MIN_SIGMA, integrate_twists
from pathspace_graph.fixed_lag import CycleResult, FixedLagMapper
from pathspace_graph.log import Log, Odometry
from pathspace_graph.pose_factors import PoseFactors, pose_key
from pathspace_graph.run import split_odometry
from pathspace_graph.settings import MapperSettings, OdometrySettings
from pathspace_graph.sim.vehicle import integrate

from .scenes import CYCLE, DT, ODOMETRY_SIGMA, bean_track, exact_log, lap_log, true_poses

Array = NDArray[np.float64]
Factors = Mapping[int, Sequence[gtsam.NonlinearFactor]]

START = 1e-3
"""Sigma of the first pose in the chains below (m, rad)."""
CHAIN = MapperSettings(
    lag=0.8,
    steps=3,
    odometry=OdometrySettings(
        sigma_scale=1e-9, sigma_bias=1e-9, sigma_start=START, sigma_start_heading=START
    ),
)
"""A short window, and an odometry that needs no calibration."""


def drive(log: Log, factors: Factors, settings: MapperSettings) -> tuple[FixedLagMapper, list[CycleResult]]:
    """A mapper after the log; `factors` by the cycle that they are given with."""
    mapper = FixedLagMapper(settings, ODOMETRY_SIGMA)
    cycles = enumerate(split_odometry(log))
    return mapper, [mapper.update(o, d, factors.get(k, ())) for k, (o, d) in cycles]


def odometry_only(twists: Array) -> Log:
    return exact_log(twists, np.zeros((0, 2)), np.zeros(0, np.intp))


def gnss(cycle: int, position: Array, sigma: float) -> gtsam.NonlinearFactor:
    """A position (2,), map frame."""
    noise = gtsam.noiseModel.Isotropic.Sigma(2, sigma)
    return gtsam.PoseTranslationPrior2D(pose_key(cycle), gtsam.Pose2(*position, 0.0), noise)


def gnss_drive(positions: Array, sigma: float) -> Factors:
    """One in every third cycle."""
    return {k: [gnss(k, positions[k], sigma)] for k in range(0, len(positions), 3)}


def between(first: int, second: int, delta: Array) -> gtsam.NonlinearFactor:
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.02, 0.03, 0.01]))
    return gtsam.BetweenFactorPose2(pose_key(first), pose_key(second), gtsam.Pose2(*delta), noise)


def batch(log: Log, factors: Factors) -> Array:
    """Every pose (n, 3) by GTSAM, from the odometry and the factors."""
    graph, values, pose = gtsam.NonlinearFactorGraph(), gtsam.Values(), gtsam.Pose2()
    start = gtsam.noiseModel.Isotropic.Sigma(3, START)
    graph.add(gtsam.PriorFactorPose2(pose_key(0), pose, start))
    values.insert(pose_key(0), pose)
    for k, (odometry, cycle) in enumerate(split_odometry(log)):
        if k:
            step = integrated(odometry, cycle.t)
            delta = gtsam.Pose2(*step.delta)
            noise = gtsam.noiseModel.Gaussian.Covariance(step.covariance + MIN_SIGMA**2 * np.eye(3))
            graph.add(gtsam.BetweenFactorPose2(pose_key(k - 1), pose_key(k), delta, noise))
            pose = pose.compose(delta)
            values.insert(pose_key(k), pose)
        for factor in factors.get(k, ()):
            graph.add(factor)
    for _ in range(10):
        values = values.retract(graph.linearize(values).optimize())
    poses = [values.atPose2(pose_key(k)) for k in range(len(log.cycles))]
    return np.array([[p.x(), p.y(), p.theta()] for p in poses])


def integrated(odometry: Odometry, t: float):  # type: ignore[no-untyped-def]
    return integrate_twists(np.diff(np.append(odometry.t, t)), odometry.twist, ODOMETRY_SIGMA)


def straight(rng: np.random.Generator) -> Log:
    """Straight on at a noisy speed: the headings stay zero, so the problem is linear."""
    speeds = 5.0 + rng.normal(size=300)
    return odometry_only(np.column_stack([speeds, np.zeros((300, 2))]))


# --- as in a batch ---------------------------------------------------------------------------------------


def test_gnss_on_a_linear_chain_is_full_batch() -> None:
    rng = np.random.default_rng(0)
    log = straight(rng)
    truth = true_poses(log)
    factors = gnss_drive(truth[:, :2] + [0.5, 0.0] * rng.normal(size=(len(truth), 1)), 0.2)
    mapper, _ = drive(log, factors, CHAIN)
    assert len(mapper.poses) == 9
    np.testing.assert_allclose(mapper.poses, batch(log, factors)[-9:], atol=1e-9)


@pytest.mark.parametrize("span", [2, 5, 8])
def test_factors_across_poses_of_the_window_are_full_batch(span: int) -> None:
    """The oldest pose leaves with factors that reach up to the newest pose of the window."""
    rng = np.random.default_rng(1)
    log = straight(rng)
    truth = true_poses(log)
    deltas = truth[span:] - truth[:-span] + [0.1, 0.0, 0.0] * rng.normal(size=(len(truth) - span, 1))
    factors = {k: [between(k - span, k, deltas[k - span])] for k in range(span, len(truth), 2)}
    mapper, _ = drive(log, factors, CHAIN)
    assert len(mapper.prior.point) > 2 + 3
    np.testing.assert_allclose(mapper.poses, batch(log, factors)[-9:], atol=1e-9)


def test_a_winding_chain_is_nearly_full_batch() -> None:
    """Nonlinear: what has left the window stays linearized where it was."""
    rng = np.random.default_rng(2)
    twists = np.column_stack([np.full(300, 6.0), np.zeros(300), np.sin(0.02 * np.arange(300))])
    log = odometry_only(twists)
    truth = true_poses(log)
    factors = gnss_drive(truth[:, :2] + 1e-4 * rng.normal(size=(len(truth), 2)), 0.1)
    mapper, _ = drive(log, factors, CHAIN)
    expected = batch(log, factors)[-9:]
    assert np.abs(expected - truth[-9:]).max() > 1e-5
    np.testing.assert_allclose(mapper.poses, expected, atol=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_rows_are_the_derivatives_of_the_factors_error(seed: int) -> None:
    """By (x, y, theta) in the map frame, at any heading, in any order of keys."""
    rng = np.random.default_rng(seed)
    poses = rng.normal(size=(4, 3)) * [5.0, 5.0, 2.0]
    deltas = rng.normal(size=(2, 3))
    held = [between(12, 10, deltas[0]), between(10, 13, deltas[1]), gnss(11, poses[0, :2], 0.1)]
    factors = PoseFactors()
    factors.add(held, 10, 13)

    def residuals(x: Array) -> list[Array]:
        values = gtsam.Values()
        for k, pose in enumerate(x.reshape(-1, 3)):
            values.insert(pose_key(10 + k), gtsam.Pose2(*pose))
        return [f.noiseModel().whiten(f.unwhitenedError(values)) for f in held]

    steps = 1e-6 * np.eye(poses.size)
    for i, rows in enumerate(factors.rows(poses, 10, 7)):
        dense = np.zeros((len(rows.residual), poses.size))
        np.put_along_axis(dense, rows.columns - 7, rows.jacobian, axis=1)
        numeric = [residuals(poses.ravel() + h)[i] - residuals(poses.ravel() - h)[i] for h in steps]
        np.testing.assert_allclose(dense, np.array(numeric).T / 2e-6, rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(rows.residual, residuals(poses.ravel())[i], atol=1e-12)


# --- what they are for -----------------------------------------------------------------------------------


def biased() -> tuple[Log, Array]:
    """Odometry with 3 % too much speed and a gyro bias of 0.02 rad/s; the true poses (n, 3)."""
    truth = np.column_stack([np.full(1000, 6.0), np.zeros(1000), 0.4 * np.sin(0.01 * np.arange(1000))])
    return odometry_only(truth * [1.03, 1.0, 1.0] + [0.0, 0.0, 0.02]), integrate(truth[:-1], DT)[::CYCLE]


def custom_gnss(cycle: int, position: Array, sigma: float) -> gtsam.NonlinearFactor:
    """The same as a factor of one's own."""

    def error(this: gtsam.CustomFactor, values: gtsam.Values, H: list[Array] | None) -> Array:
        pose = values.atPose2(this.keys()[0])
        if H is not None:
            H[0] = np.column_stack([pose.rotation().matrix(), np.zeros(2)])
        return np.array([pose.x(), pose.y()]) - position

    return gtsam.CustomFactor(gtsam.noiseModel.Isotropic.Sigma(2, sigma), [pose_key(cycle)], error)


def test_gnss_pulls_a_biased_odometry_to_the_truth() -> None:
    log, truth = biased()
    without = drive(log, {}, MapperSettings())[1]
    factors = gnss_drive(truth[:, :2], 0.05)
    mapper, results = drive(log, factors, MapperSettings())
    assert np.hypot(*(without[-1].pose - truth[-1])[:2]) > 3.0
    errors = np.array([result.pose for result in results]) - truth
    assert np.hypot(errors[50:, 0], errors[50:, 1]).max() < 0.1
    assert np.abs(errors[50:, 2]).max() < 0.05
    np.testing.assert_allclose(mapper.calibration, [0.03, 0.02], atol=0.02)


def test_a_custom_factor_is_as_good_as_a_native_one() -> None:
    log, truth = biased()
    native = drive(log, gnss_drive(truth[:, :2], 0.05), MapperSettings())[1]
    own = {k: [custom_gnss(k, truth[k, :2], 0.05)] for k in range(0, len(truth), 3)}
    custom = drive(log, own, MapperSettings())[1]
    poses = [np.array([result.pose for result in results]) for results in (native, custom)]
    np.testing.assert_allclose(poses[0], poses[1], atol=1e-9)


def test_a_loop_closes_with_gnss_too() -> None:
    log = lap_log(bean_track(), overrun=45.0)
    truth = true_poses(log)
    mapper, results = drive(log, gnss_drive(truth[:, :2], 0.2), MapperSettings())
    assert mapper.closed
    errors = np.array([result.pose for result in results])[:, :2] - truth[:, :2]
    assert np.hypot(*errors.T).max() < 0.3


# --- keys ------------------------------------------------------------------------------------------------


def test_the_next_key_is_the_next_cycles() -> None:
    mapper = FixedLagMapper(CHAIN)
    for k, (odometry, cycle) in enumerate(split_odometry(straight(np.random.default_rng(0)))):
        assert mapper.next_pose_key == mapper.pose_key(k) == gtsam.symbol("x", k)
        mapper.update(odometry, cycle)


@pytest.mark.parametrize(
    ("key", "name"), [(pose_key(2), "x2"), (pose_key(31), "x31"), (gtsam.symbol("l", 29), "l29")]
)
def test_a_key_that_is_not_in_the_window_is_named_and_nothing_is_done(key: int, name: str) -> None:
    """Cycles 21 to 29 are in it, and 30 comes now."""
    mapper = FixedLagMapper(CHAIN)
    pairs = list(split_odometry(straight(np.random.default_rng(0))))
    for odometry, cycle in pairs[:30]:
        mapper.update(odometry, cycle)
    before = mapper.state.copy()
    noise = gtsam.noiseModel.Isotropic.Sigma(3, 0.1)
    wrong = gtsam.PriorFactorPose2(key, gtsam.Pose2(), noise)
    with pytest.raises(SettingsError, match=rf"{name}: expected keys .* x21 to x30"):
        mapper.update(*pairs[30], [gnss(30, np.zeros(2), 0.1), wrong])
    np.testing.assert_array_equal(mapper.state, before)
    assert mapper.next_pose_key == pose_key(30)
    mapper.update(*pairs[30], [gnss(21, np.zeros(2), 10.0), gnss(30, np.zeros(2), 10.0)])
