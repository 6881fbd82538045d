"""ROS bags, read without ROS: rosbag1, and rosbag2 as sqlite3 and mcap."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.errors import InputError, PathspaceError, SettingsError

from .messages import MessageError, Points, frame_of, points_of, pose_of, stamp_of, twist_of, yaw_rate_of
from .poses import twists_between
from .recording import Recording
from .settings import LabelRule

Array = NDArray[np.float64]

INSTALL: Final = "pip install 'pathspace-graph[ros]'"
"""This installs the package that reads bags."""
ODOMETRY: Final = "nav_msgs/msg/Odometry"
"""A message of this type has a pose beside its twist."""
TWIST_TYPES: Final = (
    ODOMETRY,
    "geometry_msgs/msg/TwistStamped",
    "geometry_msgs/msg/TwistWithCovarianceStamped",
)
"""Messages of these types have a twist."""
SPEED_TYPES: Final = (
    "std_msgs/msg/Float32",
    "std_msgs/msg/Float64",
    "ackermann_msgs/msg/AckermannDriveStamped",
)
"""Messages of these types have a speed alone, so that the yaw rate must come from an IMU."""
IMU_TYPES: Final = ("sensor_msgs/msg/Imu",)
"""Messages of these types have a yaw rate."""
SUPPORTED: Final = (
    "sensor_msgs/msg/PointCloud2, visualization_msgs/msg/MarkerArray, or a list of cones with points"
)
"""Detections are in messages of these types."""
UNDEFINED: Final = "a type without a definition"
"""This says that neither the bag, nor ROS, nor a file that was handed over defines a message."""


@dataclass(frozen=True)
class BagOptions:
    """Describes what is read of a bag."""

    odometry: str | None
    """This is the topic of the odometry."""
    detections: str | None
    """This is the topic of the detections."""
    imu: str | None = None
    """The yaw rate is of this topic, where it is not that of the odometry."""
    definitions: Sequence[str] = ()
    """These are files of message definitions, each as `TYPE=FILE` or as a path that ends in
    `PACKAGE/msg/NAME.msg`."""
    label_field: str | None = None
    """The label of a detection is in this field; None takes the first that is known."""
    from_poses: bool = False
    """The twists are made from the poses of `nav_msgs/Odometry`."""
    received: bool = False
    """Stamps are the times at which messages were received, also where they have one of their own."""
    mounted: bool = False
    """The pose of the sensor was stated, so that frames of other names are no surprise."""


@dataclass(frozen=True, eq=False)
class Samples:
    """Holds what was taken of the messages of one topic, in the order of the bag."""

    topic: str
    """This is the topic."""
    kind: str
    """This is their type."""
    t: Array
    """(N,) These are their stamps (s)."""
    values: list[Any]
    """This was taken of each message."""


def read_bag(path: Path, options: BagOptions, rule: LabelRule) -> Recording:
    """Returns what the topics of a bag have of a drive.

    What is wrong is an InputError: a topic that is not there lists those that are, with types and rates.
    """
    notes: Counter[str] = Counter()
    with Bag.opened(path, options.definitions) as bag:
        odometry = bag.samples(options.odometry, "--odometry", TWIST_TYPES + SPEED_TYPES, options, notes)
        imu = None if options.imu is None else bag.samples(options.imu, "--imu", IMU_TYPES, options, notes)
        t, twists = _twists(odometry, imu, options, path)

        def points(message: Any) -> tuple[str, Points]:
            return frame_of(message), points_of(message, rule, options.label_field)

        detections = bag.samples(options.detections, "--detections", (), options, notes, points)
    if not options.mounted:
        _judge_frames(odometry, detections, notes, path)
    source = {"bag": path.name, "odometry": _named(odometry), "detections": _named(detections)}
    if imu is not None:
        source["imu"] = _named(imu)
    scans = [found for _, found in detections.values]
    return Recording(t, twists, detections.t, scans, source, notes)


def _named(samples: Samples) -> str:
    return f"{samples.topic} ({samples.kind})"


def _judge_frames(odometry: Samples, detections: Samples, notes: Counter[str], path: Path) -> None:
    """Notes detections in another frame than the vehicle's; those in the frame of its pose are refused."""
    world, body = frame_of(odometry.values[0]), frame_of(odometry.values[0], "child_frame_id")
    frames = {frame for frame, _ in detections.values} - {"", body}
    if odometry.kind != ODOMETRY or not body or not frames:
        return
    if world in frames:
        expected = f"expected detections in a frame of the vehicle, such as {body}"
        found = f"found them in {world}, the frame of its pose"
        otherwise = "if they are in the vehicle's for all that, --mounting 0 0 0 says so"
        raise InputError(path, f"{_named(detections)}: {expected}, {found}; {otherwise}")
    notes[
        f"messages with detections are in frame {', '.join(sorted(frames))}, the odometry is of {body}: "
        "--mounting says where the sensor is"
    ] += len(detections.values)


