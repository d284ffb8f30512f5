"""An action space of each kind, and a method of each: cylinder coordinates, or as in rcm."""

import jax
import jax.numpy as jnp

from starjax import rcm
from starjax.core.methods import Method
from starjax.rcm import actions


def written(pose: rcm.Pose, frame: actions.SpaceFrame) -> list[jax.Array]:
    return [pose.p[..., :2], pose.p[..., 2:], rcm.rot6d_encode(pose.R)]


def read(parts: dict[str, jax.Array], frame: actions.SpaceFrame) -> rcm.Pose:
    return rcm.Pose(rcm.rot6d_decode(parts["R"]), jnp.concatenate([parts["xy"], parts["z"]], -1))


def below(pose: rcm.Pose, frame: actions.SpaceFrame) -> list[jax.Array]:
    return written(pose._replace(p=pose.p - frame.p), frame)


def on_shaft(parts: dict[str, jax.Array], frame: actions.SpaceFrame) -> rcm.Pose:
    pose = read(parts, frame)
    return rcm.project(pose._replace(p=pose.p + frame.p), frame.p)


def relative(wrist: rcm.Wrist) -> actions.ActionSpace:
    def decode(parts: dict[str, jax.Array], frame: actions.SpaceFrame) -> rcm.Pose:
        pose = read(parts, frame)
        return rcm.through(wrist, pose._replace(p=pose.p + frame.p), frame.p).pose

    return actions.make_space(
        "toy_wrist_relative", below, decode, for_wrist=relative, xy=2, z=1, R=6
    )


def bent(wrist: rcm.Wrist) -> actions.ActionSpace:
    return rcm.rcm6(wrist)._replace(name="toy_wrist", for_wrist=bent)


def bent_freely(wrist: rcm.Wrist) -> actions.ActionSpace:
    return rcm.se3_wrist(wrist)._replace(name="toy_wrist_free", for_wrist=bent_freely)


FREE = actions.make_space("toy_free", written, read, is_absolute=True, is_free=True, xy=2, z=1, R=6)
RELATIVE = actions.make_space("toy_relative", below, on_shaft, xy=2, z=1, R=6)
ABSOLUTE = rcm.ACTION_SPACES["rcm4"]._replace(name="toy_absolute")
WRIST, WRIST_RELATIVE, WRIST_FREE = (
    actions.without_wrist(make(rcm.LARGE_NEEDLE_DRIVER)) for make in (bent, relative, bent_freely)
)
FREE_ROW, RELATIVE_ROW = Method("toy_free"), Method("toy_relative", sees_trocar=True)
ABSOLUTE_ROW = Method("toy_absolute", hierarchical=True)
WRIST_ROW = Method("toy_wrist", hierarchical=True)
WRIST_RELATIVE_ROW = Method("toy_wrist_relative", sees_trocar=True)
WRIST_FREE_ROW = Method("toy_wrist_free")
