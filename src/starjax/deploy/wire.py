"""Frames of the socket: openpi's protocol, msgpack with numpy arrays as maps of four entries.

The server greets a connecting client with its metadata. Each binary frame of the client is then a
request; the reply is a binary frame, or a text that describes an error. Frames cannot execute code,
and decoding allocates no more than the frame's own size.
"""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import msgpack
import numpy as np

from starjax import rcm
from starjax.core.errors import UsageError
from starjax.core.types import Command, Pose
from starjax.data import pose_rows
from starjax.deploy import images
from starjax.deploy.inputs import InputSpec, RobotObservation, image_of
from starjax.sim import trocar_region

PROTOCOL = 2
_TYPES = ("|b1", "|u1", "|i1", "<u2", "<i2", "<u4", "<i4", "<u8", "<i8", "<f2", "<f4", "<f8")
_MAX_AXES = 8
# Errors of msgpack and numpy for malformed bytes.
_BAD = (ValueError, TypeError, OverflowError, RecursionError, msgpack.exceptions.UnpackException)
_ARRAY, _SCALAR = b"__ndarray__", b"__npgeneric__"
_OVERHEAD = 1 << 14  # bytes of a request beyond its arrays, generously
SPHERICAL = "trocar_spherical"  # name of a trocar's parameters, `trocar` is its position
# Columns of `actions` in a reply, per arm.
ACTION = ("p.x m", "p.y m", "p.z m", "q.x", "q.y", "q.z", "q.w", "gripper")


class ArraySpec(NamedTuple):
    """One array of a request; the greeting of a server has these fields.

    Attributes:
      shape: for one robot.
      dtype: "float32", which accepts any real numbers, "uint8" or "uint32".
      text: meaning and unit.
      is_optional: True if a request may lack it.
    """

    shape: tuple[int, ...]
    dtype: str
    text: str
    is_optional: bool = False


class Request(NamedTuple):
    """Request of one robot.

    Attributes:
      observation: of the last O times, numbers in float32.
      trocar: parameters, fields `[*arms]`.
      key: random key's data, or None for one of the server's.
    """

    observation: RobotObservation
    trocar: rcm.Trocar
    key: np.ndarray | None


def request_arrays(spec: InputSpec, key_size: int = 2) -> dict[str, ArraySpec]:
    """Lists the arrays of a request by name."""
    moments = (spec.moments, *spec.arms)
    arrays = {
        "R": ArraySpec((*moments, 3, 3), "float32", "measured rotations R_world_tip"),
        "p": ArraySpec((*moments, 3), "float32", "measured tips in the world, m"),
        "gripper": ArraySpec(moments, "float32", "openings of the jaws, -1 closed to 1 open"),
        "trocar": ArraySpec((*spec.arms, 3), "float32", "x y z in the world, m", True),
        SPHERICAL: ArraySpec(
            (*spec.arms, 3),
            "float32",
            "instead: radius m, polar rad, azimuth rad about the nominal trocar",
            True,
        ),
        "key": ArraySpec((key_size,), "uint32", "of the decision's noise", is_optional=True),
    }
    for name in spec.cameras:
        shape = (spec.moments, spec.image_size, spec.image_size, 3)
        arrays[image_field(spec, name)] = ArraySpec(shape, "uint8", f"RGB of {name}")
    if not spec.cameras:
        shape = (spec.moments, spec.state_size)
        arrays["state"] = ArraySpec(shape, "float32", "the task's fields")
    return arrays


def image_field(spec: InputSpec, camera: str) -> str:
    """Returns the name of a camera's images in a request."""
    return "image" if len(spec.cameras) == 1 else f"image/{camera}"


def max_request_bytes(spec: InputSpec) -> int:
    """Returns the size of the largest request: numbers as float64, images of `images.LARGEST`."""
    image = max(4 * math.prod(images.LARGEST), spec.image_size**2) * 3 * spec.moments
    sizes = (
        (image if x.dtype == "uint8" else 8 * math.prod(x.shape)) + len(name)
        for name, x in request_arrays(spec).items()
    )
    return sum(sizes) + _OVERHEAD


def pack(value: Any) -> bytes:
    """Packs maps, lists, strings, numbers and numpy arrays into a frame."""
    frame: Any = msgpack.packb(value, default=_pack_array)
    return frame


def unpack(frame: bytes | str) -> Any:
    """Unpacks a frame.

    Raises:
      UsageError: it is text, or not msgpack, or contains an invalid array.
    """
    if not isinstance(frame, bytes):
        raise UsageError("frame", "bytes", "text")
    try:
        return msgpack.unpackb(frame, object_hook=_unpack_array, strict_map_key=False)
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
    """Collects the arrays of `request_arrays`, for a client to pack."""
    arrays: dict[str, Any] = {
        "R": np.asarray(observation.pose.R, np.float32),
        "p": np.asarray(observation.pose.p, np.float32),
        "gripper": np.asarray(observation.gripper, np.float32),
        SPHERICAL: np.stack([np.asarray(field, np.float32) for field in trocar], -1),
    }
    for name in spec.cameras:
        arrays[image_field(spec, name)] = np.asarray(image_of(observation, name))
    if not spec.cameras:
        arrays["state"] = np.asarray(observation.state, np.float32)
    return arrays if key is None else {**arrays, "key": np.asarray(key, np.uint32)}


