"""Errors of trajectories, known by hand."""

from __future__ import annotations

import numpy as np
import pytest

from pathspace_graph.eval.metrics.trajectory import (
    end_of_trajectory,
    interpolate_poses,
    longest_divergence,
    position_rms,
    trajectory_errors,
    vehicle_errors,
)
from pathspace_graph.io.log import Truth
from pathspace_graph.io.results import VehicleState


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
    assert position_rms(errors) == pytest.approx(np.sqrt((0.3**2 + 0.4**2) / 3))


def test_a_vehicle_is_lost_that_is_5_m_off_in_the_last_second() -> None:
    t = np.linspace(0.0, 10.0, 101)
    path = np.column_stack([t, np.zeros((101, 2))])
    true = Truth(t, path, np.zeros((0, 2)), np.zeros(0, dtype=int))
    for at_end, lost in ((5.1, True), (4.9, False)):
        poses = path.copy()
        poses[50, 1] = 20.0
        poses[t > 8.9, 1] = at_end
        found = end_of_trajectory(t, poses, true)
        assert found == {
            "error_max": pytest.approx(20.0),
            "lost_at_end": lost,
        }
    assert end_of_trajectory(t + 100.0, path, true) == {}


def test_a_vehicle_is_astray_until_it_is_within_a_metre_again() -> None:
    """At 2 m/s: 1 s off before it counts, then 0.5 s, then 2 s, and 0.3 s at the end."""
    t = np.linspace(0.0, 20.0, 201)
    path = np.column_stack([2.0 * t, np.zeros((201, 2))])
    true = Truth(t, path, np.zeros((0, 2)), np.zeros(0, dtype=int))
    poses = path.copy()
    for begin, end in ((10, 20), (50, 55), (100, 120), (198, 201)):
        poses[begin:end, 1] = 1.1
    poses[70:90, 1] = 0.9
    assert longest_divergence(t, poses, true, 3.0) == pytest.approx(
        {"divergence_time": 2.0, "divergence_distance": 4.0}
    )
    assert longest_divergence(t, poses, true, 12.0) == pytest.approx(
        {"divergence_time": 0.2, "divergence_distance": 0.4}
    )
    assert longest_divergence(t, path, true, 0.0) == {"divergence_time": 0.0, "divergence_distance": 0.0}
    assert longest_divergence(t, poses, true, np.inf) == {}


def test_the_vehicle_at_the_end_is_compared_with_the_truth() -> None:
    t, nothing = np.array([0.0, 10.0]), (np.zeros((0, 2)), np.zeros(0, dtype=int))
    true = Truth(t, np.array([[0, 0, 3.1], [0, 0, 3.1]]), *nothing, calibration=np.array([0.01, -0.002]))
    covariance = np.diag(np.array([9.0, 9.0, 0.1, 0.004, 0.001]) ** 2)
    state = VehicleState(np.array([1.0, 1.0, -3.1]), np.array([0.012, -0.001]), covariance)
    values = vehicle_errors(state, 5.0, true)
    assert values == pytest.approx(
        {
            "scale": 0.012,
            "scale_true": 0.01,
            "scale_by_sigma": 0.5,
            "bias": -0.001,
            "bias_true": -0.002,
            "bias_by_sigma": 1.0,
            "heading_by_sigma": (2 * np.pi - 6.2) / 0.1,
        }
    )
    unknown = vehicle_errors(state, 11.0, Truth(t, true.poses, *nothing))
    assert set(unknown) == {"scale", "bias"}


def test_headings_are_interpolated_the_short_way_and_wrap() -> None:
    poses = np.array([[0.0, 0.0, np.pi - 0.1], [2.0, 0.0, -np.pi + 0.1]])
    between = interpolate_poses(np.array([0.0, 2.0]), poses, np.array([0.5, 1.0, 1.5]))
    np.testing.assert_allclose(between[:, 0], [0.5, 1.0, 1.5])
    np.testing.assert_allclose(np.abs(between[:, 2]), [np.pi - 0.05, np.pi, np.pi - 0.05])
    assert between[2, 2] < 0.0 < between[0, 2]
