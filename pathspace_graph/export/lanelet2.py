"""A map as a Lanelet2 map: plain OSM XML with both boundaries as ways, and one lanelet between them."""

from __future__ import annotations

from itertools import count
from pathlib import Path
from typing import Final
from xml.etree import ElementTree as ET

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.io.map import Map
from pathspace_graph.labels import BOUNDARIES, NAMES

from .local_plane import LocalPlane
from .tables import sampled

Array = NDArray[np.float64]

WAY_TAGS: Final = {"type": "line_thin", "subtype": "solid"}
"""A boundary of cones has no kind of its own; it is a line that must not be crossed."""
LANELET_TAGS: Final = {
    "type": "lanelet",
    "subtype": "road",
    "location": "nonurban",
    "one_way": "yes",
    "participant:vehicle": "yes",
}
"""The lanelet is a road for vehicles, in the direction of travel."""
_DECIMALS_DEGREES: Final = 10
"""Degrees are written with this number of decimals, which is 0.01 mm."""
_DECIMALS: Final = 5
"""Local coordinates (m) are written with this number of decimals."""


def write_lanelet2(file: Path, track: Map, step: float, plane: LocalPlane) -> None:
    """Writes both boundaries, sampled `step` (m) apart, as the two ways of one lanelet.

    Nodes have latitude, longitude and, as tags, their place in the map frame. The way of a closed boundary
    ends with the node that it begins with.
    """
    numbers = count(1)
    root = ET.Element("osm", version="0.6", generator="pathspace-graph")
    curves = [track.curve(label, "lanelet2") for label in BOUNDARIES]
    nodes = [_add_nodes(root, sampled(curve.spline, step), plane, numbers) for curve in curves]
    ways = [
        _add_way(root, own + own[: int(curve.spline.periodic)], numbers)
        for own, curve in zip(nodes, curves, strict=True)
    ]
    relation = _add(root, "relation", next(numbers))
    for label, way in zip(BOUNDARIES, ways, strict=True):
        ET.SubElement(relation, "member", type="way", ref=str(way), role=NAMES[label])
    _add_tags(relation, LANELET_TAGS)
    ET.indent(root)
    ET.ElementTree(root).write(file, encoding="UTF-8", xml_declaration=True)


def _add_nodes(root: ET.Element, points: Array, plane: LocalPlane, numbers: count[int]) -> list[int]:
    """Adds a node for each point (n, 2), and returns their numbers."""
    own = []
    for (x, y), (latitude, longitude) in zip(
        points.tolist(), plane.to_geodetic(points).tolist(), strict=True
    ):
        own.append(next(numbers))
        node = _add(root, "node", own[-1])
        node.set("lat", f"{latitude:.{_DECIMALS_DEGREES}f}")
        node.set("lon", f"{longitude:.{_DECIMALS_DEGREES}f}")
        _add_tags(node, {"local_x": f"{x:.{_DECIMALS}f}", "local_y": f"{y:.{_DECIMALS}f}", "ele": "0.0"})
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