def decode_request(spec: InputSpec, value: Any, key_size: int = 2) -> Request:
    """Reads a request and checks shapes and types.

    Raises:
      UsageError: an array is missing, unknown, or has another shape or type.
    """
    if not isinstance(value, dict):
        raise UsageError("frame", "a map of arrays", type(value).__name__)
    specs = request_arrays(spec, key_size)
    for name in value:
        if name not in specs:
            raise UsageError("frame", f"only {', '.join(specs)}", repr(name)[:80])
    arrays = {name: _array(name, row, value.get(name)) for name, row in specs.items()}
    observation = RobotObservation(
        pose=Pose(arrays["R"], arrays["p"]),
        gripper=arrays["gripper"],
        images={name: arrays[image_field(spec, name)] for name in spec.cameras} or None,
        state=arrays.get("state"),
    )
    trocar = _trocar(spec, arrays["trocar"], arrays[SPHERICAL])
    return Request(observation, trocar, arrays["key"])


def _trocar(spec: InputSpec, place: Any, parameters: Any) -> rcm.Trocar:
    """Returns the parameters of a request's trocar, given as position or as parameters."""
    if (place is None) == (parameters is None):
        got = "neither" if place is None else "both"
        raise UsageError("trocar", f"x, y, z in m, or {SPHERICAL}", got)
    if parameters is not None:
        return rcm.Trocar(*np.moveaxis(parameters, -1, 0))
    if not np.isfinite(place).all():
        raise UsageError("trocar", "finite values", "NaN or inf")
    if spec.regions:  # before the conversion, so the error has the client's numbers
        reference = np.reshape(spec.p_world_ref, (-1, 3))
        trocar_region.check(spec.regions, reference, np.reshape(place, reference.shape))
    trocar = rcm.trocar_from_position(place, spec.p_world_ref)
    return rcm.Trocar(*(np.asarray(field) for field in trocar))


def encode_reply(command: Command, infer_ms: float) -> dict[str, Any]:
    """Collects the arrays of a reply with the plan `[H, *arms]`.

    Every array begins with H. `actions` `[H, A * 8]` has the columns of `ACTION` for each arm.
    """
    R, p, gripper = command.pose.R, command.pose.p, command.gripper
    steps = len(gripper)
    by_arm = p.reshape(steps, -1, 3), R.reshape(steps, -1, 3, 3), gripper.reshape(steps, -1)
    actions = pose_rows.pack(*by_arm).astype(np.float32)
    arrays = {"actions": actions, "R": R, "p": p, "gripper": gripper}
    return {**arrays, "server_timing": {"infer_ms": infer_ms}}


def decode_reply(spec: InputSpec, horizon: int, value: Any) -> Command:
    """Reads the plan `[H, *arms]` of a reply.

    Raises:
      UsageError: an array is missing, has another shape, or contains non-finite values.
    """
    if not isinstance(value, Mapping):
        raise UsageError("answer", "a map of arrays", type(value).__name__)
    steps = (horizon, *spec.arms)
    arrays = {
        name: _array(name, ArraySpec(shape, "float32", ""), value.get(name))
        for name, shape in (("R", (*steps, 3, 3)), ("p", (*steps, 3)), ("gripper", steps))
    }
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            raise UsageError(f"answer.{name}", "finite values", "NaN or inf")
    return Command(Pose(arrays["R"], arrays["p"]), arrays["gripper"])


def _array(name: str, spec: ArraySpec, value: Any) -> Any:
    if value is None and spec.is_optional:
        return None
    if not isinstance(value, np.ndarray):
        got = "none" if value is None else type(value).__name__
        raise UsageError(name, f"an array of shape {list(spec.shape)}", got)
    if value.shape != spec.shape:
        raise UsageError(name, f"shape {list(spec.shape)}", list(value.shape))
    if spec.dtype == "float32":
        with np.errstate(over="ignore"):  # becomes inf, which the checks of values refuse
            return value.astype(np.float32)
    if value.dtype != spec.dtype:
        raise UsageError(name, spec.dtype, value.dtype)
    return value


def _pack_array(value: Any) -> Any:
    kind = value.dtype.str if isinstance(value, np.ndarray | np.generic) else None
    if kind not in _TYPES:
        raise UsageError("value", "numbers, strings, lists, maps, arrays", type(value).__name__)
    if isinstance(value, np.generic):
        return {_SCALAR: True, b"data": value.item(), b"dtype": kind}
    data = np.ascontiguousarray(value).data
    return {_ARRAY: True, b"data": data, b"dtype": kind, b"shape": list(value.shape)}


def _unpack_array(value: dict[Any, Any]) -> Any:
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
    is_shape = isinstance(shape, list) and len(shape) <= _MAX_AXES
    if not (is_shape and all(type(n) is int and n >= 0 for n in shape)):
        raise UsageError("array", f"a shape of at most {_MAX_AXES} axes", repr(shape)[:80])
    if not isinstance(data, bytes):
        raise UsageError("array", "its data as bytes", type(data).__name__)
    size = math.prod(shape) * np.dtype(kind).itemsize
    if len(data) != size:
        raise UsageError("array", f"{size} bytes for shape {shape}", len(data))
    return np.frombuffer(data, kind).reshape(shape)
