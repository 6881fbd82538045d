"""A map as GeoJSON (RFC 7946), by a plane that touches the ellipsoid WGS84 at the map's origin."""

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.errors import SettingsError
from pathspace_graph.export.tables import boundary_points
from pathspace_graph.io.files import to_plain
from pathspace_graph.io.map import Map, MapBoundary, PointBoundary, SplineBoundary
from pathspace_graph.labels import BOUNDARIES, NAMES
from pathspace_graph.spline.planning import CentreLine

Array = NDArray[np.float64]

SEMI_MAJOR_AXIS: Final = 6_378_137.0
"""The equator of WGS84 has this radius (m)."""
FLATTENING: Final = 1.0 / 298.257223563
"""The ellipsoid of WGS84 has this flattening."""
_SQUARE: Final = FLATTENING * (2.0 - FLATTENING)
"""This is the square e^2 of the eccentricity."""
_ITERATIONS: Final = 8
"""Each iteration of the latitude or the height leaves less than a hundredth of the error."""


@dataclass(frozen=True)
class LocalPlane:
    """Places the map frame on the plane that touches the ellipsoid at the origin of the map.

    A point (x, y) of the map lies `east = x sin h - y cos h` and `north = x cos h + y sin h` of the origin on
    that plane, where h is the heading of the x axis. It has the latitude and longitude of its foot on the
    ellipsoid. Distances on the ground differ from those of the map by about d^3 / (3 R^2): 0.01 mm in 1 km,
    and 8 mm in 10 km.
    """

    latitude: float
    """This is the latitude of the map's origin, in degrees, positive to the north."""
    longitude: float
    """This is the longitude of the map's origin, in degrees, positive to the east."""
    heading: float
    """The x axis of the map points in this direction, in degrees clockwise from north."""

    def __post_init__(self) -> None:
        if not -90.0 < self.latitude < 90.0:
            raise SettingsError(
                f"origin: expected a latitude between -90 and 90 degrees, found {self.latitude:g}"
            )
        if not -180.0 <= self.longitude <= 180.0:
            raise SettingsError(
                f"origin: expected a longitude from -180 to 180 degrees, found {self.longitude:g}"
            )
        if not -360.0 <= self.heading <= 360.0:
            raise SettingsError(
                f"origin: expected a heading from -360 to 360 degrees, found {self.heading:g}"
            )

    def to_geodetic(self, points_map: Array) -> Array:
        """Returns latitude and longitude (n, 2), in degrees, of points (n, 2) of the map in m."""
        x, y, z = (self._centre + points_map @ self._axes[:2]).T
        across = np.hypot(x, y)
        latitude = np.arctan2(z, across * (1.0 - _SQUARE))
        for _ in range(_ITERATIONS):
            sine = np.sin(latitude)
            latitude = np.arctan2(z + _SQUARE * _normal_radius(sine) * sine, across)
        return np.asarray(np.degrees(np.column_stack([latitude, np.arctan2(y, x)])))

    def to_map(self, geodetic: Array) -> Array:
        """Returns the points (n, 2) of the map, in m, of latitudes and longitudes (n, 2) in degrees.

        It is the inverse of `to_geodetic`: each point is moved up or down its normal to the plane.
        """
        height = np.zeros(len(geodetic))
        for _ in range(_ITERATIONS):
            offset = (_on_earth(np.radians(geodetic), height) - self._centre) @ self._axes.T
            height = height - offset[:, 2]
        return np.asarray(offset[:, :2])

    @cached_property
    def _centre(self) -> Array:
        """Returns the origin (3,) in m, in the frame that is fixed to the earth."""
        return np.asarray(_on_earth(np.radians([[self.latitude, self.longitude]]), np.zeros(1))[0])

    @cached_property
    def _axes(self) -> Array:
        """Returns the map's axes x, y and up as rows (3, 3), in the frame that is fixed to the earth."""
        latitude, longitude, heading = np.radians([self.latitude, self.longitude, self.heading])
        east = np.array([-np.sin(longitude), np.cos(longitude), 0.0])
        up = np.array(
            [*(np.cos(latitude) * np.array([np.cos(longitude), np.sin(longitude)])), np.sin(latitude)]
        )
        north = np.cross(up, east)
        forward = np.sin(heading) * east + np.cos(heading) * north
        return np.stack([forward, np.cross(up, forward), up])


