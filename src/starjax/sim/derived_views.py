"""Views derived from a camera, by its name: `_right`, `_depth`, `_tissue` and two of them at once.

The right view is that of a second lens, as in a stereo endoscope. A depth image is an ordinary
image of three channels, which policies, datasets and exports take like any other: red is the depth
from `NEAR` to `FAR`; green and blue are triangle waves of it, a quarter period apart, which hold it
to a tenth of a millimetre without jumps. A view of tissue shows a body cavity around the task's
objects, see `camera.tissue`.
"""

import copy
from collections.abc import Collection, Iterator
from types import ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from starjax.core.types import Array, Pose
from starjax.sim.camera import geometry, tissue
from starjax.sim.names import DEPTH, TISSUE

RIGHT = "_right"
BASELINE = 0.005  # m between the lenses
NEAR, FAR = 0.1, 0.6  # m from the camera's plane; nearer and farther points are clipped
_PERIODS = 16  # periods of the waves between them, 31 mm each


class DerivedView(NamedTuple):
    """A view of a camera.

    Attributes:
      camera: name in the MJCF.
      offset: m to the right of the camera.
      is_depth: True for depth instead of colours.
      look: of the surroundings, see `render.make`.
    """

    camera: str
    offset: float
    is_depth: bool
    look: str = ""


def parse(name: str, cameras: Collection[str]) -> DerivedView:
    """Returns the view of a name; a name among `cameras` is the camera itself."""
    plain = name if name in cameras else name.removesuffix(DEPTH)
    lit = plain if plain in cameras else plain.removesuffix(TISSUE)
    camera = lit if lit in cameras else lit.removesuffix(RIGHT)
    look = tissue.NAME if lit != plain else ""
    return DerivedView(camera, BASELINE if camera != lit else 0.0, plain != name, look)


def names(cameras: Collection[str]) -> Iterator[str]:
    """Yields the names of the cameras, then those of the views derived from them."""
    yield from cameras
    for camera in cameras:
        yield from (f"{camera}{RIGHT}", f"{camera}{DEPTH}", f"{camera}{RIGHT}{DEPTH}")
        yield from (f"{camera}{TISSUE}", f"{camera}{RIGHT}{TISSUE}")


def displaced(mj_model: mujoco.MjModel, view: DerivedView) -> mujoco.MjModel:
    """Returns the model with the view's camera at its offset."""
    if not view.offset:
        return mj_model
    moved = copy.copy(mj_model)
    camera, R = moved.camera(view.camera), np.zeros(9)
    mujoco.mju_quat2Mat(R, camera.quat)
    camera.pos += view.offset * R.reshape(3, 3)[:, 0]
    return moved


def encode(depth: jax.Array) -> jax.Array:
    """Returns the image `[h, w, 3]` uint8 of a depth `[h, w]` in m."""
    part = jnp.clip((depth - NEAR) / (FAR - NEAR), 0.0, 1.0)
    waves = [1.0 - jnp.abs(2.0 * ((_PERIODS * part + shift) % 1.0) - 1.0) for shift in (0.0, 0.75)]
    return jnp.round(255.0 * jnp.stack([part, *waves], axis=-1)).astype(jnp.uint8)


def decode(image: np.ndarray) -> np.ndarray:
    """Returns the depth `[..., h, w]` in m of images `[..., h, w, 3]` uint8, to 0.1 mm."""
    return decode_scaled(np.asarray(image, np.float32) / 255.0, np)


def decode_scaled(image: Array, np_: ModuleType) -> Any:
    """Returns the depth `[..., h, w]` in m of images `[..., h, w, 3]` in [0, 1].

    `np_` is the module of the array, numpy or jax.numpy.
    """
    coarse, green, blue = np_.moveaxis(image, -1, 0)
    # Green has each value twice in a period; blue is low in the half where green rises.
    phase = np_.where(blue < 0.5, 0.5 * green, 1.0 - 0.5 * green)
    whole = np_.round(_PERIODS * coarse - phase)
    return NEAR + (FAR - NEAR) * (whole + phase) / _PERIODS


def points(
    depth: np.ndarray, mj_model: mujoco.MjModel, name: str, pose_world_camera: Pose | None = None
) -> np.ndarray:
    """Returns the point cloud `[h, w, 3]` m, in the world, of a view's depth `[h, w]` in m.

    Args:
      depth: distances from the camera's plane.
      mj_model: with the camera.
      name: of the view.
      pose_world_camera: of a camera that moves; by default the one fixed in the world.
    """
    known = [mj_model.camera(i).name for i in range(mj_model.ncam)]
    view = parse(name, known)
    height, width = depth.shape
    scene = geometry.read(
        displaced(mj_model, view), view.camera, width / height, pose_world_camera is not None
    )
    x = scene.left + (scene.right - scene.left) * (np.arange(width) + 0.5) / width
    y = scene.top + (scene.bottom - scene.top) * (np.arange(height) + 0.5) / height
    along = np.stack([*np.meshgrid(x, y), -np.ones_like(depth)], axis=-1)
    R, p = pose_world_camera or (scene.R_world_cam, scene.p_world_cam)
    return np.asarray(p) + (depth[..., None] * along) @ np.asarray(R).T
