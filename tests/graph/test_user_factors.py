"""A user's own GTSAM factors on poses, map and calibration: against a batch, and with GNSS on real drives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import gtsam
import numpy as np
import pytest

from pathspace_graph.errors import SettingsError
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.noise import KnownNoise
from pathspace_graph.factors.odometry import MIN_SIGMA, integrate_twists
from pathspace_graph.graph.gaussian import keys_of
from pathspace_graph.graph.variables import (
    CALIBRATION_KEY,
    Variables,
    are_poses,
    control_keys,
    pose_key,
    pose_keys,
)
from pathspace_graph.graph.window import UserFactors
from pathspace_graph.io.log import Log, Odometry
from pathspace_graph.labels import RIGHT
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.run import CycleResult, split_odometry
from pathspace_graph.settings.mapper import MapperSettings, OdometrySettings
from pathspace_graph.sim.vehicle import integrate

from ..scenes.drives import CYCLE, DT, ODOMETRY_SIGMA, bean_track, exact_log, lap_log, true_poses
from ..scenes.graph import columns_of
from ..scenes.linear_drive import LinearDrive

R0 = int(control_keys(1, np.array(0)))
Factors = Mapping[int, Sequence[gtsam.NonlinearFactor]]

CHAIN = MapperSettings(
    lag=0.8,
    steps=3,
    odometry=OdometrySettings(sigma_scale=1e-9, sigma_bias=1e-9),
)
"""A short window, and an odometry that needs no calibration."""


def drive(log: Log, factors: Factors, settings: MapperSettings) -> tuple[FixedLagMapper, list[CycleResult]]:
    """A mapper after the log; `factors` by the cycle that they are given with."""
    mapper = FixedLagMapper(settings, KnownNoise(ODOMETRY_SIGMA, drift=np.zeros(3)))
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
    start = gtsam.noiseModel.Diagonal.Sigmas(np.array(CHAIN.odometry.sigmas_start))
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


# --- one that says nothing -------------------------------------------------------------------------------


def everywhere(mapper: FixedLagMapper, sigma: float) -> list[gtsam.NonlinearFactor]:
    """Priors at the origin, on the next pose and on the first control point of each curve."""
    noise = gtsam.noiseModel.Isotropic.Sigma
    keys = [int(mapper.control_keys(label)[0]) for label in mapper.boundaries]
    points = [gtsam.PriorFactorPoint2(key, np.zeros(2), noise(2, sigma)) for key in keys]
    return [gtsam.PriorFactorPose2(mapper.next_pose_key, gtsam.Pose2(), noise(3, sigma)), *points]


@pytest.mark.slow
@pytest.mark.parametrize(("sigma", "says_something"), [(1e9, False), (1e3, True)])
def test_a_factor_that_says_nothing_changes_no_bit(sigma: float, says_something: bool) -> None:
    """The loop closes by the batch of the lap, as it does without factors."""
    log = lap_log(bean_track(), overrun=45.0)
    plain, given = FixedLagMapper(None, ODOMETRY_SIGMA), FixedLagMapper(None, ODOMETRY_SIGMA)
    for odometry, cycle in split_odometry(log):
        plain.update(odometry, cycle)
        given.update(odometry, cycle, everywhere(given, sigma))
    assert plain.closed
    assert given.road.smoother.user_factors.given == says_something
    assert given.closed
    assert (len(given.drive.record.factors) > 0) == says_something
    points = [(plain.control_points(label), given.control_points(label)) for label in plain.boundaries]
    assert all(np.array_equal(*pair) for pair in points) != says_something


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
    """The oldest pose is marginalized with factors that also hold the newest pose of the window."""
    rng = np.random.default_rng(1)
    log = straight(rng)
    truth = true_poses(log)
    deltas = truth[span:] - truth[:-span] + [0.1, 0.0, 0.0] * rng.normal(size=(len(truth) - span, 1))
    factors = {k: [between(k - span, k, deltas[k - span])] for k in range(span, len(truth), 2)}
    mapper, _ = drive(log, factors, CHAIN)
    assert are_poses(keys_of(mapper.road.smoother.prior)).sum() > 1
    np.testing.assert_allclose(mapper.poses, batch(log, factors)[-9:], atol=1e-9)


def test_a_winding_chain_is_nearly_full_batch() -> None:
    """The factors are nonlinear: marginalized ones keep their linearization point."""
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
    """By (x, y, theta) in the map frame, at any heading, in any order of keys, away from the references."""
    rng = np.random.default_rng(seed)
    variables = Variables()
    variables.insert(pose_keys(10 + np.arange(4)), (rng.normal(size=(4, 3)) * [5.0, 5.0, 2.0]).ravel())
    variables.insert(control_keys(1, np.arange(1)), rng.normal(size=2))
    variables.values += rng.normal(size=variables.layout.size)
    x, noise = variables.values.copy(), gtsam.noiseModel.Isotropic.Sigma(2, 0.3)
    bearing = gtsam.noiseModel.Isotropic.Sigma(1, 0.1)
    deltas = rng.normal(size=(2, 3))
    held = [
        between(12, 10, deltas[0]),
        between(10, 13, deltas[1]),
        gnss(11, x[2:4], 0.1),
        gtsam.RangeFactor2D(pose_key(12), R0, 3.0, bearing),
        gtsam.PriorFactorPoint2(R0, np.ones(2), noise),
    ]
    factors = UserFactors()
    factors.add(held)

    def residuals(x: Array) -> list[Array]:
        variables.values[:] = x
        values = variables.gtsam_values(variables.keys)
        return [f.noiseModel().whiten(f.unwhitenedError(values)) for f in held]

    linear = factors.linearized(variables)
    steps = 1e-6 * np.eye(len(x))
    for i, factor in enumerate(linear):
        matrix, right = factor.jacobian()
        entries = variables.layout.entries(np.array(list(factor.keys()), np.intp))
        dense = np.zeros((len(right), len(x)))
        dense[:, entries] = matrix
        numeric = [residuals(x + h)[i] - residuals(x - h)[i] for h in steps]
        np.testing.assert_allclose(dense, np.array(numeric).T / 2e-6, rtol=1e-5, atol=1e-5)
        here = dense @ (x - variables.reference) - right
        np.testing.assert_allclose(here, residuals(x)[i], atol=1e-12)


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


@pytest.mark.slow
def test_a_loop_closes_with_gnss_too() -> None:
    log = lap_log(bean_track(), overrun=45.0)
    truth = true_poses(log)
    mapper, results = drive(log, gnss_drive(truth[:, :2], 0.2), MapperSettings())
    assert mapper.closed
    errors = np.array([result.pose for result in results])[:, :2] - truth[:, :2]
    assert np.hypot(*errors.T).max() < 0.3


# --- on the map and on the calibration --------------------------------------------------------------------

POINT_NOISE = 0.4


def point_prior(number: int, at: Array) -> gtsam.NonlinearFactor:
    """Returns the factor of a surveyed control point of the left boundary."""
    noise = gtsam.noiseModel.Isotropic.Sigma(2, POINT_NOISE)
    return gtsam.PriorFactorPoint2(int(control_keys(0, np.array(number))), at, noise)


def point_between(first: int, second: int, offset: Array) -> gtsam.NonlinearFactor:
    noise = gtsam.noiseModel.Isotropic.Sigma(2, POINT_NOISE)
    keys = [int(key) for key in control_keys(0, np.array([first, second]))]
    return gtsam.BetweenFactorPoint2(*keys, offset, noise)


def calibration_prior(at: Array) -> gtsam.NonlinearFactor:
    return gtsam.PriorFactorPoint2(CALIBRATION_KEY, at, gtsam.noiseModel.Isotropic.Sigma(2, POINT_NOISE))


def pose_to_point(cycle: int, number: int, offset: Array) -> gtsam.NonlinearFactor:
    """`c - t - offset` in the map frame, which is linear."""
    keys = [pose_key(cycle), int(control_keys(0, np.array(number)))]

    def error(this: gtsam.CustomFactor, values: gtsam.Values, H: list[Array] | None) -> Array:
        pose = values.atPose2(keys[0])
        if H is not None:
            H[0] = np.column_stack([-pose.rotation().matrix(), np.zeros(2)])
            H[1] = np.eye(2)
        return values.atPoint2(keys[1]) - np.array([pose.x(), pose.y()]) - offset

    return gtsam.CustomFactor(gtsam.noiseModel.Isotropic.Sigma(2, POINT_NOISE), keys, error)


def with_rows(drive: LinearDrive, added: list[tuple[list[int], Array, Array]]) -> tuple[Array, Array]:
    """Mean and covariance of a batch with more rows `A x - b` (2, ...) on keys, all of them POINT_NOISE."""
    hessian, vector = drive.batch()
    for keys, A, b in added:
        at = columns_of(np.array(keys), drive.keys)
        at = np.concatenate([at[:2], at[-2:]]) if A.shape[1] == 4 else at[:2]
        hessian[np.ix_(at, at)] += A.T @ A / POINT_NOISE**2
        vector[at] += A.T @ b / POINT_NOISE**2
    return np.linalg.solve(hessian, vector), np.linalg.inv(hessian)


L = control_keys(0, np.arange(12)).tolist()
APART = np.concatenate([-np.eye(2), np.eye(2)], axis=1)


@pytest.mark.parametrize("back", [False, True])
def test_factors_on_the_map_and_the_calibration_are_full_batch(back: bool) -> None:
    """Points are active, inactive and active again, and a pose is marginalized."""
    rng = np.random.default_rng(4)
    drive, b = LinearDrive(2), rng.normal(size=(6, 2)) * 8.0
    given = {
        2: [(point_prior(1, b[0]), ([L[1]], np.eye(2), b[0]))],
        3: [(point_between(2, 4, b[1]), ([L[2], L[4]], APART, b[1]))],
        4: [(calibration_prior(b[2]), ([CALIBRATION_KEY], np.eye(2), b[2]))],
        5: [(gnss(5, b[3], POINT_NOISE), ([pose_key(5)], np.eye(2), b[3]))],
        6: [(pose_to_point(6, 3, b[4]), ([pose_key(6), L[3]], APART, b[4]))],
        7: [(point_between(6, 7, b[5]), ([L[6], L[7]], APART, b[5]))],
    }
    leaving, added = {4: 2, 7: 3, 8: 5, 11: 7}, []
    for cycle in range(15):
        own = given.get(cycle, [])
        drive.smoother.add_factors([factor for factor, _ in own])
        added += [rows for _, rows in own]
        drive.drive(1)
        if cycle in leaving:
            drive.deactivate(leaving[cycle])
        if back and cycle in (6, 10):
            drive.smoother.reactivate()
        mean, covariance = with_rows(drive, added)
        active = drive.smoother.layout.keys
        expected = mean[columns_of(active, drive.keys)]
        np.testing.assert_allclose(drive.smoother.variables.of(active), expected, atol=1e-7)
    keys = drive.smoother.variables.keys
    at = columns_of(keys, drive.keys)
    np.testing.assert_allclose(
        drive.smoother.covariance(keys), covariance[np.ix_(at, at)], atol=1e-8 * covariance.max()
    )
    np.testing.assert_allclose(drive.smoother.variables.of(keys), mean[at], atol=1e-7)
    assert len(drive.smoother.inactive) > 0


def test_a_factor_on_an_inactive_point_brings_the_map_back() -> None:
    drive, at = LinearDrive(2), np.array([3.0, -9.0])
    drive.drive(7)
    drive.deactivate(3)
    drive.drive(1)
    drive.smoother.add_factors([point_prior(1, at)])
    assert len(drive.smoother.inactive) == 0
    drive.drive(1)
    mean, _ = with_rows(drive, [([L[1]], np.eye(2), at)])
    keys = drive.smoother.variables.keys
    np.testing.assert_allclose(drive.smoother.variables.values, mean[columns_of(keys, drive.keys)], atol=1e-7)


def surveyed(cycle: int, label: int, aside: float) -> tuple[FixedLagMapper, Array]:
    """A lap and a half with a control point said to be so far aside at a cycle; its place at that time."""
    log = lap_log(bean_track(), overrun=45.0)
    mapper, place = FixedLagMapper(MapperSettings(), ODOMETRY_SIGMA), np.zeros(2)
    for k, (odometry, cycle_now) in enumerate(split_odometry(log)):
        factors: list[gtsam.NonlinearFactor] = []
        if k == cycle:
            points, keys = mapper.control_points(label), mapper.control_keys(label)
            j = len(keys) - 5
            along = points[j + 1] - points[j - 1]
            outwards = np.array([along[1], -along[0]]) / np.hypot(*along)
            place = points[j].copy()
            noise = gtsam.noiseModel.Isotropic.Sigma(2, 0.02)
            factors = [gtsam.PriorFactorPoint2(keys[j], place + aside * outwards, noise)] if aside else []
        mapper.update(odometry, cycle_now, factors)
    return mapper, place


def nearest(mapper: FixedLagMapper, label: int, place: Array) -> Array:
    """Of the curve to a place."""
    spline = mapper.map().boundaries[label].spline
    points = spline.evaluate(np.linspace(*spline.domain, 2000))
    return np.asarray(points[np.argmin(np.hypot(*(points - place).T))])


@pytest.mark.slow
def test_a_surveyed_point_pulls_after_it_has_become_inactive_and_the_loop_has_closed() -> None:
    """The detections contradict the factor: the curve moves part of the way."""
    with_factor, place = surveyed(60, RIGHT, 0.5)
    without, _ = surveyed(60, RIGHT, 0.0)
    assert without.closed and with_factor.closed
    away = np.hypot(*(nearest(with_factor, RIGHT, place) - nearest(without, RIGHT, place)))
    assert 0.1 < away < 0.6


@pytest.mark.parametrize(
    ("key", "name"),
    [(gtsam.symbol("r", 999), "r999"), (gtsam.symbol("b", 1), "b1"), (gtsam.symbol("m", 0), "m0")],
)
def test_a_key_that_is_no_variable_of_the_map_is_named_and_nothing_is_done(key: int, name: str) -> None:
    drive = LinearDrive(2)
    drive.drive(8)
    drive.deactivate(2)
    before = drive.smoother.variables.copy()
    wrong = gtsam.PriorFactorPoint2(key, np.zeros(2), gtsam.noiseModel.Isotropic.Sigma(2, 1.0))
    with pytest.raises(SettingsError, match=f"row 2: expected keys of .*control points.*found {name}"):
        drive.smoother.check_factors([gnss(8, np.zeros(2), 1.0), point_prior(0, np.zeros(2)), wrong])
    np.testing.assert_array_equal(drive.smoother.variables.values, before.values)
    assert drive.smoother.user_factors.factors == []
    assert len(drive.smoother.inactive) == 1


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
    before = mapper.road.smoother.variables.copy()
    noise = gtsam.noiseModel.Isotropic.Sigma(3, 0.1)
    wrong = gtsam.PriorFactorPose2(key, gtsam.Pose2(), noise)
    with pytest.raises(SettingsError, match=rf"row 1: expected keys .* x21 to x30.* found {name}$"):
        mapper.update(*pairs[30], [gnss(30, np.zeros(2), 0.1), wrong])
    np.testing.assert_array_equal(mapper.road.smoother.variables.values, before.values)
    np.testing.assert_array_equal(mapper.road.smoother.variables.keys, before.keys)
    assert len(mapper.road.smoother.user_factors.factors) == 0
    assert mapper.next_pose_key == pose_key(30)
    mapper.update(*pairs[30], [gnss(21, np.zeros(2), 10.0), gnss(30, np.zeros(2), 10.0)])
