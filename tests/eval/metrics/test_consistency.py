"""Whether a covariance is right: NEES of the map, errors at the cones, turn and scale."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.eval.metrics.accuracy import (
    Deviation,
    aligned,
    consistency_at_cones,
    curve_errors,
    landmark_errors,
    map_nees,
    normal_errors,
    similarity_from_truth,
    true_curve,
    with_marginals,
)
from pathspace_graph.eval.metrics.measures import measure
from pathspace_graph.factors.se2 import left_of, rotation
from pathspace_graph.io.log import Log, Odometry, Truth
from pathspace_graph.io.map import Map, PointBoundary, SplineBoundary
from pathspace_graph.io.results import RunResult
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.spline.bspline import BSpline

from .straight_maps import landmarks, line, row, truth

Array = NDArray[np.float64]


def test_errors_of_a_curve_are_one_for_each_control_point_and_have_its_covariance() -> None:
    error, covariance = curve_errors(line(2.3, sigma=0.2), true_curve(truth(row(2.0)), LEFT), np.zeros(2))
    np.testing.assert_allclose(error, -0.3)  # the truth is to the right of the curve
    basis = line(2.3).spline.basis_matrix(np.array([0.0, 10 / 3, 20 / 3, 10.0]))
    np.testing.assert_allclose(covariance, 0.04 * basis @ basis.T, atol=1e-12)


def test_errors_of_a_floating_curve_have_a_regular_covariance() -> None:
    points = np.column_stack([np.arange(6.0) * 2, np.zeros(6)])
    floating = SplineBoundary(BSpline.open_uniform(points, interval=2.0), 0.01 * np.eye(12))
    error, covariance = curve_errors(floating, row(0.0, (0.0, 4.0, 8.0)), np.zeros(2))
    assert len(error) == 4  # those of the two outermost control points fall on the ends
    assert np.linalg.cond(covariance) < 100.0


def test_landmarks_are_paired_one_to_one_and_ghosts_are_no_errors() -> None:
    boundary = landmarks((0.1, 2.0), (0.3, 2.0), (5.0, 2.2), (30.0, 30.0))
    error, covariance = landmark_errors(boundary, row(2.0), np.zeros(2))
    np.testing.assert_allclose(error, [-0.1, 0.0, 0.0, -0.2], atol=1e-12)
    assert covariance.shape == (4, 4)
    assert len(landmark_errors(landmarks(), row(2.0), np.zeros(2))[0]) == 0


def test_nees_of_honest_maps_is_one_per_degree_and_lies_in_its_interval_95_times_of_100() -> None:
    rng = np.random.default_rng(1)
    true, found = truth(row(2.0, tuple(np.arange(0.0, 60.0, 4.0)))), []
    sigma = 0.2 * np.linalg.cholesky(np.eye(60) + 0.5)
    base = np.column_stack([np.linspace(0.0, 56.0, 30), np.full(30, 2.0)])
    for _ in range(200):
        points = base + (sigma @ rng.normal(size=60)).reshape(30, 2) * [0.0, 1.0]
        spline = BSpline.clamped_from(np.linspace(0.0, 56.0, 28), points)
        found.append(map_nees(Map(False, {LEFT: SplineBoundary(spline, sigma @ sigma.T)}), true))
    assert np.mean(found) == pytest.approx(1.0, abs=0.06)
    inside = [16.79 <= 30 * one <= 46.98 for one in found]  # 95 % of chi-squared with 30 degrees of freedom
    assert 0.88 <= np.mean(inside) <= 1.0


def test_nees_counts_overconfidence_and_knows_what_it_cannot_tell() -> None:
    true = truth(row(2.0))
    timid = map_nees(Map(False, {LEFT: landmarks((0, 2.3), (5, 2), (10, 2), sigma=3.0)}), true)
    assert timid == pytest.approx(0.01 / 6)
    singular = SplineBoundary(line(2.0).spline, np.zeros((8, 8)))
    assert np.isnan(map_nees(Map(False, {LEFT: singular}), true))
    assert np.isnan(map_nees(Map(False, {}), true))


def test_normal_errors_carry_sign_and_the_joint_covariance() -> None:
    """All control points move together: sigma is 0.2 everywhere, which marginals alone wouldn't give."""
    across = np.tile([0.0, 1.0], 4)
    track = Map(False, {LEFT: SplineBoundary(line(2.0).spline, 0.2**2 * np.outer(across, across))})
    true = truth(np.array([[2.0, 2.3], [5.0, 1.5], [8.0, 2.39]]), row(0.0))
    errors, sigmas = normal_errors(track, true)
    np.testing.assert_allclose(errors, [0.3, -0.5, 0.39], atol=1e-12)
    np.testing.assert_allclose(sigmas, 0.2, atol=1e-12)
    mean_squared = (0.3**2 + 0.5**2 + 0.39**2) / (3 * 0.2**2)
    found = consistency_at_cones(track, true)
    assert found == pytest.approx({"inside": 2 / 3, "normalized_error": mean_squared})
    of_landmarks = consistency_at_cones(Map(False, {LEFT: landmarks((0, 0))}), true)
    assert np.isnan([*of_landmarks.values()]).all()


