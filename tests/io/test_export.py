"""Each format is read back, and equals what was written to its precision."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pymap3d
import pytest
from numpy.typing import NDArray

from pathspace_graph.errors import SettingsError
from pathspace_graph.io.export import (
    LocalPlane,
    spaced,
    write_centre_line,
    write_geojson,
    write_lanelet2,
    write_points,
    write_profile,
)
from pathspace_graph.io.map import Map, PointBoundary, SplineBoundary
from pathspace_graph.io.tables import read_table
from pathspace_graph.labels import BIG_ORANGE, LEFT, ORANGE, RIGHT
from pathspace_graph.settings.mapper import SpeedSettings
from pathspace_graph.spline.planning import speed_profile

from ..scenes.maps import open_map, point_map, ring_map

Array = NDArray[np.float64]

PLANE = LocalPlane(48.1, 11.5, 30.0)
every_map = pytest.mark.parametrize("make", [ring_map, open_map])


def points_of(track: Map, label: int, step: float) -> Array:
    boundary = track.boundaries[label]
    assert isinstance(boundary, SplineBoundary)
    return spaced(boundary.spline, step)


@every_map
def test_the_raceline_format(make: Callable[[], Map], tmp_path: Path) -> None:
    file, track = tmp_path / "line.csv", make()
    write_centre_line(file, track, 0.7)
    line = track.centre_line(0.7)
    rows = np.loadtxt(file, comments="#", delimiter=",")  # as TUM's own tools read it
    assert np.array_equal(rows, np.column_stack([line.points, line.width_right, line.width_left]))


@every_map
def test_the_speed_profile(make: Callable[[], Map], tmp_path: Path) -> None:
    file, track, settings = tmp_path / "profile.csv", make(), SpeedSettings(lateral=4.0)
    write_profile(file, track, 0.7, settings)
    line = track.centre_line(0.7)
    profile = speed_profile(line, settings)
    rows = np.loadtxt(file, comments="#", delimiter=",").T
    expected = (line.arc_length, *line.points.T, line.heading, line.curvature, profile.speed)
    assert np.array_equal(rows, np.array([*expected, profile.acceleration]))
    if line.closed:  # a circle of 20 m
        assert rows[5] == pytest.approx(np.sqrt(4.0 * 20.0), rel=2e-3)


def test_the_profile_of_an_open_track_begins_at_a_speed_and_ends_at_a_stop(tmp_path: Path) -> None:
    file, settings = tmp_path / "profile.csv", SpeedSettings(forward=2.0, braking=3.0)
    write_profile(file, open_map(), 0.7, settings, start=3.0, stop=True)
    speed = np.loadtxt(file, comments="#", delimiter=",").T[5]
    assert (speed[0], speed[-1]) == (3.0, 0.0)
    assert 3.0 < speed.max() < settings.top
    with pytest.raises(SettingsError, match=r"start speed of at most .*, found 99"):
        write_profile(file, open_map(), 0.7, settings, start=99.0)
    with pytest.raises(SettingsError, match=r"expected an open line .* found a loop"):
        write_profile(file, ring_map(), 0.7, settings, stop=True)


@every_map
def test_points(make: Callable[[], Map], tmp_path: Path) -> None:
    file, track = tmp_path / "points.csv", make()
    write_points(file, track, 0.7)
    table = read_table(file, ("x", "y", "label"))
    labels = np.array(table.columns["label"])
    for label, name in ((LEFT, "left"), (RIGHT, "right")):
        points = points_of(track, label, 0.7)
        assert np.array_equal(table.stack(("x", "y"))[labels == name], points)
        assert np.linalg.norm(np.diff(points, axis=0), axis=1) == pytest.approx(0.7, abs=0.02)


def test_orange_cones_are_points_of_their_own_label(tmp_path: Path) -> None:
    gate = PointBoundary(np.array([[1.5, 2.0], [1.5, -2.0]]), 0.01 * np.eye(4))
    track = replace(ring_map(), points={BIG_ORANGE: gate})
    write_points(tmp_path / "points.csv", track, 1.0)
    assert (tmp_path / "points.csv").read_text().splitlines()[-2:] == [
        "1.5,2.0,big_orange",
        "1.5,-2.0,big_orange",
    ]
    write_geojson(tmp_path / "map.geojson", track, 1.0, PLANE)
    features = json.loads((tmp_path / "map.geojson").read_text())["features"]
    own = next(one for one in features if one["properties"]["name"] == "big_orange")
    assert own["geometry"]["type"] == "MultiPoint"
    assert len(own["geometry"]["coordinates"]) == 2


def test_landmarks_are_points_as_they_are(tmp_path: Path) -> None:
    file = tmp_path / "points.csv"
    write_points(file, point_map(), 1.0)
    assert file.read_text().splitlines() == ["x,y,label", "0.0,2.0,left", "4.0,2.5,left", "0.5,-2.0,right"]


@every_map
def test_geojson(make: Callable[[], Map], tmp_path: Path) -> None:
    file, track = tmp_path / "map.geojson", make()
    write_geojson(file, track, 0.7, PLANE)
    content = json.loads(file.read_text())
    assert content["type"] == "FeatureCollection"
    assert content["origin"] == {"latitude_deg": 48.1, "longitude_deg": 11.5, "heading_deg": 30.0}
    features = {feature["properties"]["name"]: feature for feature in content["features"]}
    line = track.centre_line(0.7)
    expected = {
        "left": points_of(track, LEFT, 0.7),
        "right": points_of(track, RIGHT, 0.7),
        "centre": line.points,
    }
    for name, points in expected.items():
        geometry = features[name]["geometry"]
        assert geometry["type"] == "LineString"
        degrees = np.array(geometry["coordinates"])
        assert np.array_equal(degrees[0], degrees[-1]) == track.closed
        there = to_map(PLANE, degrees[: len(points), ::-1])
        assert there == pytest.approx(points, abs=2e-5)
        assert len(degrees) == len(points) + track.closed
    properties = features["centre"]["properties"]
    assert properties["width_left_m"] == line.width_left.tolist()
    assert properties["across_sigma_m"] == line.points_sigma.tolist()
    assert properties["length_m"] == line.length


@every_map
def test_lanelet2(make: Callable[[], Map], tmp_path: Path) -> None:
    """A loop is four lanelets, each of which ends with the nodes that the next one begins with."""
    file, track = tmp_path / "map.osm", make()
    write_lanelet2(file, track, 0.7, PLANE)
    root = ET.parse(file).getroot()
    nodes = {node.get("id"): node for node in root.findall("node")}
    ways = {way.get("id"): [ref.get("ref") for ref in way.findall("nd")] for way in root.findall("way")}
    relations = root.findall("relation")
    assert len(relations) == (4 if track.closed else 1)
    assert len(nodes) + len(ways) + len(relations) == len({element.get("id") for element in root})
    for label, name in ((LEFT, "left"), (RIGHT, "right")):
        own = [ways[member.get("ref")] for r in relations for member in r if member.get("role") == name]
        for refs, following in zip(own, own[1:] + own[:1], strict=True):
            assert (refs[-1] == following[0]) == track.closed
        row = [nodes[ref] for refs in own for ref in refs[: len(refs) - track.closed]]
        degrees = np.array([[float(node.get("lat", "")), float(node.get("lon", ""))] for node in row])
        points = to_map(PLANE, degrees)
        curve = track.curve(label, "a test").spline
        assert curve.foot_points(points).distance == pytest.approx(0.0, abs=2e-5)
        ring = np.concatenate([points, points[:1]]) if track.closed else points
        steps = np.linalg.norm(np.diff(ring, axis=0), axis=1)
        assert steps == pytest.approx(0.7, abs=0.05)
        assert steps.sum() == pytest.approx(curve.length(), rel=1e-3)


def orange(track: Map) -> Map:
    points = np.array([[1.0, 2.0], [3.0, 4.0]])
    cones = {ORANGE: PointBoundary(points, np.eye(4)), BIG_ORANGE: PointBoundary(points[:1] + 5.0, np.eye(2))}
    return replace(track, points=cones)


def test_lanelet2_reads_a_loop_that_leads_round(tmp_path: Path) -> None:
    """The package finds lengths, successors, a route over all lanelets, and the orange cones."""
    for name in ("", ".io", ".projection", ".routing", ".traffic_rules"):
        pytest.importorskip(f"lanelet2{name}")
    import lanelet2  # noqa: PLC0415

    file, track = tmp_path / "map.osm", orange(ring_map())
    write_lanelet2(file, track, 0.7, PLANE)
    origin = lanelet2.io.Origin(PLANE.latitude, PLANE.longitude)
    loaded = lanelet2.io.load(str(file), lanelet2.projection.UtmProjector(origin))
    lanelets = list(loaded.laneletLayer)
    assert len(lanelets) == 4
    lengths = [lanelet2.geometry.length(lanelet2.geometry.to2D(lanelet.centerline)) for lanelet in lanelets]
    assert sum(lengths) == pytest.approx(2 * np.pi * 20.0, rel=0.01)
    rules = lanelet2.traffic_rules.create(
        lanelet2.traffic_rules.Locations.Germany, lanelet2.traffic_rules.Participants.Vehicle
    )
    graph = lanelet2.routing.RoutingGraph(loaded, rules)
    visited = [lanelets[0]]
    for _ in range(4):
        (following,) = graph.following(visited[-1])
        visited.append(following)
    assert visited[-1].id == lanelets[0].id
    assert len({lanelet.id for lanelet in visited}) == 4
    assert [lanelet.id for lanelet in graph.getRoute(visited[0], visited[3]).shortestPath()] == [
        lanelet.id for lanelet in visited[:4]
    ]
    cones = [point for point in loaded.pointLayer if "type" in point.attributes]
    assert sorted(cone.attributes["subtype"] for cone in cones) == ["big_orange", "orange", "orange"]
    assert {cone.attributes["type"] for cone in cones} == {"cone"}


def test_what_needs_two_curves_says_so(tmp_path: Path) -> None:
    left_alone = Map(False, {LEFT: open_map().boundaries[LEFT]})
    for track, found in ((point_map(), "points in no order"), (left_alone, "none")):
        with pytest.raises(SettingsError, match=f"expected a curve as .* boundary, found {found}"):
            write_lanelet2(tmp_path / "map.osm", track, 1.0, PLANE)
        with pytest.raises(SettingsError, match=f"expected a curve as .* boundary, found {found}"):
            track.centre_line()


# --- latitude and longitude ------------------------------------------------------------------------------


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


@pytest.mark.parametrize(
    ("heading", "east", "north"), [(0.0, 0.0, 1.0), (90.0, 1.0, 0.0), (180.0, 0.0, -1.0), (-90.0, -1.0, 0.0)]
)
def test_x_points_along_the_heading_clockwise_from_north(heading: float, east: float, north: float) -> None:
    moved = LocalPlane(48.0, 11.0, heading).to_geodetic(np.array([[1000.0, 0.0]]))[0] - [48.0, 11.0]
    assert np.sign(np.round(moved, 4)) == pytest.approx([north, east])


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
