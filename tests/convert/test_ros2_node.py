"""The example of a ROS 2 node, without ROS: a drive as messages, some of them bad, gives a map."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pathspace_graph.io.files import write_json
from pathspace_graph.io.log import Log
from pathspace_graph.io.map import map_to_json, read_map
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.loop.seeking import Seeking
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track_generator import generate_track

from ..scenes.maps import ring_map
from ..scenes.paths import ROOT
from .bags import EPOCH, Messages
from .ros2 import Node, ReliabilityPolicy, install, message_class

CYCLES = 40


@pytest.fixture(scope="module")
def node() -> ModuleType:
    spec = importlib.util.spec_from_file_location("ros2_node", ROOT / "examples" / "ros2_node.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def log() -> Log:
    return simulate(generate_track(np.random.default_rng(3)), SimulationSettings(laps=1), 3)


def feed(log: Log, odometry: Any, detections: Any) -> None:
    """Hands over the messages of the first cycles, with a broken, a repeated and a wild one among them."""
    messages, row = Messages(), 0
    for index, cycle in enumerate(log.cycles[:CYCLES]):
        while row < len(log.odometry.t) and log.odometry.t[row] <= cycle.t:
            odometry(messages.odometry(float(log.odometry.t[row]), log.odometry.twist[row]))
            row += 1
        detections(messages.cloud_of(cycle))
        if index == 10:
            detections(SimpleNamespace(data=b"rubbish"))
            odometry(SimpleNamespace())
            detections(messages.cloud_of(cycle))
            detections(messages.cloud(1e6, {"x": ("f4", [5.0]), "y": ("f4", [1.5]), "label": ("u1", [0])}))


def test_a_bad_message_never_stops_the_mapper(node: ModuleType, log: Log, tmp_path: Path) -> None:
    bridge, results = node.Bridge(), []
    feed(
        log,
        lambda message: bridge.stream.take_odometry(message, 0.0),
        lambda message: results.append(bridge.update(message, 0.0)),
    )
    assert [result is None for result in results] == [False] * 11 + [True] * 3 + [False] * (CYCLES - 11)
    assert results[-1].pose[0] > 1.0
    bridge.save(tmp_path / "map")
    assert read_map(tmp_path / "map").boundaries.keys() == {LEFT, RIGHT}


def test_a_known_map_is_driven_on(node: ModuleType, tmp_path: Path) -> None:
    folder = tmp_path / "map"
    folder.mkdir()
    write_json(folder / "map.json", map_to_json(ring_map()))
    assert isinstance(node.Bridge(known=str(folder)).mapper.phase, Seeking)


def test_markers_and_poses_are_filled_in(node: ModuleType) -> None:
    points, point = np.array([[1.0, 2.0], [3.0, 4.0]]), message_class("geometry_msgs/Point")
    marker = node.fill_line(message_class("visualization_msgs/Marker")(), points, LEFT, point)
    assert [(at.x, at.y, at.z) for at in marker.points] == [(1.0, 2.0, 0.0), (3.0, 4.0, 0.0)]
    assert marker.color.b > marker.color.r and marker.type == marker.LINE_STRIP
    blank = message_class("visualization_msgs/Marker")()
    assert node.fill_line(blank, points, RIGHT, point).color.r > 0.5
    blank = message_class("geometry_msgs/PoseStamped")()
    filled = node.fill_pose(blank, np.array([1.0, 2.0, np.pi])).pose
    assert (filled.position.x, filled.position.y) == (1.0, 2.0)
    assert filled.orientation.z == pytest.approx(1.0)


def test_the_node_publishes_and_saves_when_it_is_stopped(
    node: ModuleType, log: Log, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The whole of `main`, against the recorded interface of ROS."""
    nodes = []

    def spin(running: Node) -> None:
        nodes.append(running)
        (odometry, take_odometry, deep), (cloud, take_cloud, _), (text, save, _) = running.subscribed.values()
        assert (odometry.__name__, cloud.__name__) == ("Odometry", "PointCloud2")
        assert deep.reliability == ReliabilityPolicy.BEST_EFFORT  # which every publisher fits
        feed(log, take_odometry, take_cloud)
        save(text(data="saved"))
        raise KeyboardInterrupt

    install(monkeypatch, spin, EPOCH * 10**9)
    monkeypatch.chdir(tmp_path)
    node.main()
    assert read_map(tmp_path / "map").boundaries.keys() == {LEFT, RIGHT}
    assert read_map(tmp_path / "saved").boundaries.keys() == {LEFT, RIGHT}
    published = nodes[0].published
    assert {name: len(messages) for name, messages in published.items()} == dict.fromkeys(
        ("~/map", "~/ahead", "~/path"), CYCLES
    )
    frames = [published[topic][-1].markers[0].header.frame_id for topic in ("~/map", "~/ahead")]
    assert frames == ["map", "base_link"]
    assert len(published["~/path"][-1].poses) == CYCLES
    left, right, centre = (marker.points for marker in published["~/ahead"][-1].markers)
    assert min(len(left), len(right), len(centre)) > 5
    assert left[3].y > centre[3].y > right[3].y


def test_the_example_is_short_and_says_how_to_run_it() -> None:
    text = (ROOT / "examples" / "ros2_node.py").read_text()
    assert "python examples/ros2_node.py" in text
    assert text.count("\n") < 170
