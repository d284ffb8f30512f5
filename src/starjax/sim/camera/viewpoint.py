"""Camera of one image: constants for a fixed camera, traced for a moving one.

A fixed camera's sun and textures are computed once, on the host. A moving one's scene is read in
the world's frame, and the pose comes with every image.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from starjax.core.types import Array, Pose
from starjax.sim.camera import geometry, texture, tiles, tissue

# A texture: visible points x, y, z in the camera frame, `[T, Q]` m each, to red, green and blue.
Look = Callable[[Sequence[Any]], Any]


class View(NamedTuple):
    """One camera in one image; numpy or traced.

    Attributes:
      R_cam_world: `[3, 3]`. p_world_cam: `[3]` m.
      R_light_cam: `[3, 3]`, to a frame whose z axis points to the sun, or None without a sun.
      to_sun: x, y, z in the camera frame, or None.
      textures: by row.
      look: of the textured ground and of the light, or None.
      has_look: `[]` bool, False for an image without the look; None: every image has it.
    """

    R_cam_world: Any
    p_world_cam: Any
    R_light_cam: Any
    to_sun: Sequence[Any] | None
    textures: dict[int, Look]
    look: tissue.Look | None = None
    has_look: Any = None


def fixed(scene: geometry.RenderScene, grid: tiles.Grid, look: str = "") -> View:
    """Makes the view of a camera fixed in the world, for a scene read in its frame."""
    drawn = texture.draw(scene, grid)
    direction = None if scene.sun is None else scene.sun.direction
    return View(
        R_cam_world=jnp.asarray(scene.R_world_cam.T, jnp.float32),
        p_world_cam=jnp.asarray(scene.p_world_cam, jnp.float32),
        R_light_cam=None if direction is None else _frame(-direction),
        to_sun=None if direction is None else [-float(v) for v in direction],
        textures={
            row: lambda p, rgb=rgb: rgb
            for row, rgb in drawn.items()
            if not look or row != scene.ground
        },
        look=_look(scene, grid, look, np.eye(3), np.zeros(3)),
    )


def moving(
    scene: geometry.RenderScene,
    grid: tiles.Grid,
    pose_world_cam: Pose,
    look: str = "",
    has_look: jax.Array | None = None,
) -> View:
    """Makes the view from a pose, for a scene read in the world's frame."""
    R_world_cam, p_world_cam = (jnp.asarray(x, jnp.float32) for x in pose_world_cam)
    R_light_cam = to_sun = None
    if scene.sun is not None:
        R_light_world = _frame(-scene.sun.direction)
        R_light_cam = jnp.einsum("ij,jk->ik", R_light_world, R_world_cam, precision="highest")
        to_sun = list(R_light_cam[2])
    step = abs(scene.right - scene.left) / grid.width
    return View(
        R_cam_world=R_world_cam.T,
        p_world_cam=p_world_cam,
        R_light_cam=R_light_cam,
        to_sun=to_sun,
        textures={
            row: texture.looker(checker, step, R_world_cam, p_world_cam)
            for row, checker in scene.textures.items()
            if not look or has_look is not None or row != scene.ground
        },
        look=_look(scene, grid, look, R_world_cam, p_world_cam),
        has_look=has_look,
    )


def _look(
    scene: geometry.RenderScene,
    grid: tiles.Grid,
    look: str,
    R_scene_cam: Array,
    p_scene_cam: Array,
) -> tissue.Look | None:
    """Makes a look of the ground from the camera's pose in the frame of the scene."""
    if not look:
        return None
    ground = scene.textures[scene.ground]
    R_geom_scene = jnp.asarray(ground.R_cam_geom.T, jnp.float32)
    offset = jnp.asarray(p_scene_cam - ground.p_cam_top, jnp.float32)
    R_geom_cam = jnp.matmul(R_geom_scene, R_scene_cam, precision="highest")
    p_geom_lens = jnp.matmul(R_geom_scene, offset, precision="highest")
    step = abs(scene.right - scene.left) / grid.width
    return tissue.look(step, R_geom_cam, p_geom_lens)


def _frame(z: np.ndarray) -> np.ndarray:
    """Returns a rotation whose third row is the unit vector `z`, float32."""
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z]).astype(np.float32)
