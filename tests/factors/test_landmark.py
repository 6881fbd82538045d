"""The landmark factor: its Jacobians, its residual against GTSAM's, and the quantile of its gate."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np
import pytest
from scipy.stats import chi2

from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.residuals import chi2_quantile, landmark_residuals

from ..scenes.jacobians import assert_jacobians


def one_detection(pose: Array, landmark: Array, detection: Array) -> Sequence[Array]:
    rows = landmark_residuals(pose[None], landmark[None], detection[None])
    return rows.residual[0], rows.by_pose[0], rows.by_landmark[0], -np.eye(2)


@pytest.mark.parametrize("seed", range(8))
def test_jacobians_far_from_zero(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pose, landmark, detection = rng.normal(0.0, 10.0, 3), rng.normal(0.0, 20.0, 2), rng.normal(0.0, 10.0, 2)
    assert_jacobians(one_detection, [pose, landmark, detection])


def test_a_landmark_to_the_left_is_seen_to_the_left() -> None:
    rows = landmark_residuals(np.array([[1.0, 2.0, np.pi / 2]]), np.array([[-1.0, 5.0]]), np.zeros((1, 2)))
    np.testing.assert_allclose(rows.residual, [[3.0, 2.0]], atol=1e-12)


def test_it_agrees_with_gtsam() -> None:
    rng = np.random.default_rng(1)
    poses, landmarks = rng.normal(0.0, 3.0, (20, 3)), rng.normal(0.0, 9.0, (20, 2))
    rows = landmark_residuals(poses, landmarks, np.zeros((20, 2)))
    for pose, landmark, seen in zip(poses, landmarks, rows.residual, strict=True):
        np.testing.assert_allclose(gtsam.Pose2(*pose).transformTo(landmark), seen, atol=1e-12)


@pytest.mark.parametrize("degrees", [1, 2, 3, 160])
@pytest.mark.parametrize("probability", [0.025, 0.5, 0.99, 1.0 - 1e-6])
def test_a_quantile_of_chi_square_is_that_of_scipy(probability: float, degrees: int) -> None:
    """It gates landmarks and gives the intervals of the NEES, so its tails count."""
    assert chi2_quantile(probability, degrees) == pytest.approx(chi2.ppf(probability, degrees), rel=1e-10)
