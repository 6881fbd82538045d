"""Bags as `rosbags` writes them, of all three kinds, and the messages of a log."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.rosbag2.enums import StoragePlugin
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from pathspace_graph.io.log import Detections, Log
from pathspace_graph.labels import LEFT, NAMES, RIGHT

Kind = Literal["rosbag1", "sqlite3", "mcap"]
KINDS: tuple[Kind, ...] = ("rosbag1", "sqlite3", "mcap")
"""A bag is of one of these."""
EPOCH = 1_700_000_000
"""The clock of a bag stands at this (s) where a log's is at 0."""

CONE = "eufs_msgs/msg/ConeWithCovariance"
CONES = "eufs_msgs/msg/ConeArrayWithCovariance"
DEFINITIONS = {
    CONE: "geometry_msgs/Point point\nfloat64[4] covariance\n",
    CONES: "std_msgs/Header header\n"
    + "".join(
        f"eufs_msgs/ConeWithCovariance[] {colour}_cones\n"
        for colour in ("blue", "yellow", "orange", "big_orange", "unknown_color")
    ),
    "ackermann_msgs/msg/AckermannDrive": "float32 steering_angle\nfloat32 steering_angle_velocity\n"
    "float32 speed\nfloat32 acceleration\nfloat32 jerk\n",
    "ackermann_msgs/msg/AckermannDriveStamped": "std_msgs/Header header\n"
    "ackermann_msgs/AckermannDrive drive\n",
}
"""Messages that ROS itself does not define have these definitions, by the facts of their fields."""