# --- twists ----------------------------------------------------------------------------------------------


def _twists(odometry: Samples, imu: Samples | None, options: BagOptions, path: Path) -> tuple[Array, Array]:
    """Returns the stamps (n,) in s and the twists (n, 3) of the vehicle."""
    if options.from_poses:
        t, twists = _from_poses(odometry, path)
    else:
        t, twists = odometry.t, np.array([twist_of(message) for message in odometry.values])
        _check_motion(odometry, twists, path)
    if imu is None:
        if odometry.kind in SPEED_TYPES:
            raise InputError(path, f"{_named(odometry)}: expected --imu TOPIC for the yaw rate, found none")
        return t, twists
    return with_yaw_rate(t, twists, imu.t, np.array([yaw_rate_of(message) for message in imu.values]))


def _check_motion(odometry: Samples, twists: Array, path: Path) -> None:
    """Raises an InputError where the twists are all zero and the poses are not."""
    if odometry.kind == ODOMETRY and not np.any(twists):
        poses = np.array([pose_of(message) for message in odometry.values])
        if np.ptp(poses, axis=0).any():
            raise InputError(
                path,
                f"{_named(odometry)}: expected twists, found zeros while the pose moves; --from-poses "
                "makes the twists from the poses",
            )


def _from_poses(odometry: Samples, path: Path) -> tuple[Array, Array]:
    """Returns the stamps and twists that lead from each pose to the next."""
    if odometry.kind != ODOMETRY:
        raise InputError(path, f"--from-poses: expected a topic of {ODOMETRY}, found {_named(odometry)}")
    t, first = np.unique(odometry.t, return_index=True)
    if len(t) < 2:
        raise InputError(path, f"--from-poses: expected two poses at least, found {len(t)}")
    poses = np.array([pose_of(odometry.values[index]) for index in first])
    return t[:-1], twists_between(t, poses)


def with_yaw_rate(t: Array, twists: Array, imu_t: Array, rates: Array) -> tuple[Array, Array]:
    """Returns the twists with the mean yaw rate of an IMU until the next of them.

    The heading is then that of the IMU, whichever of both is faster. Twists outside its time are left out.
    """
    order, turn = np.argsort(t, kind="stable"), np.argsort(imu_t, kind="stable")
    t, twists, imu_t, rates = t[order], twists[order].copy(), imu_t[turn], rates[turn]
    finite = np.isfinite(rates)
    imu_t, rates = imu_t[finite], rates[finite]
    inside = (t >= imu_t[0]) & (t <= imu_t[-1]) if len(imu_t) else np.zeros(len(t), bool)
    t, twists = t[inside], twists[inside]
    if len(t) < 2:
        return t, twists
    heading = np.append(0.0, np.cumsum(rates[:-1] * np.diff(imu_t)))
    steps = np.diff(t)
    turned = np.diff(np.interp(t, imu_t, heading))
    last = rates[np.searchsorted(imu_t, t[-1], side="right") - 1]
    now = np.interp(t[:-1], imu_t, rates)
    twists[:, 2] = np.append(np.where(steps > 0, turned / np.where(steps > 0, steps, 1.0), now), last)
    return t, twists


