"""Write a log as a ROS 2 bag, as a car would record it: odometry, and point clouds of cones with labels.

Use it to try `pathspace-graph convert` without a bag of your own. It needs no ROS, but the package `rosbags`
of `pip install -e '.[ros]'`.

    python examples/write_bag.py LOG BAG
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from pathspace_graph import Detections, Log, read_log

STORE = get_typestore(Stores.ROS2_HUMBLE)
"""Messages of ROS 2."""
EPOCH = 1_700_000_000
"""Time in the bag (s since 1970) at time 0 of the log."""
FLOAT32, UINT8 = 7, 2
"""Codes of a point cloud's types."""
COLUMNS = {"x": "<f4", "y": "<f4", "z": "<f4", "label": "u1"}
"""Fields of a cone: position in the vehicle frame (m), and label (0 left, 1 right, 2 unknown)."""


def make(name: str, /, **fields: Any) -> Any:
    """Make a message."""
    return STORE.types[name](**fields)


def vector(name: str, *values: float) -> Any:
    """Make a message with the fields x, y, z and, for four values, w."""
    return make(f"geometry_msgs/msg/{name}", **dict(zip("xyzw", values, strict=False)))


def header(t: float, frame: str) -> Any:
    """Make a header with a stamp (s)."""
    nanoseconds = round(t * 1e9)
    stamp = make("builtin_interfaces/msg/Time", sec=EPOCH + nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
    return make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


def odometry(t: float, twist: np.ndarray) -> Any:
    """Convert a twist (vx, vy, wz) to `nav_msgs/Odometry`; the pose stays at the origin."""
    vx, vy, wz = (float(value) for value in twist)
    still = make(
        "geometry_msgs/msg/Pose",
        position=vector("Point", 0.0, 0.0, 0.0),
        orientation=vector("Quaternion", 0.0, 0.0, 0.0, 1.0),
    )
    moving = make(
        "geometry_msgs/msg/Twist",
        linear=vector("Vector3", vx, vy, 0.0),
        angular=vector("Vector3", 0.0, 0.0, wz),
    )
    unknown = np.zeros(36)
    return make(
        "nav_msgs/msg/Odometry",
        header=header(t, "odom"),
        child_frame_id="base_link",
        pose=make("geometry_msgs/msg/PoseWithCovariance", pose=still, covariance=unknown),
        twist=make("geometry_msgs/msg/TwistWithCovariance", twist=moving, covariance=unknown),
    )


def cloud(cycle: Detections) -> Any:
    """Convert the cones of a perception cycle to `sensor_msgs/PointCloud2`."""
    cones = np.zeros(len(cycle.labels), np.dtype(list(COLUMNS.items())))
    cones["x"], cones["y"] = cycle.points_vehicle.T
    cones["label"] = cycle.labels
    fields = [
        make(
            "sensor_msgs/msg/PointField",
            name=name,
            offset=4 * column,
            datatype=UINT8 if name == "label" else FLOAT32,
            count=1,
        )
        for column, name in enumerate(COLUMNS)
    ]
    return make(
        "sensor_msgs/msg/PointCloud2",
        header=header(cycle.t, "base_link"),
        height=1,
        width=len(cones),
        fields=fields,
        is_bigendian=False,
        point_step=cones.itemsize,
        row_step=cones.nbytes,
        data=np.frombuffer(cones.tobytes(), np.uint8),
        is_dense=True,
    )


def main(log: Log, bag: Path) -> None:
    """Write the odometry to `/odom` and the cones to `/cones`, in the order of their stamps."""
    twists = zip(log.odometry.t.tolist(), log.odometry.twist, strict=True)
    messages = [(t, "/odom", odometry(t, twist)) for t, twist in twists]
    messages += [(cycle.t, "/cones", cloud(cycle)) for cycle in log.cycles]
    with Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        types = {"/odom": "nav_msgs/msg/Odometry", "/cones": "sensor_msgs/msg/PointCloud2"}
        topics = {topic: writer.add_connection(topic, name, typestore=STORE) for topic, name in types.items()}
        for t, topic, message in sorted(messages, key=lambda entry: entry[0]):
            data = STORE.serialize_cdr(message, types[topic])
            writer.write(topics[topic], EPOCH * 10**9 + round(t * 1e9), data)


if __name__ == "__main__":
    main(read_log(sys.argv[1]), Path(sys.argv[2]))
