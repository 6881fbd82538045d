"""Latitude and longitude of a map, and back."""

from __future__ import annotations

import numpy as np
import pytest

from pathspace_graph.errors import SettingsError
from pathspace_graph.io.export import FLATTENING, SEMI_MAJOR_AXIS, LocalPlane

from .earth import to_map

SQUARE = FLATTENING * (2.0 - FLATTENING)

ORIGINS = [
    (0.0, 0.0, 0.0),
    (48.1, 11.5, 30.0),
    (-33.9, 151.2, -120.0),
    (71.0, 180.0, 359.0),
    (-89.0, -45.0, 90.0),
]


@pytest.mark.parametrize("origin", ORIGINS)
def test_round_trip(origin: tuple[float, float, float]) -> None:
    plane = LocalPlane(*origin)
    points = np.random.default_rng(0).uniform(-5000.0, 5000.0, (200, 2))
    assert to_map(plane, plane.to_geodetic(points)) == pytest.approx(points, abs=1e-6)


@pytest.mark.parametrize("origin", ORIGINS)
def test_the_origin_is_where_it_is_said_to_be(origin: tuple[float, float, float]) -> None:
    there = LocalPlane(*origin).to_geodetic(np.zeros((1, 2)))[0]
    assert there == pytest.approx(origin[:2], abs=1e-12)


@pytest.mark.parametrize(
    ("heading", "east", "north"), [(0.0, 0.0, 1.0), (90.0, 1.0, 0.0), (180.0, 0.0, -1.0), (-90.0, -1.0, 0.0)]
)
def test_x_points_along_the_heading_clockwise_from_north(heading: float, east: float, north: float) -> None:
    moved = LocalPlane(48.0, 11.0, heading).to_geodetic(np.array([[1000.0, 0.0]]))[0] - [48.0, 11.0]
    assert np.sign(np.round(moved, 4)) == pytest.approx([north, east])


def test_y_points_to_the_left_of_it() -> None:
    to_left = LocalPlane(48.0, 11.0, 0.0).to_geodetic(np.array([[0.0, 100.0]]))[0]
    assert to_left[1] < 11.0
    assert to_left[0] == pytest.approx(48.0, abs=1e-6)


def test_a_kilometre_is_one_by_the_radii_of_curvature_to_a_tenth_of_a_millimetre() -> None:
    """North along the meridian by the integral of M, east along the equator by the arc."""
    north = LocalPlane(48.0, 11.0, 0.0).to_geodetic(np.array([[1000.0, 0.0]]))[0]
    latitude = np.linspace(np.radians(48.0), np.radians(north[0]), 2001)
    radius = SEMI_MAJOR_AXIS * (1.0 - SQUARE) / (1.0 - SQUARE * np.sin(latitude) ** 2) ** 1.5
    assert np.trapezoid(radius, latitude) == pytest.approx(1000.0, abs=1e-4)
    east = LocalPlane(0.0, 11.0, 90.0).to_geodetic(np.array([[1000.0, 0.0]]))[0]
    assert SEMI_MAJOR_AXIS * np.radians(east[1] - 11.0) == pytest.approx(1000.0, abs=1e-4)


@pytest.mark.parametrize(
    ("origin", "name"),
    [
        ((90.0, 0.0, 0.0), "latitude"),
        ((np.nan, 0.0, 0.0), "latitude"),
        ((0.0, 181.0, 0.0), "longitude"),
        ((0.0, 0.0, np.inf), "heading"),
    ],
)
def test_an_origin_that_is_none(origin: tuple[float, float, float], name: str) -> None:
    with pytest.raises(SettingsError, match=f"expected a {name}"):
        LocalPlane(*origin)
