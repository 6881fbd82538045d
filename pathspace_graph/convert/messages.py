"""ROS messages as arrays by their fields, so that those of `rosbags` and of `rclpy` are read alike."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import fields, is_dataclass
from itertools import pairwise
from numbers import Real
from typing import Any, Final, NamedTuple

import numpy as np

from pathspace_graph.errors import PathspaceError
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.io.log import covariances_of
from pathspace_graph.labels import BIG_ORANGE, LEFT, ORANGE, RIGHT, UNKNOWN

from .settings import LABEL_FIELDS, NO_LABEL, LabelRule

LIST_NAMES: Final = {  # labels of the cones in a list with such a word in its name
    **{"big_orange": BIG_ORANGE, "orange": ORANGE},
    **{"blue": LEFT, "left": LEFT, "yellow": RIGHT, "right": RIGHT},
}
CLOUD_TYPES: Final = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}  # by `datatype`
POINT_MARKERS: Final = (1, 2, 3, 10)  # types of markers that are one point: cube, sphere, cylinder, mesh
LINE_STRIP: Final = 4  # type of a marker that is a polyline
ALONE: Final = -1  # in place of the number of a polyline: a point that stands alone, as a cone does
DENSE: Final = -2  # a point of a scan, anywhere along a line or a wall
POSITIONS: Final = ("point", "position", "location", "center", "pose", "bbox")  # of a cone without x and y


class MessageError(PathspaceError):
    """A message is not of a kind that can be read; the text says what was expected and what was found."""


# errors of a message or a line that cannot be read
BROKEN: Final = (
    *(MessageError, AttributeError, TypeError, ValueError),
    *(IndexError, OverflowError, RecursionError),
)


def first_of(holder: Any, names: Iterable[str]) -> Any:
    """Value of the first of these fields that a message has, or None."""
    return next((getattr(holder, name) for name in names if hasattr(holder, name)), None)


class Points(NamedTuple):
    """Detected points of a message or of several, in the frame of their sensor."""

    points: Array  # (m, 2) points in m
    covariances: Array  # (m, 2, 2) covariances in m^2, NaN where the message does not give them
    labels: IntArray  # (m,) labels
    lines: IntArray  # (m,) number of the polyline of each, in the order of its vertices; or ALONE, or DENSE
    message: IntArray  # (m,) number of the message of each, in order

    @classmethod
    def of(cls, points: Any, labels: Any, covariances: Any = None, lines: Any = ALONE) -> "Points":
        """Make the points of arrays or lists, which may be empty."""
        placed = np.array(points, dtype=float).reshape(-1, 2)
        covariances = np.full((len(placed), 2, 2), np.nan) if covariances is None else covariances
        covariances = np.array(covariances, float).reshape(-1, 2, 2)
        lines = np.array(np.broadcast_to(lines, len(placed)), dtype=int)
        return cls(placed, covariances, np.array(labels, dtype=int), lines, np.zeros(len(placed), int))

    @classmethod
    def joined(cls, messages: Sequence["Points"]) -> "Points":
        """Join the points of messages, which get their numbers."""
        numbers = np.repeat(np.arange(len(messages)), [len(one.labels) for one in messages])
        columns = zip(cls.of([], []), *messages, strict=True)
        return cls(*map(np.concatenate, columns))._replace(message=numbers)

    def apart(self, count: int) -> list["Points"]:
        """Points of each of so many messages."""
        ends = np.searchsorted(self.message, np.arange(count + 1))
        return [self.where(slice(*span)) for span in pairwise(ends.tolist())]

    def where(self, chosen: BoolArray | IntArray | slice) -> "Points":
        columns: Iterable[Any] = (column[chosen] for column in self)
        return Points(*columns)


def header_of(message: Any) -> Any:
    """Header of a message, of the first point of an array of markers, or None."""
    first = next(added(message.markers), None) if hasattr(message, "markers") else message
    return getattr(first, "header", None)


def stamp_of(message: Any) -> float | None:
    """Stamp of a message's header (s), or None where it has none or the stamp is zero."""
    header = header_of(message)
    if header is None or (header.stamp.sec == 0 and header.stamp.nanosec == 0):
        return None
    return float(header.stamp.sec + 1e-9 * header.stamp.nanosec)


