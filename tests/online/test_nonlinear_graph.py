"""The window as GTSAM has it: the mapper's own system, and what GTSAM's own classes make of it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.errors import SettingsError
from pathspace_graph.factors.se2 import rotation
from pathspace_graph.graph.gaussian import graph_of, jacobian_factor, normal_equations
from pathspace_graph.graph.variables import Layout, are_poses, control_keys, pose_key
from pathspace_graph.graph.window import as_nonlinear
from pathspace_graph.io.log import Log
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.mapping import smoother as curve_smoother
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.run import split_odometry
from pathspace_graph.settings.mapper import MapperSettings, RelinearizeSettings, SplineSettings

from ..scenes.drives import bean_track, lap_log
from ..scenes.graph import KEYS, POSE_KEYS, pose_columns, random_factor, random_variables

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]

EXACT = RelinearizeSettings(1e-12, 1e-12)
"""Foot points are those of the last step then."""
EAGER = 5.0, 3.0
"""Stretch and room (m) with which parts of the map become inactive early and often."""


@pytest.fixture(scope="module")
def log() -> Log:
    """Two laps, the readings of which are 0.05 m off."""
    exact, rng = lap_log(bean_track(), overrun=100.0), np.random.default_rng(0)
    for cycle in exact.cycles:
        cycle.points_vehicle[:] += 0.05 * rng.normal(size=cycle.points_vehicle.shape)
    return exact


def driven(
    log: Log,
    cycles: int,
    settings: MapperSettings,
    factors: bool = False,
    far: tuple[float, float] = EAGER,
) -> FixedLagMapper:
    """A mapper after some cycles; `factors`: with a position and a surveyed point of its own."""
    mapper = FixedLagMapper(settings, log.odometry_sigma)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(curve_smoother, "FAR_STRETCH", far[0])
        patch.setattr(curve_smoother, "FAR_ROOM", far[1])
        for k, (odometry, cycle) in zip(range(cycles), split_odometry(log), strict=False):
            mapper.update(odometry, cycle, own_factors(mapper) if factors and k == cycles - 5 else ())
    return mapper


def own_factors(mapper: FixedLagMapper) -> Sequence[gtsam.NonlinearFactor]:
    noise, key = gtsam.noiseModel.Isotropic.Sigma(2, 0.3), mapper.control_keys(RIGHT)[-3]
    pose = mapper.poses[-1]
    return [
        gtsam.PoseTranslationPrior2D(mapper.next_pose_key, gtsam.Pose2(pose[0] + 0.8, pose[1], 0.0), noise),
        gtsam.PriorFactorPoint2(key, mapper.control_points(RIGHT)[-3] + 0.1, noise),
    ]


@pytest.fixture(
    scope="module",
    params=[(20, "all"), (90, "parts"), (90, "factors"), (240, "closed"), (240, "closed, all")],
    ids=lambda case: f"{case[1]} at {case[0]}",
)
def mapper(request: pytest.FixtureRequest, log: Log) -> FixedLagMapper:
    """In lap 1 all active, in parts, with factors of the user's; after closing in parts, and all active."""
    cycles, case = request.param
    far = (1e4, 1e4) if case.endswith("all") else EAGER
    found = driven(log, cycles, MapperSettings(relinearize=EXACT), case == "factors", far)
    assert found.closed == case.startswith("closed")
    assert (len(found.road.smoother.inactive) > 0) == (not case.endswith("all"))
    return found


def turned(mapper: FixedLagMapper) -> Array:
    """Block-diagonal T (n, n) from the tangents of `gtsam.Pose2` to our unknowns, on the window's columns."""
    keys = mapper.road.smoother.layout.keys
    matrix = np.eye(mapper.road.smoother.layout.size)
    for key, x in pose_columns(keys):
        theta = mapper.road.smoother.variables.of(np.array([key]))[2]
        matrix[x : x + 2, x : x + 2] = rotation(theta)
    return matrix


