"""The node of ROS 2, without ROS: a drive as messages, some of them bad, gives a map."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pathspace_graph.errors import PathspaceError, SettingsError
from pathspace_graph.factors.se2 import compose
from pathspace_graph.io.files import write_json
from pathspace_graph.io.log import Detections, Log, Odometry
from pathspace_graph.io.map import map_to_json, read_map
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.loop.open import Seeking
from pathspace_graph.ros import node as ros
from pathspace_graph.ros.node import MessageStream
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track_generator import generate_track

from ..scenes.maps import ring_map
from .bags import EPOCH, Messages
from .ros2 import Node, ReliabilityPolicy, install

CYCLES = 40
ODOM_T_START = np.array([7.0, -3.0, 1.2])
"""The pose of the first odometry in its own frame."""


@pytest.fixture(scope="module")
def log() -> Log:
    return simulate(generate_track(np.random.default_rng(3)), SimulationSettings(laps=1), 3)


def feed(log: Log, odometry: Any, detections: Any) -> None:
    """Hands over the messages of the first cycles, with a broken, a repeated and a wild one among them."""
    messages, row = Messages(), 0
    for index, cycle in enumerate(log.cycles[:CYCLES]):
        while row < len(log.odometry.t) and log.odometry.t[row] <= cycle.t:
            t = float(log.odometry.t[row])
            assert log.truth is not None
            moved = np.array([np.interp(t, log.truth.pose_t, of) for of in log.truth.poses.T])
            odometry(messages.odometry(t, log.odometry.twist[row], compose(ODOM_T_START, moved)))
            row += 1
        detections(messages.cloud_of(cycle))
        if index == 10:
            detections(SimpleNamespace(data=b"rubbish"))
            odometry(SimpleNamespace())
            odometry(messages.odometry(float(log.odometry.t[row]) - 1e-3, (0.0, 0.0, 157.0)))
            detections(messages.cloud_of(cycle))
            detections(messages.cloud(1e6, {"x": ("f4", [5.0]), "y": ("f4", [1.5]), "label": ("u1", [0])}))


def driven(log: Log, **options: Any) -> tuple[ros.Bridge, list[Any]]:
    """A bridge after the first cycles, and its results."""
    bridge, results = ros.Bridge(**options), list[Any]()
    feed(
        log,
        lambda message: bridge.take_odometry(message, 0.0),
        lambda message: results.append(bridge.update(message, 0.0)),
    )
    return bridge, results


def test_a_bad_message_never_stops_the_mapper(log: Log, tmp_path: Path) -> None:
    """Among them is a yaw rate that no vehicle has, which would make each later cycle a refused one."""
    bridge, results = driven(log)
    assert [result is None for result in results] == [False] * 11 + [True] * 3 + [False] * (CYCLES - 11)
    assert results[-1].pose[0] > 1.0
    bridge.save(tmp_path / "map")
    assert read_map(tmp_path / "map").boundaries.keys() == {LEFT, RIGHT}


def test_a_map_is_never_written_over_another_one(log: Log, tmp_path: Path) -> None:
    bridge, _ = driven(log)
    folder = tmp_path / "map"
    folder.mkdir()
    (folder / "map.json").write_text("of yesterday")
    assert bridge.save(folder) == tmp_path / "map-2"
    assert bridge.save(folder) == tmp_path / "map-3"
    assert (folder / "map.json").read_text() == "of yesterday"
    assert read_map(tmp_path / "map-3").boundaries.keys() == {LEFT, RIGHT}


def test_nothing_is_written_where_nothing_is_mapped(tmp_path: Path) -> None:
    with pytest.raises(PathspaceError, match="nothing mapped yet"):
        ros.Bridge().save(tmp_path / "map")
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("sigma", [(), (0.3, 0.2, 0.05)])
def test_noise_that_nobody_stated_is_measured(log: Log, sigma: tuple[float, ...]) -> None:
    """The clouds have covariances, so that only the odometry can be without a stated noise."""
    bridge, _ = driven(log, sigma=sigma)
    assert bridge.mapper is not None
    used = bridge.mapper.noise_used()
    assert (used.odometry == "stated") == bool(sigma)
    assert used.detections == "stated"
    messages, other = Messages(), ros.Bridge()
    other.take_odometry(messages.odometry(0.0, (1.0, 0.0, 0.0)), 0.0)
    columns = {"x": ("f4", [5.0, 8.0]), "y": ("f4", [1.5, -1.5]), "label": ("u1", [0, 1])}
    other.update(messages.cloud(0.1, columns), 0.0)
    assert other.mapper is not None
    assert other.mapper.noise_used().detections != "stated"


def test_a_known_map_is_driven_on(tmp_path: Path, log: Log) -> None:
    folder = tmp_path / "map"
    folder.mkdir()
    write_json(folder / "map.json", map_to_json(ring_map()))
    bridge, _ = driven(log, known=str(folder))
    assert bridge.mapper is not None
    assert isinstance(bridge.mapper.phase, Seeking)


def test_parameters_of_a_wrong_size_are_refused() -> None:
    with pytest.raises(SettingsError, match="expected three numbers"):
        ros.Bridge(mounting=(1.0, 2.0))
    with pytest.raises(SettingsError, match="expected three numbers"):
        ros.Bridge(sigma=(1.0, 2.0))


def spun(monkeypatch: pytest.MonkeyPatch, drive: Callable[[Node], None], **parameters: Any) -> Node:
    """The node after `main`, with `drive` as what spins."""
    nodes = list[Node]()

    def spin(running: Node) -> None:
        nodes.append(running)
        drive(running)
        raise KeyboardInterrupt

    install(monkeypatch, spin, (EPOCH + 500) * 10**9, **parameters)
    assert ros.main() == 0
    return nodes[0]


def test_the_node_publishes_and_saves_when_it_is_stopped(
    log: Log, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The whole of `main`, against the recorded interface of ROS, whose clock is 500 s ahead."""

    def drive(running: Node) -> None:
        (odometry, take_odometry, deep), (cloud, take_cloud, _), (text, save, _) = running.subscribed.values()
        assert (odometry.__name__, cloud.__name__) == ("Odometry", "PointCloud2")
        assert deep.reliability == ReliabilityPolicy.BEST_EFFORT  # which every publisher fits
        feed(log, take_odometry, take_cloud)
        save(text(data="saved"))

    monkeypatch.chdir(tmp_path)
    node = spun(monkeypatch, drive, path=25)
    (written,) = tmp_path.glob("map-*")
    assert read_map(written).boundaries.keys() == {LEFT, RIGHT}
    assert read_map(tmp_path / "saved").boundaries.keys() == {LEFT, RIGHT}
    assert f"map written to {written}" in node.told
    published = node.published
    assert {name: len(messages) for name, messages in published.items()} == dict.fromkeys(
        ("~/map", "~/ahead", "~/path", "/tf"), CYCLES
    )
    frames = [published[topic][-1].markers[0].header.frame_id for topic in ("~/map", "~/ahead")]
    assert frames == ["map", "base_link"]
    left, right, centre = (marker.points for marker in published["~/ahead"][-1].markers)
    assert min(len(left), len(right), len(centre)) > 5
    assert left[3].y > centre[3].y > right[3].y
    counts = [len(message.poses) for message in published["~/path"]]
    assert counts == [min(k, 25) for k in range(1, CYCLES + 1)]  # the newest ones
    t = [one.header.stamp.sec + 1e-9 * one.header.stamp.nanosec - EPOCH for one in published["~/path"]]
    np.testing.assert_allclose(t, [cycle.t for cycle in log.cycles[:CYCLES]], atol=1e-6)
    newest = published["~/path"][-1]
    assert newest.poses[-1].header.stamp.nanosec == newest.header.stamp.nanosec


