"""ROS bags, read without ROS: rosbag1, and rosbag2 as sqlite3 and mcap."""

import re
import struct
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple

import gtsam
import numpy as np

from pathspace_graph.errors import InputError, PathspaceError, SettingsError, install
from pathspace_graph.factors.arrays import Array
from pathspace_graph.io.parsing import read_text

from . import messages
from .messages import MessageError, Points
from .recording import Recording, check_clock, chosen_motion, rate
from .settings import LabelRule, Topics

SUPPORTED: Final = {  # contents that a message must have, by the option of its topic
    "--odometry": "a twist, a speed or a pose",
    "--imu": "an angular velocity",
    "--detections": "a point cloud, a scan, an array of markers, or a list of cones or polylines",
}
STATIC: Final = "/tf_static"  # topic of the transforms between frames that are fixed to the vehicle


class Samples(NamedTuple):
    """Values from the messages of one topic, in the order of the bag."""

    name: str  # topic and type of the messages
    t: Array  # (N,) stamps (s)
    values: list[Any]  # one for each message
    numbers: Any  # (N,) number of each message in its topic, from 1


def read_bag(path: Path, options: Topics, rule: LabelRule, *, mounted: bool = False) -> Recording:
    """Read the drive in the topics of a bag; `mounted` says that the sensor's pose was stated."""
    notes, namespaces = Counter[str](), Counter[str]()

    def motion(message: Any) -> tuple[Array | None, Array | None, str, str]:
        twist, pose = messages.twist_of(message, options.wheelbase), messages.pose_of(message)
        body = messages.frame_id_of(message, "child_frame_id")  # of the twist
        return twist, pose, messages.frame_id_of(message), body

    def points(message: Any) -> tuple[str, Points]:
        namespaces.update(marker.ns for marker in messages.added(getattr(message, "markers", ())))
        return messages.frame_id_of(message), messages.points_of(message, rule, options.namespaces)

    with closing(Bag(path, options, notes)) as bag:
        odometry = bag.samples(options.odometry, "--odometry", motion)
        imu = bag.samples(options.imu, "--imu", messages.yaw_rate_of) if options.imu else None
        detections = bag.samples(options.detections, "--detections", points)
        static = [] if mounted else bag.transforms()
    listed = ", ".join(f"'{name}' ({count} markers)" for name, count in sorted(namespaces.items()))
    for name in options.namespaces:
        if name not in namespaces:
            expected = f"--namespaces: expected one of {listed or 'an array of markers'}"
            raise InputError(path, f"{expected}, found '{name}'")
    if len(namespaces) > 1 and not options.namespaces:
        told = f"namespaces of markers were read together: {listed} (--namespaces chooses)"
        notes[told] += len(namespaces)
    if imu is not None:
        check_clock(imu.t, "the IMU", path)
    twists = np.array([twist for twist, *_ in odometry.values if twist is not None])
    poses = np.array([pose for _, pose, *_ in odometry.values if pose is not None])
    moved, are_poses = chosen_motion(
        twists if len(twists) else None,
        poses if len(poses) == len(odometry.values) else None,
        odometry.name,
        path,
        from_poses=options.from_poses,
    )
    if imu is None and not are_poses and np.isnan(moved[:, 2]).all():
        expected = "expected --imu TOPIC for the yaw rate, or --wheelbase where there is a steering angle"
        raise InputError(path, f"{odometry.name}: {expected}, found neither")
    mounting = None if mounted else _mounting(odometry, detections, static, notes, path)
    source = {"bag": path.name, "odometry": odometry.name, "detections": detections.name}
    source |= {} if imu is None else {"imu": imu.name}
    return Recording(
        odometry.t,
        moved,
        detections.t,
        Points.joined([points for _, points in detections.values]),
        source,
        odometry.numbers,
        f"{options.odometry}, message",
        notes,
        mounting=mounting,
        are_poses=are_poses,
        is_held=options.held,
        imu=None if imu is None else (imu.t, np.array(imu.values)),
    )


# --- where the sensor is ---------------------------------------------------------------------------------


