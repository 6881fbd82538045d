"""Scan matching: the pose that lays the detections of a cycle on those of the cycles before."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from pathspace_graph.factors import _kernels as kernels
from pathspace_graph.factors.se2 import to_vehicle
from pathspace_graph.front_end.motion import MATCHING, Matching

Array = NDArray[np.float64]
REACHES = [1.0, 0.8, 0.6, 0.5, 0.4]
CONES = np.array([[2.0, 2.0], [6.0, 2.2], [10.0, 2.0], [2.5, -1.9], [7.0, -2.0], [11.0, -2.1]])


class Match(NamedTuple):
    """What `kernels.matched` returns."""

    pose: Array
    information: Array
    is_matched: Array
    misfit: float
    is_certain: bool


def match(
    earlier: Array,
    points: Array,
    variances: Array,
    start: Array,
    reaches: Sequence[float],
    matching: Matching = MATCHING,
) -> Match:
    return Match(*kernels.matched(earlier, points, variances, start, reaches, matching))


def detected(pose: np.ndarray, cones: np.ndarray = CONES) -> np.ndarray:
    return to_vehicle(cones, np.tile(pose, (len(cones), 1)))


@given(x=st.floats(0.0, 1.2), y=st.floats(-0.3, 0.3), theta=st.floats(-0.05, 0.05))
def test_exact_detections_give_the_exact_motion(x: float, y: float, theta: float) -> None:
    pose = np.array([x, y, theta])
    start = np.array([x - 0.4, 0.0, 0.0])
    found = match(CONES, detected(pose), np.full(6, 0.01), start, REACHES)
    np.testing.assert_allclose(found.pose, pose, atol=1e-3)
    assert found.is_certain and found.is_matched.all()


# where no coordinate, heading, weight or variance is a special one
POSE = np.array([3.0, -2.0, 0.7])
ASYMMETRIC = np.array([[8.0, 1.0], [4.0, 5.5], [12.0, 9.0], [5.0, -4.0], [2.5, 1.0]])


def test_the_covariance_is_that_of_many_noisy_matches() -> None:
    """Errors that are whitened by the claimed covariance have the covariance 1, cross terms included."""
    rng, sigma, n = np.random.default_rng(0), 0.02, 3
    exact = replace(MATCHING, sigma_cone=1e-6, huber=np.inf)
    seen, errors = detected(POSE, ASYMMETRIC), []
    for _ in range(400):
        earlier = np.tile(ASYMMETRIC, (n, 1))
        earlier += sigma * rng.standard_normal(earlier.shape)
        points = seen + sigma * rng.standard_normal(seen.shape)
        found = match(earlier, points, np.full(len(seen), sigma**2), POSE, [0.4] * 2, exact)
        errors.append(np.linalg.cholesky(found.information).T @ (found.pose - POSE))
    np.testing.assert_allclose(np.cov(np.array(errors).T), np.eye(3), atol=0.2)


@pytest.mark.parametrize("n", [1, 3])
def test_the_misfit_at_a_pose_is_the_mean_square_of_the_whitened_distances(n: int) -> None:
    """One detection is 0.2 m off, one counts as much as is allowed, and one is of nothing."""
    seen = detected(POSE, ASYMMETRIC[:4])
    earlier = np.tile(ASYMMETRIC[:3], (n, 1))
    variances = np.array([0.04, 0.02, 1e-6, 0.01])
    off = np.array([[0.0, 0.2], [0.0, 0.0], [0.0, 0.2], [0.0, 0.0]])
    weight = n * np.exp(-0.5 * (0.2 / 0.4) ** 2)
    square = 0.2**2 / (0.04 * (1.0 + 1.0 / weight) + MATCHING.sigma_cone**2)
    found = kernels.misfit(earlier, seen + off, variances, POSE, 0.4, MATCHING)
    assert found == pytest.approx((square + 0.0 + 2.0 * MATCHING.most_misfit) / 4.0)


def test_a_detection_of_nothing_has_no_say() -> None:
    points = np.vstack([detected(np.array([0.5, 0.0, 0.0])), [[4.0, 0.0]]])
    found = match(CONES, points, np.full(7, 0.01), np.array([0.3, 0.0, 0.0]), REACHES)
    assert found.is_matched.tolist() == [True] * 6 + [False]
    np.testing.assert_allclose(found.pose, [0.5, 0.0, 0.0], atol=1e-3)


def test_detections_of_one_cone_alone_hold_no_motion_however_many_they_are() -> None:
    """All offsets have the same arm, so that the information is singular."""
    points = np.tile(CONES[:1], (5, 1))
    found = match(CONES[:1], points, np.full(5, 0.01), np.zeros(3), REACHES)
    assert found.is_matched.all() and not found.is_certain