def test_the_transform_leads_from_the_map_to_the_frame_of_the_odometry(
    log: Log, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The odometry's pose is the true one in a frame of its own, so that the transform is known."""

    def drive(running: Node) -> None:
        (_, take_odometry, _), (_, take_cloud, _), _ = running.subscribed.values()
        feed(log, take_odometry, take_cloud)

    monkeypatch.chdir(tmp_path)
    node = spun(monkeypatch, drive)
    (transform,) = node.published["/tf"][-1].transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ("map", "odom")
    at, turn = transform.transform.translation, transform.transform.rotation
    found = np.array([at.x, at.y, 2.0 * np.arctan2(turn.z, turn.w)])
    np.testing.assert_allclose(compose(found, ODOM_T_START), np.zeros(3), atol=0.2)
    assert "/tf" not in spun(monkeypatch, drive, tf=False).published


def test_an_odometry_without_a_pose_gives_the_transform_to_the_vehicle(log: Log) -> None:
    bridge, results = driven(log)
    bridge._odometry.clear()
    assert bridge.map_T_odometry(results[-1]) is None


def test_without_ros_one_line_says_what_is_missing(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rclpy", None)
    assert ros.main() == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1 and "expected the package rclpy of ROS 2" in told


def test_a_known_map_that_is_none_is_told_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    install(monkeypatch, lambda node: None, 0, map=str(tmp_path / "none"))
    assert ros.main() == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1 and "none" in told


# --- messages as they arrive -----------------------------------------------------------------------------


TWIST = (3.0, 0.1, 0.5)


@pytest.fixture(scope="module")
def messages() -> Messages:
    return Messages()


@pytest.fixture
def stream(messages: Messages) -> MessageStream:
    """A stream that has the twists of one second at 10 Hz."""
    stream = MessageStream()
    for t in np.arange(11) / 10.0:
        stream.take_odometry(messages.odometry(t, TWIST), 0.0)
    return stream


def cloud(messages: Messages, t: float | None, x: float = 5.0) -> Any:
    return messages.cloud(t, {"x": ("f4", [x]), "y": ("f4", [1.5]), "label": ("u1", [0])})


def stamps(cycle: Any) -> list[float]:
    return [round(t - EPOCH, 6) for t in cycle[0].t.tolist()]


def taken(stream: MessageStream, message: Any, received: float = 0.0) -> tuple[Odometry, Detections]:
    """The one cycle that a message gives."""
    (cycle,) = stream.take_detections(message, received)
    return cycle


def test_a_cycle_has_the_twists_since_the_last_one_that_was_used(
    messages: Messages, stream: MessageStream
) -> None:
    cycle = taken(stream, cloud(messages, 0.25))
    assert stamps(cycle) == [0.0, 0.1, 0.2]
    assert cycle[1].t == pytest.approx(EPOCH + 0.25)
    again = taken(stream, cloud(messages, 0.35))
    assert stamps(again) == [0.0, 0.1, 0.2, 0.3]  # the first one was refused
    stream.use(EPOCH + 0.35)
    assert stamps(taken(stream, cloud(messages, 0.55))) == [0.3, 0.4, 0.5]


def test_cycles_wait_for_older_ones_and_come_in_order(messages: Messages) -> None:
    stream, given = MessageStream(wait=0.15), list[tuple[float, list[float]]]()
    for t in np.arange(11) / 10.0:
        stream.take_odometry(messages.odometry(t, TWIST), 0.0)
    for t in (0.25, 0.45, 0.35, 0.65, 0.15):
        for cycle in stream.take_detections(cloud(messages, t), 0.0):
            given.append((round(cycle[1].t - EPOCH, 6), stamps(cycle)))
            stream.use(cycle[1].t)
    # 0.25 goes on when 0.45 is here; 0.35, which came after it, and 0.45 when 0.65 is; 0.15 is too late
    assert given == [
        (0.25, [0.0, 0.1, 0.2]),
        (0.35, [0.2, 0.3]),
        (0.45, [0.3, 0.4]),
        (0.15, []),
    ]


def test_messages_without_a_stamp_have_the_time_of_receipt(messages: Messages) -> None:
    stream = MessageStream()
    stream.take_odometry(messages.odometry(None, TWIST), 7.0)
    cycle = taken(stream, cloud(messages, None), 7.5)
    assert cycle[0].t.tolist() == [7.0]
    assert cycle[1].t == 7.5


@pytest.mark.parametrize("broken", [None, 3, SimpleNamespace(), SimpleNamespace(header=None, twist=None)])
def test_a_broken_message_is_counted_and_left_out(
    broken: Any, messages: Messages, stream: MessageStream
) -> None:
    stream.take_odometry(broken, 2.0)
    stream.take_odometry(messages.odometry(0.5, TWIST), 0.0)
    stream.take_odometry(messages.odometry(2.0, (np.nan, 0.0, 0.0)), 0.0)
    assert not [*stream.take_detections(broken, 2.0)]
    assert not [*stream.take_detections(cloud(messages, -1.0), 0.0)]
    assert sum(stream.refused.values()) == 5
    assert stamps(taken(stream, cloud(messages, 9.0)))[-1] == 1.0


def test_a_cycle_may_be_empty(messages: Messages, stream: MessageStream) -> None:
    assert len(taken(stream, cloud(messages, 0.3, x=np.nan))[1].labels) == 0
