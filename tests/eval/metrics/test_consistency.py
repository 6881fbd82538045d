"""NEES and the share within the band: honest, overconfident and unknown."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.batch.mapper import BatchResult
from pathspace_graph.batch.simplification import Scatter
from pathspace_graph.eval.metrics.accuracy import true_curve
from pathspace_graph.eval.metrics.consistency import (
    NormalizedError,
    consistency_at_cones,
    curve_errors,
    joint_cone_error,
    landmark_errors,
    map_nees,
    normal_errors,
    with_marginals,
)
from pathspace_graph.io.log import Truth
from pathspace_graph.io.map import Map, SplineBoundary
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.spline.bspline import BSpline

from .straight_maps import landmarks, line, row, truth


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
    assert np.isnan(NormalizedError(0.0, 0).ratio) and np.isnan(NormalizedError(0.0, 0).interval[0])


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


# --- jointly at the true cones, by the batch itself ------------------------------------------------------

Array = NDArray[np.float64]

POINTS = 8
X = np.arange(1.0, 29.0, 2.0)
SIGMA, SCATTER = 0.05, 0.1


@dataclass(frozen=True)
class Claim:
    """What `joint_cone_error` reads of a result."""

    map: Map
    map_covariance: Array
    scatter: Scatter


def wavy(y: Array) -> SplineBoundary:
    """Along x, its control points at heights (8,)."""
    points = np.column_stack([np.linspace(0.0, 30.0, POINTS), y])
    return SplineBoundary(
        BSpline.clamped_from(np.linspace(0.0, 30.0, POINTS - 2), points, 3), np.eye(2 * POINTS)
    )


def drawn(rng: np.random.Generator, common: float, factor: float = 1.0) -> tuple[BatchResult, Truth]:
    """Curves that err by SIGMA a point and by `common` together, cones by SCATTER; `factor` times as much."""
    covariance = SIGMA**2 * np.eye(4 * POINTS)
    ys = np.arange(1, 4 * POINTS, 2)
    covariance[np.ix_(ys, ys)] += common**2
    offset = factor * rng.multivariate_normal(np.zeros(4 * POINTS), covariance)[ys]
    boundaries = {LEFT: wavy(2.0 + offset[:POINTS]), RIGHT: wavy(-2.0 + offset[POINTS:])}
    places = dict.fromkeys(boundaries, X)
    scatter = Scatter(SCATTER, SCATTER, places, dict.fromkeys(boundaries, np.inf))
    cones = np.column_stack([np.tile(X, 2), np.repeat([2.0, -2.0], len(X))])
    cones[:, 1] += factor * rng.normal(0.0, SCATTER, len(cones))
    true = Truth(np.zeros(1), np.zeros((1, 3)), cones, np.repeat([LEFT, RIGHT], len(X)))
    claim = Claim(Map(False, dict(boundaries)), covariance, scatter)
    return claim, true  # type: ignore[return-value]  # only what is read


def mean_ratio(common: float, factor: float, count: int = 60) -> float:
    rng = np.random.default_rng(0)
    found = [joint_cone_error(*drawn(rng, common, factor)) for _ in range(count)]
    return float(np.mean([n.ratio for n in found]))


def test_an_honest_curve_has_one_per_cone() -> None:
    np.testing.assert_allclose(mean_ratio(0.0, 1.0), 1.0, atol=0.1)


def test_errors_that_both_curves_share_count_once() -> None:
    """As the heading of a whole map: with cross terms a common error of ten sigmas is honest."""
    np.testing.assert_allclose(mean_ratio(0.5, 1.0), 1.0, atol=0.1)


def test_twice_the_error_is_four_times_the_nees() -> None:
    np.testing.assert_allclose(mean_ratio(0.2, 2.0), 4.0, atol=0.4)


def test_a_cone_that_was_never_seen_may_be_farther_off() -> None:
    rng = np.random.default_rng(3)
    claim, true = drawn(rng, 0.0)
    cones = true.cones.copy()
    cones[6, 1] += 1.0
    off = Truth(true.pose_t, true.poses, cones, true.cone_labels)
    seen = joint_cone_error(claim, off)
    places = {label: np.delete(X, 6) for label in (LEFT, RIGHT)}
    scatter = Scatter(SCATTER, 0.5, places, dict.fromkeys(places, np.inf))
    unseen = joint_cone_error(Claim(claim.map, claim.map_covariance, scatter), off)  # type: ignore[arg-type]
    assert not seen.honest
    assert unseen.value < 0.6 * seen.value


def test_the_interval_is_two_sided() -> None:
    """Of chi-squared with 100 degrees of freedom: 74.2 to 129.6."""
    values = (74.0, 74.5, 129.0, 130.0)
    assert [NormalizedError(value, 100).honest for value in values] == [False, True, True, False]