class Messages:
    """Makes messages of ROS 1 or 2."""

    def __init__(self, *, ros1: bool = False) -> None:
        self.ros1 = ros1
        self.store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
        for name, text in DEFINITIONS.items():
            self.store.register(get_types_from_msg(text, name))

    def make(self, name: str, /, **fields: Any) -> Any:
        """Returns a message; fields that are not given are zero."""
        known = dict(self.store.fielddefs[name][1])
        zeros = {field: self._zero(*shape) for field, shape in known.items() if field not in fields}
        return self.store.types[name](**zeros, **fields)

    def _zero(self, shape: Any, detail: Any) -> Any:
        if shape.name == "NAME":
            return self.make(detail)
        if shape.name == "BASE":
            return {"string": "", "bool": False}.get(detail[0], 0)
        (inner, (name, *_)), size = detail
        numbers = {"float64": "f8", "float32": "f4", "uint8": "u1", "int8": "i1"}
        return np.zeros(size, numbers[name]) if inner.name == "BASE" and name in numbers else []

    def header(self, t: float | None, frame: str = "base_link") -> Any:
        """Returns a header with a stamp (s after EPOCH), or with a zero one."""
        nanoseconds = 0 if t is None else round(t * 1e9) + EPOCH * 10**9
        stamp = self.make(
            "builtin_interfaces/msg/Time", sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9
        )
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)

    def vector(self, name: str = "Vector3", x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Any:
        return self.make(f"geometry_msgs/msg/{name}", x=float(x), y=float(y), z=float(z))

    def twist(self, twist: Iterable[float]) -> Any:
        vx, vy, wz = twist
        linear, angular = self.vector(x=vx, y=vy), self.vector(z=wz)
        return self.make("geometry_msgs/msg/Twist", linear=linear, angular=angular)

    def odometry(
        self, t: float | None, twist: Iterable[float], pose: Iterable[float] = (0.0, 0.0, 0.0)
    ) -> Any:
        x, y, yaw = pose
        turned = self.make("geometry_msgs/msg/Quaternion", z=float(np.sin(yaw / 2)), w=float(np.cos(yaw / 2)))
        placed = self.make("geometry_msgs/msg/Pose", position=self.vector("Point", x, y), orientation=turned)
        return self.make(
            "nav_msgs/msg/Odometry",
            header=self.header(t, "odom"),
            child_frame_id="base_link",
            pose=self.make("geometry_msgs/msg/PoseWithCovariance", pose=placed),
            twist=self.make("geometry_msgs/msg/TwistWithCovariance", twist=self.twist(twist)),
        )

    def twist_stamped(self, t: float | None, twist: Iterable[float]) -> Any:
        return self.make("geometry_msgs/msg/TwistStamped", header=self.header(t), twist=self.twist(twist))

    def imu(self, t: float | None, rate: float) -> Any:
        rates = self.vector(z=rate)
        return self.make("sensor_msgs/msg/Imu", header=self.header(t, "imu"), angular_velocity=rates)

    def cloud(
        self,
        t: float | None,
        columns: dict[str, tuple[str, Any]],
        *,
        frame: str = "base_link",
        pad: int = 0,
        order: str = "<",
    ) -> Any:
        """Returns a point cloud of columns (numpy type, numbers), with `pad` bytes after each point."""
        codes = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
        layout = np.dtype([(name, order + kind) for name, (kind, _) in columns.items()])
        size = layout.itemsize + pad
        points = np.zeros(len(next(iter(columns.values()))[1]), layout)
        for name, (_, numbers) in columns.items():
            points[name] = numbers
        rows = np.zeros((len(points), size), np.uint8)
        if len(points):
            rows[:, : layout.itemsize] = points.view(np.uint8).reshape(len(points), -1)
        fields = [
            self.make(
                "sensor_msgs/msg/PointField",
                name=name,
                offset=layout.fields[name][1] if layout.fields else 0,
                datatype=codes[kind],
                count=1,
            )
            for name, (kind, _) in columns.items()
        ]
        return self.make(
            "sensor_msgs/msg/PointCloud2",
            header=self.header(t, frame),
            height=1,
            width=len(points),
            fields=fields,
            is_bigendian=order == ">",
            point_step=size,
            row_step=size * len(points),
            data=rows.reshape(-1),
        )

    def marker(
        self,
        t: float | None,
        point: Iterable[float],
        colour: tuple[float, float, float],
        *,
        kind: int = 3,
        action: int = 0,
    ) -> Any:
        x, y = point
        turned = self.make("geometry_msgs/msg/Quaternion", w=1.0)
        pose = self.make("geometry_msgs/msg/Pose", position=self.vector("Point", x, y), orientation=turned)
        return self.make(
            "visualization_msgs/msg/Marker",
            header=self.header(t),
            type=kind,
            action=action,
            pose=pose,
            color=self.colour(colour),
        )

    def colour(self, colour: tuple[float, float, float]) -> Any:
        r, g, b = colour
        return self.make("std_msgs/msg/ColorRGBA", r=r, g=g, b=b, a=1.0)

    def markers(self, markers: list[Any]) -> Any:
        return self.make("visualization_msgs/msg/MarkerArray", markers=markers)

    def cones(self, cycle: Detections) -> Any:
        """Returns the cones of a cycle as a simulator of Formula Student gives them."""
        lists: dict[int, list[Any]] = {0: [], 1: [], 2: []}
        for point, covariance, label in zip(
            cycle.points_vehicle, cycle.covariances, cycle.labels.tolist(), strict=True
        ):
            lists[label].append(
                self.make(CONE, point=self.vector("Point", *point), covariance=covariance.ravel())
            )
        return self.make(
            CONES,
            header=self.header(cycle.t),
            blue_cones=lists[LEFT],
            yellow_cones=lists[RIGHT],
            unknown_color_cones=lists[2],
        )

    def cloud_of(self, cycle: Detections) -> Any:
        """Returns the detections of a cycle with their covariances as a point cloud in double precision."""
        (x, y), covariances = cycle.points_vehicle.T, cycle.covariances
        entries = {name: covariances[:, i, j] for name, i, j in (("xx", 0, 0), ("xy", 0, 1), ("yy", 1, 1))}
        columns = {name: ("f8", numbers) for name, numbers in {"x": x, "y": y, **entries}.items()}
        return self.cloud(cycle.t, {**columns, "label": ("u1", cycle.labels)}, pad=3)


Written = tuple[float, str, Any]
"""A message is written at this time (s after EPOCH) to this topic."""


def write_bag(folder: Path, kind: Kind, make: Callable[[Messages], Iterable[Written]]) -> Path:
    """Writes the messages in the order in which they are made, and returns the path of the bag."""
    messages = Messages(ros1=kind == "rosbag1")
    path = folder / ("drive.bag" if messages.ros1 else f"drive_{kind}")
    if messages.ros1:
        writer: Any = rosbag1.Writer(path)
        encode = messages.store.serialize_ros1
    else:
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
        encode = messages.store.serialize_cdr
    with writer:
        topics: dict[str, Any] = {}
        for t, topic, message in make(messages):
            name = message.__msgtype__
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, name, typestore=messages.store)
            writer.write(topics[topic], round(t * 1e9) + EPOCH * 10**9, encode(message, name))
    return path


def of_log(
    log: Log, detections: Callable[[Messages, Detections], Any]
) -> Callable[[Messages], list[Written]]:
    """Returns what writes a log's drive: odometry on `/odom`, detections on `/cones`, in order of time."""

    def make(messages: Messages) -> list[Written]:
        twists = zip(log.odometry.t.tolist(), log.odometry.twist, strict=True)
        written = [(t, "/odom", messages.odometry(t, twist)) for t, twist in twists]
        written += [(cycle.t, "/cones", detections(messages, cycle)) for cycle in log.cycles]
        return sorted(written, key=lambda entry: entry[0])

    return make


def colour_of(label: int) -> tuple[float, float, float]:
    """Returns the colour of a marker: blue, yellow or grey."""
    return {"left": (0.1, 0.2, 1.0), "right": (1.0, 0.9, 0.0), "unknown": (0.5, 0.5, 0.5)}[NAMES[label]]
