"""Bags made of messages, or of signals, in each of the three storages."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

STORAGES = ("rosbag1", "sqlite3", "mcap")
SUFFIX = {"rosbag1": ".bag", "sqlite3": "", "mcap": ""}
JOINT_STATE = "sensor_msgs/msg/JointState"
MISSING = {"tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms\n"}
"""Standard types that rosbags does not know of ROS 1."""
ROBOTINO = {
    "robotino_msgs/msg/MotorReadings": (
        "time stamp\nfloat32[] velocities # rpm\nint32[] positions # ticks\n"
        "float32[] currents # A\n"
    ),
    "robotino_msgs/msg/PowerReadings": "time stamp\nfloat32 current\nfloat32 voltage\n",
}


@dataclass(frozen=True)
class Message:
    """A message: its topic and type, its fields by name, and when it was received [s]."""

    topic: str
    type: str
    fields: Mapping[str, Any]
    received: float


def types_of(storage: str, definitions: Mapping[str, str] | None = None):
    """Standard types of ROS 1 or ROS 2, and others by the text of their definition."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if storage == "rosbag1" else Stores.ROS2_HUMBLE)
    types: dict[str, Any] = {}
    missing = {name: text for name, text in MISSING.items() if name not in store.types}
    for name, text in (missing | dict(definitions or {})).items():
        types.update(get_types_from_msg(text, name))
    if types:
        store.register(types)
    return store


def message(store, name: str, fields: Mapping[str, Any]):
    """A message of a type; fields that are not given are zero or empty."""
    from rosbags.interfaces import Nodetype

    def value(description, given):
        kind, inner = description
        if kind == Nodetype.NAME:
            return given if hasattr(given, "__msgtype__") else message(store, inner, given or {})
        if kind == Nodetype.BASE:
            return ("" if inner[0] == "string" else 0) if given is None else given
        element, count = inner
        many = [None] * count if given is None and kind == Nodetype.ARRAY else given
        many = [] if many is None else many
        if isinstance(many, np.ndarray) and many.dtype == np.uint8:
            return many
        if element[0] == Nodetype.BASE and element[1][0] != "string":
            dtype = {"bool": "bool", "char": "uint8", "byte": "uint8"}.get(
                element[1][0], element[1][0]
            )
            return np.array([0 if x is None else x for x in many], dtype=dtype)
        return [value(element, one) for one in many]

    if name == "builtin_interfaces/msg/Time" and isinstance(fields, int | float):
        nanoseconds = fields if isinstance(fields, int) else round(fields * 1e9)
        fields = {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9}
    unknown = set(fields) - {key for key, _ in store.fielddefs[name][1]}
    assert not unknown, f"{name} has no {unknown}"
    return store.types[name](
        **{key: value(kind, fields.get(key)) for key, kind in store.fielddefs[name][1]}
    )


@contextmanager
def writer_of(path: Path, storage: str, **options: Any):
    """A writer of rosbags; options of its own: `compression` of rosbag1 or rosbag2."""
    from rosbags import rosbag1, rosbag2
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin

    if storage == "rosbag1":
        writer = rosbag1.Writer(path)
        if compression := options.get("compression"):
            writer.set_compression(rosbag1.Writer.CompressionFormat[compression])
    else:
        plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
        writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
        if compression := options.get("compression"):
            writer.set_compression(CompressionMode[compression], CompressionFormat.ZSTD)
    with writer:
        yield writer


def write_bag(
    path: Path,
    storage: str,
    messages: Iterable[Message],
    definitions: Mapping[str, str] | None = None,
    empty: Mapping[str, str] | None = None,
    **options: Any,
) -> Path:
    """Write messages in the order given, and topics without any (`empty`, by type)."""
    store = types_of(storage, definitions)
    serialise = store.serialize_ros1 if storage == "rosbag1" else store.serialize_cdr
    with writer_of(path, storage, **options) as writer:
        connections: dict[str, Any] = {}

        def connection(topic, name):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, name, typestore=store)
            return connections[topic]

        for topic, name in (empty or {}).items():
            connection(topic, name)
        for one in messages:
            raw = serialise(message(store, one.type, one.fields), one.type)
            writer.write(connection(one.topic, one.type), round(one.received * 1e9), raw)
    return path


def without_definitions(path: Path) -> Path:
    """Take the definitions out of a sqlite3 bag, as those before ROS 2 Iron lack them."""
    import sqlite3

    with sqlite3.connect(next(path.glob("*.db3"))) as database:
        database.execute("DELETE FROM message_definitions")
    database.close()
    return path


# messages of known types


def header(stamp: float, frame: str = "") -> dict[str, Any]:
    return {"stamp": stamp, "frame_id": frame}


def joint_states(topic, time, joints, delay=0.002, **arrays) -> list[Message]:
    """JointStates: `position`, `velocity` and `effort` by sample and joint."""
    return [
        Message(
            topic,
            JOINT_STATE,
            {
                "header": header(float(t)),
                "name": list(joints),
                **{key: np.asarray(values)[k] for key, values in arrays.items()},
            },
            float(t) + delay,
        )
        for k, t in enumerate(time)
    ]


def vector(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> dict[str, float]:
    return {"x": float(x), "y": float(y), "z": float(z)}


def turned(heading: float) -> dict[str, float]:
    """Quaternion of a turn about the vertical."""
    return {"x": 0.0, "y": 0.0, "z": float(np.sin(heading / 2)), "w": float(np.cos(heading / 2))}


def pose_fields(name: str, stamp: float, x: float, y: float, heading: float) -> dict[str, Any]:
    """Fields of any of the types that hold a pose."""
    pose = {"position": vector(x, y), "orientation": turned(heading)}
    if name.endswith("TransformStamped"):
        return transform(stamp, "map", "base", x, y, heading)
    if name.endswith(("Odometry", "PoseWithCovarianceStamped")):
        return {"header": header(stamp, "map"), "pose": {"pose": pose}}
    return {"header": header(stamp, "map"), "pose": pose}


def transform(stamp, parent, child, x, y, heading, z=0.0) -> dict[str, Any]:
    """Fields of a TransformStamped."""
    return {
        "header": header(stamp, parent),
        "child_frame_id": child,
        "transform": {"translation": vector(x, y, z), "rotation": turned(heading)},
    }


def in_order(*parts: Iterable[Message]) -> list[Message]:
    """Messages of several topics in the order of receipt."""
    return sorted((one for part in parts for one in part), key=lambda one: one.received)
