"""Frames of the socket: openpi's protocol, msgpack with numpy arrays as maps of four entries.

The server sends what it serves when a client connects. Then each binary frame of the client is a
request, and is answered by a binary frame, or by a text that says what is wrong with it. Nothing
here can run code that came over the socket, and nothing is allocated beyond the frame's own size.
"""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import msgpack
import numpy as np
from scipy.spatial.transform import Rotation

from starjax import rcm
from starjax.deploy.inputs import InputSpec, RobotObservation
from starjax.errors import UsageError
from starjax.types import Command, Pose

PROTOCOL = 1
_TYPES = ("|b1", "|u1", "|i1", "<u2", "<i2", "<u4", "<i4", "<u8", "<i8", "<f2", "<f4", "<f8")
_MOST_AXES = 8
# What msgpack and numpy raise of bytes that are no value.
_BAD = (ValueError, TypeError, OverflowError, RecursionError, msgpack.exceptions.UnpackException)
_ARRAY, _SCALAR = b"__ndarray__", b"__npgeneric__"
# Bytes of a request that are not its arrays' own, with ample room.
_OVERHEAD = 1 << 14
# Of one arm, in `actions` of an answer.
ACTION = ("p.x m", "p.y m", "p.z m", "q.w", "q.x", "q.y", "q.z", "gripper")


class ArraySpec(NamedTuple):
    """One array of a request.

    Attributes:
      shape: of one robot.
      dtype: "float32", for which any real numbers may come, "uint8" or "uint32".
      text: what it is, with its unit.
      is_optional: whether it may be left out.
    """

    shape: tuple[int, ...]
    dtype: str
    text: str
    is_optional: bool = False


class Request(NamedTuple):
    """Request of one robot.

    Attributes:
      observation: of the last O moments, numbers in float32.
      trocar: parameters, fields `[*arms]`.
      key: random key's data, or None for one of the server's.
    """

    observation: RobotObservation
    trocar: rcm.Trocar
    key: np.ndarray | None


def request_arrays(spec: InputSpec, key_size: int = 2) -> dict[str, ArraySpec]:
    """Arrays of a request by name."""
    moments = (spec.moments, *spec.arms)
    found = {
        "R": ArraySpec((*moments, 3, 3), "float32", "measured rotations R_world_tip"),
        "p": ArraySpec((*moments, 3), "float32", "measured tips in the world, m"),
        "gripper": ArraySpec(moments, "float32", "openings of the jaws, -1 closed to 1 open"),
        "trocar": ArraySpec((*spec.arms, 3), "float32", "radius m, polar rad, azimuth rad"),
        "key": ArraySpec((key_size,), "uint32", "of the decision's noise", is_optional=True),
    }
    side = spec.image_size
    for name in spec.cameras:
        shape = (spec.moments, side, side, 3)
        found[image_field(spec, name)] = ArraySpec(shape, "uint8", f"RGB of {name}")
    if not spec.cameras:
        found["state"] = ArraySpec((spec.moments, spec.state_size), "float32", "the task's fields")
    return found


def image_field(spec: InputSpec, camera: str) -> str:
    """Name of a camera's images in a request."""
    return "image" if len(spec.cameras) == 1 else f"image/{camera}"


def max_request_bytes(spec: InputSpec) -> int:
    """The largest frame that can be a request: all numbers as float64."""
    sizes = (
        math.prod(x.shape) * (1 if x.dtype == "uint8" else 8) + len(name)
        for name, x in request_arrays(spec).items()
    )
    return sum(sizes) + _OVERHEAD


def pack(value: Any) -> bytes:
    """A frame of a value of maps, lists, words, numbers and numpy arrays."""
    frame: Any = msgpack.packb(value, default=_packed)
    return frame


def unpack(frame: Any) -> Any:
    """The value of a frame.

    Raises:
      UsageError: it is text, or not msgpack, or holds an array that is none.
    """
    if not isinstance(frame, bytes):
        raise UsageError("frame", "bytes", "text")
    try:
        return msgpack.unpackb(frame, object_hook=_unpacked, strict_map_key=False)
    except UsageError:
        raise
    except _BAD as error:
        got = f"{type(error).__name__} ({str(error)[:80]})"
        raise UsageError("frame", "msgpack as openpi's client writes it", got) from None


def encode_request(
    spec: InputSpec,
    observation: RobotObservation,
    trocar: rcm.Trocar,
    key: np.ndarray | None = None,
) -> dict[str, Any]:
    """Arrays of `request_arrays`, as a client packs them."""
    found: dict[str, Any] = {
        "R": np.asarray(observation.pose.R, np.float32),
        "p": np.asarray(observation.pose.p, np.float32),
        "gripper": np.asarray(observation.gripper, np.float32),
        "trocar": np.stack([np.asarray(field, np.float32) for field in trocar], -1),
    }
    images = observation.images or {}
    for name in spec.cameras:
        image = images.get(name) if observation.image is None else observation.image
        found[image_field(spec, name)] = np.asarray(image)
    if not spec.cameras:
        found["state"] = np.asarray(observation.state, np.float32)
    return found if key is None else {**found, "key": np.asarray(key, np.uint32)}


