"""A map in the formats of planners and other tools: CSV, GeoJSON (RFC 7946) and Lanelet2."""

import json
from dataclasses import dataclass
from itertools import count, pairwise
from pathlib import Path
from typing import Any, Final
from xml.etree import ElementTree as ET

import numpy as np
import pymap3d

from pathspace_graph.errors import SettingsError
from pathspace_graph.factors.arrays import Array
from pathspace_graph.labels import BOUNDARIES, NAMES
from pathspace_graph.settings.mapper import SpeedSettings
from pathspace_graph.spline.bspline import BSpline
from pathspace_graph.spline.centre_line import find_line
from pathspace_graph.spline.planning import speed_profile

from .files import to_plain, write_table
from .log import COLUMNS, TRUTH_CONES_FILE
from .map import Map, MapBoundary, PointBoundary, SplineBoundary


def write_centre_line(file: Path, track: Map, step: float) -> None:
    """Write the centre line in TUM's raceline format, `step` (m) apart; a loop ends before its start."""
    line = track.centre_line(step)
    names = ("# x_m", "y_m", "w_tr_right_m", "w_tr_left_m")
    write_table(file, names, line.points, line.width_right, line.width_left)


def write_profile(
    file: Path, track: Map, step: float, limits: SpeedSettings, start: float | None = None, stop: bool = False
) -> None:
    """Write the centre line with heading, curvature, speed and acceleration (m, rad, 1/m, m/s, m/s^2).

    The columns are those of TUM's trajectories. An open line may begin at the speed `start` (m/s), or else
    SettingsError is raised, and may end at a stop.
    """
    line = track.centre_line(step)
    profile = speed_profile(line, limits, start, 0.0 if stop else None)
    if start is not None and profile.speed[0] < start:
        most = f"{profile.speed[0]:.3g} m/s on this line"
        raise SettingsError(f"expected a start speed of at most {most}, found {start:g}")
    curve = line.arc_length, line.points, line.heading, line.curvature
    names = ("# s_m", "x_m", "y_m", "psi_rad", "kappa_radpm", "vx_mps", "ax_mps2")
    write_table(file, names, *curve, profile.speed, profile.acceleration)


def write_points(file: Path, track: Map, step: float) -> None:
    """Write boundaries as points (m), `step` (m) apart, or as their landmarks, and orange cones."""
    rows = sorted([*track.boundaries.items(), *track.points.items()])
    points = [boundary_points(boundary, step) for _, boundary in rows]
    labels = [NAMES[label] for (label, _), own in zip(rows, points, strict=True) for _ in own]
    write_table(file, COLUMNS[TRUTH_CONES_FILE], np.concatenate([np.zeros((0, 2)), *points]), labels)


def boundary_points(boundary: MapBoundary, step: float) -> Array:
    """Points (n, 2) of a boundary about `step` (m) apart along it, or its landmarks."""
    return boundary.points if isinstance(boundary, PointBoundary) else spaced(boundary.spline, step)


def spaced(spline: BSpline, step: float, fewest: int = 4) -> Array:
    """Points (n, 2) of a curve about `step` (m) apart; the first of a closed one isn't repeated."""
    length = spline.length()
    at = np.linspace(0.0, length, max(round(length / step), fewest) + 1)
    return spline.evaluate(spline.parameters_at(at[:-1] if spline.periodic else at))


# --- latitude and longitude ------------------------------------------------------------------------------

_DECIMALS_DEGREES: Final = 10  # number of decimals of degrees, which is 0.01 mm


@dataclass(frozen=True)
class LocalPlane:
    """Plane of the map frame, which touches the ellipsoid WGS84 at the origin of the map.

    A point (x, y) lies `east = x sin h - y cos h` and `north = x cos h + y sin h` of the origin, where h is
    the heading of the x axis, and has the latitude and longitude of its foot on the ellipsoid. Distances on
    the ground differ by about d^3 / (3 R^2): 8 mm in 10 km.
    """

    latitude: float  # latitude of the map's origin (degrees), positive to the north
    longitude: float  # longitude of the map's origin (degrees), positive to the east
    heading: float  # direction of the map's x axis (degrees), clockwise from north

    def __post_init__(self) -> None:
        for good, expected, found in (
            (-90.0 < self.latitude < 90.0, "latitude between -90 and 90", self.latitude),
            (-180.0 <= self.longitude <= 180.0, "longitude from -180 to 180", self.longitude),
            (-360.0 <= self.heading <= 360.0, "heading from -360 to 360", self.heading),
        ):
            if not good:
                raise SettingsError(f"origin: expected a {expected} degrees, found {found:g}")

    def to_geodetic(self, points_map: Array) -> Array:
        """Latitude and longitude (n, 2), in degrees, of points (n, 2) of the map in m."""
        sine, cosine = np.sin(np.radians(self.heading)), np.cos(np.radians(self.heading))
        east, north = (points_map @ np.array([[sine, cosine], [-cosine, sine]])).T
        degrees = pymap3d.enu2geodetic(east, north, 0.0 * east, self.latitude, self.longitude, 0.0)
        return np.column_stack(degrees[:2])


# --- GeoJSON ---------------------------------------------------------------------------------------------


