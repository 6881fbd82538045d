"""Errors of trajectories, known by hand."""

from __future__ import annotations

import numpy as np
import pytest

from pathspace_graph.eval.metrics.trajectory import ate, interpolate_poses, trajectory_errors
from pathspace_graph.io.log import Truth


def test_trajectory_errors_are_along_and_across_the_true_heading() -> None:
    """Due north at 1 m/s: 0.3 m too far north is along, 0.4 m too far west is across (left positive)."""
    t = np.array([0.0, 10.0])
    true = Truth(
        t, np.array([[0.0, 0.0, np.pi / 2], [0.0, 10.0, np.pi / 2]]), np.zeros((0, 2)), np.zeros(0, dtype=int)
    )
    stamps = np.array([-1.0, 2.0, 5.0, 10.0, 11.0])
    poses = np.array(
        [[9, 9, 0], [0, 2.3, 1.6], [-0.4, 5, np.pi / 2], [0, 10, np.pi / 2], [9, 9, 0]], dtype=float
    )
    errors = trajectory_errors(stamps, poses, true)
    expected = [[0.3, 0, 1.6 - np.pi / 2], [0, 0.4, 0], [0, 0, 0]]
    np.testing.assert_allclose(errors, expected, atol=1e-12)
    assert ate(stamps, poses, true) == pytest.approx(np.sqrt((0.3**2 + 0.4**2) / 3))


def test_headings_are_interpolated_the_short_way_and_wrap() -> None:
    poses = np.array([[0.0, 0.0, np.pi - 0.1], [2.0, 0.0, -np.pi + 0.1]])
    between = interpolate_poses(np.array([0.0, 2.0]), poses, np.array([0.5, 1.0, 1.5]))
    np.testing.assert_allclose(between[:, 0], [0.5, 1.0, 1.5])
    np.testing.assert_allclose(np.abs(between[:, 2]), [np.pi - 0.05, np.pi, np.pi - 0.05])
    assert between[2, 2] < 0.0 < between[0, 2]
