"""NEES and the share within the band: honest, overconfident and unknown."""

from __future__ import annotations

import numpy as np
import pytest

from pathspace_graph.eval.metrics.accuracy import true_curve
from pathspace_graph.eval.metrics.consistency import (
    NormalizedError,
    consistency_at_cones,
    curve_errors,
    landmark_errors,
    map_nees,
    normal_errors,
    with_marginals,
)
from pathspace_graph.factors.se2 import left_of, rotation
from pathspace_graph.io.map import Map, PointBoundary, SplineBoundary
from pathspace_graph.labels import LEFT
from pathspace_graph.spline.bspline import BSpline

from .straight_maps import landmarks, line, row, truth


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
    assert found[0].dof == 30
    assert np.mean([c.ratio for c in found]) == pytest.approx(1.0, abs=0.06)
    inside = [16.79 <= c.value <= 46.98 for c in found]  # 95 % of chi-squared with 30 degrees of freedom
    assert 0.88 <= np.mean(inside) <= 1.0


def test_nees_counts_overconfidence_and_knows_what_it_cannot_tell() -> None:
    true = truth(row(2.0))
    timid = map_nees(Map(False, {LEFT: landmarks((0, 2.3), (5, 2), (10, 2), sigma=3.0)}), true)
    assert (timid.value, timid.dof) == (pytest.approx(0.01), 6)
    singular = SplineBoundary(line(2.0).spline, np.zeros((8, 8)))
    assert np.isnan(map_nees(Map(False, {LEFT: singular}), true).ratio)
    assert np.isnan(NormalizedError(0.0, 0).ratio)


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
        values.append(map_nees(Map(True, {LEFT: boundary}), truth(cones)).value)
    np.testing.assert_allclose(np.subtract(values, values[0]), [0.0, 1.0, 4.0, 9.0], rtol=0.1, atol=0.1)
