"""The claims of the paper's isolated tests, each held against what it says; and that they are drawn."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from pathspace_graph.baselines.ckf_curves import beyond_end
from pathspace_graph.cli import main
from pathspace_graph.eval.figures.isolated import (
    BLIND,
    FIGURES,
    MARKER,
    RIDGE,
    SIGMA_DETECTION,
    expansion,
    extend,
    fit,
    simplification,
    uncertainty,
)
from pathspace_graph.io.manifest import MANIFEST_FILE
from pathspace_graph.mapping.belief import cubature_points, square_root
from pathspace_graph.settings.mapper import CkfSettings
from pathspace_graph.spline.bspline import BSpline
from pathspace_graph.spline.knots import refit


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    with threadpool_limits(limits=1):
        yield


# --- uncertainty -----------------------------------------------------------------------------------------


def test_the_joint_covariance_is_the_spread_of_splines_and_the_marginals_are_not() -> None:
    data = uncertainty(np.random.default_rng(2), 6000)
    np.testing.assert_allclose(data.joint, data.sampled, rtol=0.05)
    assert np.abs(data.marginals / data.sampled - 1.0).max() > 0.15


def test_the_curve_is_least_certain_where_nothing_was_seen() -> None:
    data = uncertainty(np.random.default_rng(0))
    share = data.length / data.length[-1]
    inner = (share > 0.1) & (share < 0.9)
    low, high = BLIND
    assert low < share[inner][np.argmax(data.joint[inner])] < high
    assert data.joint[(share > low) & (share < high)].max() > 2.0 * np.median(data.joint)


# --- expansion -------------------------------------------------------------------------------------------


def test_detections_beyond_the_end_expand_and_the_last_of_their_chain_is_interpolated() -> None:
    data = expansion()
    np.testing.assert_array_equal(data.expands, [False, False, True, True, True])
    np.testing.assert_array_equal(data.order, [2, 3, 4])
    end = data.extended.spline.evaluate(np.array([data.extended.spline.domain[1]]))[0]
    np.testing.assert_allclose(end, data.detections[4], atol=1e-9)


def test_the_three_conditions_of_an_expansion() -> None:
    straight = BSpline.clamped_from(np.array([0.0, 6.0]), np.array([[0.0, 0], [2, 0], [4, 0], [6, 0]]))
    detections = np.array([[3.0, 1.0], [7.0, 0.0], [6.5, 2.5], [9.0, 0.0]])
    u = straight.foot_points(detections).u

    def expands(threshold: float, separation: float) -> list[bool]:
        settings = CkfSettings(threshold=threshold, separation=separation)
        return beyond_end(detections, u, 6.0, straight.control_points, settings).tolist()

    assert expands(2.0, 4.0) == [False, False, False, True]
    assert expands(0.5, 1.0) == [False, True, True, True]


def test_extension_leaves_the_curve_and_its_uncertainty_as_they_were() -> None:
    data = expansion()
    old, new = data.before.spline, data.extended.spline
    u = np.linspace(*old.domain, 60)
    np.testing.assert_allclose(new.evaluate(u), old.evaluate(u), atol=1e-9)
    before, after = old.normal_sigma(u, data.before.covariance), new.normal_sigma(u, data.extended.covariance)
    # of a point on the old curve the new last control point has no share but near the seam
    np.testing.assert_allclose(after[:30], before[:30], rtol=1e-9)
    last = data.extended.covariance[-2:, -2:]
    np.testing.assert_allclose(last, SIGMA_DETECTION**2 * np.eye(2))


def test_the_covariance_of_an_extension_is_that_of_extended_samples() -> None:
    data, rng = expansion(), np.random.default_rng(4)
    detection = data.detections[4]
    extended = extend(data.before, detection, SIGMA_DETECTION**2 * np.eye(2))
    drawn = rng.multivariate_normal(data.before.spline.control_points.ravel(), data.before.covariance, 4000)
    knots = extended.spline.knots
    lengthened = []
    for points in drawn.reshape(len(drawn), -1, 2):
        # the same knots, as the covariance is that at the estimate
        moved = BSpline(data.before.spline.knots, points)
        kept = moved.with_end_knots(np.append(moved.knots[: len(points) + 1], knots[-4:-1]))
        lengthened.append(kept.control_points)
    sampled = np.cov(np.array(lengthened).reshape(len(drawn), -1).T)
    own = extended.covariance[:-2, :-2]
    assert np.abs(sampled - own).max() < 0.08 * np.abs(own).max()


def test_the_update_draws_the_curve_to_the_detections_and_makes_it_surer() -> None:
    data = expansion()
    before, after = (
        np.abs(boundary.spline.foot_points(data.detections[:4]).distance)
        for boundary in (data.extended, data.updated)
    )
    assert np.sqrt(np.mean(after**2)) < 0.5 * np.sqrt(np.mean(before**2))
    u = np.linspace(*data.extended.spline.domain, 80)
    wide = data.extended.spline.normal_sigma(u, data.extended.covariance)
    narrow = data.updated.spline.normal_sigma(u, data.updated.covariance)
    assert narrow.max() < 0.6 * wide.max()
    assert np.linalg.eigvalsh(data.extended.covariance - data.updated.covariance).min() > -1e-12


# --- fit -------------------------------------------------------------------------------------------------


def test_each_spline_is_the_ridge_regression_of_its_sigma_point() -> None:
    """The paper's solution, (B'B + L)^-1 (B'y + L C_mu), and mean and covariance of all of them."""

    data = fit()
    m, n = data.basis.shape
    L = RIDGE * np.diag(1.0 - data.basis.sum(axis=0) / m)
    known = data.curve.control_points
    for sigma_point, fitted in zip(data.sigma_points, data.fitted_points, strict=True):
        expected = np.linalg.solve(data.basis.T @ data.basis + L, data.basis.T @ sigma_point + L @ known)
        np.testing.assert_allclose(fitted, expected, atol=1e-8)
    np.testing.assert_allclose(data.fitted_points.mean(axis=0), data.measurement.points, atol=1e-9)
    spread = (data.fitted_points - data.measurement.points).reshape(-1, 2 * n)
    np.testing.assert_allclose(spread.T @ spread / len(spread), data.measurement.covariance, atol=1e-9)


def test_the_fit_lies_between_the_curve_and_the_detections_and_moves_what_the_basis_touches() -> None:
    data = fit()
    before = data.curve.foot_points(data.detections).distance
    after = data.fitted.foot_points(data.detections).distance
    assert (np.abs(after) < 0.3 * np.abs(before)).all()
    touched = data.basis.sum(axis=0) > 0.0
    moved = np.linalg.norm(data.measurement.points - data.curve.control_points, axis=1)
    assert (moved[~touched] < 1e-9).all() and moved[touched].max() > 1.0
    own = np.diag(data.measurement.covariance).reshape(-1, 2).sum(axis=1)
    assert (own[~touched] < 1e-15).all()


# --- simplification --------------------------------------------------------------------------------------


def test_a_hundred_control_points_become_thirty_two_at_little_cost() -> None:
    data = simplification()
    assert (data.old.size, data.weighted.curve.size, data.uniform.curve.size) == (100, 32, 32)
    assert data.weighted.rms < 0.12 and data.weighted.errors.max() < 0.4
    assert data.weighted.rms < data.uniform.rms
    assert data.weighted.curve.length() == pytest.approx(data.old.length(), rel=0.01)


def test_the_covariance_of_a_simplified_curve_needs_no_sigma_points() -> None:
    """The refit is linear, so F Sigma F' is what the paper's cubature transform gives, and exact."""
    data, rng = simplification(), np.random.default_rng(3)
    root = 0.1 * rng.normal(size=(200, 200)) / np.sqrt(200)
    covariance = root @ root.T + 1e-4 * np.eye(200)
    change = refit(data.old, data.weighted.curve).new_from_old
    points = cubature_points(data.old.distinct_control_points.ravel(), square_root(covariance))
    refitted = np.einsum("ij,kjd->kid", change, points.reshape(len(points), -1, 2)).reshape(len(points), -1)
    spread = refitted - refitted.mean(axis=0)
    F = np.kron(change, np.eye(2))
    np.testing.assert_allclose(spread.T @ spread / len(spread), F @ covariance @ F.T, atol=1e-10)


# --- command ---------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_command_writes_every_figure_and_its_caption(tmp_path: Path, png_only: None) -> None:
    out = tmp_path / "figures"
    assert main(["figures", "--out", str(out)]) == 0
    expected = {f"{name}.png" for name in FIGURES}
    assert {file.name for file in out.iterdir()} == expected | {MARKER, MANIFEST_FILE}
    assert all(f"({name}.png)" in (out / MARKER).read_text() for name in FIGURES)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("keep")
    assert main(["figures", "--out", str(tmp_path / "mine")]) == 2
    assert [file.name for file in (tmp_path / "mine").iterdir()] == ["notes.txt"]
