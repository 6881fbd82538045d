"""ROS 2 node that takes odometry and detections, and publishes the map, the path and the track ahead.

    pathspace-graph-ros --ros-args -r odometry:=/odom -r detections:=/cones -p markers:=false

Detections are a PointCloud2 with labels, or with `markers:=true` a MarkerArray. Only `main` and `publisher`
need ROS; docs/ros2.md has the topics, parameters, frames and QoS.
"""

import sys
from bisect import insort
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from datetime import datetime
from itertools import count
from pathlib import Path
from typing import Any, Final

import numpy as np
from threadpoolctl import threadpool_limits

from pathspace_graph.convert import messages, recording
from pathspace_graph.convert.settings import Frames, LabelRule, NoiseSettings
from pathspace_graph.errors import PathspaceError, SettingsError
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.noise import KnownNoise
from pathspace_graph.factors.se2 import compose, inverse, se2_exp
from pathspace_graph.io.files import write_json
from pathspace_graph.io.log import SIGMA_ODOMETRY, Detections, Odometry
from pathspace_graph.io.map import MAP_FILE, Map, SplineBoundary, map_to_json, read_map
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.run import CycleResult, spared_by_collector

STEP: Final = 1.0  # distance of the published points of a boundary (m)
AHEAD: Final = 20.0  # distance up to which the road ahead is published (m)
CENTRE: Final = 2  # identifier of the centre line among the lines
COLOURS: Final = {LEFT: (0.0, 0.2, 1.0), RIGHT: (1.0, 0.9, 0.0), CENTRE: (1.0, 1.0, 1.0)}  # red, green, blue
MOST_POSES: Final = 1000  # number of poses of the published path, by default


class MessageStream:
    """Buffer of messages, which gives cycles in order, each with its twists; refused ones are counted.

    A cycle waits for older ones until a message is newer by `wait` (s), since estimators refuse late ones.
    """

    def __init__(self, frames: Frames | None = None, wait: float = 0.0) -> None:
        self.frames, self.noise, self.rule = frames or Frames(), NoiseSettings(), LabelRule()
        self.refused: Counter[str] = Counter()  # number of messages for each reason
        self.twists: deque[tuple[float, list[float]]] = deque(maxlen=10_000)
        self._first = np.inf  # the stamp (s) of the first twist
        self._wait = wait
        self._waiting = list[Detections]()  # in order of their stamps
        self._newest = -np.inf  # the stamp (s) of the newest message with detections

    def take_odometry(self, message: Any, received: float) -> bool:
        """Buffer the twist of a message that was received at this time (s); return whether it is usable."""
        try:
            t, twist = messages.stamp_of(message) or received, messages.twist_of(message)
            if twist is None:
                raise ValueError("odometry: expected a message with a twist, found a pose alone")
            twist = twist * self.frames.flip
            if not np.isfinite([t, *twist]).all() or (self.twists and t <= self.twists[-1][0]):
                raise ValueError("odometry: expected finite numbers and a stamp later than the one before")
            if recording.beyond_limits(twist).any():  # an estimator would refuse each cycle that holds it
                raise ValueError("odometry: expected a speed and a yaw rate that a vehicle can have")
            self.twists.append((t, twist.tolist()))
            self._first = min(self._first, t)
        except messages.BROKEN as error:
            self.refused[str(error)] += 1
            return False
        return True

    def take_detections(self, message: Any, received: float) -> Iterator[tuple[Odometry, Detections]]:
        """Yield the cycles that have waited for long enough, with the twists since the last in `use`."""
        try:
            points = messages.points_of(message, self.rule)
            points = points.where(points.lines < 0)  # polylines beside cones are decoration
            if (points.lines == messages.DENSE).any():
                points = recording.usable(points, self.refused)
                points = recording.along_lines(points, recording.default_spacing(points))
            else:
                points = recording.distinct(points, self.refused)
            t = messages.stamp_of(message) or received
            if not self._first <= t < np.inf:
                raise ValueError("detections: expected a stamp not before that of the first odometry")
            cycle = recording.in_vehicle_frame(t, points, self.frames, self.noise, self.refused)
        except messages.BROKEN as error:
            self.refused[str(error)] += 1
            return
        self._newest = max(self._newest, t)
        insort(self._waiting, cycle, key=lambda one: one.t)
        while self._waiting and self._waiting[0].t <= self._newest - self._wait:
            cycle = self._waiting.pop(0)
            rows = [row for row in self.twists if row[0] <= cycle.t]
            twists = np.array([twist for _, twist in rows]).reshape(-1, 3)
            yield Odometry(np.array([stamp for stamp, _ in rows]), twists), cycle

    def use(self, t: float) -> None:
        """Drop the twists that a cycle at t (s) has used, except the last one, which is held."""
        while len(self.twists) > 1 and self.twists[1][0] <= t:
            self.twists.popleft()


