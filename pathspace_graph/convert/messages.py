"""ROS messages as arrays, told by their fields, so that those of `rosbags` and of `rclpy` are read alike."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, is_dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.errors import PathspaceError
from pathspace_graph.labels import BIG_ORANGE, LEFT, ORANGE, RIGHT, UNKNOWN

from .settings import LabelRule

Array = NDArray[np.float64]
IntArray = NDArray[np.int_]

LIST_NAMES: Final = {
    "big_orange": BIG_ORANGE,
    "orange": ORANGE,
    "blue": LEFT,
    "left": LEFT,
    "yellow": RIGHT,
    "right": RIGHT,
}
"""A list of cones with such a word in its name has cones of this label."""
LABEL_FIELDS: Final = ("label", "class", "class_id", "color", "colour", "type")
"""The label of a detection is in the first of these fields, unless one is named."""
NO_LABEL: Final = "none"
"""Where this is named as the field of the label, all detections are without one."""
CLOUD_TYPES: Final = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""The field of a point cloud with this `datatype` is of this type of numpy."""
POINT_MARKERS: Final = (1, 2, 3, 10)
"""A marker of these types (cube, sphere, cylinder, mesh) is one point."""
LIST_MARKERS: Final = (6, 7, 8)
"""A marker of these types (cubes, spheres, points) is a list of points."""
ADDED: Final = 0
"""A marker with this action is added; others are taken away."""
POSITIONS: Final = ("point", "position", "location", "center", "pose")
"""A cone has its place in the first of these fields, or in its own `x` and `y`."""


class MessageError(PathspaceError):
    """A message is not of a kind that can be read; the text says what was expected and what was found."""


@dataclass(frozen=True, eq=False)
class Points:
    """Holds the detected points of one message, in the frame of its sensor."""

    points: Array
    """Each row is a point (m, 2) in m."""
    covariances: Array
    """Each point has this covariance (m, 2, 2) in m^2; it is NaN where the message does not give it."""
    labels: IntArray
    """Each point has the label LEFT, RIGHT or UNKNOWN (m,)."""

    def where(self, chosen: NDArray[np.bool_]) -> Points:
        """Returns some of the points."""
        return Points(self.points[chosen], self.covariances[chosen], self.labels[chosen])


def header_of(message: Any) -> Any:
    """Returns the header of a message, which is that of its first point in an array of markers, or None."""
    if hasattr(message, "markers"):
        return next((marker.header for marker in _added(message.markers)), None)
    return getattr(message, "header", None)


def stamp_of(message: Any) -> float | None:
    """Returns the stamp of a message's header (s), or None where it has none or the stamp is zero."""
    header = header_of(message)
    if header is None or (header.stamp.sec == 0 and header.stamp.nanosec == 0):
        return None
    return float(header.stamp.sec + 1e-9 * header.stamp.nanosec)


def frame_of(message: Any, name: str = "frame_id") -> str:
    """Returns the frame of a message by its header, or by this field of its own; empty where it has none."""
    frame = getattr(message, name, None) or getattr(header_of(message), name, "")
    return str(frame).lstrip("/")


# --- odometry --------------------------------------------------------------------------------------------


def twist_of(message: Any) -> Array:
    """Returns the twist [vx, vy, wz] (3,) of `Odometry`, `TwistStamped`, `TwistWithCovarianceStamped`, or of
    a wheel speed (`Float64`, `AckermannDriveStamped`), whose vy and wz are 0.
    """
    if hasattr(message, "drive"):
        return np.array([message.drive.speed, 0.0, 0.0], dtype=float)
    if hasattr(message, "data"):
        return np.array([message.data, 0.0, 0.0], dtype=float)
    twist = message
    while hasattr(twist, "twist"):
        twist = twist.twist
    if not hasattr(twist, "linear"):
        raise MessageError(f"expected a message with a twist, found one of {_names(message)}")
    return np.array([twist.linear.x, twist.linear.y, twist.angular.z], dtype=float)


def pose_of(message: Any) -> Array:
    """Returns the pose [x, y, yaw] (3,) of `Odometry`, in m and rad."""
    pose = message.pose.pose
    return np.array([pose.position.x, pose.position.y, _yaw(pose.orientation)], dtype=float)


