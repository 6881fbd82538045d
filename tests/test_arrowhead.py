"""The bordered chain: its solution and covariances against dense algebra."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from pathspace_graph.arrowhead import Arrowhead, empty_arrowhead
from pathspace_graph.window import POSE, SingularSystemError

Array = NDArray[np.float64]


def random_arrowhead(rng: np.random.Generator, poses: int, border: int) -> Arrowhead:
    """`J' J` of rows that each touch a pose, the next one, and the border."""
    system = empty_arrowhead(poses, border)
    for k in range(poses):
        a, b, c = rng.normal(size=(6, POSE)), rng.normal(size=(6, POSE)), rng.normal(size=(6, border))
        r = rng.normal(size=6)
        last = k == poses - 1
        system.diagonal[k] += a.T @ a
        system.coupling[POSE * k : POSE * (k + 1)] += a.T @ c
        system.descent_poses[POSE * k : POSE * (k + 1)] -= a.T @ r
        system.border[:] += c.T @ c
        system.descent_border[:] -= c.T @ r
        if not last:
            system.diagonal[k + 1] += b.T @ b
            system.following[k] += b.T @ a
            system.coupling[POSE * (k + 1) : POSE * (k + 2)] += b.T @ c
            system.descent_poses[POSE * (k + 1) : POSE * (k + 2)] -= b.T @ r
    system.border[np.diag_indices(border)] += 1.0
    system.diagonal[:, np.arange(POSE), np.arange(POSE)] += 0.5
    return system


@given(st.integers(0, 1000), st.integers(1, 9), st.integers(1, 7))
def test_the_solution_is_that_of_the_dense_system(seed: int, poses: int, border: int) -> None:
    system = random_arrowhead(np.random.default_rng(seed), poses, border)
    matrix, right = system.dense()
    expected = np.linalg.solve(matrix, right)
    step_poses, step_border = system.reduced().step(np.zeros((border, border)))
    np.testing.assert_allclose(np.concatenate([step_border, step_poses]), expected, atol=1e-9)


def test_damping_is_added_to_the_border() -> None:
    system = random_arrowhead(np.random.default_rng(3), 5, 4)
    damping = np.diag([1.0, 2.0, 3.0, 4.0])
    matrix, right = system.dense()
    matrix[:4, :4] += damping
    step_poses, step_border = system.reduced().step(damping)
    solution = np.linalg.solve(matrix, right)
    np.testing.assert_allclose(np.concatenate([step_border, step_poses]), solution, atol=1e-9)


def test_poses_beside_a_held_border() -> None:
    system = random_arrowhead(np.random.default_rng(4), 6, 3)
    matrix, right = system.dense()
    expected = np.linalg.solve(matrix[3:, 3:], right[3:])
    np.testing.assert_allclose(system.reduced().poses(np.zeros(3)), expected, atol=1e-9)
    np.testing.assert_allclose(system.poses_alone(), expected, atol=1e-9)


@given(st.integers(0, 1000), st.integers(1, 9), st.integers(1, 7))
def test_covariances_are_blocks_of_the_dense_inverse(seed: int, poses: int, border: int) -> None:
    system = random_arrowhead(np.random.default_rng(seed), poses, border)
    inverse = np.linalg.inv(system.dense()[0])
    reduced = system.reduced()
    np.testing.assert_allclose(reduced.border_covariance(), inverse[:border, :border], atol=1e-9)
    for k, marginal in enumerate(reduced.pose_marginals()):
        block = slice(border + POSE * k, border + POSE * (k + 1))
        np.testing.assert_allclose(marginal, inverse[block, block], atol=1e-9)


def test_a_chain_that_nothing_holds_is_singular() -> None:
    with pytest.raises(SingularSystemError):
        empty_arrowhead(3, 2).reduced()
