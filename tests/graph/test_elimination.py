"""A linear problem of poses and a map: its solution and covariances against dense algebra."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pathspace_graph.errors import SingularSystemError
from pathspace_graph.factors.arrays import Array
from pathspace_graph.graph.elimination import (
    Elimination,
    bayes_net,
    fix_map,
    linear_graph,
    owners,
    solution,
    step_by,
)
from pathspace_graph.graph.gaussian import cholesky
from pathspace_graph.graph.rows import Rows
from pathspace_graph.graph.variables import (
    CALIBRATION_KEY,
    POINT,
    POSE,
    Layout,
    Variables,
    are_poses,
    landmark_keys,
    pose_key,
    pose_keys,
)

SIZES = (st.integers(0, 1000), st.integers(1, 40), st.integers(1, 6))


def random_variables(rng: np.random.Generator, poses: int, points: int) -> Variables:
    """Returns values that differ from their references."""
    variables = Variables()
    variables.insert(np.array([CALIBRATION_KEY]), rng.normal(size=2))
    variables.insert(landmark_keys(np.arange(points)), rng.normal(size=POINT * points))
    variables.insert(pose_keys(np.arange(poses)), rng.normal(size=POSE * poses))
    variables.values = variables.values + rng.normal(size=variables.layout.size)
    return variables


def random_rows(rng: np.random.Generator, poses: int, points: int) -> list[Rows]:
    """Returns odometry with a calibration, detections of landmarks from each pose, and priors of points."""
    start = np.repeat(np.arange(poses - 1), POSE)
    shared = np.full(len(start), CALIBRATION_KEY)
    between = np.column_stack([shared, pose_keys(start), pose_keys(start + 1)])
    seer = np.repeat(np.arange(poses), 2 * POINT)
    seen = landmark_keys(rng.integers(points, size=len(seer)))
    every = np.append(CALIBRATION_KEY, landmark_keys(np.arange(points))).repeat(POINT)
    eye = np.tile(np.eye(POINT), (points + 1, 1))
    return [
        Rows(between, rng.normal(size=(len(start), 8)), rng.normal(size=len(start)), owners(start)),
        Rows(
            np.column_stack([seen, pose_keys(seer)]),
            rng.normal(size=(len(seer), 5)),
            rng.normal(size=len(seer)),
            owners(seer, 1),
        ),
        Rows(np.full((3, 1), pose_key(0)), np.eye(3), rng.normal(size=3), np.zeros(3, np.intp)),
        Rows(every[:, None], eye, rng.normal(size=len(every)), -1 - np.arange(len(every)) // 4),
    ]


def dense(groups: list[Rows], layout: Layout) -> tuple[Array, Array]:
    """`J' J` and `-J' r`."""
    size = layout.size
    matrix, right = np.zeros((size, size)), np.zeros(size)
    for rows in filter(len, groups):
        J = np.zeros((len(rows), size))
        np.put_along_axis(J, rows.columns(layout), rows.jacobian, axis=1)
        matrix += J.T @ J
        right -= J.T @ rows.residual
    return matrix, right


def scene(seed: int, poses: int, points: int) -> tuple[Elimination, Array, Array]:
    """Returns a problem, and its dense normal equations."""
    rng = np.random.default_rng(seed)
    variables, groups = random_variables(rng, poses, points), random_rows(rng, poses, points)
    problem = Elimination(linear_graph(groups, variables), variables.layout)
    return problem, *dense(groups, variables.layout)


@given(*SIZES)
def test_the_solution_is_that_of_the_dense_system(seed: int, poses: int, points: int) -> None:
    """The solution is a change from the values, whatever the references are."""
    rng = np.random.default_rng(seed)
    variables, groups = random_variables(rng, poses, points), random_rows(rng, poses, points)
    matrix, right = dense(groups, variables.layout)
    found = solution(linear_graph(groups, variables), variables.layout)
    np.testing.assert_allclose(found, np.linalg.solve(matrix, right), atol=1e-7)


@given(*SIZES)
def test_a_step_has_the_gradient_of_its_rows_and_the_information_of_a_net(
    seed: int, poses: int, points: int
) -> None:
    """The net of other rows on the same variables gives a step of its own information."""
    rng = np.random.default_rng(seed)
    variables, groups = random_variables(rng, poses, points), random_rows(rng, poses, points)
    others = random_rows(rng, poses, points)
    _, right = dense(groups, variables.layout)
    for held in (groups, others):
        matrix, _ = dense(held, variables.layout)
        net = bayes_net(linear_graph(held, variables), variables.layout)
        step, decrease = step_by(net, groups, variables.layout)
        expected = np.linalg.solve(matrix, right)
        np.testing.assert_allclose(step, expected, atol=1e-6)
        assert decrease == pytest.approx(0.5 * right @ expected, rel=1e-6)


def test_the_order_of_the_second_try_gives_the_same_solution(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is taken where GTSAM finds a pose free in its own order."""
    orders, eliminate = list[gtsam.Ordering](), gtsam.GaussianFactorGraph.eliminatePartialMultifrontal

    def free_at_first(graph: gtsam.GaussianFactorGraph, order: gtsam.Ordering) -> object:
        orders.append(order)
        if len(orders) == 1:
            raise RuntimeError
        return eliminate(graph, order)

    rng = np.random.default_rng(5)
    variables, groups = random_variables(rng, 30, 5), random_rows(rng, 30, 5)
    graph = linear_graph(groups, variables)
    expected = solution(graph, variables.layout)
    monkeypatch.setattr(gtsam.GaussianFactorGraph, "eliminatePartialMultifrontal", free_at_first)
    np.testing.assert_allclose(solution(graph, variables.layout), expected, atol=1e-9)
    first, second = ([order.at(k) for k in range(order.size())] for order in orders)
    assert second == sorted(first, reverse=True)


