"""Knots by curvature, refits as matrices, and fits to cones."""

from __future__ import annotations

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from pathspace_graph.errors import SettingsError
from pathspace_graph.factors.arrays import Array
from pathspace_graph.settings.mapper import SplineSettings
from pathspace_graph.spline import knots
from pathspace_graph.spline.bspline import BSpline
from pathspace_graph.spline.knots import curvature_weighted_breaks, fit_spline, quantile_breaks, refit

from ..scenes.paths import TRACKS


def hairpin() -> Array:
    """Two straights of 40 m joined by a half circle of radius 4 m, a point every metre."""
    x = np.arange(0.0, 40.0)
    angle = np.linspace(-np.pi / 2, np.pi / 2, 13)
    bend = np.stack([40.0 + 4.0 * np.cos(angle), 4.0 + 4.0 * np.sin(angle)], axis=1)
    there = np.stack([x, np.zeros(40)], axis=1)
    back = np.stack([x[::-1], np.full(40, 8.0)], axis=1)
    return np.concatenate([there, bend, back])


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


def test_knots_gather_in_a_corner_and_keep_a_minimum_on_straights() -> None:
    spline = fit_spline(hairpin(), 60, periodic=False)
    corner = spline.foot_points(np.array([[40.0, 0.0], [40.0, 8.0]])).u
    densities = []
    for baseline in (1.0, 0.5, 0.2):
        breaks = curvature_weighted_breaks(spline, 24, baseline)
        assert (np.diff(breaks) > 0.0).all()
        assert (breaks[0], breaks[-1]) == spline.domain
        bent = (breaks > corner[0]) & (breaks < corner[1])
        densities.append(int(bent.sum()))
        longest = np.diff(spline.arc_length(breaks)).max()
        assert longest <= 1.05 * spline.length() / (24 * baseline)
    share = (corner[1] - corner[0]) / (spline.domain[1] - spline.domain[0])
    assert densities[0] == pytest.approx(24 * share, abs=1.5)
    assert densities[0] + 6 <= densities[1] < densities[2]


def test_equal_quantiles_done_by_hand() -> None:
    u = np.arange(5.0)
    breaks = quantile_breaks(u, np.array([0.0, 0.0, 0.3, 0.1]), 2, 0.0)
    np.testing.assert_allclose(breaks, [0.0, 2.0 + 2.0 / 3.0, 4.0])
    mixed = quantile_breaks(u, np.array([0.0, 0.0, 0.3, 0.1]), 2, 0.5)
    np.testing.assert_allclose(mixed, [0.0, 2.0 + 0.25 / 0.5, 4.0])
    straight = quantile_breaks(u, np.zeros(4), 4, 0.0)
    np.testing.assert_allclose(straight, u)


def test_a_kink_does_not_draw_all_knots() -> None:
    u = np.arange(101.0)
    curvature = np.full(100, 0.1)
    curvature[50] = 1e9
    breaks = quantile_breaks(u, curvature, 20, 0.0)
    assert np.diff(breaks).max() < 7.0


@given(seed=st.integers(0, 10_000), baseline=st.floats(0.0, 1.0), count=st.integers(1, 40))
def test_breaks_never_decrease_and_keep_both_ends(seed: int, baseline: float, count: int) -> None:
    spline = ring(9, seed)
    low, high = spline.domain
    breaks = curvature_weighted_breaks(spline, count, baseline, low + 5.0, high + 5.0)
    assert len(breaks) == count + 1
    assert (np.diff(breaks) >= 0.0).all()
    assert (breaks[0], breaks[-1]) == (low + 5.0, high + 5.0)


@pytest.mark.parametrize("periodic", [True, False])
def test_a_refit_is_exact_where_the_new_space_contains_the_old_curve(periodic: bool) -> None:
    rng = np.random.default_rng(1)
    breaks = np.concatenate([[0.0], np.cumsum(rng.uniform(2.0, 5.0, 10))])
    old = empty(breaks, periodic)
    old = old.with_points(rng.normal(size=(old.size, 2)) * 10.0)
    finer = np.sort(np.concatenate([breaks, rng.uniform(0.0, breaks[-1], 7)]))
    new = empty(finer, periodic)
    change = refit(old, new)
    assert change.new_from_old.shape == (new.size, old.size)
    np.testing.assert_allclose(change.old_from_new @ change.new_from_old, np.eye(old.size), atol=1e-9)
    moved = new.with_points(change.new_from_old @ old.distinct_control_points)
    u = np.linspace(*old.domain, 300)
    np.testing.assert_allclose(moved.evaluate(u), old.evaluate(u), atol=1e-8)