def frame_id_of(message: Any, name: str = "frame_id") -> str:
    """Frame of a message by its header, or by this field of its own; empty where it has none."""
    frame = getattr(message, name, None) or getattr(header_of(message), name, "")
    return str(frame).lstrip("/")


def twist_of(message: Any, wheelbase: float | None = None) -> Array | None:
    """Twist [vx, vy, wz] (3,) of a message in m/s, m/s and rad/s, None of one with a pose alone.

    Of a speed alone, vy = 0 and wz is NaN, or `v tan(delta) / wheelbase` (m) with a steering angle delta.
    MessageError where there is no motion at all in the message.
    """
    twist = message
    while hasattr(twist, "twist"):
        twist = twist.twist
    if hasattr(twist, "linear") and hasattr(twist, "angular"):
        return np.array([twist.linear.x, twist.linear.y, twist.angular.z], dtype=float)
    drive = getattr(message, "drive", message)
    speed, rate = (first_of(drive, names) for names in (("speed", "data", "vx"), ("wz", "yaw_rate")))
    if isinstance(speed, Real):
        if hasattr(drive, "steering_angle") and wheelbase is not None:
            rate = speed * np.tan(drive.steering_angle) / wheelbase
        return np.array([speed, getattr(drive, "vy", 0.0), np.nan if rate is None else rate], dtype=float)
    if pose_of(message) is None:
        raise MessageError(f"expected a message with a twist, a speed or a pose, found {_names(message)}")
    return None


def pose_of(message: Any) -> Array | None:
    """Pose [x, y, yaw] (3,) of a message in m and rad, or None where it has none."""
    pose = message
    while hasattr(pose, "pose"):
        pose = pose.pose
    if not (hasattr(pose, "position") and hasattr(pose, "orientation")):
        return None
    return np.array([pose.position.x, pose.position.y, yaw_of(pose.orientation)], dtype=float)


def yaw_rate_of(message: Any) -> float:
    """Yaw rate of an `Imu` (rad/s), whose z axis points up."""
    if not hasattr(message, "angular_velocity"):
        raise MessageError(f"expected a message with an angular_velocity, found {_names(message)}")
    return float(message.angular_velocity.z)


def yaw_of(quaternion: Any) -> Any:
    """Yaw of a quaternion with x, y, z and w (rad), or of arrays of them."""
    x, y, z, w = quaternion.x, quaternion.y, quaternion.z, quaternion.w
    return np.arctan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)


def points_of(message: Any, rule: LabelRule, namespaces: Sequence[str] = ()) -> Points:
    """Points of a scan, a cloud, an array of markers, or lists of cones, polylines or numbers.

    Markers are those of the namespaces, by default of all.
    """
    if hasattr(message, "angle_increment"):
        return scan_points(message)
    if hasattr(message, "point_step"):
        return cloud_points(message, rule)
    if hasattr(message, "x") and hasattr(message, "y"):
        return array_points(message, rule)
    if hasattr(message, "markers"):
        return marker_points(message, rule, namespaces)
    return cone_points(message, rule)


def scan_points(scan: Any) -> Points:
    """Points that the beams of a `LaserScan` have hit, without labels.

    The range is NaN, infinite, or out of its limits where a beam has hit nothing.
    """
    ranges = np.asarray(scan.ranges, dtype=float)
    angles = scan.angle_min + scan.angle_increment * np.arange(len(ranges))
    hit = np.isfinite(ranges) & (ranges >= scan.range_min) & (ranges <= scan.range_max)
    points = ranges[hit, None] * np.column_stack([np.cos(angles[hit]), np.sin(angles[hit])])
    return Points.of(points, np.full(len(points), UNKNOWN), lines=DENSE)