def test_marginals_are_the_squared_basis_of_the_paper() -> None:
    """sigma_n^2 = sum_j beta_j(u)^2 n' Sigma_jj n, against the curve's normal sigma with no cross terms."""
    rng = np.random.default_rng(0)
    points = np.stack([np.arange(8.0) * 4, rng.normal(0.0, 0.5, 8)], axis=1)
    spline = BSpline(np.arange(12.0), points, 3)
    half = rng.normal(size=(16, 16))
    joint = half @ half.T
    track = Map(False, {LEFT: SplineBoundary(spline, joint)})
    cones = spline.evaluate(np.linspace(3.5, 7.5, 9)) + 0.1
    _, sigmas = normal_errors(with_marginals(track), truth(cones))
    u = np.linspace(3.0, 8.0, 20001)
    nearest = np.argmin(np.linalg.norm(cones[:, None] - spline.evaluate(u), axis=2), axis=1)
    basis = spline.basis_matrix(u[nearest])
    tangent = spline.tangent_unit(u[nearest])
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    blocks = joint.reshape(8, 2, 8, 2)[np.arange(8), :, np.arange(8), :]
    expected = np.einsum("kj,kj,ka,jab,kb->k", basis, basis, normal, blocks, normal)
    np.testing.assert_allclose(sigmas**2, expected, rtol=1e-2)
    assert not np.allclose(normal_errors(track, truth(cones))[1], sigmas, rtol=0.1)


@pytest.mark.parametrize("of_curves", [True, False])
@pytest.mark.parametrize("of_size", [True, False])
def test_an_exact_map_off_by_some_sigmas_of_its_turn_or_size_adds_their_square(
    of_curves: bool, of_size: bool
) -> None:
    """The bends of a ring move by metres, which is no error of its shape."""
    angle, breaks = np.linspace(0.0, 2 * np.pi, 41)[:-1], 6.0 * np.arange(41)
    bends = 12.0 * np.column_stack([np.zeros(40), np.sin(5 * angle)])
    ring = 40.0 * np.column_stack([np.sin(angle), 1.0 - np.cos(angle)]) + bends
    sigma = 0.02 if of_size else np.deg2rad(1.0)
    exact = BSpline.periodic_from(breaks, ring)
    cones = exact.evaluate(np.linspace(*exact.domain, 81)[:-1]) if of_curves else ring
    values = []
    for off in sigma * np.arange(4):
        points = np.exp(off) * ring if of_size else ring @ rotation(off).T
        lever = (points if of_size else left_of(points)).ravel()
        covariance = 0.05**2 * np.eye(80) + sigma**2 * np.outer(lever, lever)
        curve = SplineBoundary(BSpline.periodic_from(breaks, points), covariance)
        boundary = curve if of_curves else PointBoundary(points, covariance)
        values.append((40 if of_curves else 80) * map_nees(Map(True, {LEFT: boundary}), truth(cones)))
    np.testing.assert_allclose(np.subtract(values, values[0]), [0.0, 1.0, 4.0, 9.0], rtol=0.1, atol=0.1)


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


def test_landmarks_turn_and_grow_as_curves_do() -> None:
    """Each landmark moves by 0.1 m, and the lever arms are their distances from the start."""
    points = np.array([[5.0, 2.0], [20.0, 2.0], [40.0, -3.0]])
    moved = PointBoundary(1.01 * points @ rotation(0.02).T, np.eye(6))
    turn, scale = similarity_from_truth(Map(False, {LEFT: moved}, 0.1**2 * np.eye(6)), truth(points))
    sigma = 0.1 / (1.01 * np.sqrt(29.0 + 404.0 + 1609.0))
    assert (turn.value, turn.sigma) == (pytest.approx(0.02, abs=1e-9), pytest.approx(sigma))
    assert (scale.value, scale.sigma) == (pytest.approx(np.log(1.01), abs=1e-9), pytest.approx(sigma))
    assert turn.nees == pytest.approx((0.02 / sigma) ** 2)


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
    points = np.concatenate(
        [b.spline.distinct_control_points for b in track.boundaries.values() if isinstance(b, SplineBoundary)]
    )
    by_angle = np.column_stack([-points[:, 1], points[:, 0]]).ravel()
    found = turn_from_truth(rings(covariance=0.01**2 * np.outer(by_angle, by_angle)), ring_truth())
    assert found.sigma == pytest.approx(0.01, rel=1e-6)
    assert np.isnan(turn_from_truth(track, ring_truth()).sigma)


def test_what_is_beyond_an_open_end_or_not_mapped_does_not_count() -> None:
    cones = np.concatenate([row(2.0, FAR), row(2.0, (101.0, 102.0))])
    track = Map(False, {LEFT: line(2.0, 0.0, 100.0)})
    assert turn_from_truth(track, truth(cones, row(-2.0))).value == pytest.approx(0.0, abs=1e-12)
    assert np.isnan(turn_from_truth(Map(False, {}), ring_truth()).value)
    assert np.isnan(turn_from_truth(track, truth(row(50.0, FAR))).value)  # too far away to be the same
