"""A map of one centre line with a width, made of a map of two boundaries."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pathspace_graph.errors import SettingsError
from pathspace_graph.io.map import Map, SplineBoundary, as_ribbon, map_of_ribbon, ribbon_of
from pathspace_graph.labels import BOUNDARIES, LEFT, RIGHT

from ..scenes.maps import SIGMA, open_map, point_map, ring_map

RADII = {LEFT: 18.0, RIGHT: 22.0}


def curve_of(track: Map, label: int) -> SplineBoundary:
    return track.curve(label, "a test")


def test_the_edges_of_a_ribbon_are_the_boundaries() -> None:
    track = as_ribbon(ring_map(), SIGMA)
    assert track.closed and track.joint_covariance is not None
    for label, radius in RADII.items():
        spline = curve_of(track, label).spline
        at = np.linspace(*spline.domain, 50)
        np.testing.assert_allclose(np.hypot(*spline.evaluate(at).T), radius, atol=0.01)


def test_a_ribbon_is_found_again_from_its_own_edges() -> None:
    """Their covariance is that of the edges across themselves."""
    ribbon = ribbon_of(ring_map())[0]
    track = map_of_ribbon(ribbon, 0.01**2 * np.eye(3 * ribbon.size), SIGMA, {})
    fitted, known, _ = ribbon_of(track)
    u = np.linspace(0.0, ribbon.tables.high, 100)
    np.testing.assert_allclose(np.hypot(*fitted.centre.evaluate(u).T), 20.0, atol=0.01)
    np.testing.assert_allclose(fitted.half_width(u), 2.0, atol=0.01)
    again = map_of_ribbon(fitted, known, 0.0, {})
    for label in BOUNDARIES:
        first, second = (curve_of(one, label) for one in (track, again))
        at = np.linspace(*first.spline.domain, 50)
        ratio = second.spline.normal_sigma(at, second.covariance) / first.spline.normal_sigma(
            at, first.covariance
        )
        assert 0.3 < np.median(ratio) < 1.5


def test_an_open_ribbon_is_confirmed_as_far_as_its_boundaries() -> None:
    whole = open_map()
    half = replace(curve_of(whole, LEFT), confirmed_until=15.0)
    track = as_ribbon(replace(whole, boundaries={LEFT: half, RIGHT: curve_of(whole, RIGHT)}), SIGMA)
    assert not track.closed
    left = curve_of(track, LEFT)
    place = left.spline.evaluate(np.array([left.confirmed_until]))[0]
    expected = half.spline.evaluate(np.array([15.0]))[0]
    np.testing.assert_allclose(place, expected, atol=0.3)
    right = curve_of(track, RIGHT)
    assert right.confirmed_until == pytest.approx(right.spline.domain[1], abs=0.5)


def test_an_outline_has_no_covariance() -> None:
    bare = {label: replace(curve_of(ring_map(), label), covariance=np.zeros((0, 0))) for label in BOUNDARIES}
    track = as_ribbon(Map(True, bare), SIGMA)
    assert track.joint_covariance is None and curve_of(track, RIGHT).covariance.shape == (0, 0)


def test_landmarks_and_one_boundary_alone_have_no_ribbon() -> None:
    for track in (point_map(), Map(True, {LEFT: curve_of(ring_map(), LEFT)})):
        with pytest.raises(SettingsError, match="a centre line: expected a curve as"):
            as_ribbon(track, SIGMA)
