"""Metrics, on maps and trajectories whose errors can be told by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from pathspace_graph.eval.metrics.accuracy import (
    boundary_distances,
    cone_distances,
    cone_errors,
    lap_metrics,
)
from pathspace_graph.io.log import Truth
from pathspace_graph.io.map import Map, PointBoundary, SplineBoundary
from pathspace_graph.labels import LEFT, RIGHT, UNKNOWN
from pathspace_graph.spline.bspline import BSpline

Array = NDArray[np.float64]


def truth(cones: list[tuple[float, float, int]], poses: Array | None = None, t: Array | None = None) -> Truth:
    rows = np.array([(x, y) for x, y, _ in cones], dtype=float).reshape(-1, 2)
    return Truth(
        pose_t=np.zeros(0) if t is None else t,
        poses=np.zeros((0, 3)) if poses is None else poses,
        cones=rows,
        cone_labels=np.array([label for _, _, label in cones], dtype=int),
    )


def straight(y: float, covariance: Array | None = None) -> SplineBoundary:
    """The line from (0, y) to (10, y) with control points every 10/3 m."""
    points = np.column_stack([np.linspace(0.0, 10.0, 4), np.full(4, y)])
    spline = BSpline.clamped_from(np.array([0.0, 10.0]), points)
    return SplineBoundary(spline, np.zeros((8, 8)) if covariance is None else covariance)


def landmarks(*points: tuple[float, float]) -> PointBoundary:
    return PointBoundary(np.array(points, dtype=float).reshape(-1, 2), np.eye(2 * len(points)))


def test_table_of_a_spline_map() -> None:
    """Errors 0.3 and 0.4 to their own lines, one at 3.0 (found), one beyond the end at 5 (missed)."""
    true = truth([(5, 2.3, LEFT), (1, -2.4, RIGHT), (5, 5.0, LEFT), (13, 6.0, LEFT), (5, 0.0, UNKNOWN)])
    row = lap_metrics(Map(False, {LEFT: straight(2.0), RIGHT: straight(-2.0)}), true, lap=4)
    assert row.lap == 4
    assert row.size == 8
    assert row.missed == 0.25
    assert row.rmse == pytest.approx(np.sqrt((0.3**2 + 0.4**2 + 3.0**2) / 3), abs=1e-12)


def test_a_cone_counts_to_its_own_boundary_only() -> None:
    true = truth([(5, 2.0, RIGHT)])
    row = lap_metrics(Map(False, {LEFT: straight(2.0), RIGHT: straight(0.5)}), true, 1)
    assert row.rmse == pytest.approx(1.5)


def test_an_absent_boundary_is_missed_as_a_whole() -> None:
    true = truth([(5, 2, LEFT), (6, 2, LEFT), (7, 2, LEFT), (5, -2, RIGHT)])
    row = lap_metrics(Map(False, {RIGHT: straight(-2.0)}), true, 1)
    assert (row.missed, row.rmse, row.size) == (0.75, pytest.approx(0.0, abs=1e-12), 4)
    nothing = lap_metrics(Map(False, {}), true, 1)
    assert nothing.missed == 1.0 and np.isnan(nothing.rmse) and nothing.size == 0
    assert np.isnan(lap_metrics(Map(False, {}), truth([]), 1).missed)


def test_landmarks_are_measured_to_the_nearest() -> None:
    true = truth([(0, 0, LEFT), (10, 0, LEFT), (0, 5, RIGHT)])
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
    found = cone_errors(track, truth([*((x, 0.0, LEFT) for x in at), (0.0, 0.0, RIGHT)]))
    assert [found[key] for key in ("missed_1m", "missed_2m", "missed")] == [4 / 6, 3 / 6, 2 / 6]
    assert found["size_share"] == 1 / 6
    assert found["rmse_capped"] == pytest.approx(np.sqrt((0.81 + 2.25 + 6.25 + 9 + 9) / 6))
    assert cone_errors(track, truth([(2.0, 0.0, LEFT)]))["missed_2m"] == 0.0
    nothing = cone_errors(track, truth([]))
    assert np.isnan([*nothing.values()]).all()