def _mounting(
    odometry: Samples, detections: Samples, static: list[Any], notes: Counter[str], path: Path
) -> tuple[float, float, float] | None:
    """Find the sensor's pose in the bag's transforms; refuse detections in the world's frame."""
    (_, pose, world, body), frames = odometry.values[0], {frame for frame, _ in detections.values} - {""}
    if pose is not None and body and world in frames - {body}:
        expected = f"expected detections in a frame of the vehicle, such as {body}"
        found = f"found them in {world}, the frame of its pose"
        otherwise = "--mounting 0 0 0 takes them as in the vehicle frame"
        raise InputError(path, f"{detections.name}: {expected}, {found}; {otherwise}")
    named = {one.header.frame_id.lstrip("/") for one in static}
    body = body or next((name for name in ("base_link", "base_footprint") if name in named), "")
    others = sorted(frames - {body})
    if not body or not others:
        return None
    place = transform_between(static, body, others[0]) if len(others) == 1 else None
    # the sensor is level: the cosine of its z axis and the vehicle's
    if place is not None and place.rotation().matrix()[2, 2] > 0.98:
        x, y, yaw = place.x(), place.y(), place.rotation().yaw()
        told = f"which {STATIC} puts at {x:.3g} {y:.3g} {yaw:.3g} (m, m, rad) in {body}"
        notes[f"messages with detections are in frame {others[0]}, {told}"] += len(detections.values)
        return x, y, yaw
    told = f"in frame {', '.join(others)}, the odometry is of {body}: --mounting states where the sensor is"
    notes[f"messages with detections are {told}"] += len(detections.values)
    return None


def transform_between(static: list[Any], body: str, sensor: str) -> gtsam.Pose3 | None:
    """`body_T_sensor` by `TransformStamped`s between frames, None if nothing connects them."""
    edges: dict[str, list[tuple[str, gtsam.Pose3]]] = {}
    for one in static:
        parent, child = one.header.frame_id.lstrip("/"), one.child_frame_id.lstrip("/")
        q, p = one.transform.rotation, one.transform.translation
        step = gtsam.Pose3(gtsam.Rot3.Quaternion(q.w, q.x, q.y, q.z), [p.x, p.y, p.z])
        edges.setdefault(parent, []).append((child, step))
        edges.setdefault(child, []).append((parent, step.inverse()))
    known, waiting = {body: gtsam.Pose3()}, [body]
    while waiting:
        frame = waiting.pop()
        for other, step in edges.get(frame, []):
            if other not in known:
                known[other] = known[frame].compose(step)
                waiting.append(other)
    return known.get(sensor)


# --- bags ------------------------------------------------------------------------------------------------


