"""Tips, trocars and task states in the endoscope's frame, and commands back in the world's.

A policy with `frame = "camera"` sees and plans as if the endoscope stood where it stands in the
middle of all its places, with the world's origin in its lens: x to the right of the picture, y up,
z towards the surgeon. If patient, tools and endoscope are moved together, nothing changes for it.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from starjax import errors, rcm
from starjax.rcm import arrays
from starjax.sim import endoscope_camera
from starjax.sim.tasks.base import Field, Task
from starjax.types import Command, Observation, Pose


class Origins(NamedTuple):
    """From where trocars and rolls count in the endoscope's frame.

    Attributes:
      p_ref: `[A, 3]` m, the nominal trocars as the endoscope sees them from its own nominal pose.
      roll_zero: `[A]` rad, of a tool that points straight down in the world with its roll at zero,
        likewise: no arm works at the wrap of its roll.
    """

    p_ref: jax.Array
    roll_zero: jax.Array


def origins(task: Task) -> Origins:
    """Those of a task that has an endoscope."""
    assert task.endoscope is not None
    camera = endoscope_camera.nominal(task.endoscope)
    down = jnp.array([0.0, 0.0, -1.0])
    zero = jnp.array([slot.roll_zero for slot in task.slots])
    p = jnp.array([slot.p_world_ref for slot in task.slots])
    seen = inward(camera, Pose(rcm.rotation_from_axis_roll(down, zero), p))
    return Origins(seen.p, rcm.roll_of(seen.R))


def inward(camera: Pose, pose: Pose) -> Pose:
    """Poses `[..., *]` of the world in the frame of cameras `[...]`."""
    camera = _beside(camera, pose.p.ndim)
    back = jnp.swapaxes(camera.R, -1, -2)
    return Pose(arrays.matmul(back, pose.R), arrays.matvec(back, pose.p - camera.p))


def outward(camera: Pose, pose: Pose) -> Pose:
    """Inverse of `inward`."""
    camera = _beside(camera, pose.p.ndim)
    return Pose(arrays.matmul(camera.R, pose.R), camera.p + arrays.matvec(camera.R, pose.p))


def trocar(task: Task, camera: Pose, told: rcm.TrocarFrame) -> rcm.TrocarFrame:
    """Trocars `[..., A]` in the frame of cameras `[...]`."""
    here = origins(task)
    at = inward(camera, Pose(told.R_world_trocar, told.p_world_trocar))
    zero = jnp.broadcast_to(here.roll_zero, told.roll_zero.shape)
    return rcm.TrocarFrame(rcm.trocar_from_position(at.p, here.p_ref), at.p, at.R, zero)


def observation(task: Task, camera: Pose, seen: Observation) -> Observation:
    """Turns observations `[..., *]` into the frame of cameras `[...]`; images stay as they are."""
    state = None if seen.state is None else _state(task.fields, camera, jnp.asarray(seen.state))
    return seen._replace(pose=inward(camera, seen.pose), state=state, endoscope=None)


def command(camera: Pose, asked: Command) -> Command:
    """Commands `[..., *]` of the world in the frame of cameras `[...]`."""
    return asked._replace(pose=inward(camera, asked.pose))


def of(seen: Observation) -> Pose:
    """The endoscope's pose.

    Raises:
      errors.UsageError: it was not observed.
    """
    if seen.endoscope is None:
        raise errors.UsageError("observation.endoscope", "a pose, for policy.frame camera", "none")
    return seen.endoscope


def _state(fields: tuple[Field, ...], camera: Pose, state: jax.Array) -> jax.Array:
    """Points and rotations of a state `[..., S]` turned; what has no frame stays."""
    camera, parts, at = _beside(camera, state.ndim), [], 0
    back = jnp.swapaxes(camera.R, -1, -2)
    for field in fields:
        part = state[..., at : at + field.size]
        at += field.size
        if field.kind == "unit":
            parts.append(part)
            continue
        rows = part.reshape(*part.shape[:-1], -1, 3)
        rows = rows - camera.p[..., None, :] if field.kind == "point" else rows
        parts.append(arrays.matvec(back[..., None, :, :], rows).reshape(part.shape))
    return jnp.concatenate(parts, axis=-1)


def _beside(camera: Pose, ndim: int) -> Pose:
    """Cameras `[...]` with axes of size 1, so that they broadcast against `[..., *, n]`."""
    more: Any = (1,) * (ndim - camera.p.ndim)
    lead = camera.p.shape[:-1]
    return Pose(camera.R.reshape(*lead, *more, 3, 3), camera.p.reshape(*lead, *more, 3))
