"""Loop detection: joint compatibility against dense algebra, and rows of cones that were seen before."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.baselines.landmark_graph import JointCompatibility, detect_loop
from pathspace_graph.labels import LEFT, RIGHT

from .scenes import with_covariance

Array = NDArray[np.float64]


def four_landmarks() -> tuple[JointCompatibility, Array, Array]:
    """Returns the test of two recent and two old landmarks, with their mean and covariance."""
    rng = np.random.default_rng(4)
    points = np.array([[10.0, 2.0], [14.0, 2.0], [10.4, 2.3], [14.2, 2.1]])
    root = rng.normal(0.0, 0.4, (8, 8))
    covariance = root @ root.T + 0.05 * np.eye(8)
    smoother = with_covariance(points, np.full(4, LEFT), covariance)
    test = JointCompatibility(smoother, np.array([2, 3]), np.array([0, 1]), scale=1.5)
    order = np.array([4, 5, 6, 7, 0, 1, 2, 3])
    return test, points[[2, 3, 0, 1]], 1.5**2 * covariance[np.ix_(order, order)]


def difference(i: int, j: int) -> Array:
    """Returns the matrix (2, 8) that takes recent landmark i minus old landmark j."""
    out = np.zeros((2, 8))
    out[:, 2 * i : 2 * i + 2], out[:, 4 + 2 * j : 6 + 2 * j] = np.eye(2), -np.eye(2)
    return out


def test_the_distance_of_a_pair_has_the_covariance_of_its_difference() -> None:
    test, mean, covariance = four_landmarks()
    found = test.distances(test.mean, test.covariance)
    for i in range(2):
        for j in range(2):
            H = difference(i, j)
            r, S = H @ mean.ravel(), H @ covariance @ H.T + 0.01 * np.eye(2)
            assert found[i, j] == pytest.approx(r @ np.linalg.solve(S, r), rel=1e-6)


def test_an_accepted_pair_is_a_kalman_update() -> None:
    test, mean, covariance = four_landmarks()
    H = difference(0, 1)
    gain = covariance @ H.T @ np.linalg.inv(H @ covariance @ H.T + 0.01 * np.eye(2))
    found = test.conditioned(test.mean, test.covariance, 0, 1)
    np.testing.assert_allclose(found[0].ravel(), mean.ravel() - gain @ H @ mean.ravel(), atol=1e-6)
    np.testing.assert_allclose(found[1], covariance - gain @ H @ covariance, atol=1e-6)


def test_the_distance_of_a_hypothesis_is_that_of_all_pairs_together() -> None:
    """The sum of the sequential distances is `r' S^-1 r` of the stacked differences."""
    test, mean, covariance = four_landmarks()
    pairs, distance = test.grow(0, 0, gate=1e6)
    assert pairs == [(0, 0), (1, 1)]
    H = np.concatenate([difference(0, 0), difference(1, 1)])
    r, S = H @ mean.ravel(), H @ covariance @ H.T + 0.01 * np.eye(4)
    assert distance == pytest.approx(r @ np.linalg.solve(S, r), rel=1e-6)


def detected(gaps: Array, sigma: float) -> tuple[Array, Array] | None:
    """Returns the pairs of two old rows and the same rows seen again, with a common shift of `sigma` (m)."""
    n, x = len(gaps), np.cumsum(gaps)
    old = np.concatenate([np.column_stack([x, np.full(n, y)]) for y in (2.0, -2.0)])
    points = np.concatenate([old, old + np.array([0.6 * sigma, 0.0])])
    common = np.zeros((8 * n, 2))
    common[4 * n :: 2, 0], common[4 * n + 1 :: 2, 1] = sigma, 0.1
    covariance = common @ common.T + 0.01 * np.eye(8 * n)
    smoother = with_covariance(points, np.tile(np.repeat([LEFT, RIGHT], n), 2).astype(np.intp), covariance)
    return detect_loop(smoother, np.arange(2 * n, 4 * n), np.arange(2 * n), reach=8.0)


def test_rows_are_recognized_as_a_whole() -> None:
    """The shift is more than half the distance of the cones, so each is nearest to a wrong one."""
    found = detected(np.array([3.0, 4.0, 3.3, 5.0, 2.8, 4.4]), 3.5)
    assert found is not None
    recent, old = found
    np.testing.assert_array_equal(np.sort(recent) - 12, np.arange(12))
    np.testing.assert_array_equal(recent - 12, old)


def test_a_row_with_equal_distances_is_not_recognized() -> None:
    assert detected(np.full(6, 3.0), 3.5) is None


def test_too_few_landmarks_close_no_loop() -> None:
    assert detected(np.array([3.0]), 1.0) is None
