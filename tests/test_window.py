"""The window's normal equations, marginalization and prior, against dense algebra and GTSAM."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.factors.linear_graph import linear_graph, prior_rows, window_keys
from pathspace_graph.window import (
    POSE,
    Prior,
    Rows,
    SingularSystemError,
    accumulate,
    cholesky,
    schur_leave,
    solve,
)

Array = NDArray[np.float64]

MAP = 8
"""Entries of the shared map block in the linear problems (4 control points)."""


def random_rows(rng: np.random.Generator, count: int, width: int, size: int) -> Rows:
    """Rows on `width` different columns each of a state of `size`."""
    columns = np.array([rng.choice(size, width, replace=False) for _ in range(count)])
    return Rows(columns.reshape(count, width), rng.normal(size=(count, width)), rng.normal(size=count))


def dense(groups: list[Rows], size: int) -> tuple[Array, Array]:
    """J (m, size) and r (m,) of all rows; a column met twice in a row counts twice."""
    matrices = []
    for group in groups:
        J = np.zeros((len(group.residual), size))
        np.add.at(J, (np.arange(len(J))[:, None], group.columns), group.jacobian)
        matrices.append(J)
    return np.concatenate(matrices), np.concatenate([g.residual for g in groups])


def test_accumulate_is_the_dense_product() -> None:
    rng = np.random.default_rng(0)
    twice = Rows(np.array([[3, 5, 3]]), rng.normal(size=(1, 3)), rng.normal(size=1))
    empty = Rows(np.zeros((0, 4), np.intp), np.zeros((0, 4)), np.zeros(0))
    groups = [random_rows(rng, 30, 5, 20), empty, random_rows(rng, 10, 3, 20), twice]
    hessian, descent = accumulate(groups, 20)
    J, r = dense(groups, 20)
    np.testing.assert_allclose(hessian, J.T @ J, atol=1e-12)
    np.testing.assert_allclose(descent, -J.T @ r, atol=1e-12)
    np.testing.assert_array_equal(accumulate([empty], 4)[0], np.zeros((4, 4)))


def test_solve_is_least_squares_and_a_free_direction_is_an_error() -> None:
    rng = np.random.default_rng(1)
    groups = [random_rows(rng, 40, 6, 12)]
    hessian, descent = accumulate(groups, 12)
    J, r = dense(groups, 12)
    expected = np.linalg.lstsq(J, -r, rcond=None)[0]
    np.testing.assert_allclose(solve(cholesky(hessian), descent), expected, atol=1e-10)
    with pytest.raises(SingularSystemError, match="pivot 12 "):
        cholesky(np.diag(np.append(np.ones(11), 0.0)))


def test_split_cuts_the_rows_of_a_range_off() -> None:
    columns = np.array([[0, 1], [1, 4], [3, 2], [6, 5]])
    rows = Rows(columns, np.arange(8.0).reshape(4, 2), np.arange(4.0))
    touching, others = rows.split(2, 5)
    assert touching.residual.tolist() == [1.0, 2.0]
    np.testing.assert_array_equal(touching.columns, columns[1:3])
    assert others.residual.tolist() == [0.0, 3.0]
    np.testing.assert_array_equal(others.without(2, 5).columns, [[0, 1], [3, 2]])


def test_schur_leave_is_the_marginal() -> None:
    """Covariance and mean of what stays are those of the joint Gaussian."""
    rng = np.random.default_rng(2)
    hessian, descent = accumulate([random_rows(rng, 60, 6, 17)], 17)
    information, gradient = schur_leave(hessian, descent, 8, 11)
    stay = np.r_[0:8, 11:17]
    covariance = np.linalg.inv(hessian)
    np.testing.assert_allclose(
        np.linalg.inv(information), covariance[np.ix_(stay, stay)], rtol=1e-9, atol=1e-9
    )
    mean = np.linalg.solve(hessian, descent)
    np.testing.assert_allclose(np.linalg.solve(information, gradient), mean[stay], rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(information, information.T)


def test_schur_leave_is_gtsams_marginal() -> None:
    rng = np.random.default_rng(3)
    poses = np.zeros((3, 3))
    size = MAP + POSE * 3
    rows = random_rows(rng, 60, 6, size)
    keys = window_keys((2, 2), 0, poses)
    graph = linear_graph([(rows.columns, rows.jacobian, rows.residual)], keys)
    staying = [k for k in keys.keys if k != gtsam.symbol("x", 0)]
    ordering = gtsam.Ordering()
    for key in staying:
        ordering.push_back(key)
    expected, expected_descent = graph.marginal(gtsam.KeyVector(staying)).hessian(ordering)
    information, gradient = schur_leave(*accumulate([rows], size), MAP, MAP + POSE)
    np.testing.assert_allclose(information, expected, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(gradient, expected_descent, rtol=1e-9, atol=1e-9)


def random_prior(rng: np.random.Generator, size: int) -> Prior:
    root = rng.normal(size=(size + 2, size))
    return Prior(root.T @ root, rng.normal(size=size), rng.normal(size=size))


def test_a_priors_descent_is_the_derivative_of_its_cost() -> None:
    rng = np.random.default_rng(4)
    prior = random_prior(rng, 5)
    state = rng.normal(size=9)

    def cost(x: Array) -> float:
        dx = x[:5] - prior.point
        return float(0.5 * dx @ prior.information @ dx - prior.gradient @ dx)

    steps = 1e-5 * np.eye(9)[:5]
    numeric = np.array([(cost(state + h) - cost(state - h)) / 2e-5 for h in steps])
    np.testing.assert_allclose(prior.descent_at(state), -numeric, atol=1e-7)


@pytest.mark.parametrize("at", [0, 2, 5])
def test_widening_knows_nothing_of_the_new_entries(at: int) -> None:
    """Old entries keep their prior wherever new ones come in; those have neither weight nor pull."""
    rng = np.random.default_rng(5)
    prior = random_prior(rng, 5)
    old_state, new = rng.normal(size=7), np.array([7.0, -8.0])
    before, information = prior.descent_at(old_state), prior.information.copy()
    prior.widen(at, new)
    state = np.insert(old_state, at, new + 100.0)
    old = np.r_[0:at, at + 2 : 7]
    np.testing.assert_allclose(prior.descent_at(state)[old], before, atol=1e-12)
    np.testing.assert_array_equal(prior.descent_at(state)[at : at + 2], 0.0)
    np.testing.assert_array_equal(prior.information[np.ix_(old, old)], information)
    np.testing.assert_array_equal(prior.information[at : at + 2], 0.0)
    np.testing.assert_array_equal(prior.point[at : at + 2], new)


@pytest.mark.parametrize("unknown", [False, True])
def test_forgetting_leaves_the_others_as_sure_as_before(unknown: bool) -> None:
    """The rest has the same covariance and the same mean; also where a forgotten one was free."""
    rng = np.random.default_rng(7)
    prior = random_prior(rng, 6)
    gone, rest = np.array([1, 4]), np.array([0, 2, 3, 5])
    covariance = np.linalg.inv(prior.information)
    mean = prior.point + covariance @ prior.gradient
    if unknown:
        prior.widen(6, np.array([3.0]))
        gone = np.append(gone, 6)
    prior.forget(gone)
    assert not prior.information[gone].any()
    assert not prior.information[:, gone].any()
    assert not prior.gradient[gone].any()
    own = np.linalg.inv(prior.information[np.ix_(rest, rest)])
    np.testing.assert_allclose(own, covariance[np.ix_(rest, rest)], rtol=1e-4)
    np.testing.assert_allclose(prior.point[rest] + own @ prior.gradient[rest], mean[rest], atol=1e-4)


def test_prior_rows_are_the_prior() -> None:
    """Also where the prior knows nothing of some entries."""
    rng = np.random.default_rng(6)
    prior = random_prior(rng, 5)
    prior.widen(2, np.zeros(2))
    prior.gradient = prior.information @ rng.normal(size=7)
    columns, jacobian, residual = prior_rows(prior.information, prior.gradient)
    assert len(residual) == 5
    hessian, descent = accumulate([Rows(columns, jacobian, residual)], 7)
    np.testing.assert_allclose(hessian, prior.information, atol=1e-10)
    np.testing.assert_allclose(descent, prior.gradient, atol=1e-10)


def chain(rng: np.random.Generator, poses: int) -> list[list[Rows]]:
    """A linear problem: for each pose, rows between it and the shared map, and to the pose before.

    Columns as in the batch: the map, then every pose.
    """
    cycles = []
    for k in range(poses):
        pose = MAP + POSE * k + np.arange(POSE)
        seen = np.array([np.concatenate([rng.choice(MAP, 4, replace=False), pose]) for _ in range(6)])
        groups = [Rows(seen, rng.normal(size=seen.shape), rng.normal(size=6))]
        if k:
            moved = np.tile(np.concatenate([pose - POSE, pose]), (POSE, 1))
            groups.append(Rows(moved, rng.normal(size=moved.shape), rng.normal(size=POSE)))
        cycles.append(groups)
    return cycles


def at_state(rows: Rows, state: Array) -> Rows:
    """The linear rows `J x + r` linearized at a state."""
    residual = rows.residual + np.sum(rows.jacobian * state[rows.columns], axis=1)
    return Rows(rows.columns, rows.jacobian, residual)


def shifted(rows: Rows, by: int) -> Rows:
    """Rows with their pose columns moved down, since the oldest poses have left."""
    return Rows(np.where(rows.columns >= MAP, rows.columns - by, rows.columns), rows.jacobian, rows.residual)


def fixed_lag(cycles: list[list[Rows]], lag: int, rng: np.random.Generator) -> Array:
    """Map and the last poses, by a window of `lag` poses, each cycle relinearized at a new random state."""
    prior = Prior(np.eye(MAP), np.zeros(MAP), np.zeros(MAP))
    held: list[Rows] = []
    poses, step = 0, np.zeros(0)
    for k, groups in enumerate(cycles):
        held += [shifted(g, POSE * (k - poses)) for g in groups]
        poses += 1
        state = rng.normal(size=MAP + POSE * poses) * 10.0
        linear = [at_state(g, state) for g in held]
        hessian, descent = accumulate(linear, len(state))
        q = len(prior.point)
        hessian[:q, :q] += prior.information
        descent[:q] += prior.descent_at(state)
        step = state + solve(cholesky(hessian), descent)
        if poses > lag:
            prior, held = leave(prior, held, state)
            poses -= 1
    return step


def leave(prior: Prior, held: list[Rows], state: Array) -> tuple[Prior, list[Rows]]:
    """The oldest pose goes into the prior on the map and the next pose."""
    low, size = MAP, MAP + 2 * POSE
    touching = [at_state(g, state).split(low, low + POSE)[0] for g in held]
    hessian, descent = accumulate(touching, size)
    q = len(prior.point)
    hessian[:q, :q] += prior.information
    descent[:q] += prior.descent_at(state)
    information, gradient = schur_leave(hessian, descent, low, low + POSE)
    kept = [g for g in held if not len(g.split(low, low + POSE)[0].residual)]
    point = np.delete(state[:size], np.s_[low : low + POSE])
    return Prior(information, gradient, point), [shifted(g, POSE) for g in kept]


@pytest.mark.parametrize("lag", [1, 3])
def test_a_chain_of_marginalizations_is_full_batch_on_a_linear_problem(lag: int) -> None:
    rng = np.random.default_rng(8)
    poses = 15
    cycles = chain(rng, poses)
    size = MAP + POSE * poses
    hessian, descent = accumulate([g for groups in cycles for g in groups], size)
    hessian[:MAP, :MAP] += np.eye(MAP)
    batch = solve(cholesky(hessian), descent)
    window = fixed_lag(cycles, lag, rng)
    np.testing.assert_allclose(window[:MAP], batch[:MAP], rtol=1e-9, atol=1e-9)
    last = POSE * (lag + 1)
    np.testing.assert_allclose(window[-last:], batch[-last:], rtol=1e-9, atol=1e-9)
