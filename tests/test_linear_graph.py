"""Finished rows as GTSAM Jacobian factors: the same system, keys, tangents, and shapes that don't fit."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.factors.linear_graph import CALIBRATION_KEY, jacobian_factor, linear_graph, window_keys

Array = NDArray[np.float64]


def test_jacobian_factor_over_many_keys() -> None:
    rng = np.random.default_rng(0)
    keys, dims = [9, 4, 7, 1, 30], [2, 3, 2, 1, 3]
    A, b, x = rng.normal(size=(4, 11)), rng.normal(size=4), rng.normal(size=11)
    factor = jacobian_factor(keys, dims, A, b)
    delta = gtsam.VectorValues()
    for key, part in zip(keys, np.split(x, np.cumsum(dims)[:-1]), strict=True):
        delta.insert(key, part)
    np.testing.assert_array_equal(factor.getA(), A)
    assert factor.error(delta) == pytest.approx(0.5 * np.sum((A @ x - b) ** 2), rel=1e-12)


@pytest.mark.parametrize(
    ("keys", "dims", "shape", "rows"),
    [
        ([1, 2], [2], (3, 2), 3),
        ([1, 1], [2, 2], (3, 4), 3),
        ([1, 2], [2, 2], (3, 5), 3),
        ([1], [2], (3, 2), 2),
    ],
)
def test_what_does_not_fit_is_refused(
    keys: list[int], dims: list[int], shape: tuple[int, int], rows: int
) -> None:
    with pytest.raises(ValueError, match="expected"):
        jacobian_factor(keys, dims, np.zeros(shape), np.zeros(rows))


def test_window_keys_name_the_state() -> None:
    poses = np.array([[0.0, 0.0, 0.1], [1.0, 0.0, 0.2]])
    window = window_keys((1, 2), 2, poses, first_pose=7)
    names = [gtsam.DefaultKeyFormatter(k) for k in window.keys]
    assert names == ["l0", "r0", "r1", "b0", "x7", "x8"]
    assert window.dims.tolist() == [2, 2, 2, 2, 3, 3]
    assert window.headings.tolist() == [0.0, 0.0, 0.0, 0.0, 0.1, 0.2]
    assert CALIBRATION_KEY not in window_keys((1, 2), 0, poses).keys


def test_the_solution_is_that_of_the_rows_in_pose2s_tangent() -> None:
    """Dense least squares in the map frame, against GTSAM's elimination in each pose's own axes."""
    rng = np.random.default_rng(1)
    poses = rng.normal(size=(2, 3)) * 2.0
    window = window_keys((2, 2), 2, poses)
    size = 2 * 4 + 2 + 3 * 2
    columns = np.array([rng.choice(size, 5, replace=False) for _ in range(60)])
    columns[0, 1] = columns[0, 0]  # an entry met twice in a row counts twice
    jacobian, residual = rng.normal(size=(60, 5)), rng.normal(size=60)
    graph = linear_graph([(columns, jacobian, residual)], window)
    dense = np.zeros((60, size))
    np.add.at(dense, (np.arange(60)[:, None], columns), jacobian)
    expected = np.linalg.lstsq(dense, -residual, rcond=None)[0]
    solution = graph.optimize()
    for slot, pose in enumerate(poses):
        tangent = solution.at(gtsam.symbol("x", slot))
        step = expected[10 + 3 * slot : 13 + 3 * slot]
        c, s = np.cos(pose[2]), np.sin(pose[2])
        turned = [c * step[0] + s * step[1], -s * step[0] + c * step[1], step[2]]
        np.testing.assert_allclose(tangent, turned, atol=1e-9)
    np.testing.assert_allclose(solution.at(gtsam.symbol("r", 1)), expected[6:8], atol=1e-9)
    np.testing.assert_allclose(solution.at(CALIBRATION_KEY), expected[8:10], atol=1e-9)


def test_rows_of_the_same_keys_are_one_factor() -> None:
    window = window_keys((3, 0), 0, np.zeros((1, 3)))
    columns = np.array([[0, 1, 6, 8], [1, 0, 7, 8], [2, 3, 6, 7]])
    nothing = (columns[:0], np.ones((0, 4)), np.zeros(0))
    graph = linear_graph([nothing, (columns, np.ones((3, 4)), np.zeros(3))], window)
    assert sorted(graph.at(i).keys() for i in range(graph.size())) == sorted(
        [[window.keys[0], window.keys[3]], [window.keys[1], window.keys[3]]]
    )
