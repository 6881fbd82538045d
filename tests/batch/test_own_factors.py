"""The user's own factors in a batch: they are part of the optimum, of its information and of its graph."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.batch.mapper import BatchMapper, BatchResult
from pathspace_graph.batch.system import OwnFactors
from pathspace_graph.errors import SettingsError
from pathspace_graph.factors.gtsam_factors import boundary_point_factor
from pathspace_graph.factors.noise import KnownNoise
from pathspace_graph.factors.se2 import left_of
from pathspace_graph.graph.variables import CALIBRATION_KEY, control_keys, pose_key
from pathspace_graph.io.log import Log
from pathspace_graph.labels import LEFT
from pathspace_graph.mapping.state import State
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.run import run_online
from pathspace_graph.settings.mapper import MapperSettings

from ..scenes.drives import bean_track, lap_log, noisy, true_poses

Array = NDArray[np.float64]

HEADING = gtsam.noiseModel.Diagonal.Sigmas(np.array([1e3, 1e3, 1e-3]))
"""Noise of a compass, in the tangent space of `Pose2`."""


@cache
def log() -> Log:
    return noisy(lap_log(bean_track(), overrun=25.0), seed=3)


def compass() -> list[gtsam.NonlinearFactor]:
    """Return the true heading of each pose; where it is does not count."""
    poses = enumerate(true_poses(log()))
    return [gtsam.PriorFactorPose2(pose_key(k), gtsam.Pose2(*pose), HEADING) for k, pose in poses]


@cache
def solved(*, with_compass: bool) -> BatchResult:
    factors = compass() if with_compass else []
    return BatchMapper(None, log().noise).solve(log(), "odometry", factors=factors)


def test_a_compass_holds_the_heading_of_every_pose() -> None:
    off = [solved(with_compass=w).trajectory[:, 2] - true_poses(log())[:, 2] for w in (False, True)]
    errors = [float(np.sqrt(np.mean(np.arctan2(np.sin(one), np.cos(one)) ** 2))) for one in off]
    assert errors[1] < 5e-4 < errors[0]
    for w in (False, True):
        assert solved(with_compass=w).converged
    sigmas = [np.sqrt(solved(with_compass=w).pose_covariances[:, 2, 2]) for w in (False, True)]
    assert sigmas[1].max() < 1e-3 < np.median(sigmas[0])


def test_the_graph_has_them_and_is_at_its_optimum() -> None:
    result = solved(with_compass=True)
    assert gradient_sigmas(result) < 1.0
    assert result.graph().size() == solved(with_compass=False).graph().size() + len(log().cycles)


def test_a_factor_on_a_calibration_holds_it() -> None:
    known = np.array([0.05, 0.01])
    held = gtsam.PriorFactorPoint2(CALIBRATION_KEY, known, gtsam.noiseModel.Isotropic.Sigma(2, 1e-6))
    result = BatchMapper(None, log().noise).solve(log(), "odometry", factors=[held])
    np.testing.assert_allclose(result.calibration, known, atol=1e-4)


@pytest.mark.parametrize(
    ("key", "name"), [(int(control_keys(0, np.array([3]))[0]), "l3"), (pose_key(10**6), "x1000000")]
)
def test_another_key_is_named_before_anything_is_solved(key: int, name: str) -> None:
    other = gtsam.PriorFactorPoint2(key, np.zeros(2), gtsam.noiseModel.Unit.Create(2))
    with pytest.raises(SettingsError, match=rf"row 1: expected keys of poses, x0 to .*found {name}"):
        BatchMapper(None, log().noise).solve(log(), factors=[compass()[0], other])


# --- on control points -----------------------------------------------------------------------------------

ASIDE = 0.4  # of a surveyed point from the left curve (m)


@cache
def point() -> Array:
    """Return a point (1, 2) beside the left curve of the batch without factors, which the curve must pass."""
    state, u = solved(with_compass=False).optimum.state, np.array([30.0])
    boundary, points = state.boundaries[LEFT], state.control_points(LEFT)
    tangent = boundary.evaluate(points, u, 1)
    return np.asarray(boundary.evaluate(points, u) + ASIDE * left_of(tangent) / np.hypot(*tangent.T))


def survey(state: State) -> list[gtsam.NonlinearFactor]:
    """Return the factor of a surveyed point on the left curve of a state, as an online mapper takes it."""
    boundary, points = state.boundaries[LEFT], state.control_points(LEFT)
    u = boundary.find_anywhere(points, point()).u
    near = {"low": u - 4.0, "high": u + 4.0, "sigma": np.array([0.01])}
    return [boundary_point_factor(state.control_keys(LEFT), boundary.tables, points_map=point(), **near)]


def off_left(state: State) -> float:
    boundary = state.boundaries[LEFT]
    return float(np.abs(boundary.find_anywhere(state.control_points(LEFT), point()).distance[0]))


def solve(factors: OwnFactors) -> BatchResult:
    return BatchMapper(None, log().noise).solve(log(), "odometry", factors=factors)


def gradient_sigmas(result: BatchResult) -> float:
    """Return the length of a step by the exported graph, in sigmas of all variables together."""
    linear = result.graph().linearize(result.values())
    hessian, gradient = linear.hessian(result.optimum.state.variables.layout.ordering)
    step = np.linalg.solve(hessian, gradient)
    return float(np.sqrt(step @ hessian @ step))


def test_a_factor_on_control_points_is_made_again_on_new_knots_and_moves_the_curve() -> None:
    sizes = set[int]()

    def counted(state: State) -> list[gtsam.NonlinearFactor]:
        sizes.add(state.boundaries[LEFT].size)
        return survey(state)

    free, held = solved(with_compass=False), solve(counted)
    assert len(sizes) > 1, "the curves have had other knots"
    assert off_left(free.optimum.state) > 0.9 * ASIDE and held.converged
    assert off_left(held.optimum.state) < 0.02
    count, cost = held.own_factors
    assert count == 1 and 0.0 < cost < 5.0
    assert gradient_sigmas(held) < 1.0


def test_the_error_of_a_robust_factor_counts_as_gtsam_weighs_it() -> None:
    """Far from its measurement the loss of Huber is linear, less than half the square of the whitened row."""
    pose, sigma, k = gtsam.Pose2(50.0, 0.0, 0.0), 0.1, 1.345
    noise = gtsam.noiseModel.Isotropic.Sigma(3, sigma)
    robust = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(k), noise)
    result = solve([gtsam.PriorFactorPose2(pose_key(0), pose, robust)])
    state = result.optimum.state
    whitened = float(np.linalg.norm(pose.localCoordinates(gtsam.Pose2(*state.poses[0])) / sigma))
    assert whitened > 100.0
    np.testing.assert_allclose(result.own_factors[1], k * (whitened - 0.5 * k), rtol=1e-9)
    assert result.converged and gradient_sigmas(result) < 1.0
    system = result.system
    assert result.optimum.cost - system.evaluate(state).cost == pytest.approx(0.0, abs=1e-3)


def constant(key: int) -> gtsam.NonlinearFactor:
    def error(_: gtsam.CustomFactor, values: gtsam.Values, H: list[Array] | None) -> Array:
        if H is not None:
            H[0] = np.zeros((1, 3), order="F")
        return np.ones(1)

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(1), [key], error)


def with_a_wrong_type(state: State) -> list[gtsam.NonlinearFactor]:
    noise = gtsam.noiseModel.Unit.Create(3)
    return [*survey(state), gtsam.PriorFactorPose2(int(state.control_keys(LEFT)[0]), gtsam.Pose2(), noise)]


@pytest.mark.parametrize(
    ("factors", "told"),
    [
        (
            [constant(pose_key(3))],
            "row 0: expected a residual that depends on its variables, found Jacobians",
        ),
        ([constant(pose_key(3)), gtsam.CustomFactor()], "row 1: expected keys of .*found no key"),
        (with_a_wrong_type, "row 1: expected a factor that can be linearized, found "),
        (lambda _: [compass()[0], 7], "row 1: expected a gtsam.NonlinearFactor, found int"),
    ],
)
def test_a_factor_that_says_nothing_or_is_none_is_an_error(factors: OwnFactors, told: str) -> None:
    with pytest.raises(SettingsError, match=told):
        solve(factors)


# --- as online -------------------------------------------------------------------------------------------


class Sensors:
    """A compass, and a receiver of positions each fifth cycle, for an online mapper and a batch alike."""

    def factors(self, log: Log) -> list[gtsam.NonlinearFactor]:
        rng, found = np.random.default_rng(1), list[gtsam.NonlinearFactor]()
        noise = gtsam.noiseModel.Isotropic.Sigma(2, 0.1)
        for k, pose in enumerate(true_poses(log)):
            turned = gtsam.Pose2(*pose[:2], pose[2] + 1e-2 * rng.normal())
            found.append(gtsam.PriorFactorPose2(pose_key(k), turned, HEADING))
            if k % 5 == 0:
                place = gtsam.Pose2(*(pose[:2] + 0.1 * rng.normal(size=2)), 0.0)
                found.append(gtsam.PoseTranslationPrior2D(pose_key(k), place, noise))
        return found


class OwnOnline(Sensors, FixedLagMapper):
    pass


class OwnBatch(Sensors, BatchMapper):
    pass


def test_without_cones_the_window_of_all_cycles_and_the_batch_are_one_optimum() -> None:
    """So is GTSAM's own, from the exported graph alone."""
    blind = tuple(cycle.where(np.zeros(len(cycle.labels), bool)) for cycle in log().cycles)
    drive = replace(log(), cycles=blind)
    settings = MapperSettings(lag=1e3, max_poses=1000, steps=4)
    noise = KnownNoise(drive.odometry_sigma, drift=np.zeros(3))
    online, batch = OwnOnline(settings, noise), OwnBatch(settings, noise)
    run_online(drive, online)
    result = batch.solve(drive, "odometry")
    assert result.own_factors[0] == len(batch.factors(drive)) and len(online.poses) == len(drive.cycles)
    off_truth = np.abs(result.trajectory - true_poses(drive))[:, :2].max()
    assert 0.01 < off_truth < 0.5
    np.testing.assert_allclose(online.poses, result.trajectory, atol=1e-6)
    found = gtsam.LevenbergMarquardtOptimizer(result.graph(), result.values()).optimize()
    poses = [found.atPose2(pose_key(k)) for k in range(len(drive.cycles))]
    np.testing.assert_allclose([[p.x(), p.y()] for p in poses], result.trajectory[:, :2], atol=1e-5)
    assert gradient_sigmas(result) < 1e-3


def test_both_improve_alike_on_a_lap() -> None:
    """Huber's weights and few knots online, Tukey's and many in the batch: the optima are near."""
    online = OwnOnline(None, log().noise)
    run = run_online(log(), online)
    result = OwnBatch(None, log().noise, OwnOnline).solve(log())
    assert online.closed and run.smoothed is not None
    assert np.hypot(*(run.smoothed - result.trajectory)[:, :2].T).max() < 0.05
