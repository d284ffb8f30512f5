"""The action spaces: SE(3) and the four parameterisations of the RCM manifold (Eq. 5), both ways.

Two more are an ablation of {T}, whose x axis turns with the trocar's azimuth: `rcm1_fixed_yaw` and
`rcm2_fixed_yaw` write the same relative poses in a {T} of one yaw for every trocar. Both are then
equivalent to `rcm3`, the world's rotation and the depth, in other coordinates.

`decode` is total. For any input its pose is finite and its rotation orthonormal, and in all spaces
except SE(3) the shaft passes through the trocar up to float32 rounding: 2e-4 mm within a metre of
the origin. If an input (action, trocar or reference) is not finite, the
flag `valid` is False and the pose is the **hold pose**: tool straight down, roll 0, tip
`HOLD_DEPTH` below the trocar (whose own non-finite numbers count as zero: below the reference if
the radius is not finite). Inputs that are finite, in float32 unless jax uses float64, are always
valid: depths are clipped to [MIN_DEPTH, MAX_DEPTH], a tip at the trocar takes the axis
straight down, degenerate 6-D columns are completed, and SE(3) positions are clipped to +-MAX_REACH.

`encode` also describes measured poses, which are slightly off the manifold: its depth is the signed
one of Eq. 3, its roll and rotation those of the pose. NaN inputs give NaN.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, NoReturn

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from starjax.core import types
from starjax.core.registry import Registry, Rows
from starjax.core.types import ArrayTree
from starjax.rcm import arrays, manifold, rotations
from starjax.rcm import trocar as trocars
from starjax.rcm import wrist as wrists

MAX_REACH = 10.0  # m; bound of a decoded SE(3) position's coordinates

Where = trocars.Trocar | trocars.TrocarFrame
Encode = Callable[..., jax.Array]
Decode = Callable[..., tuple[types.Pose, jax.Array]]


class ActionSpace(NamedTuple):
    """One way to write a tip pose as a vector.

    Attributes:
      name: key in `ACTION_SPACES`.
      dim: length A of the vector.
      encode: (pose_world_tip `[...]`, trocar `[...]`, p_world_ref `[..., 3]` m) to `[..., A]`.
      decode: (action `[..., A]`, trocar, p_world_ref) to (pose_world_tip, valid bool `[...]`).
        Both also take a `TrocarFrame` `[...]` in place of trocar and reference.
      slices: positions of the parts "p" m, "R" 6-D, "depth" m, "roll" rad, "wrist" `[2]` rad.
      is_absolute: positions are in the world frame, the same at every trocar.
      is_free: the shaft of a decoded pose need not pass the trocar.
      turns: parts that the roll network of a hierarchical policy predicts: all before "p", the last
        part. Empty if the space has no such policy.
      for_wrist: wrist -> this space for instruments with that wrist; None for straight ones. If it
        `is_free`, its part "wrist" is what is commanded.
    """

    name: str
    dim: int
    encode: Encode
    decode: Decode
    slices: dict[str, slice]
    is_absolute: bool = False
    is_free: bool = False
    turns: tuple[str, ...] = ()
    for_wrist: Callable[[wrists.Wrist], "ActionSpace"] | None = None


def _encode_se3(pose: types.Pose, frame: "SpaceFrame") -> list[jax.Array]:
    return [pose.p, rotations.rot6d_encode(pose.R)]


def _decode_se3(parts: dict[str, jax.Array], frame: "SpaceFrame") -> types.Pose:
    R = rotations.rot6d_decode(parts["R"])
    return types.Pose(R=R, p=jnp.clip(parts["p"], -MAX_REACH, MAX_REACH))


def _encode_rcm1(pose: types.Pose, frame: "SpaceFrame") -> list[jax.Array]:
    depth = manifold.insertion_depth(pose, frame.p)
    R_trocar_tip = arrays.matmul(frame.R.mT, pose.R)  # R' of a rotation is its inverse
    return [depth[..., None], rotations.rot6d_encode(R_trocar_tip)]  # (d_rel, R_rel)


def _decode_rcm1(parts: dict[str, jax.Array], frame: "SpaceFrame") -> types.Pose:
    # R_world_tip = R_world_trocar R_trocar_tip
    R = arrays.matmul(frame.R, rotations.rot6d_decode(parts["R"]))
    return manifold.pose_at_depth(R, parts["depth"][..., 0], frame.p)


def _encode_rcm2(pose: types.Pose, frame: "SpaceFrame") -> list[jax.Array]:
    p_trocar_tip = arrays.matvec(frame.R.mT, pose.p - frame.p)
    return [roll_from_zero(pose.R, frame), p_trocar_tip]  # (gamma_rel, p_rel)


def _decode_rcm2(parts: dict[str, jax.Array], frame: "SpaceFrame") -> types.Pose:
    offset_world = arrays.matvec(frame.R, parts["p"])  # p_tip - p_trocar
    # Relative: the trocar is the origin, so nearness to it keeps its digits.
    axis, depth = manifold.axis_and_depth(offset_world, jnp.zeros_like(offset_world))
    return manifold.pose_on_manifold(axis, parts["roll"][..., 0] + frame.roll_zero, depth, frame.p)


def _encode_rcm3(pose: types.Pose, frame: "SpaceFrame") -> list[jax.Array]:
    depth = manifold.insertion_depth(pose, frame.p)
    # (d_rel, R_abs): the rotation is the world's, the depth is counted from this trocar.
    return [depth[..., None], rotations.rot6d_encode(pose.R)]


def _decode_rcm3(parts: dict[str, jax.Array], frame: "SpaceFrame") -> types.Pose:
    R = rotations.rot6d_decode(parts["R"])
    return manifold.pose_at_depth(R, parts["depth"][..., 0], frame.p)


def _encode_rcm4(pose: types.Pose, frame: "SpaceFrame") -> list[jax.Array]:
    return [
        roll_from_zero(pose.R, frame),
        pose.p,
    ]  # (gamma_rel, p_abs): p for any trocar


def _decode_rcm4(parts: dict[str, jax.Array], frame: "SpaceFrame") -> types.Pose:
    """Applies Algorithm 1, with the alignment in the z-down frame (`rotation_from_axis_roll`)."""
    axis, depth = manifold.axis_and_depth(parts["p"], frame.p)  # v and d (Alg. 1, line 2; Eq. 18)
    return manifold.pose_on_manifold(axis, parts["roll"][..., 0] + frame.roll_zero, depth, frame.p)


def roll_from_zero(R: jax.Array, frame: "SpaceFrame") -> jax.Array:
    """Returns the roll `[..., 1]` from the frame's zero, within half a turn either way."""
    roll = rotations.roll_of(R) - frame.roll_zero
    return (roll - 2.0 * jnp.pi * jnp.round(roll / (2.0 * jnp.pi)))[..., None]  # to [-pi, pi]