# --- bags ------------------------------------------------------------------------------------------------


class Bag:
    """Reads a bag by the package `rosbags`, and turns its errors into InputErrors."""

    def __init__(self, path: Path, reader: Any, definitions: dict[str, Any]) -> None:
        self.path = path
        self._reader = reader
        self._definitions = definitions
        self._is_ros1 = is_ros1(path)

    @staticmethod
    @contextmanager
    def opened(path: Path, definitions: Sequence[str] = ()) -> Iterator[Bag]:
        """Yields a bag that is closed afterwards."""
        if not path.exists():
            raise InputError(path, "expected a bag, found none")
        rosbag1, rosbag2, _ = _rosbags()
        given = _given_definitions(definitions)
        try:
            reader = (rosbag1 if is_ros1(path) else rosbag2).Reader(path)
            reader.open()
        except Exception as error:
            expected = "expected a ROS bag: a file .bag, .mcap or .db3, or a folder with metadata.yaml"
            raise InputError(path, f"{expected} ({error})") from None
        try:
            yield Bag(path, reader, given)
        finally:
            reader.close()

    def samples(
        self,
        topic: str | None,
        option: str,
        kinds: tuple[str, ...],
        options: BagOptions,
        notes: Counter[str],
        take: Callable[[Any], Any] = lambda message: message,
    ) -> Samples:
        """Returns what to `take` of the messages of a topic, which is of one of the `kinds`, if any.

        A message may be large, so only what is taken of it is kept.
        """
        connections = [entry for entry in self._reader.connections if entry.topic == topic]
        if not connections:
            found = "found none" if topic is None else f"found {topic}"
            raise self._error(f"{option}: expected a topic of the bag, {found}")
        kind = connections[0].msgtype
        if kinds and kind not in kinds:
            expected = f"expected a topic of one of the types {', '.join(kinds)}"
            raise self._error(f"{option}: {expected}, found {topic} ({kind})")
        received, stamps, values = self._read(connections, kind, take, option)
        if not values:
            raise self._error(f"{option}: expected messages of {topic}, found none")
        if options.received:
            stamps = [None] * len(stamps)
        return _stamped(str(topic), kind, stamps, received, values, notes)

    def _error(self, message: str) -> InputError:
        """Returns an InputError that also lists all topics with type, number of messages and rate."""
        seconds = 1e-9 * (self._reader.end_time - self._reader.start_time)
        topics = [
            f"{name} ({topic.msgtype}, {topic.msgcount} messages, {topic.msgcount / seconds:.3g} Hz)"
            for name, topic in sorted(self._reader.topics.items())
            if topic.msgcount
        ]
        listed = (
            f"the topics with messages are {', '.join(topics)}" if topics else "it has no messages at all"
        )
        return InputError(self.path, f"{message}; {listed}")

    def _read(
        self, connections: list[Any], kind: str, take: Callable[[Any], Any], option: str
    ) -> tuple[list[float], list[float | None], list[Any]]:
        """Returns the times of receipt, the stamps and what was taken of all messages of a topic."""
        store = self._store(connections[0])
        decode = store.deserialize_ros1 if self._is_ros1 else store.deserialize_cdr
        received: list[float] = []
        stamps: list[float | None] = []
        values: list[Any] = []
        try:
            for _, time, data in self._reader.messages(connections):
                message = decode(data, kind)
                values.append(take(message))
                stamps.append(stamp_of(message))
                received.append(1e-9 * time)
        except MessageError as error:
            where = f"{option} {connections[0].topic} ({kind})"
            raise InputError(self.path, f"{where}: {error}; supported are {SUPPORTED}") from None
        except Exception as error:
            where = f"message {len(values) + 1} of {connections[0].topic} ({kind})"
            raise InputError(self.path, f"{where}: expected one that can be read ({error})") from None
        return received, stamps, values

    def _store(self, connection: Any) -> Any:
        """Returns the types of a topic: those of the bag, or else those handed over and those of ROS."""
        *_, typesys = _rosbags()
        ros = typesys.Stores.ROS1_NOETIC if self._is_ros1 else typesys.Stores.ROS2_HUMBLE
        try:
            known = _types_of(connection, typesys)
            known = known or {**typesys.get_typestore(ros).fielddefs, **self._definitions}
            store = typesys.get_typestore(typesys.Stores.EMPTY)
            store.register(known)
            store.get_msgdef(connection.msgtype)
        except Exception as error:
            found = f"found {UNDEFINED} ({connection.msgtype}: {error}); --definition hands one over"
            raise InputError(self.path, f"{connection.topic}: expected a known type, {found}") from None
        return store