class Bridge:
    """Passes ROS messages to a mapper; no message can stop it."""

    def __init__(
        self,
        mounting: Sequence[float] = (0.0, 0.0, 0.0),
        wait: float = 0.0,
        known: str = "",
        sigma: Sequence[float] = (),
    ) -> None:
        """Begin a new map, or continue on the `known` map of a folder.

        `sigma` (3,) states the standard deviations of a twist (m/s, m/s, rad/s). Without it they are
        measured, as is the noise of detections without covariances.
        """
        if len(mounting) != 3 or len(sigma) not in (0, 3):
            raise SettingsError(f"mounting, sigma: expected three numbers, found {[*mounting]}, {[*sigma]}")
        x, y, yaw = map(float, mounting)
        self.stream = MessageStream(Frames((x, y, yaw)), wait)
        self.mapper: FixedLagMapper | None = None  # until the first cycle, which says which noise is stated
        self.frame, self.body = "", "base_link"  # frames of the odometry's pose and of the vehicle
        self._known = read_map(known) if known else None
        self._sigma = np.array(sigma, float)
        self._odometry = deque[tuple[float, Array, Array]](maxlen=500)  # stamp, pose and twist

    def take_odometry(self, message: Any, received: float) -> None:
        """Take a message with odometry, received at a time (s)."""
        if not self.stream.take_odometry(message, received):
            return
        with suppress(*messages.BROKEN):
            pose, t = messages.pose_of(message), messages.stamp_of(message) or received
            self.body = messages.frame_id_of(message, "child_frame_id") or self.body
            if pose is not None and np.isfinite(pose).all():
                self.frame = messages.frame_id_of(message)
                self._odometry.append((t, pose, np.array(self.stream.twists[-1][1])))

    def update(self, message: Any, received: float) -> CycleResult | None:
        """Map a message with detections, received at a time (s); return the last result, if any."""
        result: CycleResult | None = None
        for cycle in self.stream.take_detections(message, received):
            try:
                self.mapper = self.mapper or self._begun()
                result = self.mapper.update(*cycle)
            except PathspaceError as error:  # a ReadingError changes nothing in the mapper
                self.stream.refused.update([str(error)])
                continue
            self.stream.use(result.t)
        return result

    def _begun(self) -> FixedLagMapper:
        stated = bool(len(self._sigma))
        sigma = self._sigma if stated else np.array(SIGMA_ODOMETRY)
        noise = KnownNoise(
            sigma, odometry_stated=stated, detections_stated=not self.stream.refused[recording.ASSUMED]
        )
        if self._known is None:
            return FixedLagMapper(odometry_sigma=noise)
        return FixedLagMapper.on(self._known, odometry_sigma=noise)

    def map_T_odometry(self, result: CycleResult) -> Array | None:
        """Pose (3,) of the odometry's frame in the map at a cycle; None where the odometry has no pose.

        It is `map_T_odom = map_T_vehicle (odom_T_vehicle exp(dt twist))^-1`, in m, m and rad.
        """
        before = [one for one in self._odometry if one[0] <= result.t]
        if not before:
            return None
        t, pose, twist = before[-1]
        moved = compose(pose, se2_exp((result.t - t) * twist[None])[0])
        return np.asarray(compose(result.pose, inverse(moved)))

    def save(self, folder: Path | None = None) -> Path:
        """Write `map.json` to a new folder, and return it.

        By default the folder has the time in its name. One that exists is never written to: a number is
        added to the name. PathspaceError where nothing is mapped yet.
        """
        track = None if self.mapper is None else self.mapper.map()
        if track is None or not track.boundaries:
            raise PathspaceError("expected a map to write, found nothing mapped yet")
        named = folder or Path(f"map-{datetime.now():%Y%m%d-%H%M%S}")
        for number in count(1):
            made = named if number == 1 else named.with_name(f"{named.name}-{number}")
            with suppress(FileExistsError):
                made.mkdir(parents=True)
                break
        write_json(made / MAP_FILE, map_to_json(track))
        return made.absolute()


def curve_points(track: Map) -> dict[int, Array]:
    """Sample points (n, 2) along each boundary, in m, map frame."""
    points = {}
    for label, boundary in track.boundaries.items():
        if isinstance(boundary, SplineBoundary):
            samples, (begin, end) = max(2, int(boundary.spline.length() / STEP) + 1), boundary.spline.domain
            points[label] = boundary.spline.evaluate(np.linspace(begin, end, samples))
    return points


def fill_pose(position: Any, orientation: Any, pose: Array) -> None:
    """Fill the position and the quaternion of a message with a pose (3,)."""
    position.x, position.y = pose[:2].tolist()
    orientation.z, orientation.w = float(np.sin(pose[2] / 2)), float(np.cos(pose[2] / 2))