def own_system(mapper: FixedLagMapper) -> tuple[Array, Array]:
    """Hessian and negative gradient of the engine's graph at the estimate, in GTSAM's tangents."""
    smoother = mapper.road.smoother
    hessian, vector = normal_equations(smoother.linear_graph(), smoother.layout)
    entries = smoother.variables.layout.entries(smoother.layout.keys)
    T = turned(mapper)
    return T.T @ hessian @ T, T.T @ (vector - hessian @ smoother.variables.change(entries))


def test_its_linearization_is_the_mapper_s_own_system(mapper: FixedLagMapper) -> None:
    hessian, negative_gradient = own_system(mapper)
    linear = mapper.graph().linearize(mapper.values())
    found, found_descent = linear.hessian(mapper.road.smoother.layout.ordering)
    np.testing.assert_allclose(found, hessian, atol=1e-8 * np.abs(hessian).max())
    np.testing.assert_allclose(found_descent, negative_gradient, atol=1e-7 * np.abs(hessian).max())
    largest = np.sqrt(np.outer(np.diag(hessian), np.diag(hessian)))
    assert (np.abs(found - hessian) <= 3e-5 * largest).all()  # foot points differ by as much


def test_its_values_are_the_active_variables(mapper: FixedLagMapper) -> None:
    values, layout = mapper.values(), mapper.road.smoother.layout
    assert list(values.keys()) == layout.keys.tolist()
    assert list(mapper.graph().keyVector()) == layout.keys.tolist()
    newest = values.atPose2(mapper.pose_key(mapper.road.smoother.next_cycle - 1))
    np.testing.assert_allclose([newest.x(), newest.y()], mapper.poses[-1, :2])


def test_every_factor_has_an_error(mapper: FixedLagMapper) -> None:
    graph, values = mapper.graph(), mapper.values()
    errors = np.array([graph.at(i).error(values) for i in range(graph.size())])
    assert np.isfinite(errors).all() and (errors >= 0.0).all()
    assert graph.error(values) == pytest.approx(errors.sum())


def test_levenberg_marquardt_stays_where_the_mapper_is(mapper: FixedLagMapper) -> None:
    """It finds the optimum that the window was near: a few centimetres off, no more."""
    graph, values = mapper.graph(), mapper.values()
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values)
    found = optimizer.optimize()
    assert optimizer.error() <= graph.error(values)
    assert optimizer.iterations() < 50
    for cycle in range(mapper.road.smoother.first_cycle, mapper.road.smoother.next_cycle):
        before, after = (one.atPose2(pose_key(cycle)) for one in (values, found))
        assert np.hypot(after.x() - before.x(), after.y() - before.y()) < 0.3
        assert abs(after.theta() - before.theta()) < 0.05