def test_a_refit_of_a_simplified_curve_gives_its_control_points_back() -> None:
    """E: any new curve, written in a finer old basis, is that curve."""
    new = ring(8)
    finer = np.unique(np.concatenate([new.breaks, 0.5 * (new.breaks[1:] + new.breaks[:-1])]))
    old = empty(finer, periodic=True)
    change = refit(old, new)
    np.testing.assert_allclose(change.new_from_old @ change.old_from_new, np.eye(8), atol=1e-9)
    seen = old.with_points(change.old_from_new @ new.distinct_control_points)
    u = np.linspace(*new.domain, 300)
    np.testing.assert_allclose(seen.evaluate(u), new.evaluate(u), atol=1e-9)


def test_closing_an_open_curve_that_overlaps_its_own_beginning() -> None:
    """An open curve once and a tenth around a circle; both ends land on the same closed curve."""
    period, radius = 60.0, 10.0
    interval = 1.5
    n = int(period * 1.1 / interval) + 3
    greville = interval * (np.arange(n) - 1.0)
    angle = 2.0 * np.pi * greville / period
    points = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    old = BSpline.open_uniform(points, interval=interval)
    assert old.domain[1] > period
    new = empty(np.linspace(0.0, period, 25), periodic=True)
    change = refit(old, new)
    closed = new.with_points(change.new_from_old @ old.control_points)
    u = np.linspace(*old.domain, 400)
    np.testing.assert_allclose(closed.evaluate(u), old.evaluate(u), atol=5e-3)
    written_back = change.old_from_new @ closed.distinct_control_points
    np.testing.assert_allclose(written_back, old.control_points, atol=0.05)


def test_a_refit_bridges_what_the_old_curve_leaves_open() -> None:
    points = np.stack([np.arange(12.0), np.zeros(12)], axis=1)
    old = BSpline.open_uniform(points)
    low, high = old.domain
    new = empty(np.linspace(low, high + 6.0, 16), periodic=True)
    change = refit(old, new)
    moved = new.with_points(change.new_from_old @ old.control_points)
    assert np.isfinite(change.new_from_old).all()
    np.testing.assert_allclose(moved.evaluate(np.linspace(low, high, 50))[:, 1], 0.0, atol=1e-6)
    assert np.abs(moved.control_points).max() < 40.0


def test_a_map_of_parameters_is_followed() -> None:
    old = ring(10)
    period = old.domain[1]
    new = empty(old.breaks + 7.0, periodic=True)
    change = refit(old, new, lambda u: u + 7.0 + 2.0 * period)
    np.testing.assert_allclose(change.new_from_old, np.eye(10), atol=1e-9)


def test_a_fit_goes_through_points_of_a_spline() -> None:
    spline = ring(12, seed=3)
    points = spline.evaluate(np.linspace(*spline.domain, 120, endpoint=False))
    fitted = fit_spline(points, 24, periodic=True)
    assert fitted.size == 24 and fitted.periodic
    assert np.abs(fitted.foot_points(points).distance).max() < 0.05


def test_curvature_weighted_knots_fit_a_hairpin_better_than_equal_ones(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    points = hairpin()

    def mean_rmse() -> float:
        fitted = [fit_spline(points, size, periodic=False) for size in range(9, 16)]
        return float(np.mean([np.sqrt(np.mean(each.foot_points(points).distance ** 2)) for each in fitted]))

    by_curvature = mean_rmse()
    monkeypatch.setattr(knots, "KNOT_ROUNDS", 0)
    assert by_curvature < 0.4 * mean_rmse()


@pytest.mark.parametrize(("count", "size"), [(2, 4), (3, 9), (5, 30)])
def test_a_fit_to_few_points_does_not_blow_up(count: int, size: int) -> None:
    angle = np.linspace(0.0, 2.0, count)
    points = 8.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    fitted = fit_spline(points, size, periodic=False)
    assert fitted.size == size
    assert np.abs(fitted.control_points).max() < 20.0
    np.testing.assert_allclose(fitted.foot_points(points).position, points, atol=0.05)


def test_settings_out_of_range_are_refused() -> None:
    with pytest.raises(SettingsError, match="baseline"):
        SplineSettings(linear_baseline=1.5)
    with pytest.raises(SettingsError, match="too few"):
        fit_spline(hairpin(), 3, periodic=True)
    with pytest.raises(SettingsError, match="distinct points"):
        fit_spline(np.zeros((5, 2)), 5, periodic=False)
    with pytest.raises(SettingsError, match="at least one"):
        quantile_breaks(np.arange(3.0), np.zeros(2), 0)


@pytest.mark.skipif(not TRACKS.is_dir(), reason="needs the real tracks beside the repository")
def test_44_percent_of_the_cones_hold_a_real_track() -> None:
    for file in sorted((TRACKS / "pacsim").glob("*.yaml"))[:3]:
        track = yaml.safe_load(file.read_text())["track"]
        for side in ("left", "right"):
            cones = np.array([cone["position"][:2] for cone in track[side]], dtype=np.float64)
            fitted = fit_spline(cones, round(0.44 * len(cones)), periodic=True)
            distance = fitted.foot_points(cones).distance
            assert np.sqrt(np.mean(distance**2)) < 0.25
