"""Endoscope of a task: a still, level camera in a trocar of its own, drawn per episode.

It is a camera without a body: it has no contacts and casts no shadow.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from starjax.core.types import Array, Pose
from starjax.rcm import trocar as trocars
from starjax.sim.names import TISSUE

if TYPE_CHECKING:  # a robot loads tasks without the simulator
    import mujoco

    from starjax.sim.task import Task

NAME = "endoscope"  # name of the camera
STREAM = 0x73636F70  # folded into an episode's key: objects and tips are drawn as without it


class Endoscope(NamedTuple):
    """Ranges of a task's endoscope and its lens.

    Attributes:
      p_world_ref: `(3,)` m, its nominal trocar.
      radius, polar, azimuth: ranges of its trocar about the nominal one (Eq. 19), m and rad.
      work: `(3,)` m, mean point of view.
      spread: `(3,)` m, half the range of the point of view about it.
      distance: range in m from the lens to the point of view.
      up: `(3,)`, the direction that is up in the picture as far as the line of sight lets it.
      fovy: degrees from the picture's lower edge to its upper one.
    """

    p_world_ref: tuple[float, float, float]
    radius: trocars.Range
    polar: trocars.Range
    azimuth: trocars.Range
    work: tuple[float, float, float]
    spread: tuple[float, float, float]
    distance: trocars.Range
    up: tuple[float, float, float]
    fovy: float


def of(task: "Task", cameras: Sequence[str]) -> Endoscope | None:
    """Returns the task's endoscope, or None unless it is among the observed cameras."""
    return task.endoscope if any(map(is_endoscope, cameras)) else None


def is_endoscope(camera: str) -> bool:
    """Returns True for the name of the endoscope, with any look."""
    return camera.removesuffix(TISSUE) == NAME


def draw(endoscope: Endoscope, key: jax.Array) -> Pose:
    """Draws the camera's pose for the episode of `key`."""
    key_trocar, key_work, key_distance = jax.random.split(jax.random.fold_in(key, STREAM), 3)
    where = trocars.sample_trocar(
        key_trocar,
        radius_range=endoscope.radius,
        polar_range=endoscope.polar,
        azimuth_range=endoscope.azimuth,
    )
    aside = jax.random.uniform(key_work, (3,), minval=-1.0)
    low, high = endoscope.distance
    return looking_at(
        jnp.array(endoscope.work) + jnp.array(endoscope.spread) * aside,
        trocars.trocar_position(where, jnp.array(endoscope.p_world_ref)),
        jax.random.uniform(key_distance, minval=low, maxval=high),
        endoscope.up,
    )


def nominal(endoscope: Endoscope) -> Pose:
    """Returns the camera's pose at the middle of its ranges; a constant in programs."""
    work, p_trocar = np.array(endoscope.work), np.array(endoscope.p_world_ref)
    with jax.ensure_compile_time_eval(), jax.default_matmul_precision("highest"):
        return looking_at(work, p_trocar, np.mean(endoscope.distance), endoscope.up)


def add(world: "mujoco.MjSpec", endoscope: Endoscope) -> None:
    """Adds the camera at its nominal pose to a model's world."""
    import mujoco

    pose, wxyz = nominal(endoscope), np.zeros(4)
    mujoco.mju_mat2Quat(wxyz, np.asarray(pose.R, float).ravel())
    p = np.asarray(pose.p, float)
    world.worldbody.add_camera(name=NAME, pos=p, quat=wxyz, fovy=endoscope.fovy)


def looking_at(
    target: Array,
    p_trocar: Array,
    distance: ArrayLike,
    up: Any,
    lean: tuple[Any, Any] = (0.0, 1.0),
) -> Pose:
    """Returns the one pose of a scope's camera with the target in the middle of a level image.

    Args:
      target: `[3]` m.
      p_trocar: `[3]` m, the scope's trocar.
      distance: m from the lens to the target.
      up: `[3]`, up in the picture; not along the line of sight.
      lean: sine and cosine of the angle by which the lens looks from the shaft towards the
        picture's lower edge, as oblique optics do.

    Returns:
      pose_world_camera: x to the right, y up, it looks along -z.
    """
    length = jnp.linalg.norm(target - p_trocar)
    straight = (target - p_trocar) / length
    up = jnp.array(up)
    up = up - (up @ straight) * straight  # level: the picture's up is across the line of sight
    up = up / jnp.maximum(jnp.linalg.norm(up), 1e-6)
    # Triangle of trocar, lens and target: `lean` is its angle at the lens, e the one at the trocar,
    # and by the law of sines sin e = distance sin(lean) / length.
    sine, cosine = lean
    sine_e = distance * sine / length
    cosine_e = jnp.sqrt(1.0 - sine_e**2)
    axis = cosine_e * straight + sine_e * up
    p = p_trocar + (length * cosine_e - distance * cosine) * axis
    back = (p - target) / distance  # the camera's z axis
    right = jnp.cross(straight, up)
    return Pose(jnp.stack([right, jnp.cross(back, right), back], axis=-1), p)