def test_gtsam_s_marginals_are_the_mapper_s(mapper: FixedLagMapper) -> None:
    """Of the newest and the oldest pose, of an active control point and of the calibration."""
    marginals = gtsam.Marginals(mapper.graph(), mapper.values())
    smoother = mapper.road.smoother
    points = smoother.layout.keys[~are_poses(smoother.layout.keys)]
    poses = [pose_key(smoother.next_cycle - 1), pose_key(smoother.first_cycle)]
    for key in (*poses, int(points[0]), int(points[len(points) // 2])):
        expected = mapper.marginal_covariance([key])
        found = np.array(marginals.marginalCovariance(key))
        if are_poses(np.array(key)):
            T = np.eye(3)
            T[:2, :2] = rotation(smoother.variables.of(np.array([key]))[2])
            found = T @ found @ T.T
        size = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
        assert (np.abs(found - expected) <= 1e-3 * size).all()


def test_it_can_be_printed_and_drawn(
    mapper: FixedLagMapper, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    graph, values = mapper.graph(), mapper.values()
    graph.printErrors(values)
    assert f"x{mapper.road.smoother.first_cycle}" in capfd.readouterr().out
    graph.saveGraph(str(tmp_path / "window.dot"), values)
    text = (tmp_path / "window.dot").read_text()
    assert f"x{mapper.road.smoother.next_cycle - 1}" in text and text.rstrip().endswith("}")


def test_it_shares_nothing_with_the_mapper(log: Log) -> None:
    """Its error at the old values is the same after the mapper has driven on."""
    pairs = list(split_odometry(log))
    mapper = driven(log, 60, MapperSettings())
    graph, values = mapper.graph(), mapper.values()
    before = graph.error(values)
    for odometry, cycle in pairs[60:80]:
        mapper.update(odometry, cycle)
    assert graph.error(values) == before


@pytest.mark.parametrize("degree", [2, 4])
def test_it_is_the_mapper_s_system_for_other_degrees(log: Log, degree: int) -> None:
    settings = MapperSettings(spline=SplineSettings(degree=degree))
    mapper = driven(log, 60, settings)
    assert {LEFT, RIGHT} == set(mapper.boundaries)
    hessian, _ = own_system(mapper)
    found, _ = mapper.graph().linearize(mapper.values()).hessian(mapper.road.smoother.layout.ordering)
    np.testing.assert_allclose(found, hessian, atol=1e-8 * np.abs(hessian).max())


@pytest.mark.parametrize("rows", [4, 40])
def test_a_linear_factor_on_our_unknowns_is_one_of_a_nonlinear_graph(rows: int) -> None:
    """In the tangents of GTSAM's poses, away from the references; of less rank than columns, and of full."""
    rng = np.random.default_rng(rows)
    variables = random_variables(rng)
    factor, A, b = random_factor(rng, KEYS, rows)
    graph = gtsam.NonlinearFactorGraph()
    graph.add(as_nonlinear(factor, variables))
    values = variables.gtsam_values(KEYS)
    found, found_descent = graph.linearize(values).hessian(variables.layout.ordering)
    T = np.eye(variables.layout.size)
    for key, x in pose_columns(KEYS):
        T[x : x + 2, x : x + 2] = rotation(variables.of(np.array([key]))[2])
    d = variables.values - variables.reference
    np.testing.assert_allclose(found, T.T @ A.T @ A @ T, atol=1e-9 * np.abs(found).max())
    np.testing.assert_allclose(found_descent, T.T @ A.T @ (b - A @ d), atol=1e-9 * np.abs(found).max())


def test_the_error_of_such_a_factor_is_that_of_its_rows_to_a_constant() -> None:
    """At other values too, where no heading has changed: an optimizer judges its steps by it."""
    rng = np.random.default_rng(0)
    variables = random_variables(rng)
    factor, A, b = random_factor(rng, KEYS, 60)
    layout = Layout(KEYS)
    hessian, vector = normal_equations(graph_of(jacobian_factor(KEYS, A, b)), layout)
    nonlinear, differences = as_nonlinear(factor, variables), []
    x = variables.values.copy()
    for _ in range(4):
        variables.values[:] = x + 0.3 * rng.normal(size=layout.size)
        variables.values[layout.entries(POSE_KEYS)[2::3]] = x[layout.entries(POSE_KEYS)[2::3]]
        d = variables.values - variables.reference
        own = 0.5 * d @ hessian @ d - vector @ d
        differences.append(nonlinear.error(variables.gtsam_values(KEYS)) - own)
    np.testing.assert_allclose(differences, differences[0], rtol=1e-9)
    assert control_keys(0, np.array(0)) in list(nonlinear.keys())


def test_the_covariance_of_what_is_no_variable_is_refused(log: Log) -> None:
    mapper = driven(log, 60, MapperSettings())
    gone = pose_key(0)
    beyond = int(control_keys(LEFT, np.array([10_000]))[0])
    for key, text in ((gone, "x0"), (beyond, "l10000")):
        with pytest.raises(SettingsError, match=f"covariance of {text}: expected keys of poses"):
            mapper.marginal_covariance([mapper.next_pose_key - 1, key])
