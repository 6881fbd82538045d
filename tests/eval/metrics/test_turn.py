"""Turn and scale of maps that are the truth turned and scaled, and the variances that are claimed of them."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.eval.metrics.consistency import Deviation, aligned, similarity_from_truth
from pathspace_graph.eval.metrics.measures import measure
from pathspace_graph.factors.se2 import rotation
from pathspace_graph.io.log import Log, Odometry, Truth
from pathspace_graph.io.map import Map, PointBoundary, SplineBoundary
from pathspace_graph.io.results import RunResult
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.spline.bspline import BSpline

from .straight_maps import line, row, truth

Array = NDArray[np.float64]

FAR = (10.0, 50.0, 90.0)


def turn_from_truth(track: Map, truth: Truth) -> Deviation:
    (turn,) = similarity_from_truth(track, truth, 1)
    return turn


def ring(radius: float, angle: float = 0.0) -> SplineBoundary:
    """A closed curve about (30, 20), turned about the origin."""
    at = np.arange(24) * 2 * np.pi / 24
    points = np.array([30.0, 20.0]) + radius * np.column_stack([np.cos(at), np.sin(at)])
    breaks = np.linspace(0.0, 2 * np.pi * radius, 25)
    spline = BSpline.periodic_from(breaks, points @ rotation(angle).T)
    return SplineBoundary(spline, np.eye(48))


def rings(angle: float = 0.0, covariance: Array | None = None) -> Map:
    return Map(True, {LEFT: ring(15.0, angle), RIGHT: ring(19.0, angle)}, covariance)


def ring_truth() -> Truth:
    """True cones exactly on the curves that aren't turned."""
    left, right = (
        ring(r).spline.evaluate(np.linspace(0.0, 2 * np.pi * r, 40, endpoint=False)) for r in (15.0, 19.0)
    )
    return truth(left, right)


@pytest.mark.parametrize("angle", [0.0, 1e-3, -0.02, 0.3])
def test_a_turned_map_has_its_angle(angle: float) -> None:
    assert turn_from_truth(rings(angle), ring_truth()).value == pytest.approx(angle, abs=1e-8)


def test_landmarks_turn_as_curves_do() -> None:
    points = np.array([[5.0, 2.0], [20.0, 2.0], [40.0, -3.0]])
    turned = PointBoundary(points @ rotation(0.02).T, np.eye(6))
    found = turn_from_truth(Map(False, {LEFT: turned}, 0.1**2 * np.eye(6)), truth(points))
    assert found.value == pytest.approx(0.02, abs=1e-9)
    # each landmark moves by 0.1 m, and the lever arms are their distances from the start
    assert found.sigma == pytest.approx(0.1 / np.sqrt(29.0 + 404.0 + 1609.0))
    assert found.nees == pytest.approx((0.02 / found.sigma) ** 2)


def test_the_errors_of_a_straight_weigh_by_their_lever() -> None:
    """A straight that is 0.1 m too far left has the turn of the least squares fit through the start."""
    track = Map(False, {LEFT: line(2.1, 0.0, 100.0)})
    x = np.array(FAR)
    expected = np.arctan(0.1 * x.sum() / (x @ x))
    assert turn_from_truth(track, truth(row(2.0, FAR))).value == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize(("angle", "scale"), [(0.0, 0.02), (0.03, -0.05), (-0.02, 0.0)])
def test_a_map_that_is_turned_and_too_large_has_both(angle: float, scale: float) -> None:
    true = aligned(ring_truth(), -angle, -scale)
    turn, size = similarity_from_truth(rings(), true)
    assert (turn.value, size.value) == pytest.approx((angle, scale), abs=1e-7)


def test_landmarks_that_only_grow_have_no_turn_and_the_scale_s_sigma() -> None:
    points = np.array([[5.0, 2.0], [20.0, 2.0], [40.0, -3.0]])
    grown = PointBoundary(1.01 * points, np.eye(6))
    turn, scale = similarity_from_truth(Map(False, {LEFT: grown}, 0.1**2 * np.eye(6)), truth(points))
    assert turn.value == pytest.approx(0.0, abs=1e-9)
    assert scale.value == pytest.approx(np.log(1.01), abs=1e-9)
    # each landmark moves by 0.1 m, and the lever arms are their distances from the start
    assert scale.sigma == pytest.approx(0.1 / (1.01 * np.sqrt(29.0 + 404.0 + 1609.0)))


def test_the_rmse_without_turn_and_scale_is_that_of_the_shape() -> None:
    true = aligned(ring_truth(), 0.0, -0.03)
    nothing = RunResult("made", {}, rings(0.02), np.zeros(0), np.zeros((0, 3)), (), 0)
    values = measure(nothing, Log(Odometry(np.zeros(1), np.zeros((1, 3))), (), np.ones(3), truth=true))[0]
    assert values["rmse"] > 0.5 and values["rmse_aligned"] == pytest.approx(0.0, abs=1e-4)
    assert values["map_scale"] == pytest.approx(0.03, abs=1e-6)
    assert "map_scale_nees" not in values and "turn_nees" not in values  # without a joint covariance


def test_the_sigma_comes_from_the_joint_covariance() -> None:
    """Control points that only turn together about the start have exactly the turn's own variance."""
    track = rings()
    points = np.concatenate([b.spline.distinct_control_points for b in spline_boundaries(track)])
    by_angle = np.column_stack([-points[:, 1], points[:, 0]]).ravel()
    found = turn_from_truth(rings(covariance=0.01**2 * np.outer(by_angle, by_angle)), ring_truth())
    assert found.sigma == pytest.approx(0.01, rel=1e-6)
    assert np.isnan(turn_from_truth(track, ring_truth()).sigma)


def spline_boundaries(track: Map) -> list[SplineBoundary]:
    return [boundary for boundary in track.boundaries.values() if isinstance(boundary, SplineBoundary)]


def test_what_is_beyond_an_open_end_or_not_mapped_does_not_count() -> None:
    cones = np.concatenate([row(2.0, FAR), row(2.0, (101.0, 102.0))])
    track = Map(False, {LEFT: line(2.0, 0.0, 100.0)})
    assert turn_from_truth(track, truth(cones, row(-2.0))).value == pytest.approx(0.0, abs=1e-12)
    assert np.isnan(turn_from_truth(Map(False, {}), ring_truth()).value)
    assert np.isnan(turn_from_truth(track, truth(row(50.0, FAR))).value)  # too far away to be the same