def decode_request(spec: InputSpec, value: Any, key_size: int = 2) -> Request:
    """Parses a request, every array of its shape and type.

    Raises:
      UsageError: an array is missing, unknown, or has another shape or type.
    """
    if not isinstance(value, dict):
        raise UsageError("frame", "a map of arrays", type(value).__name__)
    wanted = request_arrays(spec, key_size)
    for name in value:
        if name not in wanted:
            raise UsageError("frame", f"only {', '.join(wanted)}", repr(name)[:80])
    found = {name: _array(name, said, value.get(name)) for name, said in wanted.items()}
    names = {name: found.get(image_field(spec, name)) for name in spec.cameras}
    observation = RobotObservation(
        pose=Pose(found["R"], found["p"]),
        gripper=found["gripper"],
        image=None if len(names) != 1 else found["image"],
        images=names if len(names) > 1 else None,
        state=found.get("state"),
    )
    trocar = rcm.Trocar(*(found["trocar"][..., i] for i in range(3)))
    return Request(observation, trocar, found["key"])


def encode_reply(command: Command, decided_ms: float) -> dict[str, Any]:
    """Answer to a client, of a command `[H, *arms]` on the host.

    Every array begins with H. `actions` `[H, A * 8]` has, of each arm, what `ACTION` names.
    """
    R, p, gripper = command.pose.R, command.pose.p, command.gripper
    wxyz = Rotation.from_matrix(R.reshape(-1, 3, 3)).as_quat(scalar_first=True)
    parts = [p, wxyz.reshape(*R.shape[:-2], 4), gripper[..., None]]
    actions = np.concatenate(parts, axis=-1).astype(np.float32).reshape(len(gripper), -1)
    told = {"actions": actions, "R": R, "p": p, "gripper": gripper}
    return {**told, "server_timing": {"infer_ms": decided_ms}}


def decode_reply(spec: InputSpec, horizon: int, value: Any) -> Command:
    """The command `[H, *arms]` in an answer.

    Raises:
      UsageError: it has none, or one of other shapes, or numbers that are not finite.
    """
    if not isinstance(value, Mapping):
        raise UsageError("answer", "a map of arrays", type(value).__name__)
    steps = (horizon, *spec.arms)
    shapes = {"R": (*steps, 3, 3), "p": (*steps, 3), "gripper": steps}
    found = {
        name: _array(name, ArraySpec(shape, "float32", ""), value.get(name))
        for name, shape in shapes.items()
    }
    for name, array in found.items():
        if not np.isfinite(array).all():
            raise UsageError(f"answer.{name}", "finite numbers", "some that are not")
    return Command(Pose(found["R"], found["p"]), found["gripper"])


def _array(name: str, said: ArraySpec, value: Any) -> Any:
    if value is None and said.is_optional:
        return None
    if not isinstance(value, np.ndarray):
        got = "none" if value is None else type(value).__name__
        raise UsageError(name, f"an array of shape {list(said.shape)}", got)
    if value.shape != said.shape:
        raise UsageError(name, f"shape {list(said.shape)}", list(value.shape))
    if said.dtype != "float32":
        if value.dtype != said.dtype:
            raise UsageError(name, said.dtype, value.dtype)
        return value
    with np.errstate(over="ignore"):  # what is too large is refused as not finite
        return value.astype(np.float32)


def _packed(value: Any) -> Any:
    if isinstance(value, np.ndarray) and value.dtype.str in _TYPES:
        array = np.ascontiguousarray(value)
        kind, shape = value.dtype.str, list(value.shape)
        return {_ARRAY: True, b"data": array.data, b"dtype": kind, b"shape": shape}
    if isinstance(value, np.generic) and value.dtype.str in _TYPES:
        return {_SCALAR: True, b"data": value.item(), b"dtype": value.dtype.str}
    raise UsageError("value", "numbers, words, lists, maps, arrays", type(value).__name__)


def _unpacked(value: dict[Any, Any]) -> Any:
    if _ARRAY not in value and _SCALAR not in value:
        return value
    kind, data = value.get(b"dtype"), value.get(b"data")
    if kind not in _TYPES:
        raise UsageError("array", f"one of the types {', '.join(_TYPES)}", repr(kind)[:80])
    if _SCALAR in value:
        if not isinstance(data, bool | int | float):
            raise UsageError("scalar", "a number", type(data).__name__)
        return np.dtype(kind).type(data)
    shape: Any = value.get(b"shape")
    is_shape = isinstance(shape, list) and len(shape) <= _MOST_AXES
    if not (is_shape and all(type(n) is int and n >= 0 for n in shape)):
        raise UsageError("array", f"a shape of at most {_MOST_AXES} axes", repr(shape)[:80])
    if not isinstance(data, bytes):
        raise UsageError("array", "its data as bytes", type(data).__name__)
    size = math.prod(shape) * np.dtype(kind).itemsize
    if len(data) != size:
        raise UsageError("array", f"{size} bytes for shape {shape}", len(data))
    return np.frombuffer(data, kind).reshape(shape)
