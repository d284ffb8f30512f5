"""Action spaces of instruments with a wrist.

`rcm6` is (roll, wrist angles, tip), `se3_through` a tip pose with the shaft through the trocar, and
`se3_wrist` a tip pose and wrist angles, whose shaft may be anywhere.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from starjax.core.types import Pose
from starjax.rcm import actions, arrays, rotations, wrist_checks
from starjax.rcm import wrist as wrists

_E_X = np.array([1.0, 0.0, 0.0], np.float32)
_E_Z = np.array([0.0, 0.0, 1.0], np.float32)
_G = np.array([1.0, -1.0, -1.0], np.float32)  # world to the z-down frame of fixed yaw, diagonal


def rcm6(wrist: wrists.Wrist) -> actions.ActionSpace:
    """Returns the space (roll of the shaft, wrist pitch and yaw, tip in the world) of a wrist.

    With angles of zero it is `rcm4`. `decode` returns the tip's pose; `angles_through` has its
    wrist angles, which are the action's, within the limits. The roll is singular for a shaft that
    points straight up, as in `rcm4`.

    Args:
      wrist: sizes and limits.
    """

    wrist_checks.check_wrist(wrist)

    def encode(pose: Pose, frame: actions.SpaceFrame) -> list[jax.Array]:
        angles = wrists.angles_through(wrist, pose, frame.p)
        shaft = wrists.shaft_of(wrist, pose, angles)
        # (gamma, pitch, yaw, p_abs)
        return [actions.roll_from_zero(shaft.R, frame), angles, pose.p]

    def decode(parts: dict[str, jax.Array], frame: actions.SpaceFrame) -> Pose:
        angles = wrists.limited(wrist, parts["wrist"])  # total: any numbers give a feasible wrist
        bend = wrists.bent(wrist, angles)
        offset = parts["p"] - frame.p
        line, length = arrays.direction(offset, -_E_Z)
        depth, _ = wrists.tip_depth(bend, length)
        roll = parts["roll"][..., 0] + frame.roll_zero
        # R_world_shaft = G align(e_z, a) Rz(roll) as in Alg. 1, where `align` turns about a
        # horizontal axis. It must take the rolled tip's direction to the line from trocar to tip.
        # With the roll fixed the tip's direction in {L} is known; the axis must turn it onto the
        # line.
        tip = arrays.matvec(rotations.rotation_z(roll), wrists.tip_direction(bend, depth))
        axis = _turned_z(*jnp.broadcast_arrays(tip, line * _G))
        R = rotations.rotation_from_axis_roll(axis * _G, roll)
        return wrists.tip_of(wrist, wrists.shaft_at(R, depth, bend, frame.p), angles)

    facts = {"is_absolute": True, "turns": ("roll", "wrist"), "for_wrist": rcm6}
    return actions.make_space("rcm6", encode, decode, **facts, roll=1, wrist=2, p=3)


def se3_through(wrist: wrists.Wrist) -> actions.ActionSpace:
    """Returns the space of tip poses in the world, decoded by `through`: on the manifold.

    Args:
      wrist: sizes and limits.
    """

    wrist_checks.check_wrist(wrist)

    def encode(pose: Pose, frame: actions.SpaceFrame) -> list[jax.Array]:
        return [pose.p, rotations.rot6d_encode(pose.R)]

    def decode(parts: dict[str, jax.Array], frame: actions.SpaceFrame) -> Pose:
        return wrists.through(wrist, _free_pose(parts), frame.p).pose

    facts = {"is_absolute": True, "for_wrist": se3_through}
    return actions.make_space("se3_through", encode, decode, **facts, p=3, R=6)


def se3_wrist(wrist: wrists.Wrist) -> actions.ActionSpace:
    """Returns the space of tip poses in the world with wrist angles: the trocar is ignored.

    `encode` gives the angles of a shaft through the trocar; measured ones may replace them.

    Args:
      wrist: sizes.
    """

    wrist_checks.check_wrist(wrist)

    def encode(pose: Pose, frame: actions.SpaceFrame) -> list[jax.Array]:
        angles = wrists.angles_through(wrist, pose, frame.p)
        return [pose.p, rotations.rot6d_encode(pose.R), angles]

    def decode(parts: dict[str, jax.Array], frame: actions.SpaceFrame) -> Pose:
        return _free_pose(parts)

    facts = {"is_absolute": True, "is_free": True, "for_wrist": se3_wrist}
    return actions.make_space("se3_wrist", encode, decode, **facts, p=3, R=6, wrist=2)


RCM6, SE3_THROUGH, SE3_WRIST = (
    actions.without_wrist(make(wrists.LARGE_NEEDLE_DRIVER))
    for make in (rcm6, se3_through, se3_wrist)
)


@functools.lru_cache
def action_space(name: str, wrist: wrists.Wrist | None = None) -> actions.ActionSpace:
    """Returns an action space by name.

    Args:
      name: key of `ACTION_SPACES`.
      wrist: of the instrument, for a space with `for_wrist`.

    Raises:
      ValueError: an unknown name, or a space for wrists without one.
    """
    space = actions.ACTION_SPACES.registry.get(name)
    if space.for_wrist is None:
        return space
    if wrist is None:
        raise ValueError(f"wrist: expected that of a tool for the action space {name}, got None")
    return space.for_wrist(wrist)


def _free_pose(parts: dict[str, jax.Array]) -> Pose:
    p = jnp.clip(parts["p"], -actions.MAX_REACH, actions.MAX_REACH)
    return Pose(rotations.rot6d_decode(parts["R"]), p)


def _turned_z(a: jax.Array, b: jax.Array) -> jax.Array:
    """Turns e_z as the rotation about a horizontal axis does that takes unit `a` to unit `b`.

    The axis n is orthogonal to b - a, so n is along e_z x (b - a). Across n, the parts of a and b
    are equally long; that of a has a positive z, so it is not zero.
    """
    n = jnp.stack([a[..., 1] - b[..., 1], b[..., 0] - a[..., 0], jnp.zeros_like(a[..., 0])], -1)
    n, _ = arrays.direction(n, _E_X)
    a, b = (x - arrays.dot(x, n) * n for x in (a, b))  # across n, where the turn is seen
    turn = jnp.concatenate([arrays.dot(a, b), arrays.dot(n, jnp.cross(a, b))], -1)
    turn, _ = arrays.direction(turn, _E_X[:2])
    cos, sin = turn[..., :1], turn[..., 1:]
    # The axis n is horizontal
    return cos * _E_Z.astype(a.dtype) + sin * jnp.cross(n, jnp.broadcast_to(_E_Z, n.shape))
