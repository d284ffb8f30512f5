"""ROS bags of CRTK topics, a bag per episode: rosbag2 (MCAP or SQLite) and ROS 1, by rosbags.

A column per topic, without the leading slash:

    geometry_msgs Pose, PoseStamped, Transform, TransformStamped   x y z qx qy qz qw
    sensor_msgs JointState                                         positions
    geometry_msgs Wrench, WrenchStamped                            forces N, torques N m
    sensor_msgs CompressedImage, Image (rgb8, bgr8)                [h, w, 3]
    std_msgs Float64, Float32, Bool, Int32                         the number

All are sampled at the times of one topic, the first measured pose by name: every other topic has
its last message until then. `time` is in s from the start, of the messages' headers.
"""

import contextlib
import io
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from starjax import extras
from starjax.addons.formats import base, per_file
from starjax.addons.formats.base import Column, Source

_SUFFIXES = (".mcap", ".db3", ".bag")
_META = "metadata.yaml"  # of a folder that is a rosbag2
_CLOCK = "measured_cp"  # the topic whose times are the steps'
_TIME = "time"


@contextlib.contextmanager
def _open(path: Path) -> Iterator[Source]:
    extras.require("rosbag", "ros")
    bags = _bags(path)
    base.require(bool(bags), "bags", f"none in {path}")
    with _reader(bags[0]) as reader:
        known = {_name(c.topic): c for c in reader.connections if c.msgtype in _READERS}
        clock = _clock(known)
        columns = {_TIME: Column((), "float64")}
        notes = [
            f"{_name(c.topic)}: {c.msgtype} is not read; omitted"
            for c in reader.connections
            if c.msgtype not in _READERS
        ]
        for name, connection in sorted(known.items()):
            first = next(reader.messages([connection]), None)
            if first is None:
                notes.append(f"{name}: no messages; omitted")
                continue
            value = _value(reader, connection, first[2])
            columns[name] = Column(value.shape, value.dtype.name)
    lengths = [_count(bag, clock) for bag in bags]

    def read(episode: int, names: Collection[str]) -> dict[str, np.ndarray]:
        with _reader(bags[episode]) as reader:
            return _sampled(reader, clock, names, columns)

    yield Source(0.0, lengths, columns, read, notes=notes)


def _bags(path: Path) -> list[Path]:
    if path.is_file() or (path / _META).is_file():
        return [path]
    found = [file for suffix in _SUFFIXES for file in per_file.listed(path, f"*{suffix}")]
    return found or [meta.parent for meta in per_file.listed(path, f"*/{_META}")]


@contextlib.contextmanager
def _reader(path: Path) -> Iterator[Any]:
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    # Bags of older releases lack the definitions of their messages.
    with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as reader:
        yield reader


def _clock(known: dict[str, Any]) -> str:
    """Returns the topic whose messages are the control steps."""
    poses = sorted(name for name, c in known.items() if _READERS[c.msgtype] is _pose)
    base.require(bool(poses), "a topic of poses", sorted(known))
    return next((name for name in poses if name.endswith(_CLOCK)), poses[0])


def _count(path: Path, clock: str) -> int:
    with _reader(path) as reader:
        return sum(c.msgcount for c in reader.connections if _name(c.topic) == clock)


def _sampled(
    reader: Any, clock: str, names: Collection[str], columns: dict[str, Column]
) -> dict[str, np.ndarray]:
    """Returns the columns at the times of the clock's messages."""
    times, values = _messages(reader, clock, columns)
    order = np.argsort(times, kind="stable")
    arrays = {}
    for name in names:
        if name == _TIME:
            arrays[name] = times[order] - times.min()
        elif name == clock:
            arrays[name] = values[order]
        else:
            stamps, rows = _messages(reader, name, columns)
            rank = np.argsort(stamps, kind="stable")
            last = np.searchsorted(stamps[rank], times[order], side="right") - 1
            arrays[name] = rows[rank[np.maximum(last, 0)]]
    return arrays


def _messages(reader: Any, name: str, columns: dict[str, Column]) -> tuple[np.ndarray, np.ndarray]:
    """Returns times `[N]` s and values `[N, ...]` of a topic."""
    connections = [c for c in reader.connections if _name(c.topic) == name]
    base.require(bool(connections), f"a topic {name}", "none")
    count = sum(c.msgcount for c in connections)
    base.require_fits(name, (count, *columns[name].shape), columns[name].dtype)
    times, values = [], []
    for connection, logged, raw in reader.messages(connections):
        message = reader.deserialize(raw, connection.msgtype)
        times.append(_seconds(message, logged))
        values.append(_READERS[connection.msgtype](message))
    base.require(len({value.shape for value in values}) == 1, f"{name} of one size", "several")
    return np.array(times), np.stack(values)


def _seconds(message: Any, logged: int) -> float:
    """Returns the time of a message's header, or that of its recording."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    seconds = 0.0 if stamp is None else stamp.sec + 1e-9 * stamp.nanosec
    return seconds or 1e-9 * logged


def _value(reader: Any, connection: Any, raw: bytes) -> np.ndarray:
    return _READERS[connection.msgtype](reader.deserialize(raw, connection.msgtype))


def _name(topic: str) -> str:
    return topic.lstrip("/")


def _pose(message: Any) -> np.ndarray:
    inner = getattr(message, "pose", None) or getattr(message, "transform", None) or message
    p = getattr(inner, "position", None) or inner.translation
    q = getattr(inner, "orientation", None) or inner.rotation
    return np.array([p.x, p.y, p.z, q.x, q.y, q.z, q.w])


def _joints(message: Any) -> np.ndarray:
    return np.asarray(message.position, np.float64)


def _wrench(message: Any) -> np.ndarray:
    inner = getattr(message, "wrench", message)
    parts = inner.force, inner.torque
    return np.array([value for part in parts for value in (part.x, part.y, part.z)])


def _number(message: Any) -> np.ndarray:
    return np.asarray(message.data)


def _compressed(message: Any) -> np.ndarray:
    with Image.open(io.BytesIO(bytes(message.data)), formats=("PNG", "JPEG")) as image:
        base.require_fits("an image", (image.height, image.width, 3), np.uint8)
        return np.asarray(image.convert("RGB"))


def _raw(message: Any) -> np.ndarray:
    base.require(message.encoding in ("rgb8", "bgr8"), "rgb8 or bgr8", message.encoding)
    rows = np.asarray(message.data, np.uint8).reshape(message.height, message.step)
    image = rows[:, : 3 * message.width].reshape(message.height, message.width, 3)
    return image[..., ::-1] if message.encoding == "bgr8" else image


_READERS: dict[str, Callable[[Any], np.ndarray]] = {
    **{
        f"geometry_msgs/msg/{name}{stamped}": _pose
        for name in ("Pose", "Transform")
        for stamped in ("", "Stamped")
    },
    **{f"geometry_msgs/msg/Wrench{stamped}": _wrench for stamped in ("", "Stamped")},
    **{f"std_msgs/msg/{name}": _number for name in ("Float64", "Float32", "Bool", "Int32")},
    "sensor_msgs/msg/JointState": _joints,
    "sensor_msgs/msg/CompressedImage": _compressed,
    "sensor_msgs/msg/Image": _raw,
}


def _recognises(path: Path) -> bool:
    if path.is_dir():
        return (path / _META).is_file() or bool(_bags(path))
    return path.suffix in _SUFFIXES


_ABOUT = "ROS bags of CRTK topics, a bag per episode"
FORMAT = base.Format(_ABOUT, per_file.same_name, _recognises, _open)
