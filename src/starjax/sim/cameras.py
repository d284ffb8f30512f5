"""Cameras of a scene: their poses and images.

A camera that is fixed in the world draws its textures and its sun once. One that rides on a body,
and every one of an environment with moving cameras, takes its pose from the state.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from starjax.core.types import Pose
from starjax.sim import derived_views, endoscope_camera, render
from starjax.sim.camera import tissue
from starjax.sim.quiet_mjx import mjx


class SceneCamera(NamedTuple):
    """One camera of a scene.

    Attributes:
      name: in the MJCF, or of a view derived from it, see `derived_views`.
      body: that it rides on, 0 for the world.
      R, p: `[3, 3]` and `[3]` m, pose in that body's frame: x to the right, y up, looking along -z.
      moves: True if its pose comes with every image.
      draw: see `render.make`.
      is_depth: True if its images are depth.
    """

    name: str
    body: int
    R: np.ndarray
    p: np.ndarray
    moves: bool
    draw: render.Render
    is_depth: bool = False


def make(
    mj_model: mujoco.MjModel,
    names: Sequence[str],
    image_size: int,
    shadow: bool = True,
    moving: bool = False,
    scope: endoscope_camera.Endoscope | None = None,
    samples: int = 1,
    varying_look: bool = False,
) -> tuple[SceneCamera, ...]:
    """Makes the named cameras, for square images; with `moving` all of them may move.

    `scope` is where the endoscope may be, if a trocar of its own holds it. With `varying_look`,
    views of colours without a look by their name may have that of tissue in some images.
    """
    made = []
    known = [mj_model.camera(i).name for i in range(mj_model.ncam)]
    for name in names:
        view = derived_views.parse(name, known)
        model = derived_views.displaced(mj_model, view)
        camera = model.camera(view.camera)
        body, R = int(camera.bodyid[0]), np.zeros(9)
        mujoco.mju_quat2Mat(R, camera.quat)
        R, p = R.reshape(3, 3).astype(np.float32), camera.pos.astype(np.float32)
        moves = moving or body != 0 or (scope is not None and endoscope_camera.is_endoscope(name))
        sizes = image_size, image_size
        varies = varying_look and not (view.look or view.is_depth)
        more = {"samples": samples, "depth": view.is_depth, "look_varies": varies}
        look = tissue.NAME if varies else view.look
        draw = render.make(model, view.camera, *sizes, shadow, moves=moves, look=look, **more)
        made.append(SceneCamera(name, body, R, p, moves, draw, view.is_depth))
    return tuple(made)


def nominal(cameras: Sequence[SceneCamera]) -> Pose:
    """Returns the cameras' poses `[C]` in their bodies' frames as in the MJCF."""
    return Pose(jnp.stack([c.R for c in cameras]), jnp.stack([c.p for c in cameras]))


def at_reset(
    cameras: Sequence[SceneCamera], scope: endoscope_camera.Endoscope | None, key: jax.Array
) -> Pose:
    """Returns the poses `[C]` of `nominal`, except the endoscope's, which is drawn."""
    poses = nominal(cameras)
    if scope is None:
        return poses
    is_drawn = jnp.array([endoscope_camera.is_endoscope(camera.name) for camera in cameras])
    drawn = endoscope_camera.draw(scope, key)
    return Pose(
        jnp.where(is_drawn[:, None, None], drawn.R, poses.R),
        jnp.where(is_drawn[:, None], drawn.p, poses.p),
    )


def images(
    cameras: Sequence[SceneCamera],
    poses: Pose,
    data: mjx.Data,
    rgb: jax.Array,
    has_look: jax.Array | None = None,
) -> dict[str, render.CameraImage]:
    """Renders every camera.

    Args:
      cameras: C of them.
      poses: `[C]` in their bodies' frames; ignored for cameras that do not move.
      data: with the poses of bodies and geoms.
      rgb: `[G, 3]` colours in [0, 1].
      has_look: see `state.ImageSource`.
    """
    frames: dict[str, render.CameraImage] = {}
    for i, camera in enumerate(cameras):
        draw: Callable[..., render.CameraImage] = camera.draw
        inputs = (data.geom_xpos, data.geom_xmat, rgb)
        if not camera.moves:
            frames[camera.name] = _as_image(camera, draw(*inputs))
            continue
        R_world_body, p_world_body = data.xmat[camera.body], data.xpos[camera.body]
        # T_world_body T_body_camera
        pose = Pose(R_world_body @ poses.R[i], p_world_body + R_world_body @ poses.p[i])
        frames[camera.name] = _as_image(camera, draw(*inputs, pose, has_look))
    return frames


def _as_image(camera: SceneCamera, frame: render.CameraImage) -> render.CameraImage:
    """Returns the image with its depth in place of colours, if the view is one of depth."""
    if frame.depth is None or not camera.is_depth:
        return frame
    return frame.replace(rgb=derived_views.encode(frame.depth))
