"""Environment: reset, step(Command) and observe as single-sample pure functions.

It takes poses, independent of methods, tasks and robots. `EnvParams` and the key hold all that
varies per episode, so a batch of trocars is one vmapped axis.
"""

import functools
import numbers
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from starjax.core import errors
from starjax.core.config import DEFAULT_TASK, PolicyConfig
from starjax.core.types import Observation
from starjax.sim import cameras as views
from starjax.sim import dynamics, endoscope_camera, physics, render, thread_geoms
from starjax.sim import scene as scenes
from starjax.sim.names import SceneNames
from starjax.sim.state import Env, EnvParams, EnvState, ImageSource
from starjax.sim.task import CONTROL_HZ, Task

__all__ = [
    "CONTROL_HZ",
    "Env",
    "EnvParams",
    "EnvState",
    "ImageSource",
    "for_policy",
    "make",
    "without_images",
]

SMALLEST_IMAGE = 16  # pixels per side


def make(
    task: str = DEFAULT_TASK,
    arms: Sequence[str] = (),
    tools: Sequence[str] = (),
    *,
    observation: str = "image",
    image_size: int = 256,
    cameras: Sequence[str] = (),
    shadow: bool = True,
    moving_cameras: bool = False,
    varying_look: bool = False,
    variant: Task | None = None,
) -> Env:
    """Builds an environment.

    Args:
      task: key of `registries.tasks`.
      arms, tools: keys of `registries.arms` and `registries.tools`: one per slot of the task, one
        for all slots, or none for the task's defaults.
      observation: "image" (pixels) or "state" (the task's fields instead).
      image_size: side of the cameras' square images in pixels.
      cameras: of the task; none for its first one.
      shadow: True for shadows of the sun.
      moving_cameras: True if `EnvParams.cameras` may move the cameras of an episode; else cameras
        fixed in the world are drawn faster, with identical pixels.
      varying_look: True if the images of an episode may have the look of a body cavity, see
        `EnvState.has_look`; its cameras are moving ones.
      variant: of the task, see `scene.load`.

    Raises:
      errors.UsageError: an unknown name, an unusable size, or jax in double precision.
    """
    if jnp.result_type(float) == jnp.float64:
        raise errors.UsageError("JAX_ENABLE_X64", "off, as the simulation is in float32", "on")
    errors.choice("observation", observation, ("image", "state"))
    if not isinstance(image_size, numbers.Integral) or image_size < SMALLEST_IMAGE:
        expected = f"a whole number of pixels, {SMALLEST_IMAGE} or more"
        raise errors.UsageError("image_size", expected, repr(image_size))
    scene = scenes.load(scenes.name(task, arms, tools, cameras), variant)
    names, scope = scene.names.cameras, endoscope_camera.of(scene.task, scene.names.cameras)
    moves = moving_cameras or varying_look
    scene_cameras = views.make(
        scene.mj_model, names, image_size, shadow, moves, scope, varying_look=varying_look
    )

    def start(key: jax.Array, params: EnvParams) -> EnvState:
        poses = (
            views.at_reset(scene_cameras, scope, key) if params.cameras is None else params.cameras
        )
        state = dynamics.reset(scene, key, params, poses)
        if varying_look:
            state = state.replace(has_look=jnp.zeros((), bool))
        if scope is None:
            return state
        here = next(i for i, name in enumerate(names) if endoscope_camera.is_endoscope(name))
        return state.replace(endoscope=jax.tree.map(lambda leaf: leaf[here], poses))

    def draw(source: ImageSource) -> dict[str, render.CameraImage]:
        qpos, points = thread_geoms.split(scene.mj_model, source.qpos)
        data = physics.kinematics(scene, qpos, source.p_world_trocar, source.layout)
        data = thread_geoms.placed(scene.mj_model, data, points)
        rgb = scene.task.colours(scene.bound, source.layout, jnp.asarray(scene.geom_rgb))
        return views.images(scene_cameras, source.cameras, data, rgb, source.has_look)

    def camera(state: EnvState) -> dict[str, render.CameraImage]:
        p_world_trocar = state.trocar.p_world_trocar
        place = state.coordinates, p_world_trocar, state.layout, state.cameras
        return draw(ImageSource(*place, state.has_look))

    def observe(state: EnvState) -> Observation:
        images = fields = None
        if observation == "image":
            images = {name: frame.rgb for name, frame in camera(state).items()}
        else:
            fields = scene.task.state(scene.bound, state.layout, state.measurements)
        return Observation(
            state.pose, state.gripper, images, fields, None, state.endoscope, state.wrist
        )

    return Env(
        reset=_precisely(start),
        step=_precisely(functools.partial(dynamics.step, scene)),
        observe=_precisely(observe),
        camera=_precisely(camera),
        draw=_precisely(draw),
        labels=lambda state: scene.task.label(state.layout),
        scene=scene,
        task=scene.task,
        names=scene.names,
        p_world_ref=scene.p_world_ref,
        control_hz=CONTROL_HZ,
    )


def without_images(env: Env) -> Env:
    """Returns the environment with observations that lack images and the task's fields."""
    return env._replace(observe=_observe_tools)


def _observe_tools(state: EnvState) -> Observation:
    return Observation(state.pose, state.gripper, None, None, None, state.endoscope, state.wrist)


def for_policy(
    scene: SceneNames, policy: PolicyConfig, arms: Sequence[str] = (), **options: Any
) -> Env:
    """Builds the environment of a scene with the observation of a policy.

    Args:
      scene: names of the task, arms, tools and cameras.
      policy: settings of the observation: its kind and image size.
      arms: robots instead of the scene's, unless empty.
      options: further arguments of `make`.
    """
    return make(
        scene.task,
        arms or scene.arms,
        scene.tools,
        observation=policy.observation,
        image_size=policy.image_size,
        cameras=scene.cameras,
        **options,
    )


def _precisely(f: Callable) -> Callable:
    """Returns `f` with float32 products: a GPU's default, TF32, costs the kinematics 0.2 mm."""

    @functools.wraps(f)
    def wrapped(*args):
        with jax.default_matmul_precision("highest"):
            return f(*args)

    return wrapped