def test_poses_given_a_fixed_map() -> None:
    rng = np.random.default_rng(4)
    variables, groups = random_variables(rng, 30, 5), random_rows(rng, 30, 5)
    matrix, right = dense(groups, variables.layout)
    poses = Layout(variables.keys[are_poses(variables.keys)])
    n = variables.layout.size - poses.size
    graph = linear_graph(fix_map(groups), variables)
    np.testing.assert_allclose(solution(graph, poses), np.linalg.solve(matrix[n:, n:], right[n:]), atol=1e-9)
    last = np.linalg.inv(matrix[n:, n:])[-POSE:, -POSE:]
    np.testing.assert_allclose(Elimination(graph, poses).pose_marginals[-1], last, atol=1e-9)


@given(*SIZES)
def test_covariances_are_blocks_of_the_dense_inverse(seed: int, poses: int, points: int) -> None:
    problem, matrix, _ = scene(seed, poses, points)
    inverse, n = np.linalg.inv(matrix), problem.map.size
    close = {"rtol": 1e-6, "atol": 1e-7}
    np.testing.assert_allclose(problem.map_covariance, inverse[:n, :n], **close)
    np.testing.assert_allclose(problem.cross_covariance, inverse[n:, :n], **close)
    for k, marginal in enumerate(problem.pose_marginals):
        block = slice(n + POSE * k, n + POSE * (k + 1))
        np.testing.assert_allclose(marginal, inverse[block, block], **close)


def test_the_joint_covariance_has_the_order_that_is_asked_for() -> None:
    problem, matrix, _ = scene(5, 12, 4)
    inverse, keys = np.linalg.inv(matrix), landmark_keys(np.array([2, 0]))
    entries = [6, 7, 2, 3]
    np.testing.assert_allclose(problem.joint(keys), inverse[np.ix_(entries, entries)], atol=1e-9)


def test_undetermined_poses_are_singular() -> None:
    rng = np.random.default_rng(6)
    variables = random_variables(rng, 10, 3)
    odometry, _, _, points = random_rows(rng, 10, 3)
    odometry.jacobian[:] = np.tile(np.column_stack([np.zeros((3, 2)), -np.eye(3), np.eye(3)]), (9, 1))
    with pytest.raises(SingularSystemError, match="poses"):
        Elimination(linear_graph([odometry, points], variables), variables.layout)


def test_an_undetermined_map_is_singular() -> None:
    rng = np.random.default_rng(7)
    variables = random_variables(rng, 10, 3)
    odometry, detections, first, points = random_rows(rng, 10, 3)
    detections.jacobian[:, :POINT] = 0.0
    on_calibration = points.where(points.keys[:, 0] == CALIBRATION_KEY)
    graph = linear_graph([odometry, detections, first, on_calibration], variables)
    with pytest.raises(SingularSystemError, match="free"):
        solution(graph, variables.layout)
    with pytest.raises(SingularSystemError, match="positive definite"):
        _ = Elimination(graph, variables.layout).map_covariance


def test_a_variable_that_no_factor_holds_is_named() -> None:
    """GTSAM's `hessian` would give a smaller matrix without an error."""
    rng = np.random.default_rng(8)
    variables, groups = random_variables(rng, 10, 3), random_rows(rng, 10, 3)
    graph = linear_graph(groups, variables)
    for key, name in ((landmark_keys(np.array([9])), "m9"), (pose_keys(np.array([10])), "x10")):
        wider = Layout(np.sort(np.append(variables.keys, key)))
        for answer in (solution, Elimination):
            with pytest.raises(SingularSystemError, match=name):
                answer(graph, wider)
    smaller, _ = graph.hessian(gtsam.Ordering(variables.keys.tolist()))
    assert len(smaller) == variables.layout.size


def test_covariances_outlive_what_gtsam_made_them_of() -> None:
    """`R()` and `S()` are views of memory that their factor frees."""
    problem, matrix, _ = scene(9, 40, 6)
    roots = [root for _, _, _, root, _, _ in problem._cliques()]
    del problem
    scene(10, 40, 6)
    assert all(np.isfinite(root).all() for root in roots)
    log_determinant = -2.0 * sum(np.log(np.abs(np.diagonal(root))).sum() for root in roots)
    poses = matrix[POINT * 7 :, POINT * 7 :]
    np.testing.assert_allclose(log_determinant, np.linalg.slogdet(poses)[1])


def test_cholesky_raises() -> None:
    np.testing.assert_allclose(np.tril(cholesky(np.diag([4.0, 9.0]))), np.diag([2.0, 3.0]))
    with pytest.raises(SingularSystemError):
        cholesky(np.diag([1.0, 0.0]))
