"""Least-squares fits of splines to values and to points."""

from __future__ import annotations

import numpy as np
import pytest

from pathspace_graph.errors import SettingsError
from pathspace_graph.factors.arrays import Array
from pathspace_graph.spline.bspline import SAMPLED_WEIGHT, BSpline, LeastSquares, fit_spline


def ring(m: int, seed: int = 0) -> BSpline:
    """A closed curve of m control points on uneven breaks."""
    rng = np.random.default_rng(seed)
    angle = 2.0 * np.pi * np.arange(m) / m
    points = np.stack([20.0 * np.cos(angle), 12.0 * np.sin(angle)], axis=1) + rng.normal(size=(m, 2))
    breaks = np.concatenate([[0.0], np.cumsum(rng.uniform(2.0, 5.0, m))])
    return BSpline.periodic_from(breaks, points)


def empty(breaks: Array, periodic: bool, degree: int = 3) -> BSpline:
    """A spline on the breaks whose control points don't matter."""
    count = len(breaks) - 1
    if periodic:
        return BSpline.periodic_from(breaks, np.zeros((count, 2)), degree)
    return BSpline.clamped_from(breaks, np.zeros((count + degree, 2)), degree)


@pytest.mark.parametrize("periodic", [True, False])
def test_a_fit_is_exact_where_the_space_contains_the_curve(periodic: bool) -> None:
    """It is linear: the fit of the old basis maps old to new control points."""
    rng = np.random.default_rng(1)
    breaks = np.concatenate([[0.0], np.cumsum(rng.uniform(2.0, 5.0, 10))])
    old = empty(breaks, periodic)
    old = old.with_points(rng.normal(size=(old.size, 2)) * 10.0)
    new = empty(np.sort(np.concatenate([breaks, rng.uniform(0.0, breaks[-1], 7)])), periodic)
    u = np.linspace(*old.domain, 1000)
    change = LeastSquares(new, u, SAMPLED_WEIGHT).solve(old.basis_matrix(u))
    assert change.shape == (new.size, old.size)
    moved = new.with_points(change @ old.distinct_control_points)
    np.testing.assert_allclose(moved.evaluate(u), old.evaluate(u), atol=1e-4)


def test_a_fit_bridges_what_the_values_leave_open() -> None:
    points = np.stack([np.arange(12.0), np.zeros(12)], axis=1)
    old = BSpline.open_uniform(points)
    low, high = old.domain
    new, u = empty(np.linspace(low, high + 6.0, 16), periodic=True), np.linspace(low, high, 100)
    moved = new.with_points(LeastSquares(new, u, SAMPLED_WEIGHT).solve(old.evaluate(u)))
    np.testing.assert_allclose(moved.evaluate(u)[:, 1], 0.0, atol=1e-5)
    assert np.abs(moved.control_points).max() < 40.0


def test_bending_energy_is_weighed_against_the_distances() -> None:
    """A fit is where the gradient of the weighted sum vanishes."""
    spline, rng = ring(12, seed=4), np.random.default_rng(5)
    u = np.sort(rng.uniform(*spline.domain, 40))
    values, weight = rng.normal(size=(40, 2)), 3.0
    c = LeastSquares(spline, u, weight).solve(values)
    fine = np.linspace(*spline.domain, 20_001)[:-1] + 0.5 * np.diff(spline.domain) / 20_000
    second = spline.basis_matrix(fine, 2)
    energy = second.T @ second * np.diff(spline.domain) / 20_000
    B = spline.basis_matrix(u)
    np.testing.assert_allclose(B.T @ (B @ c - values) + weight * energy @ c, 0.0, atol=1e-5)


def test_a_fit_goes_through_points_of_a_spline() -> None:
    spline = ring(12, seed=3)
    points = spline.evaluate(np.linspace(*spline.domain, 120, endpoint=False))
    fitted, u = fit_spline(points, 30, periodic=True)
    assert fitted.size == 30 and fitted.periodic
    assert np.abs(fitted.foot_points(points).distance).max() < 0.05
    np.testing.assert_allclose(fitted.evaluate(u), points, atol=0.05)


@pytest.mark.parametrize(("count", "size"), [(2, 4), (3, 9), (5, 30)])
def test_a_fit_to_few_points_does_not_blow_up(count: int, size: int) -> None:
    angle = np.linspace(0.0, 2.0, count)
    points = 8.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    fitted, _ = fit_spline(points, size, periodic=False)
    assert fitted.size == size
    assert np.abs(fitted.control_points).max() < 20.0
    np.testing.assert_allclose(fitted.foot_points(points).position, points, atol=0.05)


def test_settings_out_of_range_are_refused() -> None:
    with pytest.raises(SettingsError, match="too few"):
        fit_spline(np.eye(5)[:, :2], 3, periodic=True)
    with pytest.raises(SettingsError, match="distinct points"):
        fit_spline(np.zeros((5, 2)), 5, periodic=False)