def yaw_rate_of(message: Any) -> float:
    """Returns the yaw rate of an `Imu` (rad/s), whose z axis points up."""
    return float(message.angular_velocity.z)


def _yaw(quaternion: Any) -> float:
    x, y, z, w = quaternion.x, quaternion.y, quaternion.z, quaternion.w
    return float(np.arctan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z))


# --- detections ------------------------------------------------------------------------------------------


def points_of(message: Any, rule: LabelRule, label_field: str | None = None) -> Points:
    """Returns the points of a point cloud, an array of markers, or a message with lists of cones.

    Anything else is a MessageError.
    """
    if hasattr(message, "point_step"):
        return cloud_points(message, rule, label_field)
    if hasattr(message, "markers"):
        return marker_points(message, rule)
    return cone_points(message, rule, label_field)


def cloud_points(cloud: Any, rule: LabelRule, label_field: str | None = None) -> Points:
    """Returns the points of a `PointCloud2` by its fields `x`, `y` and that of the label.

    The fields `xx`, `xy` and `yy` are the covariance, where the cloud has them.
    """
    columns = _cloud_columns(cloud)
    name = _label_field(columns, label_field, "a point cloud with labels")
    points = np.column_stack([columns["x"], columns["y"]]).astype(float)
    covariances = np.full((len(points), 2, 2), np.nan)
    if {"xx", "xy", "yy"} <= columns.keys():
        entries = [columns[entry] for entry in ("xx", "xy", "xy", "yy")]
        covariances = np.stack(entries, axis=-1).astype(float).reshape(-1, 2, 2)
    labels = np.full(len(points), UNKNOWN)
    if name is not None:
        values, place = np.unique(columns[name], return_inverse=True)
        labels = np.array([rule.of(value) for value in values.tolist()], dtype=int)[place]
    return Points(points, covariances, labels)


def _cloud_columns(cloud: Any) -> dict[str, NDArray[Any]]:
    order = ">" if cloud.is_bigendian else "<"
    known = {field.name: field for field in cloud.fields if field.datatype in CLOUD_TYPES}
    if not {"x", "y"} <= known.keys():
        raise MessageError(f"expected a point cloud with the fields x and y, found {', '.join(known)}")
    if not cloud.width * cloud.height:
        return {name: np.zeros(0) for name in known}
    layout = _layout(cloud, known, order)
    rows = np.frombuffer(bytes(cloud.data), np.uint8)
    needed = cloud.height * cloud.row_step
    if cloud.row_step < cloud.width * cloud.point_step or len(rows) < needed:
        raise MessageError(f"expected a point cloud of {needed} bytes, found {len(rows)}")
    rows = rows[:needed].reshape(cloud.height, cloud.row_step)[:, : cloud.width * cloud.point_step]
    points = np.ascontiguousarray(rows).reshape(-1).view(layout)
    return {name: points[name] for name in known}


def _layout(cloud: Any, fields: dict[str, Any], order: str) -> np.dtype[Any]:
    """Returns how the numbers of a point lie in its bytes."""
    types = [order + CLOUD_TYPES[field.datatype] for field in fields.values()]
    offsets = [field.offset for field in fields.values()]
    try:
        return np.dtype(
            {"names": list(fields), "formats": types, "offsets": offsets, "itemsize": cloud.point_step}
        )
    except ValueError as error:
        raise MessageError(
            f"expected fields inside the {cloud.point_step} bytes of a point: {error}"
        ) from None


def marker_points(array: Any, rule: LabelRule) -> Points:
    """Returns the points of a `MarkerArray` that are added: blue ones are left, yellow ones right.

    Text, arrows, lines and triangles are no points. A marker that is a list has a colour for each of its
    points, or one for all.
    """
    found = [row for marker in _added(array.markers) for row in _of_marker(marker, rule)]
    points = np.array([row[:2] for row in found], dtype=float).reshape(-1, 2)
    labels = np.array([row[2] for row in found], dtype=int)
    return Points(points, np.full((len(points), 2, 2), np.nan), labels)


def _added(markers: Iterable[Any]) -> Iterator[Any]:
    known = POINT_MARKERS + LIST_MARKERS
    return (marker for marker in markers if marker.action == ADDED and marker.type in known)