def cloud_points(cloud: Any, rule: LabelRule) -> Points:
    """Points of a `PointCloud2` by its fields `x`, `y`, the label and, if any, xx, xy, yy."""
    known = {field.name: field for field in cloud.fields if field.datatype in CLOUD_TYPES}
    if not {"x", "y"} <= known.keys():
        raise MessageError(f"expected a point cloud with the fields x and y, found {', '.join(known)}")
    order = ">" if cloud.is_bigendian else "<"
    formats = [order + CLOUD_TYPES[field.datatype] for field in known.values()]
    offsets = [field.offset for field in known.values()]
    layout = {"names": [*known], "formats": formats, "offsets": offsets, "itemsize": cloud.point_step}
    of_a_point = np.dtype(layout)  # type: ignore[call-overload]
    rows = np.frombuffer(bytes(cloud.data), np.uint8)[: cloud.height * cloud.row_step]
    rows = rows.reshape(cloud.height, cloud.row_step)[:, : cloud.width * cloud.point_step]
    columns = np.ascontiguousarray(rows).reshape(-1).view(of_a_point)
    labels, covariances = np.full(len(columns), UNKNOWN), None
    if {"xx", "xy", "yy"} <= known.keys():
        covariances = covariances_of(*(columns[entry].astype(float) for entry in ("xx", "xy", "yy")))
    if rule.fields != (NO_LABEL,):
        name = next((name for name in rule.fields if name in known), None)
        if name is None:
            wanted = f"one of {', '.join(rule.fields)}" if len(rule.fields) > 1 else f"'{rule.fields[0]}'"
            found = f"found {', '.join(known)} (--label-field names it, `{NO_LABEL}` does without)"
            raise MessageError(f"expected a point cloud with labels in the field {wanted}, {found}")
        labels = rule.of_all(columns[name])
    return Points.of(np.column_stack([columns["x"], columns["y"]]), labels, covariances)


def array_points(message: Any, rule: LabelRule) -> Points:
    """Points of a message with an array for each of `x`, `y` and, if it has one, the label."""
    names = ["x", "y", *[name for name in rule.fields if hasattr(message, name)][:1]]
    x, y, *values = (np.atleast_1d(getattr(message, name)) for name in names)
    lengths = [len(x), len(y), *map(len, values)]
    if len(set(lengths)) > 1:
        raise MessageError(f"expected arrays {', '.join(names)} of one length, found {lengths}")
    labels = rule.of_all(values[0]) if values else np.full(len(x), UNKNOWN)
    return Points.of(np.column_stack([x, y]), labels)


def marker_points(array: Any, rule: LabelRule, namespaces: Sequence[str] = ()) -> Points:
    """Points of a `MarkerArray` that are added: blue ones are left, yellow ones right.

    A strip of lines is a polyline. Markers are those of the namespaces, by default of all.
    """
    points, labels, lines = list[tuple[float, float]](), list[int](), list[int]()
    for number, marker in enumerate(added(array.markers)):
        if namespaces and marker.ns not in namespaces:
            continue
        at, colours = marker.pose.position, [marker.color]
        if marker.type in POINT_MARKERS:
            points.append((at.x, at.y))
        else:
            yaw = yaw_of(marker.pose.orientation)
            c, s = np.cos(yaw), np.sin(yaw)
            points += [(at.x + c * p.x - s * p.y, at.y + s * p.x + c * p.y) for p in marker.points]
            one_each = len(marker.colors) == len(marker.points)
            colours = marker.colors if one_each else [marker.color] * len(marker.points)
        labels += map(rule.of, colours)
        lines += [number if marker.type == LINE_STRIP else ALONE] * len(colours)
    return Points.of(points, labels, lines=lines)


def added(markers: Iterable[Any]) -> Iterator[Any]:
    """Yield the markers that are points or polylines and are not taken away."""
    known = (*POINT_MARKERS, LINE_STRIP, 6, 7, 8)  # the last are lists of cubes, spheres and points
    return (marker for marker in markers if marker.action == 0 and marker.type in known)


