"""Values of ROS messages as arrays, and the names of their entries."""

import io
from collections.abc import Callable
from typing import Any

import numpy as np
from PIL import Image

from starjax.addons.formats import base

_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
_WRENCH = ("fx", "fy", "fz", "tx", "ty", "tz")


def seconds(message: Any, logged: int) -> float:
    """Returns the time of a message's header in s, or that of its recording in ns."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    since = 0.0 if stamp is None else stamp.sec + 1e-9 * stamp.nanosec
    return since or 1e-9 * logged


def names(message: Any) -> tuple[str, ...]:
    """Returns the names of the entries of a message's value; empty without names."""
    reader = READERS[message.__msgtype__]
    if reader is _joints:
        return tuple(map(str, message.name))
    return _POSE if reader is _pose else _WRENCH if reader is _wrench else ()


def value(message: Any, order: tuple[str, ...] = ()) -> np.ndarray:
    """Returns the value of a message, joints in the order of their names.

    Raises:
      Damaged: the joints are other ones than `order`.
    """
    array = READERS[message.__msgtype__](message)
    own = names(message)
    if own == order or not (own or order):
        return array
    base.require(
        sorted(own) == sorted(order), f"joints {', '.join(order)}", ", ".join(own) or "none"
    )
    base.require(len(array) == len(own), f"{len(own)} positions", len(array))
    return array[[own.index(name) for name in order]]


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


READERS: dict[str, Callable[[Any], np.ndarray]] = {
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
