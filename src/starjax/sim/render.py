"""Camera: a ray caster of MuJoCo's primitives in plain JAX, for CPUs and GPUs.

Planes, spheres, capsules, cylinders and boxes; a headlight and one sun with shadows, lit as
MuJoCo's own renderer lights them (no GL is needed); checkered textures. Single-sample: vmap it.
"""

from collections.abc import Callable

import flax.struct
import jax
import jax.numpy as jnp
import mujoco

from starjax.core import errors
from starjax.core.types import Pose
from starjax.sim.camera import cast, texture, tiles
from starjax.sim.camera import geometry as scenes
from starjax.sim.camera import viewpoint as views

geom_rgb = scenes.geom_rgb

Render = Callable[..., "CameraImage"]


@flax.struct.dataclass
class CameraImage:
    """One rendered image.

    Attributes:
      rgb: `[h, w, 3]` uint8.
      depth: `[h, w]` float32 distance from the camera's plane in m, `rays.FAR` without a hit,
        or None.
      segmentation: `[h, w]` int32 geom id, -1 for the background, or None.
    """

    rgb: jax.Array
    depth: jax.Array | None = None
    segmentation: jax.Array | None = None


def make(
    mj_model: mujoco.MjModel,
    camera: str = "camera",
    height: int = 256,
    width: int = 256,
    shadow: bool = True,
    depth: bool = False,
    segmentation: bool = False,
    samples: int = 1,
    moves: bool = False,
    look: str = "",
    look_varies: bool = False,
) -> Render:
    """Makes `render(geom_xpos, geom_xmat, geom_rgb) -> CameraImage` of a fixed camera.

    For a camera that `moves` it is `render(geom_xpos, geom_xmat, geom_rgb, pose_world_cam)`: x to
    the right, y up, the camera looks along -z. Textures are then checkers only, and their edges
    differ from the fixed camera's by the way they are smoothed. If its look varies, a fifth
    argument `has_look`, `[]` bool, is true for an image that has it.

    Geoms of group 3 and above, fully transparent ones and sites are not drawn. `geom_xpos [G, 3]`
    m and `geom_xmat [G, 3, 3]` are the simulation's; `geom_rgb [G, 3]` in [0, 1] starts from
    `geom_rgb(mj_model)`.

    Args:
      mj_model: shapes, materials, lights and camera; only poses and colours vary afterwards.
      camera: name of the camera.
      height, width: of the picture in pixels.
      shadow: True for shadows of the first directional light.
      depth, segmentation: True to return these too (of a pixel's last sample).
      samples: rays along each side of a pixel: 1, 2 or 4; 2 smooths outlines at 4 times the cost.
      moves: True if the camera's pose comes with every image.
      look: of the ground and the light, `tissue.NAME`; empty: the MJCF's.
      look_varies: True if each image of a moving camera has the look or not; a scene without a
        textured ground then never has it.
    """
    for name, value in (("height", height), ("width", width)):
        if value < 1:
            raise ValueError(f"{name}: expected a positive number of pixels, got {value}")
    if samples not in (1, 2, 4):
        raise ValueError(f"samples: expected 1, 2 or 4 rays a pixel side, got {samples}")
    scene = scenes.read(mj_model, camera, width / height, moves)
    if look_varies and not scene.textures:
        look = ""
    elif look and not scene.textures:
        raise errors.UsageError("camera", f"a ground with a texture for {look}", "none")
    grid = tiles.grid(scene, height * samples, width * samples)
    if moves and not all(map(texture.is_checker, scene.textures.values())):
        raise errors.UsageError("mj_model", "checkers as textures for a moving camera", "others")
    still = None if moves else views.fixed(scene, grid, look)

    def render(
        geom_xpos: jax.Array,
        geom_xmat: jax.Array,
        geom_rgb: jax.Array,
        pose_world_cam: Pose | None = None,
        has_look: jax.Array | None = None,
    ) -> CameraImage:
        shape = geom_xpos.shape, geom_xmat.shape, geom_rgb.shape
        n = mj_model.ngeom
        if shape != ((n, 3), (n, 3, 3), (n, 3)):
            raise ValueError(
                f"geom_xpos, geom_xmat, geom_rgb: expected {[n, 3]}, {[n, 3, 3]}, {[n, 3]}, "
                f"got {shape}"
            )
        inputs = [jnp.asarray(v, jnp.float32) for v in (geom_xpos, geom_xmat, geom_rgb)]
        view = still
        if pose_world_cam is not None:
            varying = has_look if look_varies else None
            view = views.moving(scene, grid, pose_world_cam, look, varying)
        if view is None or (still is not None and pose_world_cam is not None):
            got = "none" if pose_world_cam is None else "one"
            raise errors.UsageError("pose_world_cam", "one" if moves else "none", got)
        t, face, word = cast.cast(scene, grid, view, shadow, *inputs)
        frame = CameraImage(rgb=_bytes(grid, word, samples))
        if depth:
            frame = frame.replace(
                depth=tiles.picture(grid, tiles.pixels(grid, t, samples)[..., -1])
            )
        if segmentation:
            ids = jnp.append(jnp.asarray(scene.ids[scene.row_of_face()]), -1)[face].astype(
                jnp.int32
            )
            one = tiles.pixels(grid, ids, samples)[..., -1]
            frame = frame.replace(segmentation=tiles.picture(grid, one))
        return frame

    return render


def _bytes(grid: tiles.Grid, word: jax.Array, samples: int) -> jax.Array:
    """Averages samples to an image `[h, w, 3]` uint8."""
    if samples > 1:
        parts = jax.lax.bitcast_convert_type(tiles.pixels(grid, word, samples), jnp.uint8)
        mean = (parts.astype(jnp.float32).mean(-2) + 0.5).astype(jnp.uint8)
        word = jax.lax.bitcast_convert_type(mean, jnp.int32)
    return jax.lax.bitcast_convert_type(tiles.picture(grid, word), jnp.uint8)[..., :3]