def _normal_radius(sine: Array) -> Array:
    """Returns the radius of curvature N across the meridian, in m, at the sine of a latitude."""
    return np.asarray(SEMI_MAJOR_AXIS / np.sqrt(1.0 - _SQUARE * sine**2))


def _on_earth(geodetic: Array, height: Array) -> Array:
    """Returns points (n, 3) in the frame that is fixed to the earth, in m.

    They are given by latitude and longitude (n, 2), in rad, and height (n,) above the ellipsoid, in m.
    """
    sine, cosine = np.sin(geodetic[:, 0]), np.cos(geodetic[:, 0])
    normal = _normal_radius(sine)
    across = (normal + height) * cosine
    x, y = across * np.cos(geodetic[:, 1]), across * np.sin(geodetic[:, 1])
    return np.column_stack([x, y, (normal * (1.0 - _SQUARE) + height) * sine])


# --- the file --------------------------------------------------------------------------------------------


DECIMALS: Final = 10
"""Degrees are rounded to this number of decimals, which is 0.01 mm."""
CENTRE: Final = "centre"
"""The centre line has this name."""
_PROPERTIES: Final = (
    ("arc_length_m", "arc_length"),
    ("curvature_per_m", "curvature"),
    ("width_left_m", "width_left"),
    ("width_right_m", "width_right"),
    ("across_sigma_m", "points_sigma"),
    ("curvature_sigma_per_m", "curvature_sigma"),
    ("width_left_sigma_m", "width_left_sigma"),
    ("width_right_sigma_m", "width_right_sigma"),
)
"""Each property of the centre line is a list with a value for each point, from this attribute."""


def write_geojson(file: Path, track: Map, step: float, plane: LocalPlane) -> None:
    """Writes a FeatureCollection with each boundary and, where both are curves, the centre line.

    A curve is a LineString of points `step` (m) apart, which ends where it begins if it is closed. Landmarks
    are a MultiPoint, and so are orange cones of each label.
    """
    features = [
        _boundary(NAMES[label], boundary, step, plane)
        for label, boundary in sorted([*track.boundaries.items(), *track.points.items()])
    ]
    if all(isinstance(track.boundaries.get(label), SplineBoundary) for label in BOUNDARIES):
        features.append(_centre(track.centre_line(step), plane))
    origin = {"latitude_deg": plane.latitude, "longitude_deg": plane.longitude, "heading_deg": plane.heading}
    content = {"type": "FeatureCollection", "origin": origin, "features": features}
    file.write_text(json.dumps(to_plain(content), allow_nan=False) + "\n", encoding="utf-8", newline="\n")


def _boundary(name: str, boundary: MapBoundary, step: float, plane: LocalPlane) -> dict[str, Any]:
    points = boundary_points(boundary, step)
    kind = "MultiPoint" if isinstance(boundary, PointBoundary) else "LineString"
    closed = isinstance(boundary, SplineBoundary) and boundary.spline.periodic
    return _feature(kind, _coordinates(points, closed, plane), {"name": name, "closed": closed})


def _centre(line: CentreLine, plane: LocalPlane) -> dict[str, Any]:
    """Returns the centre line; its lists have no value for the point that a closed line repeats."""
    values = {name: getattr(line, attribute) for name, attribute in _PROPERTIES}
    properties = {"name": CENTRE, "closed": line.closed, "length_m": line.length, **values}
    return _feature("LineString", _coordinates(line.points, line.closed, plane), properties)


def _feature(kind: str, coordinates: Array, properties: dict[str, Any]) -> dict[str, Any]:
    geometry = {"type": kind, "coordinates": coordinates}
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def _coordinates(points: Array, closed: bool, plane: LocalPlane) -> Array:
    """Returns longitude and latitude (n, 2), in this order; a closed line ends with its first point."""
    degrees = np.round(plane.to_geodetic(points)[:, ::-1], DECIMALS)
    return np.concatenate([degrees, degrees[:1]]) if closed else degrees
