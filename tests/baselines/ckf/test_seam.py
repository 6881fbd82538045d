"""The seam: where a hand-made curve's end overlaps its beginning, and the periodic curve that it becomes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.baselines.filters import Overlap, find_overlap, make_periodic
from pathspace_graph.settings.mapper import Knots, MapperSettings
from pathspace_graph.spline.boundary import Boundary

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


@pytest.mark.parametrize("knots", ["cones", "curvature"])
@pytest.mark.parametrize("turns", [0.97, 1.1, 1.4])
def test_a_circle_becomes_a_closed_circle(knots: Knots, turns: float) -> None:
    boundary, points = circle(turns)
    new = make_periodic(boundary, points, MapperSettings(), knots)
    closed = boundary.closed(new.knots)
    u = np.linspace(0.0, closed.length, 200)
    np.testing.assert_allclose(radii(closed.evaluate(new.points, u)), RADIUS, atol=0.2)
    ends = [closed.evaluate(new.points, np.array([at]), 1)[0] for at in (0.0, closed.length - 1e-9)]
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-6)


def test_the_change_of_variables_gives_the_old_curve_back() -> None:
    """`C_old = E C_new`, also where the curve overlaps itself. The rows of E sum to one."""
    boundary, points = circle(1.3)
    new = make_periodic(boundary, points, MapperSettings(), "cones")
    assert new.old_from_new.shape == (boundary.size, len(new.points))
    np.testing.assert_allclose(new.old_from_new.sum(axis=1), 1.0, atol=1e-9)
    u = np.linspace(1.0, boundary.confirmed_end - 1.0, 100)
    found = boundary.evaluate(new.old_from_new @ new.points, u)
    np.testing.assert_allclose(found, boundary.evaluate(points, u), atol=0.15)


@pytest.mark.parametrize(("share", "size"), [(0.43, 15), (0.25, 9), (0.1, 8)])
def test_the_size_is_a_share_of_the_cones_of_one_lap(share: float, size: int) -> None:
    """36 cones a lap, however many times the curve went past them; the least size is 8."""
    settings = MapperSettings()
    settings = replace(settings, spline=replace(settings.spline, size_share=share))
    for turns in (1.1, 1.4):
        assert len(make_periodic(*circle(turns), settings, "cones").points) == size


def test_the_size_of_a_line_is_a_share_of_places_3_m_apart_and_not_of_its_points() -> None:
    """A lap of 94 m has 31 of them before the seam, of which 0.43 are 13, however many points were merged."""
    new = make_periodic(*circle(1.1), MapperSettings(kind="line"), "cones")
    assert len(new.points) == 13