def write_geojson(file: Path, track: Map, step: float, plane: LocalPlane) -> None:
    """Write curves, by points `step` (m) apart, as LineStrings with a centre line, cones as MultiPoints."""

    def feature(kind: str, points: Array, closed: bool, properties: dict[str, Any]) -> dict[str, Any]:
        degrees = np.round(plane.to_geodetic(points)[:, ::-1], _DECIMALS_DEGREES)
        coordinates = np.concatenate([degrees, degrees[:1]]) if closed else degrees
        geometry = {"type": kind, "coordinates": coordinates}
        return {"type": "Feature", "geometry": geometry, "properties": properties}

    features = []
    for label, boundary in sorted([*track.boundaries.items(), *track.points.items()]):
        kind = "MultiPoint" if isinstance(boundary, PointBoundary) else "LineString"
        closed = isinstance(boundary, SplineBoundary) and boundary.spline.periodic
        properties: dict[str, Any] = {"name": NAMES[label], "closed": closed}
        features.append(feature(kind, boundary_points(boundary, step), closed, properties))
    if all(isinstance(track.boundaries.get(label), SplineBoundary) for label in BOUNDARIES):
        line = track.centre_line(step)
        properties = {"name": "centre", "closed": line.closed, "length_m": line.length}
        properties |= {  # values at its points, none at a repeated one
            "arc_length_m": line.arc_length,
            "curvature_per_m": line.curvature,
            "width_left_m": line.width_left,
            "width_right_m": line.width_right,
            "across_sigma_m": line.points_sigma,
            "curvature_sigma_per_m": line.curvature_sigma,
            "width_left_sigma_m": line.width_left_sigma,
            "width_right_sigma_m": line.width_right_sigma,
        }
        features.append(feature("LineString", line.points, line.closed, properties))
    origin = {"latitude_deg": plane.latitude, "longitude_deg": plane.longitude, "heading_deg": plane.heading}
    content = to_plain({"type": "FeatureCollection", "origin": origin, "features": features})
    file.write_text(json.dumps(content, allow_nan=False) + "\n", encoding="utf-8", newline="\n")


# --- Lanelet2 --------------------------------------------------------------------------------------------


class _Osm:
    """OSM XML that grows by nodes, ways and relations; each gets a number, and a version for readers."""

    def __init__(self, plane: LocalPlane) -> None:
        self.root = ET.Element("osm", version="0.6", generator="pathspace-graph")
        self._plane, self._numbers = plane, count(1)

    def add(self, kind: str, tags: dict[str, str], parts: list[ET.Element], **attributes: str) -> str:
        """Add an element with its parts and tags, and return its number."""
        shared = {"id": str(next(self._numbers)), "visible": "true", "version": "1"}
        element = ET.SubElement(self.root, kind, shared | attributes)
        element.extend([*parts, *(ET.Element("tag", k=key, v=value) for key, value in tags.items())])
        return shared["id"]

    def add_nodes(self, points: Array, tags: dict[str, str]) -> list[str]:
        """Add a node for each point (n, 2) of the map, and return their numbers."""
        nodes = []
        for (x, y), degrees in zip(points.tolist(), self._plane.to_geodetic(points).tolist(), strict=True):
            latitude, longitude = (f"{one:.{_DECIMALS_DEGREES}f}" for one in degrees)
            place = {"local_x": f"{x:.5f}", "local_y": f"{y:.5f}", "ele": "0.0"}
            nodes.append(self.add("node", place | tags, [], lat=latitude, lon=longitude))
        return nodes


def write_lanelet2(file: Path, track: Map, step: float, plane: LocalPlane) -> None:
    """Write both boundaries as ways of points `step` (m) apart, lanelets between them, and orange cones.

    Nodes of the OSM XML have latitude, longitude and, as tags, their place in the map frame. A loop is cut
    where normals of its centre line cross the boundaries; consecutive lanelets share their nodes there.
    """
    osm = _Osm(plane)
    left, right = (boundary.spline for boundary in track.curves("lanelet2"))
    line = find_line(left, right)
    # a loop is four lanelets: Lanelet2 knows neither length nor successor of a single one
    cuts = np.linspace(*line.ribbon.domain, 5)[: 4 if left.periodic else 0]
    sides = []
    for spline, crossing in zip((left, right), line.crossings(cuts), strict=True):
        pieces = [osm.add_nodes(piece, {}) for piece in _pieces(spline, crossing.u, step)]
        for piece, following in zip(pieces, pieces[1:] + pieces[:1] if left.periodic else [], strict=False):
            piece.append(following[0])
        sides.append(pieces)
    for label, cones in sorted(track.points.items()):
        osm.add_nodes(cones.points, {"type": "cone", "subtype": NAMES[label]})
    solid = {"type": "line_thin", "subtype": "solid"}  # must not be crossed
    road = {"type": "lanelet", "subtype": "road", "location": "nonurban"}
    road |= {"one_way": "yes", "participant:vehicle": "yes"}  # for vehicles, in the direction of travel
    ways = [
        [osm.add("way", solid, [ET.Element("nd", ref=node) for node in nodes]) for nodes in pieces]
        for pieces in sides
    ]
    for pair in zip(*ways, strict=True):
        members = [
            ET.Element("member", type="way", ref=way, role=NAMES[label])
            for label, way in zip(BOUNDARIES, pair, strict=True)
        ]
        osm.add("relation", road, members)
    ET.indent(osm.root)
    ET.ElementTree(osm.root).write(file, encoding="UTF-8", xml_declaration=True)


def _pieces(spline: BSpline, cuts: Array, step: float) -> list[Array]:
    """Points (n, 2) of each stretch between cuts, without its last one, or of an open curve."""
    if not len(cuts):
        return [spaced(spline, step, 2)]
    length, (low, high) = spline.length(), spline.domain
    begins = spline.arc_length(low + np.mod(cuts - low, high - low))
    begins = begins[0] + np.mod(begins - begins[0], length)
    pieces = []
    for begin, end in pairwise([*begins, begins[0] + length]):
        intervals = max(round((end - begin) / step), 2)
        at = np.linspace(begin, end, intervals + 1)[:-1]
        pieces.append(spline.evaluate(spline.parameters_at(np.mod(at, length))))
    return pieces