class SpaceFrame(NamedTuple):
    """The trocar frame {T}, pose_world_trocar, and the roll that counts as zero."""

    R: jax.Array
    p: jax.Array
    roll_zero: jax.Array


def _fixed_yaw(encode_or_decode: Callable) -> Callable:
    """Wraps a map, with the world's x axis as that of {T} at every trocar."""

    def mapped(pose_or_parts: ArrayTree, frame: SpaceFrame) -> Any:
        return encode_or_decode(pose_or_parts, frame._replace(R=_down(frame.R.dtype)))

    return mapped


def _down(dtype: jnp.dtype) -> jax.Array:
    """Returns the frame with z down and x along the world's, G of `rotation_from_axis_roll`."""
    return jnp.diag(jnp.array([1.0, -1.0, -1.0], dtype))


def make_space(
    name: str,
    encode: Callable,
    decode: Callable,
    *,
    is_absolute: bool = False,
    is_free: bool = False,
    turns: tuple[str, ...] = (),
    for_wrist: Callable[[wrists.Wrist], ActionSpace] | None = None,
    **sizes: int,
) -> ActionSpace:
    """Wraps a pair of maps: checks, broadcasts and bounds the inputs, inserts the hold pose."""
    slices, dim = {}, 0
    for part, size in sizes.items():
        slices[part] = slice(dim, dim + size)
        dim += size

    @arrays.compiled()
    def encode_pose(
        pose: types.Pose, trocar: Where, p_world_ref: ArrayLike | None = None
    ) -> jax.Array:
        R, p, *rest = arrays.checked(
            **{"pose.R": (pose.R, (3, 3)), "pose.p": (pose.p, (3,))},
            **_trocar_arguments(trocar, p_world_ref),
        )
        frame, shape = _frame(rest)
        parts = encode(types.Pose(R=R, p=p), frame)
        batch = jnp.broadcast_shapes(R.shape[:-2], p.shape[:-1], shape)
        return jnp.concatenate(
            [jnp.broadcast_to(part, (*batch, part.shape[-1])) for part in parts], axis=-1
        )

    @arrays.compiled()
    def decode_action(
        action: ArrayLike, trocar: Where, p_world_ref: ArrayLike | None = None
    ) -> tuple[types.Pose, jax.Array]:
        action, *rest = arrays.checked(
            action=(action, (dim,)), **_trocar_arguments(trocar, p_world_ref)
        )
        # `place` is the reference of a Trocar, the position of a TrocarFrame.
        radius, polar, azimuth, place, *turned = rest
        valid = (
            jnp.isfinite(action).all(axis=-1)
            & jnp.isfinite(place).all(axis=-1)
            & jnp.isfinite(radius)
            & jnp.isfinite(polar)
            & jnp.isfinite(azimuth)
        )
        if turned:
            R_world_trocar, roll_zero = turned
            valid &= jnp.isfinite(R_world_trocar).all(axis=(-2, -1)) & jnp.isfinite(roll_zero)
        # Finite numbers in place of NaN: their results are dropped below, but must not poison
        # gradients.
        frame, _ = _frame([arrays.bounded(value) for value in rest])
        bounded = arrays.bounded(action)
        pose = decode({part: bounded[..., where] for part, where in slices.items()}, frame)
        hold = _hold_pose(frame.p)
        R = jnp.where(valid[..., None, None], pose.R, hold.R)  # the robot always gets a pose
        p = jnp.where(valid[..., None], pose.p, hold.p)
        return types.Pose(R=R, p=p), valid

    return ActionSpace(
        name, dim, encode_pose, decode_action, slices, is_absolute, is_free, turns, for_wrist
    )


