"""Latitude and longitude as points of a map, the inverse of `LocalPlane.to_geodetic`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.io.export import LocalPlane

Array = NDArray[np.float64]
SEMI_MAJOR_AXIS = 6_378_137.0
FLATTENING = 1.0 / 298.257223563
SQUARE = FLATTENING * (2.0 - FLATTENING)


def to_map(plane: LocalPlane, geodetic: Array) -> Array:
    """Points (n, 2) of the map, in m: each is moved up or down its normal to the plane."""
    latitude, longitude, heading = np.radians([plane.latitude, plane.longitude, plane.heading])
    east = np.array([-np.sin(longitude), np.cos(longitude), 0.0])
    up = np.array(
        [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)]
    )
    x = np.sin(heading) * east + np.cos(heading) * np.cross(up, east)
    axes = np.stack([x, np.cross(up, x), up])
    origin = on_earth(np.array([[latitude, longitude]]), np.zeros(1))[0]
    height = np.zeros(len(geodetic))
    for _ in range(8):
        offset = (on_earth(np.radians(geodetic), height) - origin) @ axes.T
        height = height - offset[:, 2]
    return np.asarray(offset[:, :2])


def on_earth(geodetic: Array, height: Array) -> Array:
    """Points (n, 3) in the frame fixed to the earth, in m."""
    (latitude, longitude), sine = geodetic.T, np.sin(geodetic[:, 0])
    normal = SEMI_MAJOR_AXIS / np.sqrt(1.0 - SQUARE * sine**2)
    across = (normal + height) * np.cos(latitude)
    z = (normal * (1.0 - SQUARE) + height) * sine
    return np.column_stack([across * np.cos(longitude), across * np.sin(longitude), z])