class Bag:
    """A bag as the package `rosbags` reads it, with InputErrors in place of its errors."""

    def __init__(self, path: Path, options: Topics, notes: Counter[str]) -> None:
        if not path.exists():
            raise InputError(path, "expected a bag, found none")
        try:
            from rosbags import rosbag1, rosbag2, typesys  # noqa: PLC0415
        except ImportError:
            raise PathspaceError(
                f"bags: expected the package rosbags, found none: {install('ros')}"
            ) from None
        self._path, self._received, self._notes, self._types = path, options.received, notes, typesys
        # a folder is a bag of rosbag2, whatever its name
        self._is_ros1 = path.name.endswith((".bag", ".bag.active")) and not path.is_dir()
        self._definitions = self._given(options.definition)
        try:
            self._reader = (rosbag1 if self._is_ros1 else rosbag2).Reader(path)
            self._reader.open()
        except Exception as error:
            bags = "bags of ROS 1 and ROS 2 (.bag, .db3, and .mcap of profile 'ros2')"
            readable = f"read are {bags}, CSV (--from csv) and JSON lines (--from jsonl)"
            found = f"found {described(path)} ({error}); {readable}"
            raise InputError(path, f"expected a ROS bag, {found}") from None

    def close(self) -> None:
        self._reader.close()

    def samples(self, topic: str | None, option: str, take: Callable[[Any], Any]) -> Samples:
        """`take` the messages of a topic, with their header stamps if most have one, else of receipt."""
        connections = [entry for entry in self._reader.connections if entry.topic == topic]
        if not connections:
            found = "found none" if topic is None else f"found {topic}"
            raise self._error(f"{option}: expected a topic of the bag, {found}")
        name = f"{topic} ({connections[0].msgtype})"
        received, stamps, values = self._read(connections, take, option)
        if not values:
            raise self._error(f"{option}: expected messages of {topic}, found none")
        stamped = [] if self._received else [k for k, stamp in enumerate(stamps) if stamp is not None]
        if 2 * len(stamped) <= len(stamps):
            self._notes[f"messages of {topic} have the time at which they were received"] += len(values)
            return Samples(name, np.array(received), values, np.arange(len(values)) + 1)
        self._notes[f"messages of {topic} without a stamp were left out"] += len(stamps) - len(stamped)
        t = np.array([stamps[k] for k in stamped], dtype=float)
        return Samples(name, t, [values[k] for k in stamped], np.array(stamped) + 1)

    def transforms(self) -> list[Any]:
        """`TransformStamped`s between frames fixed to the vehicle, of which there may be none."""
        connections = [entry for entry in self._reader.connections if entry.topic == STATIC]
        read = self._read(connections, lambda message: list(message.transforms), "transforms")
        return [one for message in read[2] for one in message]

    def _error(self, message: str) -> InputError:
        seconds = 1e-9 * (self._reader.end_time - self._reader.start_time)
        topics = [
            f"{name} ({topic.msgtype}, {topic.msgcount} messages, {rate(topic.msgcount, seconds)})"
            for name, topic in sorted(self._reader.topics.items())
            if topic.msgcount
        ]
        listed = f"the topics with messages are {', '.join(topics)}"
        return InputError(self._path, f"{message}; {listed if topics else 'it has no messages at all'}")

    def _read(
        self, connections: list[Any], take: Callable[[Any], Any], option: str
    ) -> tuple[list[float], list[float | None], list[Any]]:
        """Read the times of receipt, the stamps and what was taken of all messages of a topic."""
        received, stamps, values = list[float](), list[float | None](), list[Any]()
        if not connections:
            return received, stamps, values
        store, kind = self._store(connections[0]), connections[0].msgtype
        decode = store.deserialize_ros1 if self._is_ros1 else store.deserialize_cdr
        found = self._reader.messages(connections)
        while True:
            try:
                _, time, data = next(found)
            except StopIteration:
                return received, stamps, values
            except Exception as error:
                damaged = f"expected a whole bag, found one that is damaged ({error})"
                raise InputError(self._path, damaged) from None
            try:
                message = decode(data, kind)
                values.append(take(message))
                stamps.append(messages.stamp_of(message))
            except MessageError as error:
                told = f"{option} {connections[0].topic} ({kind}): {error}"
                raise self._error(f"{told}; supported are messages with {SUPPORTED[option]}") from None
            except Exception as error:
                where = f"message {len(received) + 1} of {connections[0].topic} ({kind})"
                raise InputError(self._path, f"{where}: expected one that can be read ({error})") from None
            received.append(1e-9 * time)

    def _store(self, connection: Any) -> Any:
        """Types of a topic: those of the bag, else those of the options and of ROS."""
        stores, text, known = self._types.Stores, connection.msgdef.data, dict[str, Any]()
        try:
            if connection.msgdef.format.name == "MSG":
                known |= self._types.get_types_from_msg(text, connection.msgtype)
            elif connection.msgdef.format.name == "IDL":
                parts = (re.sub(r"\AIDL: .*\n", "", part) for part in text.split("=" * 80 + "\n"))
                for part in filter(str.strip, parts):
                    known |= self._types.get_types_from_idl(part)
            else:  # an old bag defines none
                ros = self._types.get_typestore(stores.ROS1_NOETIC if self._is_ros1 else stores.ROS2_HUMBLE)
                known |= {**ros.fielddefs, **self._definitions}
            store = self._types.get_typestore(stores.EMPTY)
            store.register(known)
            store.get_msgdef(connection.msgtype)
        except Exception as error:
            found = f"found a type without a definition ({connection.msgtype}: {error})"
            expected = f"{connection.topic}: expected a known type"
            raise InputError(self._path, f"{expected}, {found}; --definition provides one") from None
        return store

    def _given(self, definitions: Sequence[str]) -> dict[str, Any]:
        """Types of messages that the options define, as PACKAGE/msg/NAME=FILE or by the end of a path."""
        types: dict[str, Any] = {}
        for entry in definitions:
            stated, equals, path = entry.rpartition("=")
            file = Path(path)
            parts = stated.split("/") if equals else [*file.absolute().parts[-3:-1], file.stem]
            parts = [part for part in parts if part != "msg"]
            if len(parts) < 2 or not all(parts):
                raise SettingsError(f"--definition: expected PACKAGE/msg/NAME=FILE, found '{entry}'")
            name = f"{parts[-2]}/msg/{parts[-1]}"
            text = read_text(file, "a message definition")
            try:
                types |= self._types.get_types_from_msg(text, name)
            except Exception as error:
                raise InputError(file, f"expected the definition of {name} ({error})") from None
        return types


