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

from starjax import errors, rcm
from starjax.config import DEFAULT_TASK, PolicyConfig
from starjax.sim import arm_motion, collision, endoscope_camera, ik, physics, render
from starjax.sim import cameras as views
from starjax.sim import scene as scenes
from starjax.sim.names import SceneNames
from starjax.sim.state import Env, EnvParams, EnvState, ImageSource
from starjax.sim.tasks.base import CONTROL_HZ, SimReadings, Task
from starjax.types import Command, Observation, Pose

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

RESET_IK_ITERATIONS = 40
# Energy (J) of the contact solver's error beyond which a step counts as diverged: it moves an arm's
# first joint by 10 mrad/s. 7 of 1,400 trials exceed 1e-7 at some step without harm.
MAX_SOLVER_ERROR = 1e-4
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
    scene_cameras = views.make(scene.mj_model, names, image_size, shadow, moving_cameras, scope)

    def start(key: jax.Array, params: EnvParams) -> EnvState:
        poses = (
            views.at_reset(scene_cameras, scope, key) if params.cameras is None else params.cameras
        )
        state = reset(scene, key, params, poses)
        if scope is None:
            return state
        here = names.index(endoscope_camera.NAME)
        return state.replace(endoscope=jax.tree.map(lambda leaf: leaf[here], poses))

    def draw(source: ImageSource) -> dict[str, render.CameraImage]:
        data = physics.kinematics(scene, source.qpos, source.p_world_trocar, source.layout)
        rgb = scene.task.colours(scene.bound, source.layout, jnp.asarray(scene.geom_rgb))
        return views.images(scene_cameras, source.cameras, data, rgb)

    def camera(state: EnvState) -> dict[str, render.CameraImage]:
        p_world_trocar = state.trocar.p_world_trocar
        return draw(ImageSource(state.physics.qpos, p_world_trocar, state.layout, state.cameras))

    def observe(state: EnvState) -> Observation:
        images = fields = None
        if observation == "image":
            images = {name: frame.rgb for name, frame in camera(state).items()}
        else:
            fields = scene.task.state(scene.bound, state.layout, state.measurements)
        return Observation(state.pose, state.gripper, images, fields, endoscope=state.endoscope)

    return Env(
        reset=_precisely(start),
        step=_precisely(functools.partial(step, scene)),
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

    def observe(state: EnvState) -> Observation:
        return Observation(state.pose, state.gripper, None, None, endoscope=state.endoscope)

    return env._replace(observe=observe)


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


def reset(scene: scenes.Scene, key: jax.Array, params: EnvParams, cameras: Pose) -> EnvState:
    """Starts an episode with objects and tips drawn by the task, and cameras `[C]`."""
    layout = scene.task.sample(scene.bound, key)
    trocar, measured_trocar = (
        rcm.trocar_frame(parameters, scene.p_world_ref, scene.roll_zero)
        for parameters in (params.trocar, params.measured_trocar or params.trocar)
    )
    count = len(scene.arms)
    tips = scene.task.tips(scene.bound, layout, trocar.p_world_trocar)
    start = jnp.concatenate([jnp.zeros((count, 1)), tips], axis=-1)
    pose, _ = rcm.ACTION_SPACES["rcm4"].decode(start, trocar)
    solved = [
        arm_motion.solve(
            bound, trocar.p_world_trocar[a], arm_motion.of(pose, a), None, RESET_IK_ITERATIONS
        )
        for a, bound in enumerate(scene.arms)
    ]
    q = tuple(q for q, _ in solved)
    no = jnp.zeros((), bool)
    is_lost = ~jnp.all(jnp.isfinite(trocar.p_world_trocar))
    state = physics.initial(scene, q, layout)
    opening, touch = jnp.ones(count), jnp.zeros(count, bool)
    still, contacts = jnp.zeros((count, 3)), physics.no_contacts(scene)
    readings = SimReadings(state.qpos, state.qvel, pose, still, opening, touch, contacts)
    first = EnvState(
        physics=state,
        q_target=q,
        q_velocity=tuple(jnp.zeros_like(x) for x in q),
        velocity=jnp.zeros((count, 7)),
        correction=jnp.zeros((count, 3)),
        gripper_target=jnp.ones(count),
        trocar=trocar,
        measured_trocar=measured_trocar,
        cameras=cameras,
        layout=layout,
        measurements=scene.task.measure(scene.bound, layout, readings, None),
        step=jnp.zeros((), jnp.int32),
        settled=jnp.zeros((), jnp.int32),
        stage=jnp.zeros((), jnp.int32),
        reward=jnp.zeros(()),
        done=is_lost,
        success=no,
        loose=no,
        lost=no,
        invalid=is_lost,
        collided=no,
        rcm_error=jnp.zeros(count),
        rcm_error_within=jnp.zeros(count),
        ik_error=jnp.stack([error for _, error in solved]),
        solver_error=jnp.zeros(()),
        touch=touch,
        pose=pose,
        gripper=opening,
    )
    return _measure(scene, first, contacts)


def step(scene: scenes.Scene, state: EnvState, command: Command) -> EnvState:
    """Advances one control period towards `command` `[A]`."""
    moves = [
        arm_motion.move(scene, a, state, arm_motion.of(command, a)) for a in range(len(scene.arms))
    ]
    dq, velocity, correction, gripper, ik_error = zip(*moves, strict=True)
    p_world_trocar, period = state.trocar.p_world_trocar, 1.0 / CONTROL_HZ
    after, result = physics.advance(
        scene,
        state.physics,
        state.q_target,
        dq,
        state.q_velocity,
        jnp.stack(gripper),
        p_world_trocar,
        period,
        state.layout,
        state.step * period,
        state.model,
    )
    moved = state.replace(
        physics=after,
        q_target=tuple(q + d for q, d in zip(state.q_target, dq, strict=True)),
        q_velocity=tuple(CONTROL_HZ * d for d in dq),
        velocity=jnp.stack(velocity),
        correction=jnp.stack(correction),
        gripper_target=jnp.stack(gripper),
        step=state.step + 1,
        ik_error=jnp.stack(ik_error),
        solver_error=result.solver_error,
        touch=result.touch,
        rcm_error_within=arm_motion.largest_within(scene, result.qpos, p_world_trocar),
    )
    moved = with_status(scene, _measure(scene, moved, result.contacts))
    stopped = state.replace(invalid=jnp.ones((), bool), done=jnp.ones((), bool))
    sound = physics.is_sound(scene, after) & (result.solver_error < MAX_SOLVER_ERROR)
    moved = _select(sound, moved, stopped)
    return _select(state.done, state, moved)


def with_status(scene: scenes.Scene, state: EnvState) -> EnvState:
    """Returns the measured state with its outcome."""
    status = scene.task.status(scene.bound, state.layout, state.measurements)
    settled = jnp.where(status.success_now, state.settled + 1, 0)
    success = settled >= scene.task.settle_steps
    return state.replace(
        settled=settled,
        success=success,
        loose=state.loose | status.loose,
        lost=state.lost | status.lost,
        stage=status.stage,
        reward=status.reward,
        done=success | state.lost | status.lost,
    )


def _measure(scene: scenes.Scene, state: EnvState, contacts: "physics.Contacts") -> EnvState:
    qpos, p_world_trocar = state.physics.qpos, state.trocar.p_world_trocar
    kinematics = [
        ik.forward(scenes.chain_at(bound, p_world_trocar[a]), qpos[bound.q])
        for a, bound in enumerate(scene.arms)
    ]
    pose = jax.tree.map(lambda *x: jnp.stack(x), *(pose for pose, _, _ in kinematics))
    opening = physics.openings(scene, qpos)
    velocity = CONTROL_HZ * (pose.p - state.pose.p)
    readings = SimReadings(qpos, state.physics.qvel, pose, velocity, opening, state.touch, contacts)
    measurements = scene.task.measure(scene.bound, state.layout, readings, state.measurements)
    hit = collision.detect(
        scene.arms,
        pose,
        [origins for _, origins, _ in kinematics],
        p_world_trocar,
        scene.task.obstacles(scene.bound, state.layout, measurements),
        scene.task.floor,
    )
    rcm_error = rcm.rcm_error(pose, p_world_trocar)
    return state.replace(
        pose=pose,
        gripper=opening,
        measurements=measurements,
        rcm_error=rcm_error,
        rcm_error_within=jnp.maximum(state.rcm_error_within, rcm_error),
        collided=state.collided | hit,
    )


def _precisely(f: Callable) -> Callable:
    """Returns `f` with float32 products: a GPU's default, TF32, costs the kinematics 0.2 mm."""

    @functools.wraps(f)
    def wrapped(*args):
        with jax.default_matmul_precision("highest"):
            return f(*args)

    return wrapped


def _select(which: jax.Array, a: EnvState, b: EnvState) -> EnvState:
    return jax.tree.map(lambda x, y: jnp.where(which, x, y), a, b)
