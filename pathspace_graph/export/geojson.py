"""A map as GeoJSON (RFC 7946): its boundaries and its centre line, by longitude and latitude."""

import json
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.io.files import to_plain
from pathspace_graph.io.map import Map, MapBoundary, PointBoundary, SplineBoundary
from pathspace_graph.labels import BOUNDARIES, NAMES
from pathspace_graph.spline.planning import CentreLine

from .local_plane import LocalPlane
from .tables import boundary_points

Array = NDArray[np.float64]

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
