"""How far a map is from the truth: Table 1, curves, ghosts, differences of maps."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from pathspace_graph.eval.metrics.accuracy import (
    boundary_distances,
    boundary_errors,
    cone_distances,
    cone_errors,
    cones_in_order,
    crossings,
    lap_metrics,
    mapped_points,
    true_curve,
)
from pathspace_graph.io.log import Truth
from pathspace_graph.io.map import Map, PointBoundary, SplineBoundary
from pathspace_graph.labels import LEFT, RIGHT, UNKNOWN
from pathspace_graph.spline.bspline import BSpline

from .straight_maps import landmarks, line, row, truth

Array = NDArray[np.float64]


def labelled(
    cones: list[tuple[float, float, int]], poses: Array | None = None, t: Array | None = None
) -> Truth:
    rows = np.array([(x, y) for x, y, _ in cones], dtype=float).reshape(-1, 2)
    return Truth(
        pose_t=np.zeros(0) if t is None else t,
        poses=np.zeros((0, 3)) if poses is None else poses,
        cones=rows,
        cone_labels=np.array([label for _, _, label in cones], dtype=int),
    )


def test_table_of_a_spline_map() -> None:
    """Errors 0.3 and 0.4 to their own lines, one at 3.0 (found), one beyond the end at 5 (missed)."""
    true = labelled([(5, 2.3, LEFT), (1, -2.4, RIGHT), (5, 5.0, LEFT), (13, 6.0, LEFT), (5, 0.0, UNKNOWN)])
    row = lap_metrics(Map(False, {LEFT: line(2.0), RIGHT: line(-2.0)}), true, lap=4)
    assert row.lap == 4
    assert row.size == 8
    assert row.missed == 0.25
    assert row.rmse == pytest.approx(np.sqrt((0.3**2 + 0.4**2 + 3.0**2) / 3), abs=1e-12)


def test_a_cone_counts_to_its_own_boundary_only() -> None:
    true = labelled([(5, 2.0, RIGHT)])
    row = lap_metrics(Map(False, {LEFT: line(2.0), RIGHT: line(0.5)}), true, 1)
    assert row.rmse == pytest.approx(1.5)


def test_an_absent_boundary_is_missed_as_a_whole() -> None:
    true = labelled([(5, 2, LEFT), (6, 2, LEFT), (7, 2, LEFT), (5, -2, RIGHT)])
    row = lap_metrics(Map(False, {RIGHT: line(-2.0)}), true, 1)
    assert (row.missed, row.rmse, row.size) == (0.75, pytest.approx(0.0, abs=1e-12), 4)
    nothing = lap_metrics(Map(False, {}), true, 1)
    assert nothing.missed == 1.0 and np.isnan(nothing.rmse) and nothing.size == 0
    assert np.isnan(lap_metrics(Map(False, {}), labelled([]), 1).missed)


def test_landmarks_are_measured_to_the_nearest() -> None:
    true = labelled([(0, 0, LEFT), (10, 0, LEFT), (0, 5, RIGHT)])
    track = Map(False, {LEFT: landmarks((0.0, 1.0), (0.0, 2.0), (10.0, 0.0)), RIGHT: landmarks()})
    np.testing.assert_array_equal(cone_distances(track, true), [1.0, 0.0, np.inf])
    row = lap_metrics(track, true, 1)
    assert (row.size, row.missed) == (3, pytest.approx(1 / 3))
    assert row.rmse == pytest.approx(np.sqrt(0.5))


@settings(deadline=None)
@given(seed=st.integers(0, 10_000))
def test_the_closest_point_is_no_farther_than_any_sample(seed: int) -> None:
    rng = np.random.default_rng(seed)
    angle = np.arange(12) * 2 * np.pi / 12
    ring = 20.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1) + rng.normal(0.0, 2.0, (12, 2))
    spline = BSpline.periodic_from(np.arange(13.0), ring)
    points = rng.uniform(-30.0, 30.0, (40, 2))
    distances = boundary_distances(SplineBoundary(spline, np.zeros((24, 24))), points)
    samples = spline.evaluate(np.linspace(0.0, 12.0, 6001))
    sampled = np.linalg.norm(points[:, None] - samples[None], axis=2).min(axis=1)
    assert (distances <= sampled + 1e-3).all()
    np.testing.assert_allclose(distances, sampled, atol=0.02)


def test_missed_at_a_distance_and_rmse_with_a_missed_cone_as_three_metres() -> None:
    track = Map(False, {LEFT: PointBoundary(np.zeros((1, 2)), np.eye(2))})
    at = (0.0, 0.9, 1.5, 2.5, 4.0)
    found = cone_errors(track, labelled([*((x, 0.0, LEFT) for x in at), (0.0, 0.0, RIGHT)]))
    assert [found[key] for key in ("missed_1m", "missed_2m", "missed")] == [4 / 6, 3 / 6, 2 / 6]
    assert found["size_share"] == 1 / 6
    assert found["rmse_capped"] == pytest.approx(np.sqrt((0.81 + 2.25 + 6.25 + 9 + 9) / 6))
    assert cone_errors(track, labelled([(2.0, 0.0, LEFT)]))["missed_2m"] == 0.0
    nothing = cone_errors(track, labelled([]))
    assert np.isnan([*nothing.values()]).all()


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
    found = cones_in_order(around(np.random.default_rng(0).permutation(RING)), LEFT)
    np.testing.assert_array_equal(
        found, np.roll(RING, -int(np.argmin(np.linalg.norm(RING - found[0], axis=1))), axis=0)
    )
    np.testing.assert_array_equal(
        cones_in_order(truth(RING), LEFT), RING
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
    found = boundary_errors(Map(False, {LEFT: line(2.3), RIGHT: line(-2.3)}), true)
    assert found["mapped_to_truth"] == pytest.approx(0.3, abs=2e-3)
    assert found["truth_to_mapped"] == pytest.approx(0.3)
    # half of it: nothing from the half to the whole, and 2.5 m on average back on the half that isn't mapped
    half = boundary_errors(Map(False, {LEFT: line(2.0, end=5.0)}), truth(row(2.0)))
    assert half["mapped_to_truth"] == pytest.approx(0.0, abs=0.03)
    assert half["truth_to_mapped"] == pytest.approx(1.25, abs=0.03)


def test_curve_distance_charges_landmarks_for_the_gaps_and_an_absent_boundary_for_all() -> None:
    true = truth(row(2.0))
    found = boundary_errors(Map(False, {LEFT: landmarks((0, 2), (5, 2), (10, 2))}), true)
    assert found["mapped_to_truth"] == pytest.approx(0.0, abs=1e-9)
    assert found["truth_to_mapped"] == pytest.approx(1.25, abs=0.02)  # a quarter of the gap
    absent = boundary_errors(Map(False, {}), true)
    assert np.isnan(absent["mapped_to_truth"]) and absent["truth_to_mapped"] == np.inf
    nothing = boundary_errors(Map(False, {LEFT: line(0.0)}), truth(np.zeros((0, 2))))
    assert np.isnan([nothing["mapped_to_truth"], nothing["truth_to_mapped"]]).all()


def test_ghost_landmarks() -> None:
    """One is 2.5 m off the row, and one of the wrong colour."""
    true = truth(row(2.0), row(-2.0))
    track = Map(
        False,
        {
            LEFT: landmarks((0, 2.1), (5, 2), (5.4, 2.1), (10, 2), (2.5, 4.5), (5, -2)),
            RIGHT: landmarks((2.5, -2)),
        },
    )
    found = boundary_errors(track, true)
    assert (found["ghost_landmarks"], found["ghost_metres"]) == (2, 0.0)


def test_ghost_curve_is_the_length_with_no_boundary_near() -> None:
    """20 m of curve over 10 m of truth: what is more than 2 m past its end has no boundary near."""
    found = boundary_errors(Map(False, {LEFT: line(2.0, end=20.0)}), truth(row(2.0)))
    assert found["ghost_metres"] == pytest.approx(8.0, abs=0.1)
    assert found["ghost_landmarks"] == 0
    whole = boundary_errors(Map(False, {LEFT: line(2.0)}), truth(np.zeros((0, 2))))
    assert whole["ghost_metres"] == pytest.approx(10.0)


def test_curves_that_cross_are_counted_once_a_place() -> None:
    """A lying eight crosses itself once, and a circle around its middle four times."""
    eight = np.column_stack([20.0 * np.sin(ANGLE), 10.0 * np.sin(2.0 * ANGLE)])
    circle = 15.0 * np.column_stack([np.cos(ANGLE), np.sin(ANGLE)])
    curves = (BSpline.periodic_from(np.arange(25.0), points) for points in (eight, circle))
    boundaries = {label: SplineBoundary(curve, np.eye(48)) for label, curve in enumerate(curves)}
    assert crossings(Map(True, {LEFT: boundaries[LEFT], RIGHT: boundaries[RIGHT]})) == (4, 1)
    assert crossings(Map(True, {LEFT: boundaries[RIGHT], RIGHT: landmarks((0.0, 0.0))})) == (0, 0)