def without_wrist(space: ActionSpace) -> ActionSpace:
    """Returns the row of a space `for_wrist`: its facts, and maps that raise ValueError."""

    def refuse(*_: object) -> NoReturn:
        raise ValueError(f"wrist: expected that of a tool for the action space {space.name}")

    return space._replace(encode=refuse, decode=refuse)


def _trocar_arguments(trocar: Where, p_world_ref: ArrayLike | None) -> dict:
    if isinstance(trocar, trocars.TrocarFrame):
        if p_world_ref is not None:
            raise ValueError("p_world_ref: expected None with a TrocarFrame, got a value")
        return {
            **trocars.named_fields(trocar.trocar),
            "trocar.p_world_trocar": (trocar.p_world_trocar, (3,)),
            "trocar.R_world_trocar": (trocar.R_world_trocar, (3, 3)),
            "trocar.roll_zero": (trocar.roll_zero, ()),
        }
    if p_world_ref is None:
        raise ValueError("p_world_ref: expected [..., 3] with a Trocar, got None")
    return {**trocars.named_fields(trocar), "p_world_ref": (p_world_ref, (3,))}


def _frame(values: Sequence[jax.Array]) -> tuple[SpaceFrame, tuple[int, ...]]:
    """Returns the frame of `_trocar_arguments` and its leading axes."""
    radius, polar, azimuth, place, *turned = values
    scalars = [x.shape for x in (radius, polar, azimuth, *turned[1:])]
    shape = jnp.broadcast_shapes(*scalars, place.shape[:-1])
    if turned:
        R, roll_zero = turned
        return SpaceFrame(R, place, roll_zero), shape
    trocar = trocars.Trocar(radius, polar, azimuth)
    R, p = trocars.trocar_rotation(trocar), trocars.trocar_position(trocar, place)
    return SpaceFrame(R, p, jnp.zeros((), p.dtype)), shape


def _hold_pose(p_world_trocar: jax.Array) -> types.Pose:
    """Returns the pose straight below the trocar, roll 0."""
    R = _down(p_world_trocar.dtype)
    return manifold.pose_at_depth(R, jnp.asarray(manifold.HOLD_DEPTH), p_world_trocar)


_BUILT_IN = {
    "se3": make_space("se3", _encode_se3, _decode_se3, is_absolute=True, is_free=True, p=3, R=6),
    "rcm1": make_space("rcm1", _encode_rcm1, _decode_rcm1, depth=1, R=6),
    "rcm2": make_space("rcm2", _encode_rcm2, _decode_rcm2, turns=("roll",), roll=1, p=3),
    "rcm3": make_space("rcm3", _encode_rcm3, _decode_rcm3, depth=1, R=6),
    "rcm4": make_space(
        "rcm4", _encode_rcm4, _decode_rcm4, is_absolute=True, turns=("roll",), roll=1, p=3
    ),
    "rcm1_fixed_yaw": make_space(
        "rcm1_fixed_yaw", _fixed_yaw(_encode_rcm1), _fixed_yaw(_decode_rcm1), depth=1, R=6
    ),
    "rcm2_fixed_yaw": make_space(
        "rcm2_fixed_yaw",
        _fixed_yaw(_encode_rcm2),
        _fixed_yaw(_decode_rcm2),
        turns=("roll",),
        roll=1,
        p=3,
    ),
    "rcm6": "starjax.rcm.wrist_actions:RCM6",
    "se3_through": "starjax.rcm.wrist_actions:SE3_THROUGH",
    "se3_wrist": "starjax.rcm.wrist_actions:SE3_WRIST",
}
# Other packages add theirs by an entry point of the group `starjax.action_spaces`.
ACTION_SPACES = Rows(Registry("action_space", _BUILT_IN, "starjax.rcm.actions:ActionSpace"))
