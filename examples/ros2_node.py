"""ROS 2 node that takes odometry and detections, and publishes the map, the path and the track ahead.

    python examples/ros2_node.py --ros-args -r odometry:=/odom -r detections:=/cones -p markers:=false

Detections are a PointCloud2 with labels, or with `markers:=true` a MarkerArray.
Only `main` and `publisher` need ROS; docs/ros2.md has the topics, frames and QoS.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pathspace_graph import LEFT, RIGHT, FixedLagMapper, Map, SplineBoundary
from pathspace_graph.convert.recording import MessageStream
from pathspace_graph.convert.settings import Frames
from pathspace_graph.errors import PathspaceError
from pathspace_graph.io.files import write_json
from pathspace_graph.io.log import SIGMA_ODOMETRY
from pathspace_graph.io.map import MAP_FILE, map_to_json, read_map
from pathspace_graph.run import CycleResult

Array = NDArray[np.float64]

STEP = 1.0
"""Distance of the published points of a boundary (m)."""
AHEAD = 20.0
"""Distance up to which boundaries and centre line are published in the vehicle's frame (m)."""
CENTRE = 2
"""Identifier of the centre line among the lines."""
COLOURS = {LEFT: (0.0, 0.2, 1.0), RIGHT: (1.0, 0.9, 0.0), CENTRE: (1.0, 1.0, 1.0)}
"""Red, green and blue of each line."""
LINE_STRIP = 4
"""Type of a `Marker` that is a line."""


class Bridge:
    """Passes ROS messages to a mapper; no message can stop it."""

    def __init__(
        self, mounting: tuple[float, float, float] = (0.0, 0.0, 0.0), wait: float = 0.0, known: str = ""
    ) -> None:
        """Begin a new map, or continue on the `known` map of a folder."""
        sigma = np.array(SIGMA_ODOMETRY)
        on = partial(FixedLagMapper.on, read_map(known)) if known else FixedLagMapper
        self.mapper: FixedLagMapper = on(odometry_sigma=sigma)
        self.stream = MessageStream(Frames(mounting), wait)

    def update(self, message: Any, received: float) -> CycleResult | None:
        """Map a message with detections, received at a time (s); return the last result, if any."""
        result: CycleResult | None = None
        for cycle in self.stream.take_detections(message, received):
            try:
                result = self.mapper.update(*cycle)
            except PathspaceError as error:  # a ReadingError changes nothing in the mapper
                self.stream.refused[str(error)] += 1
                continue
            self.stream.use(result.t)
        return result

    def save(self, folder: Path) -> None:
        """Write `map.json` to a folder, for `pathspace-graph plot` and `export`."""
        folder.mkdir(parents=True, exist_ok=True)
        write_json(folder / MAP_FILE, map_to_json(self.mapper.map()))


def boundary_points(track: Map) -> dict[int, Array]:
    """Sample points (n, 2) along each boundary, in m, map frame."""
    points = {}
    for label, boundary in track.boundaries.items():
        if isinstance(boundary, SplineBoundary):
            count = max(2, int(boundary.spline.length() / STEP) + 1)
            points[label] = boundary.spline.evaluate(np.linspace(*boundary.spline.domain, count))
    return points


def fill_line(marker: Any, points: Array, label: int, make_point: Any) -> Any:
    """Fill a `Marker` with a line through points (n, 2)."""
    marker.ns, marker.id, marker.type = "track", label, LINE_STRIP
    marker.scale.x, marker.pose.orientation.w = 0.1, 1.0
    colour = marker.color
    (colour.r, colour.g, colour.b), colour.a = COLOURS[label], 1.0
    marker.points = [make_point(x=x, y=y, z=0.0) for x, y in points.tolist()]
    return marker


def fill_pose(stamped: Any, pose: Array) -> Any:
    """Fill a `PoseStamped` with a pose (3,), map frame."""
    at = stamped.pose
    at.position.x, at.position.y = pose[:2].tolist()
    at.orientation.z, at.orientation.w = float(np.sin(pose[2] / 2)), float(np.cos(pose[2] / 2))
    return stamped


def publisher(node: Any, bridge: Bridge) -> Callable[[CycleResult], None]:
    """Function that publishes map, road ahead and path after a cycle."""
    from geometry_msgs.msg import Point, PoseStamped
    from nav_msgs.msg import Path as PathMessage
    from std_msgs.msg import Header
    from visualization_msgs.msg import Marker, MarkerArray

    to_map, to_ahead = (node.create_publisher(MarkerArray, f"~/{name}", 1) for name in ("map", "ahead"))
    to_path, path = node.create_publisher(PathMessage, "~/path", 1), PathMessage()

    def lines(points: dict[int, Array], header: Any) -> Any:
        markers = [fill_line(Marker(header=header), points[label], label, Point) for label in points]
        return MarkerArray(markers=markers)

    def publish(result: CycleResult) -> None:
        stamp, ahead = node.get_clock().now().to_msg(), bridge.mapper.ahead(AHEAD)
        path.header = Header(frame_id="map", stamp=stamp)
        to_map.publish(lines(boundary_points(bridge.mapper.outline()), path.header))
        near = {LEFT: ahead.left, RIGHT: ahead.right, CENTRE: ahead.points}
        to_ahead.publish(lines(near, Header(frame_id="base_link", stamp=stamp)))
        path.poses.append(fill_pose(PoseStamped(header=path.header), result.pose))
        to_path.publish(path)

    return publish


def main() -> None:
    """Run the node until it is stopped, then write the map to the folder `map`."""
    import rclpy
    from nav_msgs.msg import Odometry
    from rclpy.executors import ExternalShutdownException
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from sensor_msgs.msg import PointCloud2
    from std_msgs.msg import String
    from visualization_msgs.msg import MarkerArray

    rclpy.init()
    node = rclpy.create_node("pathspace_graph")
    mounting, wait = node.declare_parameter("mounting", [0.0] * 3), node.declare_parameter("wait", 0.0)
    bridge = Bridge(tuple(mounting.value), wait.value, node.declare_parameter("map", "").value)
    kind = MarkerArray if node.declare_parameter("markers", False).value else PointCloud2
    publish = publisher(node, bridge)

    def now() -> float:
        return float(node.get_clock().now().nanoseconds) * 1e-9

    def take_detections(message: Any) -> None:
        result = bridge.update(message, now())
        if result is not None:
            publish(result)

    deep, short = (QoSProfile(depth=n, reliability=ReliabilityPolicy.BEST_EFFORT) for n in (100, 10))
    take_odometry = bridge.stream.take_odometry
    node.create_subscription(Odometry, "odometry", lambda message: take_odometry(message, now()), deep)
    node.create_subscription(kind, "detections", take_detections, short)
    node.create_subscription(String, "~/save", lambda message: bridge.save(Path(message.data)), 1)
    try:
        with suppress(KeyboardInterrupt, ExternalShutdownException), threadpool_limits(limits=1):
            rclpy.spin(node)
    finally:
        bridge.save(Path("map"))
        node.get_logger().info(f"map written; refused: {dict(bridge.stream.refused)}")


if __name__ == "__main__":
    main()