def cone_points(message: Any, rule: LabelRule) -> Points:
    """Cones in all lists of a message, as in `ConeArrayWithCovariance` and `Detection3DArray`.

    A list whose name has a word of `LIST_NAMES` in it gives all its cones that label. In other lists a cone
    has its own. Its covariance has 4 (x, y), 9 (x, y, z) or 36 entries (a pose), row by row. What has a list
    of points in place of a position is a polyline.
    """
    if not (lists := _lists(message)):
        raise MessageError(f"expected a message with a list of cones, found the fields {_names(message)}")
    points, covariances = list[tuple[float, float]](), list[Array]()
    labels, numbers = list[int](), list[int]()
    for number, (name, one) in enumerate((name, one) for name, listed in lists.items() for one in listed):
        found, is_polyline = _positions(one)
        label = next((label for word, label in LIST_NAMES.items() if word in name.lower()), None)
        if label is None:
            value = _label_value(one, rule.fields)
            label = UNKNOWN if value is None else rule.of(value)
        points += found
        labels += [label] * len(found)
        covariances += [_covariance(one)] * len(found)
        numbers += [number if is_polyline else ALONE] * len(found)
    return Points.of(points, labels, covariances, numbers)


def _lists(message: Any) -> dict[str, Any]:
    """Lists of messages in a message, by field."""
    fields = {name: getattr(message, name) for name in _names(message)}
    return {name: value for name, value in fields.items() if _is_list(value)}


def _is_list(value: Any) -> bool:
    return isinstance(value, list | tuple) and not (value and isinstance(value[0], str | int | float | bytes))


def _path(cone: Any) -> Iterator[Any]:
    """Yield a cone and what its position lies in, from the outside to the inside."""
    at = cone
    while at is not None:
        yield at
        at = first_of(at, POSITIONS)


def _positions(one: Any) -> tuple[list[tuple[float, float]], bool]:
    """Position (m) of a cone, or those of the vertices of a polyline, and whether it is one.

    A position may lie some fields deep, as in a pose with covariance. A polyline has arrays x and y in its
    place, or a list of points.
    """
    if np.ndim(getattr(one, "x", 0.0)) and np.ndim(getattr(one, "y", 0.0)):
        return [(float(x), float(y)) for x, y in zip(one.x, one.y, strict=True)], True
    if place := next(filter(None, map(_place, _path(one))), None):
        return [place], False
    lists = [vertices for name, vertices in _lists(one).items() if name != "covariance"]
    if not lists:
        expected = f"x and y, range and bearing, or one of {', '.join(POSITIONS)}"
        raise MessageError(f"expected a cone with the fields {expected}, found {_names(one)}")
    return [place for vertex in lists[0] for place in _positions(vertex)[0]], True


def _place(at: Any) -> tuple[float, float] | None:
    """Position (m) of a pair, or of what has x and y, or range and bearing; None of anything else."""
    if isinstance(at, list | tuple):
        x, y = at
        return float(x), float(y)
    if hasattr(at, "x") and hasattr(at, "y"):
        return float(at.x), float(at.y)
    if hasattr(at, "range") and hasattr(at, "bearing"):
        return float(at.range * np.cos(at.bearing)), float(at.range * np.sin(at.bearing))
    return None


def _covariance(cone: Any) -> Array:
    """Covariance (2, 2) of a cone's position (m^2), which is NaN where it has none."""
    holder = next((at for at in _path(cone) if hasattr(at, "covariance")), None)
    entries = np.zeros(0) if holder is None else np.asarray(holder.covariance, dtype=float).ravel()
    side = {4: 2, 9: 3, 36: 6}.get(len(entries))
    return np.full((2, 2), np.nan) if side is None else entries.reshape(side, side)[:2, :2]


def _label_value(holder: Any, names: Sequence[str]) -> Any:
    """Value of the first label field, also inside the first of several hypotheses."""
    value = first_of(holder, names)
    if _is_list(value):
        value = value[0] if value else None
    inside = _label_value(value, LABEL_FIELDS) if value is not None else None
    return value if inside is None else inside


def _names(message: Any) -> Sequence[str]:
    if is_dataclass(message):
        return [field.name for field in fields(message) if not field.name.startswith("_")]
    if hasattr(message, "get_fields_and_field_types"):
        return list(message.get_fields_and_field_types())
    return list(vars(message))
