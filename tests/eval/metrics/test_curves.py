"""The true curve, points of a mapped one, and distances of curves, known by hand."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.eval.metrics.accuracy import (
    centre_line_errors,
    crossings,
    curve_distance,
    driving_order,
    mapped_points,
    true_curve,
    two_way_distance,
)
from pathspace_graph.io.log import Truth
from pathspace_graph.io.map import Map, SplineBoundary
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.spline.bspline import BSpline

from ...scenes.maps import SIGMA, point_map, ring_map
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


def test_two_curves_apart_and_one_longer_than_the_other() -> None:
    assert two_way_distance(line(2.0), line(2.7)) == pytest.approx(0.7)
    # forth 0; back 0 on the shared half, and 0 to 5 m from its end on the other half
    assert two_way_distance(line(2.0, end=5.0), line(2.0)) == pytest.approx(0.5 * 1.25, abs=0.01)


def rings(left: float, right: float) -> Truth:
    """Cones on two circles about the origin, driven anticlockwise; the curves have a gap of one cone."""
    angle = 2 * np.pi * np.arange(120) / 120
    at = np.column_stack([np.cos(angle), np.sin(angle)])
    cones = np.concatenate([left * at, right * at])
    labels = np.repeat([LEFT, RIGHT], 120)
    turn = np.linspace(0.0, 2 * np.pi, 400)
    middle = 0.5 * (left + right)
    poses = np.stack([middle * np.cos(turn), middle * np.sin(turn), turn + np.pi / 2], axis=1)
    return Truth(turn, poses, cones, labels)


def test_the_errors_of_a_centre_line() -> None:
    """The map is a ring of 18 m and 22 m; the true centre is 0.2 m to its right, and 0.1 m wider each way."""
    errors = centre_line_errors(ring_map(), rings(18.1, 22.3))
    (across, across_sigma), (width, width_sigma) = errors["centre"], errors["half_width"]
    known = ~np.isnan(across)
    assert known.sum() >= len(known) - 2  # the rings of cones are open curves
    np.testing.assert_allclose(across[known], -0.2, atol=1e-3)
    np.testing.assert_allclose(width[known], 0.1, atol=1e-3)
    line = ring_map().centre_line(1.0)
    np.testing.assert_array_equal(across_sigma, line.points_sigma)
    np.testing.assert_allclose(width_sigma, line.width_left_sigma, rtol=0.2)
    assert (across_sigma < SIGMA).all()


def test_a_true_boundary_far_away_has_no_errors() -> None:
    across, _ = centre_line_errors(ring_map(), rings(18.0, 26.0))["centre"]
    assert np.isnan(across).all()


def test_a_map_of_points_has_no_centre_line() -> None:
    assert centre_line_errors(point_map(), rings(18.0, 22.0)) == {}


def test_boundaries_that_cross_each_other_or_themselves_are_counted() -> None:
    assert crossings(Map(False, {LEFT: line(2.0), RIGHT: line(-2.0)})) == (0, 0)
    assert crossings(ring_map()) == (0, 0)
    slanted = np.array([[0.0, -1.0], [3.0, 0.0], [6.0, 2.0], [10.0, 3.0]])
    crossed = SplineBoundary(BSpline.clamped_from(np.array([0.0, 10.0]), slanted), np.eye(8))
    assert crossings(Map(False, {LEFT: line(2.0), RIGHT: crossed})) == (1, 0)
    loop = np.array([[0.0, 0.0], [12.0, 10.0], [-8.0, 10.0], [4.0, 0.0]])
    looped = SplineBoundary(BSpline.clamped_from(np.array([0.0, 10.0]), loop), np.eye(8))
    assert crossings(Map(False, {LEFT: looped})) == (0, 1)
    assert crossings(Map(False, {})) == (0, 0)
    assert crossings(Map(False, {LEFT: landmarks((0.0, 0.0))})) == (0, 0)