def _of_marker(marker: Any, rule: LabelRule) -> Iterator[tuple[float, float, int]]:
    place = marker.pose.position
    if marker.type in POINT_MARKERS:
        yield place.x, place.y, rule.of(marker.color)
        return
    yaw = _yaw(marker.pose.orientation)
    c, s = np.cos(yaw), np.sin(yaw)
    one_each = len(marker.colors) == len(marker.points)
    for index, point in enumerate(marker.points):
        colour = marker.colors[index] if one_each else marker.color
        yield place.x + c * point.x - s * point.y, place.y + s * point.x + c * point.y, rule.of(colour)


def cone_points(message: Any, rule: LabelRule, label_field: str | None = None) -> Points:
    """Returns the cones in all lists of a message, such as `ConeArrayWithCovariance` and `Track`.

    A list whose name has a word of `LIST_NAMES` in it gives all its cones that label. In other
    lists a cone has its own. Its covariance has 4 (x, y), 9 (x, y, z) or 36 entries (a pose), row by row.
    """
    lists = {name: getattr(message, name) for name in _names(message)}
    lists = {name: listed for name, listed in lists.items() if _is_list(listed)}
    if not lists:
        raise MessageError(f"expected a message with a list of cones, found the fields {_names(message)}")
    cones = [(name, cone) for name, listed in lists.items() for cone in listed]
    found = [
        (*_place(cone), _covariance(cone), _cone_label(name, cone, rule, label_field)) for name, cone in cones
    ]
    points = np.array([row[:2] for row in found], dtype=float).reshape(-1, 2)
    covariances = np.array([row[2] for row in found], dtype=float).reshape(-1, 2, 2)
    return Points(points, covariances, np.array([row[3] for row in found], dtype=int))


def _is_list(value: Any) -> bool:
    return isinstance(value, list | tuple) and not (value and isinstance(value[0], str | int | float | bytes))


def _place(cone: Any) -> tuple[float, float]:
    """Returns the place of a cone (m), which may lie some fields deep, as in a pose with covariance."""
    at = cone
    while not (hasattr(at, "x") and hasattr(at, "y")):
        name = next((name for name in POSITIONS if hasattr(at, name)), None)
        if name is None:
            raise MessageError(
                f"expected a cone with one of the fields {', '.join(POSITIONS)}, found {_names(cone)}"
            )
        at = getattr(at, name)
    return float(at.x), float(at.y)


def _covariance(cone: Any) -> Array:
    """Returns the covariance (2, 2) of a cone's place (m^2), which is NaN where it has none."""
    holder = cone
    while not hasattr(holder, "covariance"):
        name = next((name for name in POSITIONS if hasattr(holder, name)), None)
        if name is None:
            return np.full((2, 2), np.nan)
        holder = getattr(holder, name)
    entries = np.asarray(holder.covariance, dtype=float).ravel()
    side = {4: 2, 9: 3, 36: 6}.get(len(entries))
    return np.full((2, 2), np.nan) if side is None else entries.reshape(side, side)[:2, :2]


def _cone_label(name: str, cone: Any, rule: LabelRule, label_field: str | None) -> int:
    for word, label in LIST_NAMES.items():
        if word in name.lower():
            return label
    field = label_field or next((field for field in LABEL_FIELDS if hasattr(cone, field)), None)
    return rule.of(getattr(cone, field)) if field is not None and hasattr(cone, field) else UNKNOWN


def _label_field(names: Iterable[str], asked: str | None, expected: str) -> str | None:
    names = list(names)
    if asked == NO_LABEL:
        return None
    name = next((name for name in ([asked] if asked else LABEL_FIELDS) if name in names), None)
    if name is None:
        wanted = f"'{asked}'" if asked else f"one of {', '.join(LABEL_FIELDS)}"
        found = f"found {', '.join(names)} (--label-field names it, `{NO_LABEL}` does without)"
        raise MessageError(f"expected {expected} in the field {wanted}, {found}")
    return name


def _names(message: Any) -> Sequence[str]:
    """Returns the names of a message's fields."""
    if is_dataclass(message):
        return [field.name for field in fields(message)]
    if hasattr(message, "get_fields_and_field_types"):
        return list(message.get_fields_and_field_types())
    return list(vars(message))
