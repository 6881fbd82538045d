"""The seam: where a hand-made curve's end overlaps its beginning, and the periodic curve that it becomes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.baselines.filters import Overlap, curvature_weighted_breaks, find_overlap, make_periodic
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.boundary import Boundary
from pathspace_graph.spline.bspline import BSpline, fit_spline

from ...scenes.maps import boundary_through

Array = NDArray[np.float64]

RADIUS = 15.0


def circle(turns: float) -> tuple[Boundary, Array]:
    """Returns a boundary through cones on a circle, 36 a turn, and its control points."""
    phi = np.linspace(0.0, turns * 2.0 * np.pi, round(36 * turns) + 1)
    return boundary_through(RADIUS * np.column_stack([np.cos(phi), np.sin(phi)]))


def radii(points: Array) -> Array:
    return np.hypot(*points.T)


# --- the overlap -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("turns", [1.05, 1.25, 1.5])
def test_the_seam_is_where_the_end_meets_the_beginning(turns: float) -> None:
    """The parameter is the length of the chords between the cones, of which a lap has 36."""
    boundary, points = circle(turns)
    overlap = find_overlap(boundary, points)
    lap = 36 * 2.0 * RADIUS * np.sin(np.pi / 36)
    assert overlap.period == pytest.approx(lap, abs=0.1)
    assert (np.diff(overlap.u) > 0.0).all() and (np.diff(overlap.w) >= 0.0).all()
    np.testing.assert_allclose(overlap.w, overlap.u - lap, atol=0.15)


def test_places_of_the_overlap_are_the_same_places_of_the_beginning() -> None:
    boundary, points = circle(1.3)
    overlap = find_overlap(boundary, points)
    u = np.linspace(overlap.period + 2.0, boundary.confirmed_end - 1.0, 20)
    again = overlap.new_parameter(u) - overlap.period
    np.testing.assert_allclose(boundary.evaluate(points, again), boundary.evaluate(points, u), atol=0.15)


def test_a_gap_between_end_and_beginning_counts_as_straight() -> None:
    """A tenth of the circle is missing: its chord is 2 R sin(pi / 10)."""
    boundary, points = circle(0.9)
    overlap = find_overlap(boundary, points)
    gap = 2.0 * RADIUS * np.sin(0.1 * np.pi)
    assert overlap.period == pytest.approx(boundary.confirmed_end + gap, abs=0.1)


def test_parameters_before_the_seam_stay_and_those_after_it_go_on() -> None:
    overlap = Overlap(10.0, np.array([10.0, 12.0, 14.0]), np.array([0.0, 1.0, 4.0]))
    found = overlap.new_parameter(np.array([3.0, 10.0, 11.0, 13.0, 99.0]))
    np.testing.assert_allclose(found, [3.0, 10.0, 10.5, 12.5, 14.0])


# --- the periodic curve ----------------------------------------------------------------------------------


@pytest.mark.parametrize("turns", [0.97, 1.1, 1.4])
def test_a_circle_becomes_a_closed_circle(turns: float) -> None:
    _, closed, _ = make_periodic(*circle(turns), MapperSettings())
    assert closed.periodic
    u = np.linspace(*closed.domain, 200)
    np.testing.assert_allclose(radii(closed.evaluate(u)), RADIUS, atol=0.2)


def test_the_change_of_variables_is_a_mean_of_the_old_control_points() -> None:
    """`C_new = F C`: the rows of F sum to one, and the new curve lies on the old one where that overlaps."""
    boundary, points = circle(1.3)
    overlap, closed, change = make_periodic(boundary, points, MapperSettings())
    np.testing.assert_allclose(change @ points, closed.distinct_control_points)
    np.testing.assert_allclose(change.sum(axis=1), 1.0, atol=1e-6)
    u = np.linspace(1.0, boundary.confirmed_end - 1.0, 100)
    np.testing.assert_allclose(
        closed.evaluate(overlap.new_parameter(u)), boundary.evaluate(points, u), atol=0.15
    )


@pytest.mark.parametrize(("share", "size"), [(0.43, 15), (0.25, 9), (0.1, 8)])
def test_the_size_is_a_share_of_the_cones_of_one_lap(share: float, size: int) -> None:
    """36 cones a lap, however many times the curve went past them; the least size is 8."""
    settings = MapperSettings()
    settings = replace(settings, spline=replace(settings.spline, size_share=share))
    for turns in (1.1, 1.4):
        assert make_periodic(*circle(turns), settings)[1].size == size


def test_the_size_of_a_line_is_a_share_of_places_3_m_apart_and_not_of_its_points() -> None:
    """A lap of 94 m has 31 of them before the seam, of which 0.43 are 13, however many points were merged."""
    assert make_periodic(*circle(1.1), MapperSettings(kind="line"))[1].size == 13


# --- knots by curvature ----------------------------------------------------------------------------------


def hairpin() -> Array:
    """Two straights of 40 m joined by a half circle of radius 4 m, a point every metre."""
    x = np.arange(0.0, 40.0)
    angle = np.linspace(-np.pi / 2, np.pi / 2, 13)
    bend = np.stack([40.0 + 4.0 * np.cos(angle), 4.0 + 4.0 * np.sin(angle)], axis=1)
    there = np.stack([x, np.zeros(40)], axis=1)
    back = np.stack([x[::-1], np.full(40, 8.0)], axis=1)
    return np.concatenate([there, bend, back])


def test_knots_gather_in_a_corner_and_keep_a_minimum_on_straights() -> None:
    spline, _ = fit_spline(hairpin(), 60, periodic=False)
    corner = spline.foot_points(np.array([[40.0, 0.0], [40.0, 8.0]])).u
    densities = []
    for baseline in (1.0, 0.5, 0.2):
        breaks = curvature_weighted_breaks(spline, 24, baseline, *spline.domain)
        assert (np.diff(breaks) > 0.0).all()
        assert (breaks[0], breaks[-1]) == spline.domain
        bent = (breaks > corner[0]) & (breaks < corner[1])
        densities.append(int(bent.sum()))
        longest = np.diff(spline.arc_length(breaks)).max()
        assert longest <= 1.05 * spline.length() / (24 * baseline)
    share = (corner[1] - corner[0]) / (spline.domain[1] - spline.domain[0])
    assert densities[0] == pytest.approx(24 * share, abs=1.5)
    assert densities[0] + 6 <= densities[1] < densities[2]


def test_a_kink_does_not_attract_all_knots() -> None:
    """Three control points of a circle coincide."""
    angle = 2.0 * np.pi * np.arange(40) / 40
    points = 10.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    points[[19, 21]] = points[20]
    spline = BSpline.periodic_from(np.arange(41.0), points)
    breaks = curvature_weighted_breaks(spline, 20, 0.0, *spline.domain)
    assert np.diff(spline.arc_length(breaks)).max() < 8.0


def test_knots_past_the_end_of_an_open_curve_are_even() -> None:
    """It is straight there, as long as on average for each parameter."""
    spline = BSpline.open_uniform(np.column_stack([2.0 * np.arange(12.0), np.sin(np.arange(12.0))]))
    low, high = spline.domain
    breaks = curvature_weighted_breaks(spline, 30, 0.5, low, high + 6.0)
    assert (breaks[0], breaks[-1]) == (low, high + 6.0)
    assert (np.diff(breaks) > 0.0).all()
    beyond = np.diff(breaks[breaks > high])
    np.testing.assert_allclose(beyond, beyond[0], rtol=1e-6)