def is_ros1(path: Path) -> bool:
    """Returns whether a bag is one of rosbag1: a file. A folder is a bag of rosbag2, whatever its name."""
    return path.suffix == ".bag" and not path.is_dir()


def _stamped(
    topic: str,
    kind: str,
    stamps: list[float | None],
    received: list[float],
    values: list[Any],
    notes: Counter[str],
) -> Samples:
    """Returns samples with header stamps where most have one, else with the times of receipt.

    Both are not mixed, since they may be of different clocks: a message without a stamp among others that
    have one is left out.
    """
    stamped = [index for index, stamp in enumerate(stamps) if stamp is not None]
    if 2 * len(stamped) <= len(stamps):
        notes[f"messages of {topic} have the time at which they were received"] += len(values)
        return Samples(topic, kind, np.array(received), values)
    notes[f"messages of {topic} without a stamp were left out"] += len(stamps) - len(stamped)
    t = np.array([stamps[index] for index in stamped], dtype=float)
    return Samples(topic, kind, t, [values[index] for index in stamped])


def _types_of(connection: Any, typesys: Any) -> dict[str, Any]:
    """Returns the types that the bag itself defines for a topic; an old bag defines none."""
    text, form = connection.msgdef.data, connection.msgdef.format.name
    if form == "MSG":
        return dict(typesys.get_types_from_msg(text, connection.msgtype))
    if form != "IDL":
        return {}
    types: dict[str, Any] = {}
    for part in text.split("=" * 80 + "\n"):
        head, _, body = part.partition("\n")
        types |= (
            typesys.get_types_from_idl(body if head.startswith("IDL: ") else part) if part.strip() else {}
        )
    return types


def _given_definitions(definitions: Sequence[str]) -> dict[str, Any]:
    *_, typesys = _rosbags()
    types: dict[str, Any] = {}
    for entry in definitions:
        name, file = _type_and_file(entry)
        try:
            text = file.read_text(encoding="utf-8")
            types |= typesys.get_types_from_msg(text, name)
        except OSError as error:
            raise InputError(
                file, f"expected a message definition, can't be read ({error.strerror})"
            ) from None
        except Exception as error:
            raise InputError(file, f"expected the definition of {name} ({error})") from None
    return types


def _type_and_file(entry: str) -> tuple[str, Path]:
    """Returns the type `PACKAGE/msg/NAME` and the file of `TYPE=FILE`, or of a path that ends like a type."""
    name, equals, path = entry.rpartition("=")
    file = Path(path)
    parts = name.split("/") if equals else [*file.absolute().parts[-3:-1], file.stem]
    parts = [part for part in parts if part != "msg"]
    if len(parts) < 2 or not all(parts):
        raise SettingsError(f"--definition: expected PACKAGE/msg/NAME=FILE, found '{entry}'")
    return f"{parts[-2]}/msg/{parts[-1]}", file


def _rosbags() -> tuple[Any, Any, Any]:
    """Returns the modules of `rosbags`, which is an optional package."""
    try:
        from rosbags import rosbag1, rosbag2, typesys  # noqa: PLC0415
    except ImportError:
        raise PathspaceError(f"bags: expected the package rosbags, found none: {INSTALL}") from None
    return rosbag1, rosbag2, typesys
