"""A map as a Lanelet2 map: plain OSM XML with both boundaries as ways, and lanelets between them."""

from __future__ import annotations

from itertools import count, pairwise
from pathlib import Path
from typing import Final
from xml.etree import ElementTree as ET

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.errors import SettingsError
from pathspace_graph.export.geojson import LocalPlane
from pathspace_graph.io.map import Map
from pathspace_graph.labels import BOUNDARIES, NAMES
from pathspace_graph.spline.bspline import BSpline
from pathspace_graph.spline.centre_line import find_line

Array = NDArray[np.float64]

WAY_TAGS: Final = {"type": "line_thin", "subtype": "solid"}
"""Tags of a way: a boundary of cones has no kind of its own, and is a line that must not be crossed."""
LANELET_TAGS: Final = {
    "type": "lanelet",
    "subtype": "road",
    "location": "nonurban",
    "one_way": "yes",
    "participant:vehicle": "yes",
}
"""Tags of a lanelet: a road for vehicles, in the direction of travel."""
CONE: Final = "cone"
"""Type of the node of an orange cone, whose subtype is its label."""
_PIECES: Final = 4
"""Number of lanelets of a loop; Lanelet2 knows neither length nor successor of a single one."""
_FEWEST_INTERVALS: Final = 2
"""Smallest number of intervals of a way."""
_DECIMALS_DEGREES: Final = 10
"""Number of decimals of degrees, which is 0.01 mm."""
_DECIMALS: Final = 5
"""Number of decimals of local coordinates (m)."""


def write_lanelet2(file: Path, track: Map, step: float, plane: LocalPlane) -> None:
    """Writes both boundaries as ways of points `step` (m) apart, lanelets between them, and orange cones.

    Nodes have latitude, longitude and, as tags, their place in the map frame. An open track is one lanelet. A
    loop is cut where normals of its centre line cross the boundaries; consecutive lanelets share their nodes
    there.
    """
    numbers = count(1)
    root = ET.Element("osm", version="0.6", generator="pathspace-graph")
    left, right = (track.curve(label, "lanelet2").spline for label in BOUNDARIES)
    if left.periodic != right.periodic:
        raise SettingsError("lanelet2: expected both boundaries closed or both open, found one of each")
    closed = left.periodic
    line = find_line(left, right, closed)
    cuts = np.linspace(*line.ribbon.domain, _PIECES + 1)[: _PIECES if closed else 0]
    ways = []
    for spline, crossing in zip((left, right), line.crossings(cuts), strict=True):
        pieces = [_add_nodes(root, piece, plane, numbers) for piece in _pieces(spline, crossing.u, step)]
        ends = pieces[1:] + pieces[:1] if closed else []
        for piece, following in zip(pieces, ends, strict=False):
            piece.append(following[0])
        ways.append(pieces)
    for label, cones in sorted(track.points.items()):
        _add_nodes(root, cones.points, plane, numbers, {"type": CONE, "subtype": NAMES[label]})
    numbered = [[_add_way(root, nodes, numbers) for nodes in pieces] for pieces in ways]
    for pair in zip(*numbered, strict=True):
        relation = _add(root, "relation", next(numbers))
        for label, way in zip(BOUNDARIES, pair, strict=True):
            ET.SubElement(relation, "member", type="way", ref=str(way), role=NAMES[label])
        _add_tags(relation, LANELET_TAGS)
    ET.indent(root)
    ET.ElementTree(root).write(file, encoding="UTF-8", xml_declaration=True)


def _pieces(spline: BSpline, cuts: Array, step: float) -> list[Array]:
    """Returns the points (n, 2) of each stretch between cuts, without its last one, or of an open curve."""
    length = spline.length()
    if len(cuts):
        low, high = spline.domain
        begins = spline.arc_length(low + np.mod(cuts - low, high - low))
        begins = begins[0] + np.mod(begins - begins[0], length)
        ends = np.append(begins, begins[0] + length)
    else:
        ends = np.array([0.0, length])
    pieces = []
    for begin, end in pairwise(ends):
        intervals = max(round((end - begin) / step), _FEWEST_INTERVALS)
        at = np.linspace(begin, end, intervals + 1)[: -1 if len(cuts) else None]
        pieces.append(spline.evaluate(spline.parameters_at(np.mod(at, length) if len(cuts) else at)))
    return pieces


def _add_nodes(
    root: ET.Element,
    points: Array,
    plane: LocalPlane,
    numbers: count[int],
    tags: dict[str, str] | None = None,
) -> list[int]:
    """Adds a node with tags for each point (n, 2), and returns their numbers."""
    own = []
    for (x, y), (latitude, longitude) in zip(
        points.tolist(), plane.to_geodetic(points).tolist(), strict=True
    ):
        own.append(next(numbers))
        node = _add(root, "node", own[-1])
        node.set("lat", f"{latitude:.{_DECIMALS_DEGREES}f}")
        node.set("lon", f"{longitude:.{_DECIMALS_DEGREES}f}")
        _add_tags(node, {"local_x": f"{x:.{_DECIMALS}f}", "local_y": f"{y:.{_DECIMALS}f}", "ele": "0.0"})
        _add_tags(node, tags or {})
    return own


def _add_way(root: ET.Element, nodes: list[int], numbers: count[int]) -> int:
    number = next(numbers)
    way = _add(root, "way", number)
    for node in nodes:
        ET.SubElement(way, "nd", ref=str(node))
    _add_tags(way, WAY_TAGS)
    return number


def _add(root: ET.Element, kind: str, number: int) -> ET.Element:
    """Adds an element with its number; readers of OSM XML expect a version."""
    return ET.SubElement(root, kind, id=str(number), visible="true", version="1")


def _add_tags(element: ET.Element, tags: dict[str, str]) -> None:
    for key, value in tags.items():
        ET.SubElement(element, "tag", k=key, v=value)
