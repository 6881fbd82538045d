"""What a comparison measures besides the paper's table, on maps whose answer can be told by hand."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.errors import SettingsError
from pathspace_graph.eval.metrics.consistency import Nees, curve_errors, landmark_errors, map_nees
from pathspace_graph.eval.metrics.cost import WHOLE, covariance_bytes, map_bytes, stage_times
from pathspace_graph.eval.metrics.curve_distance import curve_distance
from pathspace_graph.eval.metrics.ghosts import GhostSettings, ghosts
from pathspace_graph.eval.metrics.table1 import capped_rmse, missed_share
from pathspace_graph.eval.metrics.true_curve import mapped_points, true_curve
from pathspace_graph.io.log import Truth
from pathspace_graph.io.map import Map, PointBoundary, SplineBoundary
from pathspace_graph.io.results import CycleRecord
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.spline.bspline import BSpline

Array = NDArray[np.float64]


def truth(left: Array, right: Array | None = None) -> Truth:
    right = np.zeros((0, 2)) if right is None else right
    labels = np.repeat([LEFT, RIGHT], [len(left), len(right)])
    return Truth(np.zeros(0), np.zeros((0, 3)), np.concatenate([left, right]), labels)


def row(y: float, x: tuple[float, ...] = (0.0, 5.0, 10.0)) -> Array:
    return np.array([(value, y) for value in x])


def line(y: float, start: float = 0.0, end: float = 10.0, sigma: float = 0.1) -> SplineBoundary:
    """A straight clamped spline of four control points."""
    points = np.column_stack([np.linspace(start, end, 4), np.full(4, y)])
    return SplineBoundary(BSpline.clamped_from(np.array([0.0, end - start]), points), sigma**2 * np.eye(8))


def landmarks(*points: tuple[float, float], sigma: float = 0.1) -> PointBoundary:
    return PointBoundary(np.array(points).reshape(-1, 2), sigma**2 * np.eye(2 * len(points)))


# --- cones -----------------------------------------------------------------------------------------------


def test_missed_at_a_distance_and_rmse_with_a_missed_cone_as_three_metres() -> None:
    distances = np.array([0.0, 0.9, 1.5, 2.5, 4.0, np.inf])
    assert [missed_share(distances, d) for d in (1.0, 2.0, 3.0)] == [4 / 6, 3 / 6, 2 / 6]
    assert missed_share(np.array([2.0]), 2.0) == 0.0
    assert capped_rmse(distances) == pytest.approx(np.sqrt((0.81 + 2.25 + 6.25 + 9 + 9) / 6))
    assert np.isnan(missed_share(np.zeros(0))) and np.isnan(capped_rmse(np.zeros(0)))


# --- curves ----------------------------------------------------------------------------------------------


def test_the_true_curve_passes_every_cone_and_closes_where_the_path_came_round() -> None:
    angle = 2 * np.pi * np.arange(24) / 24
    ring = 20.0 * np.stack([np.sin(angle), 1 - np.cos(angle)], axis=1)
    turn = np.linspace(0.0, 2 * np.pi, 400)
    poses = np.stack(
        [22 * np.sin(turn), 22 * (1 - np.cos(turn)), (turn + np.pi) % (2 * np.pi) - np.pi], axis=1
    )
    shuffled = ring[np.random.default_rng(0).permutation(24)]
    curve = true_curve(Truth(turn, poses, shuffled, np.full(24, LEFT)), LEFT)
    np.testing.assert_allclose(np.linalg.norm(curve - [0.0, 20.0], axis=1), 20.0, atol=0.02)
    assert np.linalg.norm(curve[0] - curve[-1]) < 1e-9
    distances = np.linalg.norm(curve[:, None] - ring[None], axis=2).min(axis=0)
    assert distances.max() < 0.011  # half a step
    open_curve = true_curve(truth(ring), LEFT)
    assert np.linalg.norm(open_curve[0] - open_curve[-1]) == pytest.approx(np.linalg.norm(ring[0] - ring[-1]))
    assert len(true_curve(truth(ring), RIGHT)) == 0


def test_mapped_points_stand_for_equal_lengths() -> None:
    points = mapped_points(line(1.0), 0.5)
    np.testing.assert_allclose(points, np.column_stack([0.25 + 0.5 * np.arange(20), np.ones(20)]), atol=1e-9)
    np.testing.assert_array_equal(mapped_points(landmarks((3.0, 4.0))), [[3.0, 4.0]])


def test_curve_distance_of_a_parallel_and_of_half_a_curve() -> None:
    true = truth(row(2.0), row(-2.0))
    found = curve_distance(Map(False, {LEFT: line(2.3), RIGHT: line(-2.3)}), true)
    assert found.mapped_to_truth == pytest.approx(0.3, abs=2e-3)
    assert (found.truth_to_mapped, found.two_way) == (pytest.approx(0.3), pytest.approx(0.3, abs=2e-3))
    # half of it: nothing from the half to the whole, and 2.5 m on average back on the half that isn't mapped
    half = curve_distance(Map(False, {LEFT: line(2.0, end=5.0)}), truth(row(2.0)))
    assert half.mapped_to_truth == pytest.approx(0.0, abs=0.03)
    assert half.truth_to_mapped == pytest.approx(1.25, abs=0.03)


def test_curve_distance_charges_landmarks_for_the_gaps_and_an_absent_boundary_for_all() -> None:
    true = truth(row(2.0))
    found = curve_distance(Map(False, {LEFT: landmarks((0, 2), (5, 2), (10, 2))}), true)
    assert found.mapped_to_truth == pytest.approx(0.0, abs=1e-9)
    assert found.truth_to_mapped == pytest.approx(1.25, abs=0.02)  # a quarter of the gap
    absent = curve_distance(Map(False, {}), true)
    assert np.isnan(absent.mapped_to_truth) and absent.truth_to_mapped == np.inf
    assert np.isnan(curve_distance(Map(False, {LEFT: line(0.0)}), truth(np.zeros((0, 2)))).two_way)


# --- ghosts ----------------------------------------------------------------------------------------------


def test_ghost_landmarks_and_duplicates() -> None:
    """One 2.5 m off the row, one of the wrong colour, and a second one beside the cone at 5 m."""
    true = truth(row(2.0), row(-2.0))
    track = Map(
        False,
        {
            LEFT: landmarks((0, 2.1), (5, 2), (5.4, 2.1), (10, 2), (2.5, 4.5), (5, -2)),
            RIGHT: landmarks((2.5, -2)),
        },
    )
    found = ghosts(track, true)
    assert (found.landmarks, found.duplicates, found.metres) == (2, 1, 0.0)
    assert found.share == pytest.approx(2 / 7)
    assert ghosts(track, true, GhostSettings(distance=3.0)).landmarks == 1


def test_ghost_curve_is_the_length_with_no_boundary_near() -> None:
    """20 m of curve over 10 m of truth: what is more than 2 m past its end has no boundary near."""
    found = ghosts(Map(False, {LEFT: line(2.0, end=20.0)}), truth(row(2.0)))
    assert found.metres == pytest.approx(8.0, abs=0.1)
    assert found.share == pytest.approx(0.4, abs=0.005)
    assert (found.landmarks, found.duplicates) == (0, 0)
    whole = ghosts(Map(False, {LEFT: line(2.0)}), truth(np.zeros((0, 2))))
    assert whole.metres == pytest.approx(10.0)
    assert np.isnan(ghosts(Map(False, {}), truth(row(2.0))).share)
    with pytest.raises(SettingsError):
        GhostSettings(distance=0.0)


# --- consistency -----------------------------------------------------------------------------------------


def test_errors_of_a_curve_are_one_for_each_control_point_and_have_its_covariance() -> None:
    error, covariance = curve_errors(line(2.3, sigma=0.2), true_curve(truth(row(2.0)), LEFT))
    np.testing.assert_allclose(error, -0.3)  # the truth is to the right of the curve
    basis = line(2.3).spline.basis_matrix(np.array([0.0, 10 / 3, 20 / 3, 10.0]))
    np.testing.assert_allclose(covariance, 0.04 * basis @ basis.T, atol=1e-12)


def test_errors_of_a_floating_curve_have_a_regular_covariance() -> None:
    points = np.column_stack([np.arange(6.0) * 2, np.zeros(6)])
    floating = SplineBoundary(BSpline.open_uniform(points, interval=2.0), 0.01 * np.eye(12))
    error, covariance = curve_errors(floating, row(0.0, (0.0, 4.0, 8.0)))
    assert len(error) == 4  # those of the two outermost control points fall on the ends
    assert np.linalg.cond(covariance) < 100.0


def test_landmarks_are_paired_one_to_one_and_ghosts_are_no_errors() -> None:
    boundary = landmarks((0.1, 2.0), (0.3, 2.0), (5.0, 2.2), (30.0, 30.0))
    error, covariance = landmark_errors(boundary, row(2.0))
    np.testing.assert_allclose(error, [-0.1, 0.0, 0.0, -0.2], atol=1e-12)
    assert covariance.shape == (4, 4)
    assert len(landmark_errors(landmarks(), row(2.0))[0]) == 0


def test_nees_of_honest_maps_is_one_per_degree_and_lies_in_its_interval_95_times_of_100() -> None:
    rng = np.random.default_rng(1)
    true, found = truth(row(2.0, tuple(np.arange(0.0, 60.0, 4.0)))), []
    sigma = 0.2 * np.linalg.cholesky(np.eye(60) + 0.5)
    base = np.column_stack([np.linspace(0.0, 56.0, 30), np.full(30, 2.0)])
    for _ in range(200):
        points = base + (sigma @ rng.normal(size=60)).reshape(30, 2) * [0.0, 1.0]
        spline = BSpline.clamped_from(np.linspace(0.0, 56.0, 28), points)
        found.append(map_nees(Map(False, {LEFT: SplineBoundary(spline, sigma @ sigma.T)}), true))
    assert found[0].dof == 30
    assert np.mean([c.ratio for c in found]) == pytest.approx(1.0, abs=0.06)
    assert 0.88 <= np.mean([c.honest for c in found]) <= 1.0
    low, high = found[0].interval
    assert (low, high) == (pytest.approx(16.79 / 30, abs=1e-3), pytest.approx(46.98 / 30, abs=1e-3))


def test_nees_counts_overconfidence_and_knows_what_it_cannot_tell() -> None:
    true = truth(row(2.0))
    timid = map_nees(Map(False, {LEFT: landmarks((0, 2.3), (5, 2), (10, 2), sigma=3.0)}), true)
    assert (timid.value, timid.dof) == (pytest.approx(0.01), 6)
    assert timid.ratio < timid.interval[0] and not timid.honest
    singular = SplineBoundary(line(2.0).spline, np.zeros((8, 8)))
    assert np.isnan(map_nees(Map(False, {LEFT: singular}), true).ratio)
    assert np.isnan(Nees(0.0, 0).ratio) and np.isnan(Nees(0.0, 0).interval[0])


# --- memory and time -------------------------------------------------------------------------------------


def test_bytes_of_a_map() -> None:
    closed = BSpline.periodic_from(np.arange(9.0), np.random.default_rng(0).normal(size=(8, 2)))
    track = Map(True, {LEFT: SplineBoundary(closed, np.eye(16)), RIGHT: landmarks((0, 0), (1, 1), (2, 2))})
    assert map_bytes(track) == 8 * (16 + 9 + 6)
    assert covariance_bytes(track) == 8 * (16 * 17 // 2 + 6 * 7 // 2)
    assert map_bytes(Map(False, {LEFT: line(0.0)})) == 8 * (8 + 8)
    assert map_bytes(Map(False, {})) == covariance_bytes(Map(False, {})) == 0


def test_times_of_cycles_and_their_stages() -> None:
    cycles = [
        CycleRecord(k, 0.1 * k, 0.001 * (k + 1), 0, 0, 0, 1, {"predict": 0.0005, **extra})
        for k, extra in enumerate([{}, {}, {"close": 0.002}])
    ]
    whole, predict, close = stage_times(cycles)
    assert (whole.stage, predict.stage, close.stage) == (WHOLE, "predict", "close")
    assert (whole.mean, whole.median) == (pytest.approx(0.002), pytest.approx(0.002))
    assert whole.p99 == pytest.approx(0.00298)
    assert (predict.share, close.mean, close.median) == (0.25, pytest.approx(0.002 / 3), 0.0)
    assert np.isnan(stage_times([])[0].mean)