# --- what is no bag ----------------------------------------------------------------------------------------

MCAP: Final = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL = 1, 2, 3, 4  # kinds of records of an MCAP file
FOOTER_BYTES: Final = 37  # of the last record of an MCAP file with what is around it
KINDS: Final = {  # kind of a file, by its first bytes
    b"#ROSBAG": "a bag of ROS 1 that is damaged or was cut off",
    b"SQLite format 3": "an SQLite database that is no bag, is damaged or was cut off",
    b"PK\x03\x04": "a ZIP archive",
    b"\x1f\x8b": "a file that gzip has compressed as a whole",
    b"\x28\xb5\x2f\xfd": "a file that zstd has compressed as a whole",
    b"ULog": "a ULog of PX4",
    b"": "a file of another kind",
}


def described(path: Path) -> str:
    """Say what a file, or each file of a folder, holds that is no bag."""
    if path.is_dir():
        files = sorted(file for file in path.iterdir() if file.is_file() and file.name != "metadata.yaml")
        return "; ".join(f"{file.name}, {described(file)}" for file in files[:8]) or "an empty folder"
    with path.open("rb") as stream:
        begin = stream.read(len(MCAP))
        if begin == MCAP:
            return described_mcap(stream)
        begin += stream.read(len(MCAP))
    return next(kind for magic, kind in KINDS.items() if begin.startswith(magic))


def described_mcap(stream: BinaryIO) -> str:
    """Say which messages an MCAP file holds, by the records of its summary."""
    stream.seek(max(stream.seek(0, 2) - FOOTER_BYTES, 0))
    end = stream.read()
    if len(end) < FOOTER_BYTES or not end.endswith(MCAP) or end[0] != FOOTER:
        return "an MCAP file that was cut off or is damaged"
    (summary,) = struct.unpack("<Q", end[9:17])
    profile, schemas, topics, kind = "", dict[int, str](), dict[str, tuple[str, str]](), HEADER
    stream.seek(len(MCAP))
    with suppress(struct.error, UnicodeDecodeError):
        while kind != FOOTER:
            kind, size = struct.unpack("<BQ", stream.read(9))
            record = BytesIO(stream.read(size))
            if kind == HEADER:
                profile = _text(record)
                stream.seek(summary or stream.tell())
            elif kind == SCHEMA:
                (key,) = struct.unpack("<H", record.read(2))
                schemas[key] = _text(record)
            elif kind == CHANNEL:
                _, key = struct.unpack("<HH", record.read(4))
                topic, encoding = _text(record), _text(record)
                topics[topic] = schemas.get(key, "no schema"), encoding
    named = [f"{topic} ({schema})" for topic, (schema, _) in sorted(topics.items())]
    listed = ", ".join(named[:8]) + ", ..." * (len(named) > 8)
    encodings = " and ".join(sorted({encoding for _, encoding in topics.values()}))
    if profile == "ros2" and encodings == "cdr":
        return "an MCAP file of ROS 2 that is damaged"
    return f"an MCAP file of {encodings or 'no'} messages (profile '{profile}'), not of ROS 2: {listed}"


def _text(record: BytesIO) -> str:
    """Text of a record, after its length."""
    (size,) = struct.unpack("<I", record.read(4))
    return record.read(size).decode()
