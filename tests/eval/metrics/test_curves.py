"""The true curve, points of a mapped one, and distances of curves, known by hand."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.eval.metrics.accuracy import (
    curve_distance,
    driving_order,
    mapped_points,
    true_curve,
)
from pathspace_graph.io.log import Truth
from pathspace_graph.io.map import Map
from pathspace_graph.labels import LEFT, RIGHT

from .straight_maps import landmarks, line, row, truth

Array = NDArray[np.float64]

ANGLE = 2 * np.pi * np.arange(24) / 24
RING = 20.0 * np.stack([np.sin(ANGLE), 1 - np.cos(ANGLE)], axis=1)
"""Cones on a circle, in driving order."""


def around(cones: Array) -> Truth:
    """A lap of radius 22 m around the cones."""
    turn = np.linspace(0.0, 2 * np.pi, 400)
    heading = (turn + np.pi) % (2 * np.pi) - np.pi
    poses = np.stack([22 * np.sin(turn), 22 * (1 - np.cos(turn)), heading], axis=1)
    return Truth(turn, poses, cones, np.full(len(cones), LEFT))


def test_cones_are_put_in_driving_order() -> None:
    found = driving_order(around(np.random.default_rng(0).permutation(RING)), LEFT)
    np.testing.assert_array_equal(
        found, np.roll(RING, -int(np.argmin(np.linalg.norm(RING - found[0], axis=1))), axis=0)
    )
    np.testing.assert_array_equal(
        driving_order(truth(RING), LEFT), RING
    )  # without a path the file's own order


def test_the_true_curve_passes_every_cone_and_closes_where_the_path_came_round() -> None:
    curve = true_curve(around(np.random.default_rng(0).permutation(RING)), LEFT)
    np.testing.assert_allclose(np.linalg.norm(curve - [0.0, 20.0], axis=1), 20.0, atol=0.02)
    assert np.linalg.norm(curve[0] - curve[-1]) < 1e-9
    distances = np.linalg.norm(curve[:, None] - RING[None], axis=2).min(axis=0)
    assert distances.max() < 0.011  # half a step
    open_curve = true_curve(truth(RING), LEFT)
    assert np.linalg.norm(open_curve[0] - open_curve[-1]) == pytest.approx(np.linalg.norm(RING[0] - RING[-1]))
    assert len(true_curve(truth(RING), RIGHT)) == 0


def test_mapped_points_stand_for_equal_lengths() -> None:
    points = mapped_points(line(1.0), 0.5)
    np.testing.assert_allclose(points, np.column_stack([0.25 + 0.5 * np.arange(20), np.ones(20)]), atol=1e-9)
    np.testing.assert_array_equal(mapped_points(landmarks((3.0, 4.0))), [[3.0, 4.0]])


def test_curve_distance_of_a_parallel_and_of_half_a_curve() -> None:
    true = truth(row(2.0), row(-2.0))
    found = curve_distance(Map(False, {LEFT: line(2.3), RIGHT: line(-2.3)}), true)
    assert found["mapped_to_truth"] == pytest.approx(0.3, abs=2e-3)
    assert found["truth_to_mapped"] == pytest.approx(0.3)
    # half of it: nothing from the half to the whole, and 2.5 m on average back on the half that isn't mapped
    half = curve_distance(Map(False, {LEFT: line(2.0, end=5.0)}), truth(row(2.0)))
    assert half["mapped_to_truth"] == pytest.approx(0.0, abs=0.03)
    assert half["truth_to_mapped"] == pytest.approx(1.25, abs=0.03)


def test_curve_distance_charges_landmarks_for_the_gaps_and_an_absent_boundary_for_all() -> None:
    true = truth(row(2.0))
    found = curve_distance(Map(False, {LEFT: landmarks((0, 2), (5, 2), (10, 2))}), true)
    assert found["mapped_to_truth"] == pytest.approx(0.0, abs=1e-9)
    assert found["truth_to_mapped"] == pytest.approx(1.25, abs=0.02)  # a quarter of the gap
    absent = curve_distance(Map(False, {}), true)
    assert np.isnan(absent["mapped_to_truth"]) and absent["truth_to_mapped"] == np.inf
    nothing = curve_distance(Map(False, {LEFT: line(0.0)}), truth(np.zeros((0, 2))))
    assert np.isnan([*nothing.values()]).all()
