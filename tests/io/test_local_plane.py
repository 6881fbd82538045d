"""Latitude and longitude of a map, and back."""

from __future__ import annotations

import numpy as np
import pymap3d
import pytest
from numpy.typing import NDArray

from pathspace_graph.errors import SettingsError
from pathspace_graph.io.export import LocalPlane


def to_map(plane: LocalPlane, geodetic: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points (n, 2) of the map in m; the foot of a point on the ellipsoid is 3 mm off at 7 km."""
    origin = plane.latitude, plane.longitude, 0.0
    east, north, _ = pymap3d.geodetic2enu(*geodetic.T, np.zeros(len(geodetic)), *origin)
    s, c = np.sin(np.radians(plane.heading)), np.cos(np.radians(plane.heading))
    return np.column_stack([s * east + c * north, s * north - c * east])


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
    assert to_map(plane, plane.to_geodetic(points)) == pytest.approx(points, abs=4e-3)


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
