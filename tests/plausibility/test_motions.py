"""Motions: the meanings of the odometry's columns, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from pathspace_graph.io.log import Odometry
from pathspace_graph.plausibility.hypotheses import DEGREE, Hypothesis, motions

T = 0.1 * np.arange(11)


def twists(vx: float, vy: float, wz: float) -> Odometry:
    return Odometry(T, np.tile([vx, vy, wz], (len(T), 1)))


def test_a_quarter_circle_is_exact() -> None:
    radius = 2.0
    poses = Hypothesis().poses(twists(0.5 * np.pi * radius, 0.0, 0.5 * np.pi))
    np.testing.assert_allclose(poses[-1], [radius, radius, 0.5 * np.pi], atol=1e-12)


def test_units_scale_speeds_and_rates() -> None:
    poses = Hypothesis(speed=1e-3, rate=DEGREE).poses(twists(3000.0, 0.0, 0.0))
    np.testing.assert_allclose(poses[-1], [3.0, 0.0, 0.0], atol=1e-12)
    assert Hypothesis(rate=DEGREE).poses(twists(0.0, 0.0, 90.0))[-1, 2] == pytest.approx(0.5 * np.pi)


def test_a_twist_in_the_map_frame_is_not_turned() -> None:
    poses = Hypothesis(content="twist in the map frame").poses(twists(1.0, 2.0, 3.0))
    np.testing.assert_allclose(poses[-1], [1.0, 2.0, 3.0], atol=1e-12)


def test_a_pose_is_taken_as_it_is_with_its_heading_unwrapped() -> None:
    heading = np.linspace(3.0, 4.0, len(T))
    wrapped = (heading + np.pi) % (2.0 * np.pi) - np.pi
    odometry = Odometry(T, np.column_stack([T, 2.0 * T, wrapped]))
    poses = Hypothesis(content="pose").poses(odometry)
    np.testing.assert_allclose(poses, np.column_stack([T, 2.0 * T, heading]), atol=1e-12)


def test_a_motion_is_in_the_frame_of_its_beginning() -> None:
    poses = np.array([[0.0, 0.0, 0.0], [5.0, 1.0, 0.5 * np.pi], [5.0, 4.0, np.pi]])
    found = motions(np.arange(3.0), poses, np.array([1.0, 0.5]), np.array([2.0, 0.5]))
    np.testing.assert_allclose(found, [[3.0, 0.0, 0.5 * np.pi], [0.0, 0.0, 0.0]], atol=1e-12)
