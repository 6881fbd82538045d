"""The interface of rclpy and of its messages, recorded, for where ROS isn't installed.

Signatures are those of rclpy in ROS 2 Jazzy, as far as the node needs them. Messages have the
fields of their definitions in `rosbags`; as in ROS, there are no others, and each has its type.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Callable
from enum import Enum
from functools import cache
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.ROS2_JAZZY)
NUMBERS = {"bool": False, "string": "", "float32": 0.0, "float64": 0.0}


@cache
def message_class(name: str) -> type:
    """A message class by its name with the package, such as `std_msgs/Header`."""
    constants, fields = STORE.fielddefs[name.replace("/", "/msg/")]
    kinds = dict(fields)

    class Message:
        def __init__(self, **given: Any) -> None:
            for field, kind in kinds.items():
                object.__setattr__(self, field, _default(kind))
            for field, value in given.items():
                setattr(self, field, value)

        def __setattr__(self, field: str, value: Any) -> None:
            assert field in kinds, f"{name} has no field {field}"
            expected = type(_default(kinds[field]))
            assert isinstance(value, expected), f"{name}.{field}: expected {expected}, found {value!r}"
            object.__setattr__(self, field, value)

    for constant, _, value in constants:
        setattr(Message, constant, value)
    return type(name.rpartition("/")[2], (Message,), {})


def _default(field: Any) -> Any:
    code, kind = field
    if code == Nodetype.BASE:
        return NUMBERS.get(kind[0], 0)
    return message_class(kind.replace("/msg/", "/"))() if code == Nodetype.NAME else []


class ExternalShutdownException(Exception):  # noqa: N818 - its name in rclpy
    pass


class ReliabilityPolicy(Enum):
    RELIABLE = 1
    BEST_EFFORT = 2


class QoSProfile:
    def __init__(self, *, depth: int, reliability: ReliabilityPolicy = ReliabilityPolicy.RELIABLE) -> None:
        self.depth, self.reliability = depth, reliability


class Node:
    """A node that keeps what is published, and by topic what it subscribes to."""

    def __init__(self, name: str, now: int, parameters: dict[str, Any]) -> None:
        self.name, self._now, self._parameters = name, now, parameters
        self.published: defaultdict[str, list[Any]] = defaultdict(list)
        self.told: list[str] = []
        self.subscribed: dict[str, tuple[type, Callable[[Any], None], QoSProfile]] = {}

    def declare_parameter(self, name: str, value: Any = None) -> Any:
        return SimpleNamespace(value=self._parameters.get(name, value))

    def create_publisher(self, msg_type: type, topic: str, qos_profile: QoSProfile | int) -> Any:
        def publish(msg: Any) -> None:
            assert isinstance(msg, msg_type)
            self.published[topic].append(msg)

        return SimpleNamespace(publish=publish)

    def create_subscription(
        self, msg_type: type, topic: str, callback: Callable[[Any], None], qos_profile: Any
    ) -> None:
        self.subscribed[topic] = msg_type, callback, qos_profile

    def get_clock(self) -> Any:
        stamp = message_class("builtin_interfaces/Time")(sec=self._now // 10**9, nanosec=self._now % 10**9)
        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=self._now, to_msg=lambda: stamp))

    def get_logger(self) -> Any:
        return SimpleNamespace(info=self.told.append, error=self.told.append)


def install(patch: pytest.MonkeyPatch, spin: Callable[[Node], None], now: int, **parameters: Any) -> None:
    """Put the modules of ROS in place, whose clock stands at `now` (ns); `spin` has the node's callbacks."""
    module = ModuleType("rclpy")
    vars(module).update(
        init=lambda *, args=None: None,
        create_node=lambda node_name: Node(node_name, now, parameters),
        spin=spin,
    )
    modules = {"rclpy": module}
    for name, members in {
        "rclpy.executors": (ExternalShutdownException,),
        "rclpy.qos": (QoSProfile, ReliabilityPolicy),
        "builtin_interfaces.msg": ("Time",),
        "geometry_msgs.msg": ("Point", "PoseStamped", "TransformStamped"),
        "nav_msgs.msg": ("Odometry", "Path"),
        "sensor_msgs.msg": ("PointCloud2",),
        "std_msgs.msg": ("Header", "String"),
        "tf2_msgs.msg": ("TFMessage",),
        "visualization_msgs.msg": ("Marker", "MarkerArray"),
    }.items():
        package = name.partition(".")[0]
        made = modules[name] = ModuleType(name)
        modules.setdefault(package, ModuleType(package))
        for member in members:
            kind = message_class(f"{package}/{member}") if isinstance(member, str) else member
            setattr(made, kind.__name__, kind)
    for name, made in modules.items():
        patch.setitem(sys.modules, name, made)