def publisher(
    node: Any, bridge: Bridge, most: int = MOST_POSES, tf: bool = True
) -> Callable[[CycleResult], None]:
    """Function that publishes map, road ahead, path and, with `tf`, transform after a cycle.

    All have the stamp of the cycle. The path has at `most` so many poses, the newest ones.
    """
    from builtin_interfaces.msg import Time
    from geometry_msgs.msg import Point, PoseStamped, TransformStamped
    from nav_msgs.msg import Path as PathMessage
    from std_msgs.msg import Header
    from tf2_msgs.msg import TFMessage
    from visualization_msgs.msg import Marker, MarkerArray

    to_map, to_ahead = (node.create_publisher(MarkerArray, f"~/{name}", 1) for name in ("map", "ahead"))
    to_path = node.create_publisher(PathMessage, "~/path", 1)
    to_tf = node.create_publisher(TFMessage, "/tf", 100) if tf else None
    poses = deque[Any](maxlen=max(most, 1))

    def lines(points: dict[int, Array], header: Any) -> Any:
        markers = []
        for label, own in points.items():
            marker = Marker(header=header, ns="track", id=label, type=Marker.LINE_STRIP)
            marker.scale.x, marker.pose.orientation.w = 0.1, 1.0
            (marker.color.r, marker.color.g, marker.color.b), marker.color.a = COLOURS[label], 1.0
            marker.points = [Point(x=x, y=y, z=0.0) for x, y in own.tolist()]
            markers.append(marker)
        return MarkerArray(markers=markers)

    def publish(result: CycleResult) -> None:
        assert bridge.mapper is not None
        seconds, nanoseconds = divmod(round(result.t * 1e9), 10**9)
        stamp = Time(sec=seconds, nanosec=nanoseconds)
        header, ahead = Header(frame_id="map", stamp=stamp), bridge.mapper.ahead(AHEAD)
        to_map.publish(lines(curve_points(bridge.mapper.outline()), header))
        near = {LEFT: ahead.left, RIGHT: ahead.right, CENTRE: ahead.points}
        to_ahead.publish(lines(near, Header(frame_id=bridge.body, stamp=stamp)))
        at = PoseStamped(header=header)
        fill_pose(at.pose.position, at.pose.orientation, result.pose)
        poses.append(at)
        to_path.publish(PathMessage(header=header, poses=[*poses]))
        if to_tf is not None:
            of_odometry = bridge.map_T_odometry(result) if bridge.frame else None
            child, pose = (bridge.body, result.pose) if of_odometry is None else (bridge.frame, of_odometry)
            placed = TransformStamped(header=header, child_frame_id=child)
            fill_pose(placed.transform.translation, placed.transform.rotation, pose)
            to_tf.publish(TFMessage(transforms=[placed]))

    return publish


def main() -> int:
    """Run the node until it is stopped, then write the map to a new folder; return 2 where it can't start."""
    try:
        import rclpy
        from nav_msgs.msg import Odometry
        from rclpy.executors import ExternalShutdownException
        from rclpy.qos import QoSProfile, ReliabilityPolicy
        from sensor_msgs.msg import PointCloud2
        from std_msgs.msg import String
        from visualization_msgs.msg import MarkerArray
    except ModuleNotFoundError as error:
        way = "source /opt/ros/jazzy/setup.bash, in an environment made with --system-site-packages"
        print(
            f"pathspace-graph-ros: expected the package {error.name} of ROS 2 ({way}), found none",
            file=sys.stderr,
        )
        return 2

    rclpy.init()
    node = rclpy.create_node("pathspace_graph")
    defaults = {"mounting": [0.0] * 3, "wait": 0.0, "map": "", "sigma": [0.0] * 3}
    defaults |= {"markers": False, "path": MOST_POSES, "tf": True}
    given = {name: node.declare_parameter(name, value).value for name, value in defaults.items()}
    stated = given["sigma"] if any(given["sigma"]) else ()
    try:
        bridge = Bridge(given["mounting"], given["wait"], given["map"], stated)
    except PathspaceError as error:
        print(f"pathspace-graph-ros: {error}", file=sys.stderr)
        return 2
    publish = publisher(node, bridge, given["path"], given["tf"])

    def now() -> float:
        return float(node.get_clock().now().nanoseconds) * 1e-9

    def take_detections(message: Any) -> None:
        result = bridge.update(message, now())
        if result is not None:
            publish(result)

    def save(folder: Path | None = None) -> None:
        try:
            node.get_logger().info(f"map written to {bridge.save(folder)}")
        except (PathspaceError, OSError) as error:
            node.get_logger().error(f"map not written: {error}")

    deep, short = (QoSProfile(depth=n, reliability=ReliabilityPolicy.BEST_EFFORT) for n in (100, 10))
    kind = MarkerArray if given["markers"] else PointCloud2
    node.create_subscription(Odometry, "odometry", lambda one: bridge.take_odometry(one, now()), deep)
    node.create_subscription(kind, "detections", take_detections, short)
    node.create_subscription(String, "~/save", lambda one: save(Path(one.data)), 1)
    try:
        stopped = suppress(KeyboardInterrupt, ExternalShutdownException)
        with stopped, threadpool_limits(limits=1), spared_by_collector():
            rclpy.spin(node)
    finally:
        save()
        node.get_logger().info(f"refused: {dict(+bridge.stream.refused)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
